"""Kinds of steps of a script, one module each."""
