"""Aceinna's devices on SAE J1939, as an IMU of the station."""

from drivers.imus.aceinna.codec import AXIS_ORDERS, DEFAULT_ADDRESS, RATES_HZ
from drivers.imus.aceinna.imu import AceinnaImu
from drivers.protocols import FrameLink, ImuSource
from drivers.specs import ImuSetup, ImuSpec, described


def _make(setup: ImuSetup, link: FrameLink) -> ImuSource:
    return AceinnaImu(setup.name, link, setup.rate_hz, **setup.options)


_KEYS = {"model": {"one_of": AXIS_ORDERS}, "address": {"one_of": range(0xFE), "default": DEFAULT_ADDRESS}}
SPEC = described(ImuSpec, __package__, _KEYS, make=_make, rates_hz=sorted(RATES_HZ))
