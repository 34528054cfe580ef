"""imucal itself reads the exported file, and corrects samples of both sensors with it."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from strangers import needs_python

sys.path.insert(0, str(Path(__file__).parents[1] / "station"))
from test_export import EFFECTS, at_mean_temperature, record
from test_export_accelerometers import MOUNTINGS, RecordForces, assert_same, felt, record_forces

from estimator.calibration.correction import compensate
from estimator.geometry.array import SensorArray
from station.exports.exported import exported_of
from station.exports.formats import FORMATS

__all__ = ["record", "record_forces"]  # the fixtures


@needs_python("imucal", "imucal")
@pytest.mark.parametrize("array", MOUNTINGS.values(), ids=MOUNTINGS)
def test_imucal_corrects_samples_with_the_file(record_forces: RecordForces, array: SensorArray) -> None:
    from imucal import CalibrationInfo, FerrarisCalibrationInfo

    path = record_forces(array, {"g_sensitivity": EFFECTS["g_sensitivity"]})
    info = CalibrationInfo.from_json(str(FORMATS["imucal"].write(exported_of(path)).text))
    assert isinstance(info, FerrarisCalibrationInfo)
    force, outputs = felt(path)
    plain, (rate, t_s, _, _) = at_mean_temperature(path, ("g_sensitivity",))
    count = len(force)
    found, found_dps = info.calibrate(outputs, np.degrees(rate[:count]), "m/s^2", "deg/s")
    assert_same(found, force)
    expected = compensate(plain, rate[:count], t_s[:count], None, force)
    assert np.abs(np.radians(found_dps) - expected).max() < 1e-9
    assert "lever arm" in info.comment
