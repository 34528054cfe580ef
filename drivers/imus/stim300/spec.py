"""A STIM300, as an IMU of the station."""

from drivers.imus.stim300.imu import Stim300Imu
from drivers.imus.stim300.special import RATES_HZ
from drivers.imus.stim300.units import ACCEL_LSB_G, UNITS
from drivers.protocols import ByteLink, ImuSource
from drivers.specs import ImuSetup, ImuSpec, described


def _make(setup: ImuSetup, link: ByteLink) -> ImuSource:
    unit, most_g = setup.options["gyro_unit"], setup.options["accel_range"]
    rate_hz, timeout_s = round(setup.rate_hz), setup.timeout_s
    return Stim300Imu(setup.name, link, rate_hz, gyro_unit=unit, accel_range_g=most_g, timeout_s=timeout_s)


_RANGES = {"one_of": ACCEL_LSB_G, "told": f"is one of {', '.join(map(str, ACCEL_LSB_G))} g"}
_KEYS = {"gyro_unit": {"one_of": UNITS.values()}, "accel_range": _RANGES}
SPEC = described(ImuSpec, __package__, _KEYS, make=_make, rates_hz=RATES_HZ)
