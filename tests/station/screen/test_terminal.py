"""The program as an operator meets it: started in a terminal, keys pressed, the cells of the screen read."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest
from streams import TINY, bench_text
from support import command
from terminal import Terminal

from station.screen.drawings import RUN_CHARTS, STATE_CHARTS

SIZES = pytest.mark.parametrize("size", [(80, 24), (120, 40), (200, 60)], ids=["80x24", "120x40", "200x60"])
MOTION = {"rate"}
_FEW_CELLS = 10
"""So many cells at least have dots where a curve is drawn; a calibration in the history is one dot."""


def wait_for_charts(terminal: Terminal, names: set[str], least_cells: int = _FEW_CELLS) -> None:
    """Wait until a curve is drawn in each of these charts."""

    def drawn(_: str) -> bool:
        return names <= {name for name, cells in terminal.charts().items() if cells >= least_cells}

    terminal.wait_for(drawn, limit_s=30)


@pytest.fixture
def tiny(place: Path) -> Path:
    """A working folder with a bench of twins, and a short script that ends with a rest, when all states are known."""
    (place / "bench.toml").write_text(bench_text())
    (place / "tiny.toml").write_text(f'{TINY}[[step]]\nkind = "rest"\nduration = "15 s"\n')
    return place


def screen(size: tuple[int, int], *options: str) -> Terminal:
    """Start the screen in a terminal of a size."""
    variables = {name: os.environ[name] for name in ("XDG_RUNTIME_DIR", "XDG_STATE_HOME", "TMPDIR")}
    return Terminal(command("ui", "--folder", "recordings", *options), *size, **variables)


def start_run(terminal: Terminal) -> None:
    """Enter who and what, and start."""
    terminal.wait_for("Operator")
    terminal.press("A. Operator", "enter", "SN-0042")
    terminal.wait_for("READY  the table")
    terminal.press("f7")


def whole_day(size: tuple[int, int], run: set[str], states: set[str]) -> None:
    """Prepare, run, judge, look back: in each charts are drawn."""
    with screen(size, "--bench", "bench.toml", "--script", "tiny.toml", "--scale", "8") as terminal:
        start_run(terminal)
        wait_for_charts(terminal, run)
        terminal.wait_for("States and their sigmas")
        wait_for_charts(terminal, states)
        terminal.press("f2")
        terminal.wait_for("Before START")
        wait_for_charts(terminal, MOTION)
        terminal.press("f5")
        terminal.wait_for("1 recordings in")
        wait_for_charts(terminal, states, least_cells=1)


def test_charts_are_drawn_on_every_page(tiny: Path) -> None:
    whole_day((120, 40), set(RUN_CHARTS), set(STATE_CHARTS))


@pytest.mark.full
@pytest.mark.parametrize(
    ("size", "run", "states"),
    [((80, 24), {"rate"}, {"k"}), ((200, 60), set(RUN_CHARTS), set(STATE_CHARTS))],
    ids=["80x24", "200x60"],
)
def test_charts_are_drawn_at_other_sizes(tiny: Path, size: tuple[int, int], run: set[str], states: set[str]) -> None:
    whole_day(size, run, states)


@pytest.mark.full
@SIZES
def test_charts_of_a_session_that_runs_by_itself_are_drawn(tiny: Path, size: tuple[int, int]) -> None:
    options = ["--bench", "bench.toml", "--script", "tiny.toml", "--scale", "2", "-o", "run.h5"]
    who = ["--operator", "A. Operator", "--serial-number", "SN-0042"]
    session = subprocess.Popen(command("run", "--host", "--json", *options, *who), stdout=subprocess.DEVNULL)
    try:
        folder = Path(os.environ["XDG_RUNTIME_DIR"]) / f"station-{os.getuid()}"
        while not list(folder.glob("*.sock")):
            assert session.poll() is None
        with screen(size, "--attach") as terminal:
            wait_for_charts(terminal, {"rate"} if size == (80, 24) else set(RUN_CHARTS))
    finally:
        session.terminate()
        session.wait()
