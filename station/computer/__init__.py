"""The computer beside the table: what of it stands in the way of a run, and the command that helps."""
