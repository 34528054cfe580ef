"""An Xsens MTi, as an IMU of the station."""

from drivers.imus.xsens.imu import HIGHEST_RATE_HZ, XsensImu
from drivers.specs import ImuSpec, described

SPEC = described(
    ImuSpec,
    __package__,
    make=lambda own, link: XsensImu(own.name, link, own.rate_hz, **own.options, timeout_s=own.timeout_s),
    rates_hz=range(1, HIGHEST_RATE_HZ + 1),
)
