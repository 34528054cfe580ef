"""Work that serves only those who look on: a defect there must not end a run."""

import logging
from collections.abc import Callable
from typing import TypeVar

from station.errors import sentence

_log = logging.getLogger(__name__)

T = TypeVar("T")


class Beside:
    """Does what is beside the run: counts, snapshots, progress, telling of events."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        """``tell`` is given one sentence for each piece of work that fails, the first time it does."""
        self._tell = tell
        self._failed: set[str] = set()
        self.notes: list[str] = []
        """What has been told."""

    def attempt(self, what: str, work: Callable[[], T], otherwise: T) -> T:
        """Return what ``work`` returns, or ``otherwise`` if it raises; ``what`` names it to the operator.

        A lack of memory is raised: it is one of the computer, and the next to meet it would be the recording.
        """
        try:
            return work()
        except MemoryError:
            raise
        except Exception as error:  # whatever a driver, a plug-in or the station itself has wrong
            self.failed(what, error)
            return otherwise

    def failed(self, what: str, error: Exception) -> None:
        """Log that a piece of work failed, and tell it, once."""
        if what in self._failed:
            return
        self._failed.add(what)
        _log.error("%s failed; the run goes on", what, exc_info=error)
        note = sentence("run.beside_failed", what=what, error=f"{type(error).__name__}: {error}")
        self.notes.append(note)
        self._tell(note)
