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
FILES = {"counted_imu.py": 6, "numbered_table.py": 6, "climate_chamber.py": 4}
# test_table_conformance tries the station's own tables harder, on its own wires; tests of each decoder cut and spoil.
LONG = ("framing cut anywhere", "garbage", "clock", "loss")
DEVICES = [
    pytest.param(spec, suite, id=f"{name} {suite}", marks=[pytest.mark.full] if name in TABLES or suite in LONG else [])
    for name, spec in (*IMUS.items(), *TABLES.items())
    for suite in suites_of(spec)
]


@pytest.mark.parametrize(("spec", "suite"), DEVICES)
def test_a_device_of_the_station_passes(spec: ImuSpec | TableSpec, suite: str) -> None:
    assert complaint(spec, suite) == ""


@pytest.mark.parametrize(("file", "suites"), FILES.items())
def test_the_examples_pass_and_each_suite_is_told(file: str, suites: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["conformance", str(EXAMPLES / file), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["ok"]
    assert all(finding["wrong"] == "" for finding in told["findings"])
    assert len(told["findings"]) == suites


FRAMES = """
rate = ["a", "b", "c"]
counter = "count"
[units]
rate = "deg/s"
[frame]
bytes = 16
sync = "AB CD"
byte_order = "big"
check = { name = "CRC-16/XMODEM", at = -2 }
[frame.fields]
count = { at = 2, type = "u24" }
a = { at = 5, type = "i24", scale = 0.0001 }
b = { at = 8, type = "i24", byte_order = "little", scale = 0.0001 }
c = { at = 11, type = "i24", scale = 0.0001 }
"""
"""Numbers of three bytes, the first byte of them first or last."""


@pytest.mark.parametrize("rates", ['["a", "b", "c"]', '["a", "b", "c", "a"]'])
def test_an_imu_that_a_file_describes_is_tried(tmp_path: Path, capsys: pytest.CaptureFixture[str], rates: str) -> None:
    (tmp_path / "own.toml").write_text(FRAMES.replace('["a", "b", "c"]', rates))
    assert main(["conformance", str(tmp_path / "own.toml"), "--json"]) == 0
    findings = json.loads(capsys.readouterr().out)["findings"]
    assert [finding["suite"] for finding in findings] == list(suites_of(IMUS["described"]))
    assert not any(finding["wrong"] for finding in findings)


@pytest.mark.parametrize(
    ("right", "wrong", "told"),
    [('"u24"', '"u20"', r"own.toml, line 12: frame.fields.count.type"), (', "c"]', "]", r"own.toml describes 2 gyros")],
)
def test_what_is_wrong_with_a_description_is_told_before_anything_is_tried(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], right: str, wrong: str, told: str
) -> None:
    (tmp_path / "own.toml").write_text(FRAMES.replace(right, wrong))
    assert main(["conformance", str(tmp_path / "own.toml")]) == 2
    printed = capsys.readouterr()
    assert re.search(told, printed.err)
    assert printed.out == ""


@pytest.mark.parametrize(
    ("file", "right", "wrong", "suite", "told"),
    [
        (
            "counted_imu",
            "[new] * self._lsb",
            "[new] * 2 * self._lsb",
            "units",
            "says 40.00 deg/s while it turns at 20.00",
        ),
        (
            "counted_imu",
            "1 / setup.rate_hz, 1",
            "1.1 / setup.rate_hz, 1",
            "clock",
            "sample times do not always increase",
        ),
        ("counted_imu", "t_ns=t_ns,", "t_ns=t_ns - 50_000_000,", "clock", "are [45]. ms too early"),
        ("counted_imu", "counts = self._clock.counts", "counts = SourceCounts()", "loss", "and 0 were counted as lost"),
        (
            "counted_imu",
            "self._rest += data",
            "self._rest = data",
            "framing cut anywhere",
            "ended with|no samples came",
        ),
        ("counted_imu", "int.from_bytes(frame[-2:]):", "0 or True:", "garbage", "damaged samples .* were accepted"),
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
        (
            "counted_imu",
            "block = self._block(await self._link.receive())",
            "block = [][await self._link.receive()]",
            "units",
            "^no samples came; it ended with TypeError: list indices .*mine.py, line 7",
        ),
        ("counted_imu", "yield self._device, block", "if not block: yield", "units", "^no samples came$"),
        ("counted_imu", "    twin=CountedTwin,\n", "", "units", "counted has no twin: its SPEC needs one"),
        ("counted_imu", "    def flush(self)", "    def flash(self)", "units", "the driver has no flush"),
        ("numbered_table", "async def disable", "async def disabel", "units", "the driver has no disable"),
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


@pytest.mark.parametrize("forever", ["while True: pass", "while True: await asyncio.sleep(0)"])
def test_a_driver_that_never_comes_back_is_told_with_its_line(tmp_path: Path, forever: str) -> None:
    path = tmp_path / "mine.py"
    text = (EXAMPLES / "counted_imu.py").read_text()
    path.write_text(
        text.replace("            block = self._block(", f"            {forever}\n            block = self._block(")
    )
    (spec,) = records_of(load_file(path), ImuSpec)
    assert re.search("does not return within 1 s", complaint(spec, "units", [path], within_s=1))


def test_what_follows_from_a_wrong_unit_is_not_told_as_more_faults(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "mine.py"
    path.write_text((EXAMPLES / "counted_imu.py").read_text().replace("[new] * self._lsb", "[new] * -self._lsb"))
    assert main(["conformance", str(path)]) == 1
    said = capsys.readouterr().out.splitlines()
    assert [line for line in said if line.startswith("FAIL")] == [said[0]]
    assert "skip  counted, clock: it needs correct rates, and units fails" in said


@pytest.mark.parametrize(
    ("right", "wrong", "told"),
    [
        (
            "yield round(asyncio.get_running_loop().time() * 1e9), (",
            "yield 1, (",
            "instants of its series do not always",
        ),
        ('f"TEMP, S{SAFE_C:.1f}"', 'f"TEMP, X{SAFE_C:.1f}"', "it was told to go to 25 degC and goes to 27 degC"),
    ],
)
def test_a_device_of_another_kind_that_is_wrong_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], right: str, wrong: str, told: str
) -> None:
    text = (EXAMPLES / "climate_chamber.py").read_text()
    assert right in text
    (tmp_path / "mine.py").write_text(text.replace(right, wrong))
    assert main(["conformance", str(tmp_path / "mine.py")]) == 1
    assert told in " ".join(capsys.readouterr().out.split())


def test_a_file_without_a_device_is_told_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.py").write_text("x = 1")
    assert main(["conformance", str(tmp_path / "mine.py")]) == 2
    assert "mine.py has no ImuSpec and no TableSpec" in capsys.readouterr().err
