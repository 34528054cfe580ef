"""The way to rest of a table: everything that went wrong is told."""

from __future__ import annotations

import asyncio
from typing import cast

from drivers.errors import DeviceFault
from drivers.protocols import Turntable
from drivers.tables.making_safe import make_safe


class Deaf:
    """A table of which the stop and the relay of the power fail, and the abort works."""

    async def stop(self) -> None:
        raise DeviceFault("table", "no answer to stop")

    async def abort(self) -> None:
        """It aborts."""

    async def disable(self) -> None:
        raise DeviceFault("table", "the relay sticks")


def test_power_that_stays_on_is_told_also_after_a_stop_that_failed() -> None:
    told: list[str] = []
    state = asyncio.run(make_safe(cast("Turntable", Deaf()), time_scale=1.0, unconfirmed=told.append))
    assert len(told) == 1
    assert "no answer to stop" in told[0]
    assert state.seen
    assert "did not come to rest by a controlled stop" in state.trouble
    assert "its power may be on (table: the relay sticks)" in state.trouble
