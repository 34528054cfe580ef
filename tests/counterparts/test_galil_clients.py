"""QCoDeS' driver of a Galil DMC-4133 sets up, moves, stops and aborts the twin."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from strangers import HERE, needs_python
from support import TwinProcess

BENCH = Path(__file__).parents[1] / "data" / "benches" / "galil_j1939.toml"


@needs_python("qcodes", "qcodes")
def test_qcodes_drives_the_twin() -> None:
    with TwinProcess("--bench", BENCH) as twin:
        words = [sys.executable, str(HERE / "galil" / "session.py"), twin.links["table"].removeprefix("tcp://")]
        done = subprocess.run(words, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == {
        "idn": {"vendor": "Galil Motion Control, Inc.", "model": "DMC4030", "serial": "9046", "firmware": "1.2c"},
        "delivered": "off",
        "servo": "on",
        "kept": True,
        "off on error": "enable for position, amp error or abort",
        "moves": 1,
        "at": "10000",
        "target": {"A": 10_000, "B": 0, "C": 0},
        "deceleration": 204_800,
        "refused": "20 Begin not valid with motor off",
        "stopped": 0,
        "aborted": [0, "off"],
        "off": "off",
    }
