"""A public driver of the VN-200, written from the maker's manual, asks the twin of a VectorNav for all it knows."""

from __future__ import annotations

from pathlib import Path

import pytest
from strangers import needs_python
from support import TwinProcess

BENCH = Path(__file__).parents[1] / "data" / "benches" / "acutrol_vectornav.toml"


@needs_python("vectornav", "vectornav-vn200")
def test_a_vn200_driver_asks_the_twin() -> None:
    from vectornav import VN200
    from vectornav._vn200 import VN200Error

    with TwinProcess("--bench", BENCH) as twin, VN200(twin.links["vn100"].removeprefix("serial://")) as device:
        assert device.read_model_number().startswith("VN-")
        assert device.read_serial_number() > 0
        assert device.read_hardware_revision() > 0
        assert device.read_firmware_version().count(".") == 3
        with pytest.raises(VN200Error, match="Invalid Register"):
            device._read_register(200)
        rested = device.read_imu()
        assert abs(rested["gyro_x"]) + abs(rested["gyro_y"]) + abs(rested["gyro_z"]) < 0.05
        assert rested["accel_z"] == pytest.approx(9.80665, abs=0.1)
        assert rested["temperature"] == pytest.approx(25.0, abs=3.0)
        together = device.read_mag_accel_gyro()
        assert together["accel_x"] == pytest.approx(device.read_accel()["accel_x"], abs=0.01)
        attitude = device.read_ypr_mag_accel_gyro()
        assert attitude["pitch"] == pytest.approx(device.read_yaw_pitch_roll()["pitch"], abs=0.01)
        assert attitude["gyro_y"] == pytest.approx(together["gyro_y"], abs=0.05)
