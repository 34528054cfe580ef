"""IMUs on a byte link that a file describes, as an IMU of the station."""

from drivers.imus.described.imu import DescribedImu
from drivers.specs import ImuSpec, described

SPEC = described(
    ImuSpec,
    __package__,
    make=lambda own, link: DescribedImu(own.name, link, own.signals, own.rate_hz),
    gyros=None,
)
