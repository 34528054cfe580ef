"""A body that swings about three axes, three gyros on it, and what other instruments say of it, in deg/s and s.

A motion is three angles (about z, then y, then x) that are sums of sines, so it is known at any instant. The commands
are run as a user runs them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foreign_logs import CSV, GYRO
from scipy.spatial.transform import Rotation

from station.cli import main

HZ, SECONDS = 100.0, 80.0
G_MPS2 = 9.80665
K = np.array([0.004, -0.003, 0.006])
BIAS_DPS = np.array([0.3, -0.2, 0.1])
NOISE_DPS = 0.05
NAMES = ("gx", "gy", "gz")

TIME = '[time]\ncolumn = "t"\nunit = "s"\n'
TOP = CSV + TIME + GYRO
ACCEL = '[accelerometer]\ncolumns = ["ax", "ay", "az"]\nunit = "m/s2"\n'
RATE = '[reference]\nkind = "rate"\ncolumns = ["rx", "ry", "rz"]\nunit = "deg/s"\n'
ATTITUDE = '[reference]\nkind = "attitude"\ncolumns = ["qw", "qx", "qy", "qz"]\norder = "wxyz"\n'
BESIDE = 'file = "{stem}_reference.csv"\n'

Gyros = Mapping[str, Mapping[str, Any]]

_SWINGS_HZ = np.array([[0.21, 0.5, 0.083], [0.17, 0.41, 0.67], [0.26, 0.59, 0.11]])
_SWINGS_DEG = np.array([[35.0, 12.0, 40.0], [22.0, 12.0, 6.0], [30.0, 10.0, 40.0]])
_HALF_S = 5e-4


def attitude(t_s: np.ndarray, size: float = 1.0) -> Rotation:
    """Return rotations, body to base, of swings so many times as large."""
    phase = 2 * np.pi * t_s[:, None, None] * _SWINGS_HZ + np.arange(9).reshape(3, 3)
    return Rotation.from_euler("ZYX", np.radians(size * np.sum(_SWINGS_DEG * np.sin(phase), axis=2)))


def rate(t_s: np.ndarray, size: float = 1.0) -> np.ndarray:
    """Return body rates (n, 3)."""
    before, after = attitude(t_s - _HALF_S, size), attitude(t_s + _HALF_S, size)
    return np.asarray(np.degrees((before.inv() * after).as_rotvec()) / (2 * _HALF_S))


def quaternions(t_s: np.ndarray, size: float = 1.0) -> np.ndarray:
    """Return w x y z (n, 4)."""
    return np.roll(attitude(t_s, size).as_quat(), 1, axis=1)


def instants(seconds: float = SECONDS, hz: float = HZ) -> np.ndarray:
    """Return instants of samples."""
    return np.arange(round(seconds * hz)) / hz


def outputs(rates_dps: np.ndarray, seed: int = 1) -> np.ndarray:
    """Return what the gyros put out (n, 3)."""
    noise = NOISE_DPS * np.random.default_rng(seed).standard_normal(rates_dps.shape)
    return np.asarray((1 - K) * rates_dps - BIAS_DPS + noise)


def write(path: Path, heading: str, *columns: np.ndarray) -> None:
    """Write columns, each (n,) or (n, c), under a heading."""
    np.savetxt(path, np.column_stack(columns), delimiter=",", fmt="%.7g", header=heading, comments="")


def ran(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, str]:
    """Return how a command ended and all that it printed."""
    capsys.readouterr()
    code = main([str(argument) for argument in arguments])
    said = capsys.readouterr()
    return code, said.out + said.err


def imported(capsys: pytest.CaptureFixture[str], folder: Path, mapping: str, *logs: str) -> tuple[Path, str]:
    """Return where the recording of some logs is, and what the import said."""
    (folder / "mapping.toml").write_text(mapping)
    files = [folder / log for log in logs or ("log.csv",)]
    code, said = ran(capsys, "import", folder / "mapping.toml", *files, "-o", folder / "run.h5")
    assert code == 0, said
    return folder / "run.h5", said


def calibrated(capsys: pytest.CaptureFixture[str], run: Path, *options: str | Path) -> tuple[Gyros, str]:
    """Return the gyros of a calibration by name, and what is told of it in words."""
    capsys.readouterr()
    main([str(argument) for argument in ("calibrate", run, *options, "--json")])
    document = json.loads(capsys.readouterr().out)
    told = "\n".join([document["reason"], *document["doubts"], *document["notes"]])
    return {gyro["name"]: gyro for gyro in document["gyros"]}, told


def investigated(capsys: pytest.CaptureFixture[str], run: Path) -> tuple[int, dict[str, Any]]:
    """Return how an investigation ended, and its result."""
    capsys.readouterr()
    code = main(["investigate", str(run), "--json"])
    return code, json.loads(capsys.readouterr().out)
