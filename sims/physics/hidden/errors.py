"""What is wrong with a hidden-effects file."""


class HiddenError(ValueError):
    """A hidden effect that cannot be what it says; the message names file, table and key where there are such."""
