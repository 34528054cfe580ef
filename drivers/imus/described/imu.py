"""An IMU on a byte link whose protocol a file describes, as a DBC describes one on CAN."""

import asyncio
from contextlib import suppress
from dataclasses import dataclass

from drivers.errors import LinkLost
from drivers.imus.can.imu import CanImu, CanSource
from drivers.imus.described.framing import Decoder, Frames, Lines
from drivers.protocols import ByteLink
from drivers.specs import ImuSetup, ImuSpec, described
from drivers.types import ByteChunk, Frame, SourceCounts


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Description(CanSource):
    """How an IMU speaks on a byte link: its framing, and the single message of ``database`` in each frame.

    ``dbc`` is the description's file; the one of ``channels`` names the signals. ``start`` and ``stop`` are the bytes
    to send, each with a pause in s after it.
    """

    framing: Frames | Lines
    start: tuple[tuple[bytes, float], ...] = ()
    stop: tuple[tuple[bytes, float], ...] = ()


class FramedLink:
    """A byte link presented as a bus with a single message."""

    def __init__(self, link: ByteLink, description: Description) -> None:
        """Take the link, which is not open yet."""
        self._link, self._description = link, description
        self._identifier: int = description.database.messages[0].frame_id
        self._started = False
        self.decoder = Decoder(description.framing)

    async def open(self) -> None:
        """Open the link and send the bytes that start the device."""
        await self._link.open()
        self._started = True
        for data, pause_s in self._description.start:
            self._link.write(data)
            await asyncio.sleep(pause_s)

    async def receive(self) -> list[Frame]:
        """Return the frames of all bytes that have arrived, waiting for the first bytes; LinkLost if the link is gone.

        Each holds one message as its data, and the arrival time of the chunk that completed it. The list is empty if
        the bytes complete no frame. If the link is lost after some bytes were read, the next call says so.
        """
        frames = self._framed(await self._link.receive())
        with suppress(TimeoutError, LinkLost):  # bytes that have arrived already are read without waiting
            async with asyncio.timeout(0):
                while True:
                    frames += self._framed(await self._link.receive())
        return frames

    def send(self, frame: Frame) -> None:
        """Send a frame."""
        self._link.write(self._description.framing.written(frame.data))

    def close(self) -> None:
        """Send the bytes that stop the device, if it was started, without pauses, and close the link; a lost link is no
        error.
        """
        with suppress(LinkLost):
            for data, _ in self._description.stop if self._started else ():
                self._link.write(data)
        self._started = False
        self._link.close()

    def _framed(self, chunk: ByteChunk) -> list[Frame]:
        return [Frame(chunk.t_ns, self._identifier, False, message) for message in self.decoder.feed(chunk.data)]


class DescribedImu(CanImu):
    """One source with as many gyros as the description has."""

    def __init__(self, setup: ImuSetup, link: ByteLink) -> None:
        """Prepare for samples at the bench's rate: the ``Description`` does not tell how to ask for it."""
        self._framed = FramedLink(link, setup.signals)
        super().__init__(setup, self._framed)

    def counts(self, name: str) -> SourceCounts:
        """Return the counts; ``corrupt`` are places that began like a frame or line but were none."""
        counts = super().counts(name)
        counts.corrupt = self._framed.decoder.damaged
        return counts


SPEC = described(ImuSpec, __package__, make=DescribedImu, gyros=None)
