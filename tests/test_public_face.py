"""What a notebook has of the estimator: its names, and the notebook that the documentation shows."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib
import pytest

import estimator

NOTEBOOK = Path(__file__).parents[1] / "docs" / "notebooks" / "somebody_elses_recording.ipynb"


def test_there_are_few_names_and_each_is_there() -> None:
    assert len(estimator.__all__) <= 25
    assert set(estimator.__all__) <= set(dir(estimator))
    for name in estimator.__all__:
        assert getattr(estimator, name).__doc__


def test_the_import_alone_loads_no_library() -> None:
    program = "import estimator, sys; print({'scipy', 'h5py', 'matplotlib'} & sys.modules.keys())"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_the_notebook_finds_the_delay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(NOTEBOOK.parent)
    matplotlib.use("Agg")
    names: dict[str, Any] = {}
    for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    assert list(names["calibration"].to_frame().index) == ["x", "y", "z"]
    frame = names["recording"].sources["imu"].to_frame()
    assert {"x", "y", "z", "accel_z_mps2"} <= set(frame.columns)
    assert frame.index.name == "t_s"
    (latency,) = (added for added in names["found"].added if added.effect == "latency")
    assert latency.parameters["delay"].value == pytest.approx(0.012, abs=0.001)
    assert names["found"].after.rms_rps < names["found"].before.rms_rps
    assert estimator.plot_states(names["calibration"], 1).get_ylabel() == "b, deg/h"
