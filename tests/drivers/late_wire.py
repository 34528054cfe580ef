"""A wire on which answers come late, in pieces, and with noise between them; in order, as on every wire."""

from __future__ import annotations

import asyncio
import random
from collections import deque
from collections.abc import Callable

import pytest
from turntable_rigs import COUNTS, DEG, Controller, byte_pair, model_of, virtually
from wire_pair import pair

from drivers.errors import BadReply, LinkLost
from drivers.links.memory_link import MemoryLink


class LateWire:
    """The controller's end of a wire in memory. ``delay_s`` says how late the next answer is."""

    def __init__(self, link: MemoryLink, seed: int, delay_s: Callable[[random.Random], float]) -> None:
        self.link = link
        self.controller: Controller | None = None
        self.noise = 0.0  # chance of noise before an answer
        self.pieces = True
        self.late = True
        self._random = random.Random(seed)
        self._delay_s = delay_s
        self._under_way: deque[bytes] = deque()
        self._free_s = 0.0  # nothing overtakes what was written before

    def write(self, data: bytes) -> None:
        """Send an answer of the controller, some time."""
        loop = asyncio.get_running_loop()
        if self._random.random() < self.noise:
            self._send(loop.time(), self._random.randbytes(self._random.randint(1, 12)))
        self._send(loop.time() + (self._delay_s(self._random) if self.late else 0.0), data)

    def _send(self, at_s: float, data: bytes) -> None:
        loop = asyncio.get_running_loop()
        while data:
            length = self._random.randint(1, len(data)) if self.pieces else len(data)
            self._free_s = max(self._free_s, at_s)
            self._under_way.append(data[:length])
            loop.call_at(self._free_s, self._arrive)  # timers of one instant come in any order: the queue keeps it
            data = data[length:]
            at_s = self._free_s + (self._random.choice((0.0, 1e-4, 2e-3)) if self.pieces else 0.0)

    def _arrive(self) -> None:
        self.link.write(self._under_way.popleft())

    async def carry(self) -> None:
        """Carry what the driver writes to the controller, until cancelled."""
        while True:
            data = (await self.link.receive()).data
            if self.controller is not None:
                self.controller.received(data)


def often_late(dice: random.Random) -> float:
    """Mostly in time, sometimes after one time-out of 0.2 s, now and then after several."""
    kind = dice.random()
    if kind < 0.8:
        return dice.uniform(0.0, 0.02)
    if kind < 0.95:
        return dice.uniform(0.1, 0.45)
    return dice.uniform(0.4, 2.5)


def read_under_lateness(kind: str, seed: int, noise: float) -> tuple[int, int]:
    """Read three turning axes in turn; see that each reading is true within its round trip; count read and lost.

    A stale answer would be of another axis, of another quantity, or of before its request: it would show.
    """
    told = {"x": 20.0, "y": -70.0, "z": 5.0}
    count = max(0.51 * 360.0 / COUNTS[kind], 1e-5)
    read = lost = 0

    async def main() -> None:
        nonlocal read, lost
        model = model_of("xyz", COUNTS[kind])
        near, far = pair("table")
        wire = LateWire(far, seed, often_late)
        wire.late = False
        table, wire.controller = byte_pair(kind, near, model, wire.write, "xyz")
        carrier = asyncio.get_running_loop().create_task(wire.carry())
        await table.open()
        await table.enable()
        await table.home()
        for axis, rate in told.items():
            await table.jog(axis, rate * DEG, 50 * DEG)
        await asyncio.sleep(3.0)
        wire.late, wire.noise = True, noise
        for turn in range(400):
            axis = "xyz"[turn % 3]
            try:
                state = await table.read(axis)
            except (LinkLost, BadReply):
                lost += 1
                continue
            read += 1
            angle_s, half_s = state.angle_t_ns * 1e-9, state.half_width_ns * 1e-9
            way = sorted(model.motion[axis].at(angle_s + sign * half_s)[0] / DEG for sign in (-1, 1))
            turns = 360.0 * round((state.angle_rad / DEG - way[0]) / 360.0) if kind == "acutrol" else 0.0
            assert way[0] - count <= state.angle_rad / DEG - turns <= way[1] + count
            assert state.rate_rps / DEG == pytest.approx(told[axis], abs=1.1e-4)
            await asyncio.sleep(0.01)
        assert table.counts.timeouts > 20
        assert table.counts.discarded > 100
        table.close()
        carrier.cancel()

    virtually(main)
    return read, lost
