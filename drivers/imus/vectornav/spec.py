"""A VectorNav, as an IMU of the station."""

from drivers.imus.vectornav.codec import RATES_HZ
from drivers.imus.vectornav.imu import VectorNavImu
from drivers.protocols import ByteLink, ImuSource
from drivers.specs import ImuSetup, ImuSpec, Key, ProposedImu


def _make(setup: ImuSetup, link: ByteLink) -> ImuSource:
    output = setup.options["output"]
    return VectorNavImu(setup.name, link, setup.rate_hz, output=output, timeout_s=setup.timeout_s)


SPEC = ImuSpec(
    name="vectornav",
    what="VectorNav VN-100, 200, 300",
    link="serial:///dev/ttyUSB0?baud=115200",
    make=_make,
    rates_hz=RATES_HZ,
    rates_by="output",
    keys=(Key("output", "text", "with time stamps (binary) or without (VNIMU)", "binary", one_of=RATES_HZ),),
    proposed=ProposedImu("vectornav", "200 Hz", "0.0035 deg/s/rtHz", "7 deg/h"),
)
