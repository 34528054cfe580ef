"""Whole runs on wires that misbehave: the table soon at rest, nothing printed, the reason names what happened."""

from __future__ import annotations

import os

import pytest
from misbehaving import KINDS, PHASES, run_cases

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX only")
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


@pytest.mark.full
@pytest.mark.timeout(600)
@pytest.mark.parametrize("protocol", sorted(KINDS))
@pytest.mark.parametrize("phase", PHASES)
def test_every_kind_in_every_phase(protocol: str, phase: str) -> None:
    found = run_cases([(protocol, kind, phase) for kind in KINDS[protocol]])
    assert [str(one) for one in found if one.wrong] == []
