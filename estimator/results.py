"""Results kept in the recording they were drawn from: the group /calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from estimator.calibrate import Calibration
from estimator.model import STATES
from estimator.recording import write_results


def write_calibration(path: Path, calibration: Calibration, attributes: dict[str, object] | None = None) -> None:
    """Write /calibration: names, sources, states (n, 4), sd (n, 4), covariance (n, 4, 4), noise (n,)."""
    gyros = calibration.gyros
    write_results(
        path,
        "calibration",
        {
            "name": np.array([g.name.encode() for g in gyros]),
            "source": np.array([g.source.encode() for g in gyros]),
            "states": np.array([g.states for g in gyros]),
            "sd": np.array([g.sd for g in gyros]),
            "covariance": np.array([g.covariance for g in gyros]),
            "noise_rps": np.array([g.noise_rps for g in gyros]),
        },
        {
            "state_names": list(STATES),
            "nis_mean": calibration.nis_mean,
            "samples": calibration.samples,
            "lost": calibration.lost,
            "notes": list(calibration.notes),
            **(attributes or {}),
        },
    )
