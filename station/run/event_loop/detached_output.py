"""Output that a run does not depend on: its reader may be gone, or slow without limit."""

import os
import queue
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO, cast

_MOST_WAITING = 1 << 16  # characters; further text is dropped while so many wait
_LAST_WORDS_S = 1.0


class _LastingStream:
    """A text stream that writes to nowhere once its far end is gone (EIO of a terminal, EPIPE of a pipe)."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        with self._lasting():
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with self._lasting():
            self._stream.flush()

    @contextmanager
    def _lasting(self) -> Iterator[None]:
        """Redirect the stream to os.devnull if it raises OSError within this context; the error is dropped."""
        try:
            yield
        except OSError:
            with suppress(OSError):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, self._stream.fileno())
                os.close(nowhere)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class _PatientStream:
    """A text stream written by a separate thread, so that nobody waits for its far end.

    The thread writes to the descriptor directly, so that it holds no lock that a later print would wait for.
    """

    def __init__(self, stream: TextIO) -> None:
        """Flush the stream and start the thread that writes; UnsupportedOperation, an OSError, if it has no
        descriptor."""
        self._stream = stream
        self._descriptor = stream.fileno()
        stream.flush()
        self._waiting = 0
        self._texts: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write_all, name="output", daemon=True)
        self._thread.start()

    def write(self, text: str) -> int:
        if text and self._waiting + len(text) <= _MOST_WAITING:
            self._waiting += len(text)
            self._texts.put(text)
        return len(text)

    def flush(self) -> None:
        """Do nothing: the thread writes texts as soon as it can."""

    def end(self, limit_s: float) -> None:
        """Let the thread end after the last text; wait for that until an instant of the monotonic clock."""
        self._texts.put("")
        self._thread.join(max(limit_s - time.monotonic(), 0.0))

    def _write_all(self) -> None:
        """Write queued texts until an empty one comes, and take each off ``_waiting``; what cannot be written is
        dropped."""
        errors = self._stream.errors or "replace"
        while text := self._texts.get():
            with suppress(OSError):  # its reader is gone
                data = memoryview(text.encode(self._stream.encoding, errors))
                while data:
                    data = data[os.write(self._descriptor, data) :]
            self._waiting -= len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def lasting_streams() -> Iterator[None]:
    """Keep stdout and stderr usable within this context when their far ends are gone; restore them afterwards."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (stream and cast(TextIO, _LastingStream(stream)) for stream in before)
    try:
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()
        sys.stdout, sys.stderr = before


@contextmanager
def patient_streams() -> Iterator[None]:
    """Let no print within this context wait for a held terminal (Ctrl-S, a lost connection) or an unread pipe.

    Lost is what they have not accepted a second after the end, and what is printed while 64 KiB wait. Streams without a
    descriptor are left as they are. POSIX only.
    """
    before = sys.stdout, sys.stderr
    patient = []
    try:
        for name in ("stdout", "stderr"):
            stream = getattr(sys, name)
            if stream is None or os.name != "posix":
                continue
            with suppress(OSError):  # without a descriptor it is in memory
                patient.append(_PatientStream(stream))
                setattr(sys, name, patient[-1])
        yield
    finally:
        sys.stdout, sys.stderr = before
        limit_s = time.monotonic() + _LAST_WORDS_S
        for own in patient:
            own.end(limit_s)
