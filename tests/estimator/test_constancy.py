"""What is measured changes in mid-run: it is told, named, and nothing is told of a run in which nothing changes."""

from __future__ import annotations

import re

import numpy as np
import pytest
from support import SITE, TABLE_1

from estimator.estimation.calibrate import calibrate
from estimator.geometry.array import tetrahedron
from sims.physics.hidden import Hidden
from station.opening import DeviceTruth, simulate
from station.scripts.loop_scripts import exploration_script
from station.scripts.script import paper_script

DEVICE = DeviceTruth(
    tetrahedron(), np.tile(TABLE_1, (4, 1)), float(np.radians(0.005)), float(np.radians(2 / 3600)), kind="tetrahedron"
)


def told(tables: dict[str, object], seed: int = 1, *, explored: bool = False) -> tuple[str, ...]:
    script = exploration_script() if explored else paper_script()
    recording = simulate(script, {"array": DEVICE}, seed, site=SITE, hidden=Hidden.of(tables))
    return calibrate(recording, innovations=False).spoilt


@pytest.mark.parametrize("explored", [False, True])
def test_nothing_is_told_of_a_run_in_which_nothing_changes(explored: bool) -> None:
    assert told({}, explored=explored) == ()


def test_a_scale_factor_that_steps_is_told_with_gyro_size_and_time() -> None:
    (said,) = told({"scale_step": {"size": ["0 ppm", "-2000 ppm", "0 ppm", "0 ppm"], "at": "105 s"}})
    found = re.search(r"\bk of gyro2 by ([+-][\d.e+]+) ppm from (\d+) s on", said)
    assert found, said
    assert "gyro1" not in said
    assert float(found[1]) == pytest.approx(2000, rel=0.3)  # a positive k makes the output too small
    assert float(found[2]) == pytest.approx(105, abs=6)


def test_a_sense_axis_that_tilts_further_is_told() -> None:
    (said,) = told({"alignment_step": {"sigma_j": ["0.1 deg", "0 deg", "0 deg", "0 deg"], "at": "170 s"}})
    assert "sigma_j of gyro1" in said


def test_gearing_that_changes_is_the_tables_because_all_gyros_say_so() -> None:
    reading = {"axis": "y", "from": "180 s", "angle": "0.3 %", "rate": "0.3 %"}
    (said,) = told({"table_reading": reading})
    assert re.search(r"the way of axis y beside its readings by -0\.[23]\d* % from 1[78]\d s on", said), said


def test_a_body_that_creeps_for_a_moment_while_the_table_says_that_it_rests_is_told() -> None:
    reading = {"axis": "x", "from": "20 s", "until": "40 s", "creep": "0.03 deg/s", "followed": True}
    (said,) = told({"table_reading": reading})
    assert re.search(r"the way of axis x beside its readings by -0\.0\d+ deg/s (from|between) [12]\d ", said), said


@pytest.mark.parametrize("seed", range(4))
def test_a_creep_that_would_pass_for_noise_is_told(seed: int) -> None:
    reading = {"axis": "xyzx"[seed], "from": "20 s", "until": "60 s", "creep": "0.008 deg/s", "followed": True}
    (said,) = told({"table_reading": reading}, seed)
    assert "changed in mid-run" in said


def test_earth_rate_on_a_table_of_no_stated_site_is_no_change() -> None:
    recording = simulate(paper_script(), {"array": DEVICE}, 1, site=None)
    assert calibrate(recording, innovations=False).spoilt == ()
