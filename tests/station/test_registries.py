"""Devices by name: the built-in ones, and those that a bench file brings; what is said of names that there are not."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
from support import changed

from drivers.imus.registry import IMUS
from drivers.specs import ImuSpec
from drivers.tables.registry import TABLES
from sims.imus import registry as imus
from sims.tables import registry as tables
from station.bench.bench import load_bench
from station.errors import BenchError

BENCH = (Path(__file__).parents[1] / "data" / "benches" / "galil_xsens.toml").read_text()


def bench(folder: Path, *changes: tuple[str, str], first: str = "") -> Path:
    """Write a bench with a Galil and an Xsens, changed."""
    path = folder / "bench.toml"
    path.write_text(first + changed(BENCH, *changes))
    return path


def test_every_device_names_itself_says_what_its_keys_mean_and_has_a_twin() -> None:
    for name, spec in (*IMUS.items(), *TABLES.items()):
        assert spec.name == name
        assert callable((imus if isinstance(spec, ImuSpec) else tables).twin_of(spec))
        assert all(key.doc for key in spec.keys)


def test_the_station_names_no_protocol_but_in_captures_of_them() -> None:
    names = {*IMUS, *TABLES} - {"can"}  # which is a word of its own
    for path in (Path(__file__).parents[2] / "station").rglob("*.py"):
        constants = {node.value for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Constant)}
        assert path.name == "captures.py" or not names & constants, path


@pytest.mark.parametrize(
    ("right", "wrong", "told"),
    [
        (
            "xsens",
            "xsense",
            r"imu.0.protocol: 'xsense' is not one of can, described, j1939, stim300, vectornav, xsens.* xsens\?",
        ),
        ("galil", "gallil", r"table.protocol: 'gallil' is not one of modbus, galil, acutrol, aerosmith; .* galil\?"),
    ],
)
def test_an_unknown_protocol_is_told_with_the_known_ones_and_the_nearest(
    tmp_path: Path, right: str, wrong: str, told: str
) -> None:
    path = bench(tmp_path, (f'protocol = "{right}"', f'protocol = "{wrong}"'))
    with pytest.raises(BenchError, match=rf"bench.toml, line \d+: {told}"):
        load_bench(path)


@pytest.mark.parametrize(
    ("protocol", "options", "rate_hz", "told"),
    [
        ("vectornav", {"output": "binary"}, 12.5, "protocol vectornav sends binary at 1, 2, 4, .*, 400, 800 Hz"),
        ("vectornav", {"output": "ascii"}, 400, "protocol vectornav sends ascii at 1, 2, .* 100, 200 Hz"),
        ("stim300", {}, 100, "protocol stim300 sends at 125, 250, 500, 1000, 2000 Hz"),
        ("j1939", {}, 33, "protocol j1939 sends at 2, 4, 5, 10, 20, 25, 50, 100 Hz"),
        ("xsens", {}, 99.5, "protocol xsens sends at a whole number of Hz, up to 2000"),
        ("xsens", {}, 2001, "protocol xsens sends at a whole number of Hz, up to 2000"),
        ("xsens", {}, 400.0, "$"),
        ("can", {}, 33.3, "$"),
    ],
)
def test_a_rate_that_a_device_has_not_is_refused_with_those_it_has(
    protocol: str, options: dict[str, str], rate_hz: float, told: str
) -> None:
    assert re.match(told, IMUS[protocol].refused_rate(rate_hz, options))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("import numpy\n\n1 / 0\n", "line 3: ZeroDivisionError: division by zero"),
        ("def f(:\n", "line 1: SyntaxError: invalid syntax"),
        ("import no_such_module_at_all\n", "line 1: ModuleNotFoundError: No module named 'no_such_module_at_all'"),
        ("raise SystemExit(0)\n", "line 1: SystemExit: 0"),
        (None, "FileNotFoundError: "),
    ],
)
def test_a_plug_in_that_fails_is_one_line_with_its_name_and_the_reason(
    tmp_path: Path, text: str | None, told: str
) -> None:
    if text is not None:
        (tmp_path / "mine.py").write_text(text)
    with pytest.raises(BenchError) as caught:
        load_bench(bench(tmp_path, first='plugins = ["mine.py"]\n'))
    message = str(caught.value)
    assert "bench.toml, line 1: plugins: plug-in" in message
    assert "mine.py" in message
    assert told in message
    assert "\n" not in message


def test_a_plug_in_may_not_take_a_name_that_is_taken(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("from drivers.tables.galil.table import SPEC\n")
    with pytest.raises(BenchError, match=r"plugins: two tables are called galil: choose another name for yours"):
        load_bench(bench(tmp_path, first='plugins = ["mine.py"]\n'))


def test_files_in_plugins_beside_the_bench_are_taken_without_being_listed(tmp_path: Path) -> None:
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "broken.py").write_text("raise RuntimeError('not today')\n")
    with pytest.raises(BenchError, match=r"plugins/broken.py, line 1: RuntimeError: not today"):
        load_bench(bench(tmp_path))


def test_the_key_tables_have_every_protocol_its_baud_rate_and_its_keys() -> None:
    rows = (Path(__file__).parents[2] / "docs/pages/reference/bench.md").read_text().splitlines()
    for spec in (*IMUS.values(), *TABLES.values()):
        (row,) = (row for row in rows if row.startswith(f"| `{spec.name}`"))
        assert spec.on_can or str(spec.baud) in row
        for key in spec.keys:
            assert any(row.startswith(f"| `{key.name}`") and spec.name in row for row in rows), key


def test_what_has_met_nothing_of_others_is_called_experimental() -> None:
    """In the README, and by its record wherever that is shown."""
    readme = " ".join((Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8").split())
    specs = [registry[name] for registry in (TABLES, IMUS) for name in registry]
    for spec in specs:
        assert (f"{spec.what} (experimental)" in readme) is not bool(spec.checked_against), spec.name
        assert spec.said.startswith("EXPERIMENTAL") is not bool(spec.checked_against)
    assert any(spec.checked_against for spec in specs)
