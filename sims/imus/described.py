"""Twin of an IMU on a byte link that a file describes: its output follows the same description."""

from collections.abc import Callable

import can

from drivers.imus.described.imu import Description
from sims.imus.can_nodes import CanNodes
from sims.wires.frames import ImuTwinSetup


class DescribedDevice(CanNodes):
    """Measures all the time; sends from the end of the start phrase until it receives the stop phrase."""

    def __init__(self, setup: ImuTwinSetup, write: Callable[[bytes], None]) -> None:
        """Prepare for the ``Description`` in ``setup.signals``; it sends at once if that has no start phrase."""
        description: Description = setup.signals
        super().__init__(setup, self)
        self._write, self._framing = write, description.framing
        self._start, self._stop = (
            b"".join(data for data, _ in phrases) for phrases in (description.start, description.stop)
        )
        self._heard = b""
        self.running = not self._start

    def received(self, data: bytes) -> None:
        """Take bytes from the host, cut anywhere."""
        self._heard += data
        awaited = self._stop if self.running else self._start
        if awaited and awaited in self._heard:
            self.running, self._heard = not self.running, b""
        self._heard = self._heard[max(len(self._heard) - len(awaited), 0) :]

    def send(self, msg: can.Message) -> None:
        """Send a message as the description frames it."""
        if self.running:
            self._write(self._framing.written(bytes(msg.data)))
