"""Every table and IMU passes the suites of `station conformance`, and what is wrong with one is told in words."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from drivers.imus.registry import IMUS
from drivers.plugins import load_file, records_of
from drivers.specs import ImuSpec, TableSpec
from drivers.tables.registry import TABLES
from station.cli import main
from station.commands.conformance import complaint, suites_of

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
FILES = [EXAMPLES / "counted_imu.py", EXAMPLES / "numbered_table.py"]
# test_table_conformance tries the station's own tables harder, on wires of its own.
DEVICES = [
    pytest.param(spec, suite, id=f"{name} {suite}", marks=[pytest.mark.full] if name in TABLES else [])
    for name, spec in (*IMUS.items(), *TABLES.items())
    for suite in suites_of(spec)
]


@pytest.mark.parametrize(("spec", "suite"), DEVICES)
def test_a_device_of_the_station_passes(spec: ImuSpec | TableSpec, suite: str) -> None:
    assert complaint(spec, suite) == ""


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_the_examples_pass_and_each_suite_is_told(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["conformance", str(path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["ok"]
    assert all(finding["wrong"] == "" for finding in told["findings"])
    assert len(told["findings"]) == 6


@pytest.mark.parametrize(
    ("file", "right", "wrong", "suite", "told"),
    [
        (
            "counted_imu",
            "[new] * self._lsb",
            "[new] * 2 * self._lsb",
            "units",
            "says 39.* deg/s where it turns at 20.00",
        ),
        ("counted_imu", "1 / setup.rate_hz, 1", "1.1 / setup.rate_hz, 1", "clock", "sample times do not always go up"),
        ("counted_imu", "ImuBlock(t_ns, arr", "ImuBlock(t_ns - 50_000_000, arr", "clock", "are [45]. ms too early"),
        ("counted_imu", "counts = self._clock.counts", "counts = SourceCounts()", "loss", "and 0 were counted as lost"),
        (
            "counted_imu",
            "self._rest += data",
            "self._rest = data",
            "framing cut anywhere",
            "ended with|no samples came",
        ),
        ("counted_imu", "int.from_bytes(frame[-2:]):", "0 or True:", "garbage", "damaged samples .* went through"),
        (
            "counted_imu",
            "yield self._device, block",
            "yield self._device, block\n                return",
            "unplugged",
            "LinkLost",
        ),
        (
            "numbered_table",
            "{math.degrees(value):.6f}",
            "{9 / 10 * math.degrees(value):.6f}",
            "units",
            "at 18.00 by its rate",
        ),
        ("numbered_table", " if int(found[1]) == number)", ")", "loss", "ended with"),
        ("numbered_table", 'await self._rest(lambda axis: (f"stop {axis}",), self.read)', '""', "stop", "still turned"),
        (
            "numbered_table",
            "await self._exchange.open()",
            'raise ValueError("no")',
            "abort",
            "ended with ValueError: no",
        ),
    ],
)
def test_what_is_wrong_with_one_is_told(
    tmp_path: Path, file: str, right: str, wrong: str, suite: str, told: str
) -> None:
    text = (EXAMPLES / f"{file}.py").read_text()
    assert text.count(right) == 1
    path = tmp_path / "mine.py"
    path.write_text(text.replace(right, wrong))
    module = load_file(path)
    (spec,) = [*records_of(module, ImuSpec), *records_of(module, TableSpec)]
    assert re.search(told, complaint(spec, suite, [path]))


def test_no_device_at_all_is_told_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["conformance", "vectornaw"]) == 2
    assert "did you mean vectornav?" in capsys.readouterr().err
