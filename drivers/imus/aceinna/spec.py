"""Aceinna's devices on SAE J1939, as an IMU of the station."""

from drivers.imus.aceinna.codec import AXIS_ORDERS, DEFAULT_ADDRESS, RATES_HZ, Settings
from drivers.imus.aceinna.imu import AceinnaImu
from drivers.protocols import FrameLink, ImuSource
from drivers.specs import CONFIGURE, ImuSetup, ImuSpec, Key, ProposedImu


def _make(setup: ImuSetup, link: FrameLink) -> ImuSource:
    settings = Settings(rate_hz=setup.rate_hz, packets=("ari", "accs")) if setup.options["configure"] else None
    own = {key: setup.options[key] for key in ("model", "axis_order", "address")}
    return AceinnaImu(setup.name, link, setup.rate_hz, **own, settings=settings)


SPEC = ImuSpec(
    name="j1939",
    what="Aceinna OpenIMU300RI, MTLT305D",
    link="can:socketcan:can0 or can:pcan:PCAN_USBBUS1?bitrate=250000",
    make=_make,
    on_can=True,
    rates_hz=sorted(RATES_HZ),
    temperature=False,
    keys=(
        CONFIGURE,
        Key("model", "text", "which device, and so the order of its axes", "openimu300ri", one_of=AXIS_ORDERS),
        Key("axis_order", "text", "x y z, or y before x; left out: the model's", one_of=("xyz", "sae")),
        Key("address", "integer", "J1939 address", DEFAULT_ADDRESS, low=0, high=0xFD, noun="J1939 address"),
    ),
    proposed=ProposedImu("openimu", "100 Hz", "0.005 deg/s/rtHz", "6 deg/h"),
)
