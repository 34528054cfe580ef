"""An Xsens MTi, as an IMU of the station."""

from drivers.imus.xsens.imu import HIGHEST_RATE_HZ, XsensImu
from drivers.protocols import ByteLink, ImuSource
from drivers.specs import CONFIGURE, ImuSetup, ImuSpec, ProposedImu


def _make(setup: ImuSetup, link: ByteLink) -> ImuSource:
    configure = setup.options["configure"]
    return XsensImu(setup.name, link, setup.rate_hz, configure=configure, timeout_s=setup.timeout_s)


SPEC = ImuSpec(
    name="xsens",
    what="Xsens MTi",
    link="serial:///dev/ttyUSB0?baud=921600",
    make=_make,
    baud=921_600,
    rates_hz=range(1, HIGHEST_RATE_HZ + 1),
    keys=(CONFIGURE,),
    proposed=ProposedImu("mti", "400 Hz", "0.01 deg/s/rtHz", "10 deg/h"),
)
