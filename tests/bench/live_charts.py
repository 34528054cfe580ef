"""Charts of live screens, in a real terminal: how many screens have filled charts, how much of them is empty.

python tests/bench/live_charts.py               START pressed at five sizes, then Prepare; attached at five sizes
python tests/bench/live_charts.py --sizes 80x24 --seconds 15

Exits with 1 if no chart of a screen has a curve, or if the bottom half of a screen is mostly empty.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import tempfile
import time
from pathlib import Path

from support import command
from terminal import Terminal

SIZES = ("80x24", "100x30", "120x40", "160x50", "200x60")
_FEW_CELLS = 10
_MOST_EMPTY = 0.5
"""Share of the rows in the bottom half of a screen without any text."""


def empty_share(rows: list[str]) -> float:
    """Return the share of empty rows in the bottom half of a screen."""
    bottom = rows[len(rows) // 2 :]
    return sum(not row.strip() for row in bottom) / len(bottom)


class Tally:
    """Screens that were looked at, and those with filled charts."""

    def __init__(self) -> None:
        self.looked = 0
        self.filled = 0

    def look(self, name: str, terminal: Terminal, seconds: float, *, text_may_fill: bool = False) -> None:
        """Look for a while until a chart in sight has a curve; print and count what was seen.

        With ``text_may_fill`` it is enough that no chart is in sight and the room is taken by text.
        """
        deadline_s = time.monotonic() + seconds
        good = False
        while not good and time.monotonic() < deadline_s:
            time.sleep(0.5)
            rows = terminal.rows()
            charts = terminal.charts()
            filled = any(cells >= _FEW_CELLS for cells in charts.values()) or (text_may_fill and not charts)
            good = filled and empty_share(rows) <= _MOST_EMPTY
        self.looked += 1
        self.filled += good
        drawn = sum(cells >= _FEW_CELLS for cells in charts.values())
        share = empty_share(rows)
        print(f"{name:24} {drawn} of {len(charts)} charts filled, bottom half {share:.0%} empty", flush=True)


def main() -> int:
    """Look at the screens and print; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="*", default=SIZES, help="columns x rows")
    parser.add_argument("--seconds", type=float, default=30.0, help="how long a screen may take; default: 30")
    arguments = parser.parse_args()
    tally = Tally()
    for size in arguments.sizes:
        columns, rows = map(int, size.split("x"))
        with tempfile.TemporaryDirectory(prefix="st-") as folder:
            variables = dict.fromkeys(("XDG_RUNTIME_DIR", "XDG_STATE_HOME", "TMPDIR"), folder)
            options = ("--folder", folder, "--scale", "1")
            with Terminal(command("ui", *options), columns, rows, variables=variables) as terminal:
                terminal.wait_for("Operator")
                terminal.press("A. Operator", "enter", "SN-0042")
                terminal.wait_for("READY  the table", limit_s=120)
                tally.look(f"{size} Prepare", terminal, arguments.seconds, text_may_fill=True)
                terminal.press("f7")
                terminal.wait_for("script begins", limit_s=120)
                tally.look(f"{size} Run", terminal, arguments.seconds)
            # The session outlives its screen: another one attaches to it.
            with Terminal(
                command("ui", "--attach", "--folder", folder), columns, rows, variables=variables
            ) as terminal:
                tally.look(f"{size} Run, attached", terminal, arguments.seconds)
            stop_sessions(Path(folder))
    print(f"{tally.filled} of {tally.looked} live screens are filled, with curves; load {os.getloadavg()[0]:.1f}")
    return int(tally.filled < tally.looked)


def stop_sessions(folder: Path) -> None:
    """Bring the sessions of a folder to rest and wait for their end."""
    for path in (folder / f"station-{os.getuid()}").glob("*.sock"):
        os.kill(int(path.stem), signal.SIGINT)
        subprocess.run(["tail", "--pid", path.stem, "-f", "/dev/null"], timeout=60, check=False)


if __name__ == "__main__":
    raise SystemExit(main())
