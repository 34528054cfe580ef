"""Aceinna's devices on SAE J1939, as an IMU of the station."""

from drivers.imus.aceinna.codec import AXIS_ORDERS, DEFAULT_ADDRESS, RATES_HZ, Settings
from drivers.imus.aceinna.imu import AceinnaImu
from drivers.protocols import FrameLink, ImuSource
from drivers.specs import ImuSetup, ImuSpec, described


def _make(setup: ImuSetup, link: FrameLink) -> ImuSource:
    settings = Settings(rate_hz=setup.rate_hz, packets=("ari", "accs")) if setup.options["configure"] else None
    own = {key: setup.options[key] for key in ("model", "axis_order", "address")}
    return AceinnaImu(setup.name, link, setup.rate_hz, **own, settings=settings)


_KEYS = {"model": {"one_of": AXIS_ORDERS}, "address": {"one_of": range(0xFE), "default": DEFAULT_ADDRESS}}
SPEC = described(ImuSpec, __package__, _KEYS, make=_make, rates_hz=sorted(RATES_HZ))
