"""The operator's screen (textual): a client of the commands and of a running session; it drives no table itself."""
