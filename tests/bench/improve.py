"""How soon a found script reaches the sigmas of the 360 s script, and how long finding it takes.

python tests/bench/improve.py
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path

from support import station

BARS = (("all states", (), 165.0), ("k and misalignments", ("--states", "k,sigma"), 40.0))
SEARCH_BAR_S = 30.0


def main() -> int:
    """Print each bar with what was found; 1 if one is missed."""
    missed = False
    for name, arguments, bar_s in BARS:
        with tempfile.TemporaryDirectory() as folder:
            began_s = time.perf_counter()
            done = station("plan", "--improve", "--json", "-o", Path(folder) / "found.toml", *arguments)
            took_s = time.perf_counter() - began_s
        found = json.loads(done.stdout)
        length_s = found["duration_with_sequencer_s"]
        missed |= not found["reached"] or length_s > bar_s or took_s > SEARCH_BAR_S
        print(
            f"{name}: {length_s:.1f} s with the sequencer (bar {bar_s:g} s), reached: {found['reached']}; "
            f"found in {took_s:.1f} s (bar {SEARCH_BAR_S:g} s), {found['compared']} combinations of turns"
        )
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
