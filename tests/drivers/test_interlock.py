"""An open interlock, or an emergency stop that is pressed, is told in words where the protocol tells it."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest
from test_lexium import drives
from turntable_rigs import DEG, rig, settle, virtually

from drivers.errors import DeviceFault
from sims.physics.table import TableModel

WORDS = "interlock|emergency stop"


@asynccontextmanager
async def table_of(kind: str) -> AsyncIterator[tuple[Any, TableModel]]:
    if kind == "lexium32":
        async with drives() as (table, model):
            await table.open()
            yield table, model
    else:
        async with rig(kind) as found:
            yield found.table, found.model


@pytest.mark.parametrize("kind", ["acutrol", "galil", "lexium32"])
def test_no_axis_is_enabled_while_the_interlock_is_open(kind: str) -> None:
    async def main() -> None:
        async with table_of(kind) as (table, model):
            assert not (await table.status("x")).interlock
            model.open_interlock()
            for _ in range(2):
                status = await table.status("x")
                assert "emergency stop" in status.interlock
                assert not status.enabled
                with pytest.raises(DeviceFault, match=WORDS):
                    await table.enable()
            model.interlock_open = False
            await table.reset_fault()
            await table.enable()
            status = await table.status("x")
            assert status.enabled
            assert not status.trouble

    virtually(main)


@pytest.mark.parametrize("kind", ["acutrol", "galil", "lexium32"])
def test_an_interlock_that_opens_while_an_axis_turns_is_told_and_no_reset_helps(kind: str) -> None:
    async def main() -> None:
        async with table_of(kind) as (table, model):
            await table.enable()
            await table.jog("y", 20 * DEG, 50 * DEG)
            await settle(table, "y")
            model.open_interlock()
            status = await table.status("y")
            assert not status.enabled
            assert "emergency stop" in status.interlock
            with pytest.raises(DeviceFault):
                await table.reset_fault()

    virtually(main)
