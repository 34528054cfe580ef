"""What the tests of devices on CAN share: a driver on a bus in memory, in virtual time."""

from __future__ import annotations

import asyncio
import itertools
import json
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from drivers.errors import LinkLost
from drivers.protocols import ImuSource
from drivers.types import Frame, ImuBlock
from sims.physics.body import Body
from sims.physics.geometry import MOUNTS_DEG, mounted
from sims.physics.gyro import GyroArray, GyroTruth
from station.run.event_loop.loops import VirtualLoop

T = TypeVar("T")
_buses = itertools.count()


def vectors(name: str) -> list[dict[str, Any]]:
    """Return the vectors of one file."""
    path = Path(__file__).parents[1] / "vectors" / f"{name}.json"
    return list(json.loads(path.read_text())["vectors"])


def wire() -> str:
    """Return the name of a bus in memory that nobody else uses."""
    return f"can support {next(_buses)}"


def in_virtual_time(main: Callable[[], Awaitable[T]]) -> T:
    """Run a test's main in virtual time."""

    async def run() -> T:
        return await main()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(run())


async def collect(source: ImuSource, duration_s: float, *, flush: bool = True) -> dict[str, ImuBlock]:
    """Return what an open source gives in this time, one block a name."""
    found: dict[str, list[ImuBlock]] = {name: [] for name in source.names}

    async def read() -> None:
        async for name, block in source.blocks():
            found[name].append(block)

    reader = asyncio.create_task(read())
    await asyncio.sleep(duration_s)
    reader.cancel()
    await asyncio.gather(reader, return_exceptions=True)
    for name, block in source.flush() if flush else ():
        found[name].append(block)
    return {name: joined(blocks) for name, blocks in found.items() if blocks}


class Flood:
    """A link that gives frames with random data at the pace of 500 a second, then is lost.

    Four of five have an identifier of ours, the rest any of 11 or 29 bits; lengths are any.
    """

    def __init__(self, own: Sequence[tuple[int, bool]], frames: int) -> None:
        """``own`` are identifiers, each with whether it is extended."""
        self._own, self._left, self._rng, self._t_ns = own, frames, np.random.default_rng(1), 0

    async def open(self) -> None:
        pass

    async def receive(self) -> list[Frame]:
        if self._left <= 0:
            raise LinkLost("imu", "that was all")
        self._left -= 100
        rng = self._rng
        mine, chosen, extended = rng.random(100) < 0.8, rng.integers(len(self._own), size=100), rng.random(100) < 0.5
        lengths = np.where(rng.random(100) < 0.5, 8, rng.integers(9, size=100))
        frames = []
        for i in range(100):
            self._t_ns += 2_000_000
            foreign = (int(rng.integers(1 << (29 if extended[i] else 11))), bool(extended[i]))
            identifier, is_extended = self._own[chosen[i]] if mine[i] else foreign
            frames.append(Frame(self._t_ns, identifier, is_extended, rng.bytes(int(lengths[i]))))
        return frames

    def send(self, frame: Frame) -> None:
        pass

    def close(self) -> None:
        pass


def joined(blocks: list[ImuBlock]) -> ImuBlock:
    """Return blocks as one."""

    def column(name: str) -> Any:
        parts = [getattr(block, name) for block in blocks]
        return None if parts[0] is None else np.concatenate(parts)

    return ImuBlock(*(column(name) for name in ImuBlock.__slots__))


def gyros(
    rate_hz: float, rate_dps: tuple[float, float, float] = (10.0, -20.0, 30.0), mount: str = "triad"
) -> GyroArray:
    """Return gyros without noise that see their part of a constant rate about x, y, z."""
    mounting = mounted(MOUNTS_DEG[mount])
    m = len(mounting.p)
    truth = GyroTruth(np.zeros(m), -(mounting.p @ np.radians(rate_dps)), np.zeros(m), np.zeros(m), 0.0, 0.0)
    still = Body(
        gimbals=("z",),
        angles=lambda _, t_s: np.zeros(len(t_s)),
        revision=lambda: 0,
        latitude_rad=0.0,
        heading_rad=0.0,
        earth_turns=False,
    )
    return GyroArray(mounting=mounting, truth=truth, body=still, rate_hz=rate_hz, seed=(1,))
