"""The computer beside the table: its obstacles to a run, and commands that remove them."""
