"""JSON Schemas for editors: they take every file that the station takes, and underline what it refuses."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from jsonschema import Draft7Validator

from drivers.tables.modbus.registers import PROFILE_FOLDER
from station.bench.bench import default_bench_text
from station.bench.can_mappings import MAPPING_FOLDER
from station.bench.descriptions import DESCRIPTIONS
from station.cli import main

ROOT = Path(__file__).parents[2]
SCHEMAS = ROOT / "docs/pages/reference/schemas"
SCRIPT = """
name = "there and back"
[[step]]
kind = "rest"
duration = "3 s"
[[step]]
kind = "move"
axis = "x"
rate = "3 deg/s"
angle = "90 deg"
[[step]]
kind = "rotate"
axis = "x"
rate = "-3 deg/s"
duration = "90 s"
"""


HIDDEN = """
devices = ["array"]
[temperature]
rise = "8 degC"
shape = "linear"
[thermal_bias]
linear = ["0.005 deg/s/degC", "1 deg/h/degC"]
[[tone]]
size = "0.1 deg/s"
frequency = "7 Hz"
[[tone]]
size = "0.1 deg/s"
frequency = "9 Hz"
[sample_hold]
samples = 3
"""


MAPPING = """
[device]
name = "unit 7"
[file]
format = "csv"
[time]
column = "t"
unit = "ms"
[gyro]
columns = ["gx", "gy", "gz"]
unit = "raw"
count = 0.061
count_unit = "deg/s"
axes = ["x", "-y", [0, 0, 1]]
[reference]
kind = "turns"
sd_deg = 0.5
[reference.sections]
up = { axis = "z", angle_deg = 90, start_s = 1, end_s = 2 }
"""


def valid(kind: str) -> Draft7Validator:
    schema = json.loads((SCHEMAS / f"{kind}.json").read_text(encoding="utf-8"))
    Draft7Validator.check_schema(schema)
    return Draft7Validator(schema)


def files() -> Iterator[tuple[str, str]]:
    yield "bench", default_bench_text()
    yield "script", SCRIPT
    yield "hidden", HIDDEN
    for kind, folder in (
        ("bench", ROOT / "tests/data/benches"),
        ("can_mapping", MAPPING_FOLDER),
        ("description", DESCRIPTIONS),
        ("profile", PROFILE_FOLDER),
    ):
        yield from ((kind, path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.toml")))
    yield "mapping", MAPPING
    for path in sorted((ROOT / "tests/data").rglob("*.toml")):
        if path.parent.name not in ("benches", "untrusted") and "[gyro]" in (text := path.read_text(encoding="utf-8")):
            yield "mapping", text
    for path in sorted((ROOT / "docs/pages").rglob("*.md")):
        blocks = re.findall(r"^```toml\n(.*?)^```", path.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
        yield from (("mapping", text) for text in blocks if "[gyro]" in text)


@pytest.mark.parametrize(("kind", "text"), files())
def test_what_the_station_takes_the_schema_takes(kind: str, text: str) -> None:
    assert [error.message for error in valid(kind).iter_errors(tomllib.loads(text))] == []


@pytest.mark.parametrize("table", ["modbus", "galil", "acutrol", "aerosmith"])
def test_what_init_writes_the_schema_takes(table: str, tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    imus = (word for imu in ("can", "stim300", "described") for word in ("--imu", imu))
    assert main(["init", str(path), "--defaults", "--table", table, *imus]) == 0
    assert [error.message for error in valid("bench").iter_errors(tomllib.loads(path.read_text()))] == []


@pytest.mark.parametrize(
    ("kind", "old", "new", "at"),
    [
        ("bench", "poll_rate", "pol_rate", ["table"]),
        ("bench", '"0.2 s"', '"0.2 Hz"', ["table", "timeout"]),
        ("bench", 'latitude = "45 deg"', "latitude = 45", ["site", "latitude"]),
        ("bench", "counts_per_turn = 65536", "counts_per_turn = 0", ["table", "x", "counts_per_turn"]),
        ("bench", '"tetrahedron"', '"tetraeder"', ["imu", 0, "array"]),
        ("bench", "[limits]", '[twin.array.fault]\nlos = "1 %"\n[limits]', ["twin", "array", "fault"]),
        ("bench", "nis_low = 0.8", 'nis_low = "0.8"', ["limits", "nis_low"]),
        ("script", '"rotate"', '"turn"', ["step", 2, "kind"]),
        ("script", "angle =", "angel =", ["step", 1]),
        ("hidden", "[sample_hold]", "[sample_holt]", []),
        ("hidden", "samples = 3", 'samples = "3"', ["sample_hold"]),
        ("mapping", 'unit = "ms"', 'unit = "min"', ["time", "unit"]),
        ("mapping", 'column = "t"', 'column = "t"\nrate_hz = 100', ["time"]),
        ("mapping", 'format = "csv"', 'format = "csv"\nheader_bytes = 3', ["file"]),
        ("mapping", "count = 0.061", "count = -1", ["gyro", "count"]),
        ("mapping", "count = 0.061", "", ["gyro"]),
        ("mapping", '"-y"', '"w"', ["gyro", "axes"]),
        ("mapping", "sd_deg = 0.5", "sd_deg = 0", ["reference", "sd_deg"]),
        ("mapping", "sd_deg", "sd_degrees", ["reference"]),
        ("mapping", 'kind = "turns"', 'kind = "magic"', ["reference", "kind"]),
        ("mapping", "angle_deg", "angle", ["reference", "sections", "up"]),
    ],
)
def test_what_the_station_refuses_the_schema_underlines(kind: str, old: str, new: str, at: list[str | int]) -> None:
    texts = {"bench": default_bench_text(), "script": SCRIPT, "hidden": HIDDEN, "mapping": MAPPING}
    assert old in texts[kind]
    errors = valid(kind).iter_errors(tomllib.loads(texts[kind].replace(old, new, 1)))
    assert at in [list(error.absolute_path) for error in errors]
