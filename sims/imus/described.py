"""Twin of an IMU on a byte link whose protocol a file describes: what it sends is written by the same description."""

from collections.abc import Callable

import can

from drivers.imus.described.imu import Description
from sims.imus.can_nodes import CanNodes
from sims.physics.gyro import GyroArray
from sims.wires.frames import NodeFaults, SpecificForce


class DescribedDevice:
    """Measures from the beginning; sends when it has heard all that starts it, until it has heard all that stops it."""

    def __init__(
        self,
        gyros: GyroArray,
        write: Callable[[bytes], None],
        rate_hz: float,
        description: Description,
        *,
        specific_force: SpecificForce | None = None,
        faults: NodeFaults | None = None,
    ) -> None:
        """The gyros, as many as the description has, were made for ``rate_hz``."""
        self._write, self._description = write, description
        file, channels, database = description.file, (description.channel,), description.database
        self._nodes = CanNodes(
            gyros, self, file, channels, rate_hz, faults=faults, specific_force=specific_force, database=database
        )
        self.running = not description.start
        self._heard = b""

    def received(self, data: bytes) -> None:
        """Take bytes from the host, cut anywhere."""
        self._heard += data
        phrases = self._description.stop if self.running else self._description.start
        wanted = b"".join(phrase for phrase, _ in phrases)
        if wanted and wanted in self._heard:
            self.running, self._heard = not self.running, b""
        self._heard = self._heard[-len(wanted) or len(self._heard) :]

    def send(self, msg: can.Message) -> None:
        """Send a message as the description frames it."""
        if self.running:
            self._write(self._description.framing.written(bytes(msg.data)))

    async def serve(self) -> None:
        """Send until cancelled."""
        await self._nodes.serve()
