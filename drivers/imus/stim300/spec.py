"""A STIM300, as an IMU of the station."""

from drivers.imus.stim300.imu import Stim300Imu
from drivers.imus.stim300.special import RATES_HZ
from drivers.imus.stim300.units import ACCEL_LSB_G, UNITS
from drivers.protocols import ByteLink, ImuSource
from drivers.specs import ImuSetup, ImuSpec, Key, ProposedImu


def _make(setup: ImuSetup, link: ByteLink) -> ImuSource:
    unit, most_g = setup.options["gyro_unit"], setup.options["accel_range"]
    rate_hz, timeout_s = round(setup.rate_hz), setup.timeout_s
    return Stim300Imu(setup.name, link, rate_hz, gyro_unit=unit, accel_range_g=most_g, timeout_s=timeout_s)


SPEC = ImuSpec(
    name="stim300",
    what="Sensonor STIM300",
    link="serial:///dev/ttyUSB0?baud=921600",
    make=_make,
    baud=921_600,
    rates_hz=RATES_HZ,
    keys=(
        Key("gyro_unit", "text", "output unit that it must be set to", one_of=tuple(UNITS.values())),
        Key("accel_range", "integer", "accelerometer range that it must be set to", one_of=ACCEL_LSB_G, unit="g"),
    ),
    proposed=ProposedImu("stim300", "500 Hz", "0.0025 deg/s/rtHz", "0.5 deg/h"),
)
