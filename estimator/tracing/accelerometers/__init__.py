"""Effects of accelerometers that the four states do not cover, traced in runs on a table."""
