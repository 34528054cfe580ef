"""Accelerometers on a table: runs of specific force, laws that only they have, the estimate."""
