"""Accelerometers of a device that is mounted askew: as it reports them, and turned into the body's axes on reading."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from estimator.recordings.reading import read_recording
from station.cli import main

BENCHES = Path(__file__).parents[1] / "data" / "benches"
DEVICES = {"galil_xsens": "mti", "acutrol_vectornav": "vn100"}
GRAVITY_MPS2 = 9.80665
SCRIPT = """
name = "tilts"
[[step]]
kind = "rest"
duration = "2 s"
[[step]]
kind = "move"
axis = "x"
angle = "90 deg"
rate = "60 deg/s"
[[step]]
kind = "rest"
duration = "2 s"
[[step]]
kind = "move"
axis = "y"
angle = "30 deg"
rate = "60 deg/s"
[[step]]
kind = "rest"
duration = "2 s"
"""
# The innermost gimbal is x: the body turns by it within y. Up is z of the base.
UP_IN_BODY = ([0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-np.sin(np.radians(30)), np.cos(np.radians(30)), 0.0])


def askew(bench: str) -> str:
    """Return the text of a bench whose triad is turned as the first one of the two skewed triads is."""
    axes = (BENCHES / "two_triads.toml").read_text().split("\np = ")[1].split("\nrate = ")[0]
    return (BENCHES / f"{bench}.toml").read_text().replace('array = "triad"', f"p = {axes}")


@pytest.mark.parametrize(("bench", "device"), DEVICES.items())
def test_a_recording_has_raw_accelerations_and_their_axes(tmp_path: Path, bench: str, device: str) -> None:
    (tmp_path / "bench.toml").write_text(askew(bench))
    (tmp_path / "tilts.toml").write_text(SCRIPT)
    path = tmp_path / "tilts.h5"
    options = ("--bench", tmp_path / "bench.toml", "--script", tmp_path / "tilts.toml", "-o", path)
    main(["run", *map(str, options)])
    data = read_recording(path).sources[device]
    assert data.accel_mps2 is not None
    assert data.specific_force_mps2 is not None
    with h5py.File(path) as file:
        steps = file["steps"]
        rests = [
            (steps["t_start_ns"][i], steps["t_end_ns"][i])
            for i, label in enumerate(steps["label"].asstr()[()])
            if label.startswith("rest")
        ]
    assert len(rests) == len(UP_IN_BODY)
    for (start_ns, end_ns), up in zip(rests, UP_IN_BODY, strict=True):
        within = (data.t_ns > start_ns + 5e8) & (data.t_ns < end_ns - 1e8)
        force_mps2 = GRAVITY_MPS2 * np.array(up)
        # The device measures along its own axes, which are askew.
        np.testing.assert_allclose(data.accel_mps2[within].mean(axis=0), data.array.p @ force_mps2, atol=0.01)
        np.testing.assert_allclose(data.specific_force_mps2[within].mean(axis=0), force_mps2, atol=0.01)
