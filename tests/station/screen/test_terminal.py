"""The program as an operator meets it: started in a terminal, keys pressed, the cells of the screen read.

A recorded session speaks, so that a busy machine changes nothing; ``full`` has runs of twins as well.
"""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

import h5py
import pytest
from streams import STREAMS, TINY, Replay
from support import command
from terminal import Terminal

from station.screen.drawings import STATE_CHARTS
from station.screen.run_charts import RUN_CHARTS

SIZES = [(80, 24), (100, 30), (120, 40), (160, 50), (200, 60)]
_WIDE, _LARGE = 120, 200
_FEW_CELLS = 10
"""So many cells at least have dots where a curve is drawn; a calibration in the history is one dot."""


def wait_for_charts(terminal: Terminal, names: set[str], least_cells: int = _FEW_CELLS) -> None:
    """Wait until a curve has been drawn in each of these charts."""
    missing = set(names)

    def drawn(_: str) -> bool:
        missing.difference_update(name for name, cells in terminal.charts().items() if cells >= least_cells)
        return not missing

    terminal.wait_for(drawn, limit_s=60)


def run_charts(size: tuple[int, int]) -> set[str]:
    """Return the charts of Run that are in sight at a size without scrolling."""
    if size == (80, 24) or size[0] < _WIDE:
        return {"rate"}
    return set(RUN_CHARTS)


def attached(size: tuple[int, int], folder: Path) -> Terminal:
    """Start a screen in a terminal of a size that shows the session that runs."""
    variables = {name: os.environ[name] for name in ("XDG_RUNTIME_DIR", "XDG_STATE_HOME", "TMPDIR")}
    words = ("ui", "--attach", "--bench", "bench.toml", "--script", "short.toml", "--folder", str(folder))
    return Terminal(command(*words), *size, variables=variables)


def look_at_every_page(size: tuple[int, int], folder: Path) -> None:
    """Look at Run, Prepare, History and Result: charts are drawn on each of them."""
    with Replay("pass", 40.0), attached(size, folder) as terminal:
        wait_for_charts(terminal, run_charts(size))
        terminal.press("f5")
        terminal.wait_for("4 recordings in")
        terminal.press("down", "down", "down")  # to the calibration that passed: the newest are damaged
        wait_for_charts(terminal, {"k"}, least_cells=1)
        terminal.press("enter")
        terminal.wait_for("States and their sigmas")
        if size[0] >= _WIDE:
            wait_for_charts(terminal, set(STATE_CHARTS))
        terminal.press("f2")
        terminal.wait_for("Before START")
        if size[0] >= _WIDE:
            wait_for_charts(terminal, {"commanded"})  # the first word of "commanded rate"


def test_charts_are_drawn_on_every_page(recordings: Path) -> None:
    look_at_every_page((120, 40), recordings)


@pytest.mark.full
@pytest.mark.parametrize(
    "size", [size for size in SIZES if size != (120, 40)], ids=lambda size: "x".join(map(str, size))
)
def test_charts_are_drawn_at_other_sizes(recordings: Path, size: tuple[int, int]) -> None:
    look_at_every_page(size, recordings)


@pytest.mark.full
@pytest.mark.parametrize("size", SIZES, ids=lambda size: "x".join(map(str, size)))
def test_charts_are_drawn_in_a_run_that_a_key_started(place: Path, size: tuple[int, int]) -> None:
    (place / "tiny.toml").write_text(TINY)
    variables = {name: os.environ[name] for name in ("XDG_RUNTIME_DIR", "XDG_STATE_HOME", "TMPDIR")}
    words = ("ui", "--bench", "bench.toml", "--script", "tiny.toml", "--folder", "recordings", "--scale", "1")
    with Terminal(command(*words), *size, variables=variables) as terminal:
        terminal.wait_for("Operator")
        terminal.press("A. Operator", "enter", "SN-0042")
        terminal.wait_for("READY  the table")
        terminal.press("f7")
        wait_for_charts(terminal, run_charts(size))


UNITS = '\n[units]\nmisalignment = "mrad"\n'


def test_a_result_has_one_figure_a_state_its_unit_and_its_limit_as_written(place: Path) -> None:
    (place / "recordings").mkdir()
    shutil.copy(STREAMS / "first.h5", place / "recordings")
    with h5py.File(place / "recordings/first.h5", "r+") as file:
        file.attrs["bench"] = str(file.attrs["bench"]) + UNITS
    variables = {name: os.environ[name] for name in ("XDG_RUNTIME_DIR", "XDG_STATE_HOME", "TMPDIR")}
    with Terminal(command("ui", "--folder", "recordings"), 200, 60, variables=variables) as terminal:
        terminal.press("f5")
        terminal.wait_for("1 recordings in")
        terminal.wait_for(lambda text: "limit ±0.5 deg/s" in text and "sigma_j (mrad)" in text)
        terminal.press("enter")
        text = terminal.wait_for(lambda text: "States and their sigmas" in text and text.count("limit ±") == 4)
    for words in ("limit ±10000 ", "limit ±0.5 deg/s ", "limit ±0.5 deg "):
        assert words in text
    first, *_ = (line.split() for line in text.splitlines() if line.startswith(" gyro1"))
    for at, name in enumerate(STATE_CHARTS):
        titled = re.search(rf"─ {name} \(\S+\) (\S+) ± (\S+)", text)
        assert titled is not None
        assert titled.groups() == tuple(first[1 + 2 * at : 3 + 2 * at])
