"""A VectorNav, as an IMU of the station."""

from drivers.imus.vectornav.codec import RATES_HZ
from drivers.imus.vectornav.imu import VectorNavImu
from drivers.specs import ImuSpec, described

SPEC = described(
    ImuSpec,
    __package__,
    {"output": {"one_of": RATES_HZ}},
    make=lambda own, link: VectorNavImu(own.name, link, own.rate_hz, **own.options, timeout_s=own.timeout_s),
    rates_hz=RATES_HZ,
)
