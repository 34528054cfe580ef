"""A recording that passed its limits, with all that a certificate states beside: made at once, estimated by nobody."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from estimator.calibration.calibration_file import write_calibration
from estimator.calibration.error_model import ErrorModel, KnownEffect, Size
from estimator.calibration.gyro import EffectValue, GyroCalibration
from estimator.calibration.values import Calibration
from estimator.geometry.array import triad
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import TableReadings
from estimator.recordings.writing import write_recording
from station.bench.bench import default_bench_text

META = """
[laboratory]
name = "Gyro <laboratory> & sons"
address = ["Seestrasse 7", "Zürich"]
country = "CH"
[customer]
name = "Aerial surveys"
address = ["Langstrasse 1", "Bern"]
[item]
maker = "Sensor works"
model = "TG4"
received = 2026-05-02
[performed]
date = 2026-05-09
temperature = "21.4 degC"
humidity = "43 %"
[[equipment]]
name = "rate table"
serial_number = "T-1"
certificate = "RT-2026-11"
due = 2027-06-30
[procedure]
name = "P-12"
edition = "3"
[certificate]
issued = 2026-05-11
approved_by = "G. Hopper"
"""
EFFECTS = {"thermal_bias": ((2e-4,), "rad/s/K"), "g_sensitivity": ((1e-6, -2e-6, 3e-6), "rad/s/g")}


def certified(folder: Path, seed: int = 7, **attributes: Any) -> Path:
    """Write run.h5 and meta.toml; ``attributes`` are of the recording."""
    random, array = np.random.default_rng(seed), triad()
    t_ns = np.arange(200, dtype=np.int64) * 10_000_000
    data = ImuData(
        array, t_ns, random.normal(0, 0.4, (200, 3)), temperature_c=27 + 3 * np.sin(t_ns * 1e-9), device="imu"
    )
    still = TableReadings(
        t_ns=t_ns[[0, -1]], angle_rad=np.zeros((2, 3)), rate_rps=np.zeros((2, 3)), gimbals=("z", "y", "x")
    )
    bench = default_bench_text()
    for key, wide in (("scale_factor_error", "5 %"), ("bias", "9 deg/s"), ("misalignment", "9 deg")):
        bench = re.sub(rf'^{key} = ".*?"', f'{key} = "{wide}"', bench, flags=re.MULTILINE)
    told = {
        "outcome": "PASS",
        "reason": "all limits are met",
        "operator": "A. Turing",
        "device_serial": "TG-0042",
        "bench": bench,
    }
    path = folder / "run.h5"
    write_recording(path, Recording({"imu": data}, still, attributes=told | attributes))
    sizes = {
        name: tuple(Size(f"part {n}", unit, 0.0, abs(value)) for n, value in enumerate(values))
        for name, (values, unit) in EFFECTS.items()
    }
    model = ErrorModel(tuple(KnownEffect(name, False, parts, {}) for name, parts in sizes.items()))
    gyros = [_gyro(random, name, p) for name, p in zip(array.names, array.p, strict=True)]
    write_calibration(
        path, Calibration(gyros=tuple(gyros), nis_mean=1.0, samples=600, lost=0, notes=(), model=model.text())
    )
    (folder / "meta.toml").write_text(META, encoding="utf-8")
    return path


def _gyro(random: np.random.Generator, name: str, p: Any) -> GyroCalibration:
    root = random.normal(0, 1, (4, 4)) * np.array([1e-5, 1e-6, 1e-5, 1e-5])[:, None]
    effects = tuple(
        EffectValue(
            effect=effect,
            parameter=f"part {n}",
            value=float(value * random.uniform(0.5, 1.5)),
            sd=1e-8,
            unit=unit,
            expected_sd=abs(value),
            shared=False,
        )
        for effect, (values, unit) in EFFECTS.items()
        for n, value in enumerate(values)
    )
    states = random.normal(0, (5e-3, 2e-2, 2e-3, 2e-3))
    return GyroCalibration(
        name=name,
        source="imu",
        states=states,
        covariance=root @ root.T,
        noise_rps=1e-3,
        p=p,
        device="imu",
        effects=effects,
    )
