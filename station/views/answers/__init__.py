"""Answers of commands, as --json prints them and as the screen reads them back."""
