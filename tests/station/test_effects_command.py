"""station effects: the catalogue as a person and a machine read it."""

from __future__ import annotations

import json

import pytest

from sims.physics.hidden.effects import KINDS
from station.cli import main

NOT_IN_IT = {"hysteresis", "rate_dependent_delay", "motor_current_gain", "encoder_eccentricity", "thermal_lag"}
CHANGES = {"scale_step", "alignment_step", "table_reading"}  # in mid-run: told by the verdict, no effect to add


def test_the_catalogue_lists_all_that_twins_can_hide_but_what_it_is_tried_on(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["effects", "--json"]) == 0
    listed = {entry["effect"]: entry for entry in json.loads(capsys.readouterr().out)}
    names = {name.removesuffix("_1").removesuffix("_2").removesuffix("_4") for name in listed}
    assert {*KINDS, "earth_rate"} - NOT_IN_IT - CHANGES <= names
    assert listed["stuck"]["kind"] == "fault of the data"
    assert listed["bias_walk"]["parameters"][0]["unit"] == "rad/s/rts"
    assert all(entry["shown_by"] for entry in listed.values())
    known = {*listed, *names}
    assert all(other in known for entry in listed.values() for other in entry["confused_with"])


def test_the_catalogue_is_readable(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["effects"]) == 0
    said = capsys.readouterr().out
    assert "thermal bias" in said
    assert "a temperature that" in said
