"""Devices under test as a kind: they send by themselves, and nothing has to be done to make them safe."""

from drivers.imus.registry import IMUS
from drivers.kind import DeviceKind

SPEC = DeviceKind(name="imu", what="a device under test", protocols=IMUS, wires=("serial", "tcp"))
