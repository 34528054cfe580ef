"""IMUs on a byte link that a file describes, as an IMU of the station."""

from drivers.imus.described.imu import DescribedImu
from drivers.protocols import ByteLink, ImuSource
from drivers.specs import ImuSetup, ImuSpec, ProposedImu


def _make(setup: ImuSetup, link: ByteLink) -> ImuSource:
    return DescribedImu(setup.name, link, setup.signals, setup.rate_hz)


SPEC = ImuSpec(
    name="described",
    what="described by a file: lines of text or binary frames",
    link="serial:///dev/ttyUSB0?baud=115200",
    make=_make,
    gyros=None,
    described=True,
    proposed=ProposedImu("imu", "100 Hz", "0.01 deg/s/rtHz", "10 deg/h"),
)
