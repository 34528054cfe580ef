"""What is printed of accelerometers: results, findings of an investigation, plans."""
