"""Whole runs on wires that misbehave: the table soon at rest, nothing printed, the reason names what happened."""

from __future__ import annotations

import asyncio
import os
import re
from dataclasses import replace
from pathlib import Path

import pytest
from misbehaving import BENCH, DEG, KINDS, PHASES, SCRIPT, LoopbackLoop, joined, run_cases
from misbehaving_wire import Kind, Proxy

from station.bench.bench import load_bench
from station.opening import open_bench
from station.run.session import Session
from station.run.snapshot import Phase

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX only")
RATE = 20 * DEG
SOME = {
    ("modbus", "byte count too large", "steady"),
    ("galil", "reset and gone for 0.3 s", "homing"),
    ("acutrol", "half-open", "ramp"),
    ("rtu", "a bit flipped", "last stop"),
}


def test_a_run_whose_wire_is_struck_ends_at_rest_and_says_why() -> None:
    cases = [(protocol, kind, phase) for protocol in KINDS for kind in KINDS[protocol] for phase in PHASES]
    found = run_cases([case for case in cases if (case[0], case[1].name, case[2]) in SOME])
    assert len(found) == len(SOME)
    assert [str(one) for one in found if one.wrong] == []


def test_a_table_that_heeds_neither_stop_nor_abort_is_told_to_switch_off(tmp_path: Path) -> None:
    class Stubborn(Proxy):
        sent = b""

        def requests(self, data: bytes, spoilt: bool = True) -> list[bytes]:
            self.sent += data
            return [data if self.kind is None else data.replace(b"\rST", b"\rTS").replace(b"\rAB", b"\rTC")]

    async def main() -> str:
        proxy = Stubborn()
        async with joined("galil", proxy) as (table, model), open_bench(load_bench(BENCH)) as twins:
            session = Session(replace(twins, table=table, at_rest=model.at_rest), SCRIPT, tmp_path / "r.h5")

            async def strike() -> None:
                while model.at_rest() or session.snapshot().phase is not Phase.RUNNING:
                    await asyncio.sleep(0.01)
                proxy.strike(Kind("heeds nothing"))
                model.motion["z"].jog(model.clock(), RATE, RATE)

            striking = asyncio.ensure_future(strike())
            reason = (await session.run()).verdict.reason
            await striking
            assert b"\rMO" in proxy.sent[proxy.sent.rindex(b"\rAB") :]
            return reason

    with asyncio.Runner(loop_factory=LoopbackLoop) as runner:
        reason = runner.run(main())
    assert re.match(r"table: axis z turns at .*the table was not seen to come to rest .*use the emergency stop", reason)


@pytest.mark.full
@pytest.mark.timeout(600)
@pytest.mark.parametrize("protocol", sorted(KINDS))
@pytest.mark.parametrize("phase", PHASES)
def test_every_kind_in_every_phase(protocol: str, phase: str) -> None:
    found = run_cases([(protocol, kind, phase) for kind in KINDS[protocol]])
    assert [str(one) for one in found if one.wrong] == []
