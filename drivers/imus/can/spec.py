"""Any gyros on CAN, as an IMU of the station."""

from drivers.imus.can.imu import CanImu
from drivers.protocols import FrameLink, ImuSource
from drivers.specs import ImuSetup, ImuSpec, ProposedImu


def _make(setup: ImuSetup, link: FrameLink) -> ImuSource:
    can = setup.signals
    return CanImu(setup.name, link, can.dbc, can.channels, setup.rate_hz, source_address=can.source_address)


SPEC = ImuSpec(
    name="can",
    what="any gyros on CAN that a DBC describes",
    link="can:socketcan:can0 or can:slcan:/dev/ttyACM0",
    make=_make,
    on_can=True,
    gyros=None,
    signals_of_dbc=True,
    proposed=ProposedImu("array", "100 Hz", "0.005 deg/s/rtHz", "2 deg/h", array="tetrahedron"),
)
