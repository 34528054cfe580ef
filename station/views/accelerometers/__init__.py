"""Accelerometers for tables and for JSON: results, findings of an investigation, plans."""
