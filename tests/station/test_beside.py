"""What only serves those who look on fails in the middle of a run: the run goes on, and says so once."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import pytest

from station.cli import main

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
FAILING = """
_told = CountedImu.{method}


def _failing(self, name):
    if self._clock.counts.samples > 300:
        raise RuntimeError("deque mutated during iteration")
    return _told(self, name)


CountedImu.{method} = _failing
"""
AXIS = '[table.{}]\nmax_rate = "100 deg/s"\nmax_acceleration = "50 deg/s2"\n'
BENCH = (
    'plugins = ["numbered_table.py", "failing_imu.py"]\n[undeclared]\neffects = "none"\n'
    '[table]\nprotocol = "numbered"\npoll_rate = "5 Hz"\n'
    + "".join(map(AXIS.format, "zyx"))
    + """
[[imu]]
name = "mine"
protocol = "counted"
array = "triad"
rate = "50 Hz"
resolution = "18 deg/h"
[imu.datasheet]
arw = "0.005 deg/s/rtHz"
[limits]
bias = "2 deg/s"
"""
)


SCRIPT = '[[step]]\nkind = "rest"\nduration = "4 s"\n' + "".join(
    f'[[step]]\nkind = "rotate"\naxis = "{axis}"\nrate = "40 deg/s"\nacceleration = "40 deg/s2"\nduration = "5 s"\n'
    for axis in "xyz"
)
ENDLESS = """
def _fails(self):
    raise RuntimeError("nothing is left to flush")


CountedImu.flush = _fails
"""


def benched(folder: Path, change: str) -> Path:
    """Write a bench with the IMU of the examples, changed, and return it."""
    counted = (EXAMPLES / "counted_imu.py").read_text()
    (folder / "failing_imu.py").write_text(counted + change)
    (folder / "numbered_table.py").write_text((EXAMPLES / "numbered_table.py").read_text())
    (folder / "bench.toml").write_text(BENCH)
    (folder / "script.toml").write_text(SCRIPT)
    return folder / "bench.toml"


def test_a_driver_that_fails_whenever_a_run_is_to_end_is_told_without_a_traceback(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench, recording = benched(tmp_path, ENDLESS), tmp_path / "run.h5"
    script = str(tmp_path / "script.toml")
    code = main(["run", "--bench", str(bench), "--script", script, "--json", "--seed", "3", "-o", str(recording)])
    found = json.loads(capsys.readouterr().out)
    assert (found["outcome"], code) == ("ABORTED", 3)
    assert "nothing is left to flush (failing_imu.py" in found["reason"]
    assert "did not end properly" in found["reason"]
    with h5py.File(recording) as file:
        assert file.attrs["outcome"] == "ABORTED"
        assert file.attrs["reason"] == found["reason"]
        assert len(file["table/t_ns"]) > 50


@pytest.mark.parametrize(("method", "what"), [("counts", "counts of mine"), ("alignment", "clock of mine")])
def test_a_driver_that_fails_to_tell_its_counts_or_its_clock_ends_no_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], method: str, what: str
) -> None:
    bench, recording = benched(tmp_path, FAILING.format(method=method)), tmp_path / "run.h5"
    script = str(tmp_path / "script.toml")
    code = main(["run", "--bench", str(bench), "--script", script, "--json", "--seed", "3", "-o", str(recording)])
    printed = capsys.readouterr()
    found = json.loads(printed.out)
    assert (found["outcome"], code) == ("PASS", 0), found["reason"]
    assert printed.err.count(f"note: {what} failed") == 1
    assert "the run continues" in printed.err
    with h5py.File(recording) as file:
        texts = [text.decode() for text in file["events/text"][:]]
    assert sum(text.startswith(f"{what} failed") for text in texts) == 1
