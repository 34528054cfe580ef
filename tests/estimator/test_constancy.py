"""What is measured changes in mid-run: it is told, named, and nothing is told of a run in which nothing changes."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from support import SITE, TABLE_1

from estimator.estimation.calibrate import calibrate
from estimator.geometry.array import tetrahedron
from estimator.observations.defects.stuck import stuck_doubts
from sims.physics.hidden import Hidden
from station.opening import DeviceTruth, simulate
from station.scripts.loop_scripts import exploration_script, verification_script
from station.scripts.script import Script, paper_script

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


@pytest.mark.parametrize(("script", "once"), [(paper_script(), True), (verification_script(), False)])
def test_what_turned_only_once_is_said_to_show_no_change_between_turns(script: Script, once: bool) -> None:
    recording = simulate(script, {"array": DEVICE}, 1, site=SITE)
    notes = [note for note in calibrate(recording, innovations=False).notes if "turned only once" in note]
    assert len(notes) == once
    assert not once or notes[0].startswith("turned only once: x, y, z:")


@pytest.mark.parametrize(("cycle", "from_s"), [(1, 20.0), (4, 20.0), (1, 200.0)])
def test_a_source_that_gives_the_same_samples_again_and_again_is_stuck(cycle: int, from_s: float) -> None:
    recording = simulate(paper_script(), {"array": DEVICE}, 1, site=SITE)
    ((name, data),) = recording.sources.items()
    first = int(from_s * len(data.t_ns) / paper_script().duration_s)
    rates = data.rate_rps.copy()
    rates[first:] = rates[first : first + cycle][np.arange(len(rates) - first) % cycle]
    stuck = replace(recording, sources={name: replace(data, rate_rps=rates)})
    said = calibrate(stuck, innovations=False).spoilt[0]
    assert re.match(rf".*: the same samples again and again from {from_s:.0f}\.\d s on for \d+\.\d s", said), said


def test_a_coarse_gyro_that_rests_on_a_count_is_not_stuck() -> None:
    recording = simulate(paper_script(), {"array": DEVICE}, 1, site=SITE)
    ((name, data),) = recording.sources.items()
    coarse = np.round(data.rate_rps / np.radians(0.5)) * np.radians(0.5)
    rounded = replace(recording, sources={name: replace(data, rate_rps=coarse)})
    assert not any("stuck" in one for one in calibrate(rounded, innovations=False).spoilt)


def test_a_coarse_and_quiet_gyro_whose_stamps_are_late_is_not_stuck() -> None:
    quiet = replace(DEVICE, arw_rps_rthz=1e-6)
    recording = simulate(verification_script(), {"array": quiet}, 1, site=SITE)
    ((name, data),) = recording.sources.items()
    counts = np.round(data.rate_rps / np.radians(0.061)) * np.radians(0.061)
    late = replace(recording, sources={name: replace(data, rate_rps=counts, t_ns=data.t_ns + 60_000_000)})
    assert stuck_doubts(late) == []


def test_gyros_at_the_limit_of_their_range_are_not_stuck() -> None:
    recording = simulate(verification_script(), {"array": DEVICE}, 1, site=SITE)
    ((name, data),) = recording.sources.items()
    most = np.radians(5.0)
    limited = replace(recording, sources={name: replace(data, rate_rps=np.clip(data.rate_rps, -most, most))})
    assert stuck_doubts(limited) == []
