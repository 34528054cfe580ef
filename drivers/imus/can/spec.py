"""Any gyros on CAN, as an IMU of the station."""

from drivers.imus.can.imu import CanImu
from drivers.protocols import FrameLink, ImuSource
from drivers.specs import ImuSetup, ImuSpec, described


def _make(setup: ImuSetup, link: FrameLink) -> ImuSource:
    can = setup.signals
    return CanImu(setup.name, link, can.dbc, can.channels, setup.rate_hz, source_address=can.source_address)


SPEC = described(ImuSpec, __package__, make=_make, gyros=None)
