"""The two ways in which numbers can be refused."""


class EstimatorError(Exception):
    """Data that cannot be used; the message says why and what to do."""


def first_line(error: BaseException) -> str:
    """Return the first line of an error's text, else its type; HDF5's further lines are for its developers."""
    return str(error).splitlines()[0] if str(error) else type(error).__name__


MISSHAPEN = (OSError, AttributeError, TypeError, ValueError, LookupError, ArithmeticError, RuntimeError, MemoryError)
"""What reading a file can raise that was made by hand, or to do harm."""


class GeometryError(EstimatorError):
    """An impossible sensor array: singular, axes that are not unit vectors, or skewed triads."""


class RecordingError(EstimatorError):
    """A file that is not a readable recording, or one that lacks what an estimate needs."""


class InvestigationError(EstimatorError):
    """Recordings that cannot be investigated together, or at all; the message says why and what to do."""
