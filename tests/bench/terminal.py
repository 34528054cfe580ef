"""A program in a pseudo-terminal, and the cells of the screen that it has drawn.

python tests/bench/terminal.py --size 120x40 --keys 8 f7 10 -- ui --operator "A. Operator"    prints the cells
"""

from __future__ import annotations

import argparse
import fcntl
import os
import pty
import re
import signal
import struct
import sys
import termios
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

import pyte
from pyte.screens import Char
from support import command

KEYS = {
    "enter": b"\r",
    "tab": b"\t",
    "escape": b"\x1b",
    "down": b"\x1b[B",
    "f1": b"\x1bOP",
    "f2": b"\x1bOQ",
    "f3": b"\x1bOR",
    "f4": b"\x1bOS",
    "f5": b"\x1b[15~",
    "f6": b"\x1b[17~",
    "f7": b"\x1b[18~",
    "f8": b"\x1b[19~",
    "f9": b"\x1b[20~",
    "f10": b"\x1b[21~",
    "ctrl+q": b"\x11",
}
"""What terminals of the xterm family send."""
_LOOK_S = 0.05
_TITLE = re.compile(r"[─━] ([^ ─━]+)(?: [^─━]*)? [─━]")


class Terminal:
    """A program in a pseudo-terminal.

    Its output is kept as bytes; the screen is made of them when it is looked at, so that reading costs nothing.
    Used as a context, it ends the program.
    """

    def __init__(
        self, arguments: list[str], columns: int, rows: int, variables: Mapping[str, str] | None = None
    ) -> None:
        """Start the program in a terminal of a size, with environment ``variables`` beside those that are set."""
        self.began_s = time.monotonic()
        self.bytes = 0
        self._columns = columns
        self._screen = pyte.Screen(columns, rows)
        self._stream = pyte.ByteStream(self._screen)
        self._unread = bytearray()
        self._lock = threading.Lock()
        own = {name: text for name, text in os.environ.items() if name not in ("COLUMNS", "LINES", "NO_COLOR")}
        environment = {
            **own,
            "TERM": "xterm-256color",
            "COLORTERM": "truecolor",
            "LANG": "C.UTF-8",
            **(variables or {}),
        }
        self.pid, self._fd = pty.fork()
        if self.pid == 0:  # the size before the program: it must not begin at another
            fcntl.ioctl(pty.STDOUT_FILENO, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
            os.execve(arguments[0], arguments, environment)
        threading.Thread(target=self._read, daemon=True).start()

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def press(self, *keys: str) -> None:
        """Press keys by name; what is no name of a key is typed."""
        for key in keys:
            self.write(KEYS.get(key, key.encode()))

    def write(self, data: bytes) -> None:
        """Write bytes as the terminal would."""
        os.write(self._fd, data)

    def cells(self) -> list[list[Char]]:
        """Return the cells of the screen, row by row."""
        with self._lock:
            data, self._unread = bytes(self._unread), bytearray()
            self._stream.feed(data)
            rows = [self._screen.buffer[number] for number in range(self._screen.lines)]
            return [[row[column] for column in range(self._columns)] for row in rows]

    def rows(self) -> list[str]:
        """Return the text of the screen, row by row."""
        return ["".join(cell.data for cell in row) for row in self.cells()]

    def text(self) -> str:
        """Return the text of the screen."""
        return "\n".join(row.rstrip() for row in self.rows())

    def wait_for(self, holds: str | Callable[[str], bool], limit_s: float = 60.0) -> str:
        """Wait until a text is on the screen, or until ``holds(text)``; return the text.

        TimeoutError with the screen.
        """
        deadline_s = time.monotonic() + limit_s
        while True:
            text = self.text()
            if holds in text if isinstance(holds, str) else holds(text):
                return text
            if time.monotonic() > deadline_s:
                raise TimeoutError(f"after {limit_s:g} s the terminal shows\n{text}")
            time.sleep(_LOOK_S)

    def charts(self) -> dict[str, int]:
        """Return by the name of each chart how many cells of it hold dots of a curve."""
        return plotted(self.rows())

    def cpu_s(self) -> float:
        """Return the processor time that the program has used."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def close(self) -> None:
        """End the program."""
        with suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)
        os.waitpid(self.pid, 0)
        os.close(self._fd)

    def _read(self) -> None:
        while True:
            try:
                data = os.read(self._fd, 65536)
            except OSError:
                return
            with self._lock:
                self._unread += data
            self.bytes += len(data)


def plotted(rows: list[str]) -> dict[str, int]:
    """Return by the name of each chart on a screen how many of its cells hold dots of a curve.

    A chart begins at the line above it, "─ name words ───", and ends at the next such line in its columns.
    """
    found: dict[str, int] = {}
    charts: list[tuple[int, int, str]] = []  # first column, column after the last, name
    for row in rows:
        titles = list(_TITLE.finditer(row))
        ends = [*(title.start() for title in titles[1:]), len(row)]
        for title, end in zip(titles, ends, strict=False):
            charts = [chart for chart in charts if chart[1] <= title.start() or chart[0] >= end]
            charts.append((title.start(), end, title[1]))
            found.setdefault(title[1], 0)
        for start, end, name in charts:
            found[name] += sum("\u2801" <= cell <= "\u28ff" or cell == "●" for cell in row[start:end])
    return found


def main() -> None:
    """Start the program, press keys, print the cells."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="120x40", help="columns x rows; default: 120x40")
    parser.add_argument("--keys", nargs="*", default=[], help="keys by name, or text; a number waits so many seconds")
    parser.add_argument("words", nargs="+", help="the command line of the station")
    arguments = parser.parse_args()
    columns, rows = map(int, arguments.size.split("x"))
    with Terminal(command(*arguments.words), columns, rows) as terminal:
        for key in arguments.keys:
            if key.replace(".", "", 1).isdigit():
                time.sleep(float(key))
            else:
                terminal.press(key)
        print(terminal.text())
        print(terminal.charts(), file=sys.stderr)


if __name__ == "__main__":
    main()
