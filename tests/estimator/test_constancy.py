"""What is measured changes in mid-run: it is told, named, and nothing is told of a run in which nothing changes."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from motions import simulate
from support import SITE, TABLE_1

from estimator.estimation.calibrate import calibrate
from estimator.geometry.array import tetrahedron
from estimator.observations.coverage import coverage, coverage_notes, not_proved
from estimator.observations.defects.stuck import stuck_doubts
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import RateReadings
from sims.physics.hidden import Hidden
from station.bench.bench import load_bench
from station.opening import DeviceTruth
from station.scripts.early_late import early_and_late
from station.scripts.loop_scripts import between_rests, exploration_script, there_and_back, verification_script
from station.scripts.script import Rest, Rotate, Step, paper_script

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
    found = re.search(r"from (\d+) s on, k of gyro2 differed by ([+-][\d.e+]+) ppm", said)
    assert found, said
    assert "gyro1" not in said
    assert float(found[2]) == pytest.approx(2000, rel=0.3)  # a positive k makes the output too small
    assert float(found[1]) == pytest.approx(105, abs=6)


def test_a_sense_axis_that_tilts_further_is_told() -> None:
    (said,) = told({"alignment_step": {"sigma_j": ["0.1 deg", "0 deg", "0 deg", "0 deg"], "at": "170 s"}})
    assert "sigma_j of gyro1" in said


def test_gearing_that_changes_is_the_tables_because_all_gyros_say_so() -> None:
    reading = {"axis": "y", "from": "180 s", "angle": "0.3 %", "rate": "0.3 %"}
    (said,) = told({"table_reading": reading})
    assert re.search(r"from 1[78]\d s on, the gyros and the y encoder disagreed by -0\.[23]\d* %", said), said


def test_a_body_that_creeps_for_a_moment_while_the_table_says_that_it_rests_is_told() -> None:
    reading = {"axis": "x", "from": "20 s", "until": "40 s", "creep": "0.03 deg/s", "followed": True}
    (said,) = told({"table_reading": reading})
    assert re.search(r"from [12]\d (s on,|to \d+ s) the gyros and the x encoder disagreed by -0\.0\d+ deg/s", said)


@pytest.mark.parametrize("seed", range(4))
def test_a_creep_that_would_pass_for_noise_is_told(seed: int) -> None:
    reading = {"axis": "xyzx"[seed], "from": "20 s", "until": "60 s", "creep": "0.008 deg/s", "followed": True}
    (said,) = told({"table_reading": reading}, seed)
    assert re.search(r"from \d+ (s on,|to \d+ s) .+ (differed|disagreed) by", said), said


def test_earth_rate_on_a_table_of_no_stated_site_is_no_change() -> None:
    recording = simulate(paper_script(), {"array": DEVICE}, 1, site=None)
    assert calibrate(recording, innovations=False).spoilt == ()


def turn(axis: str, rate_dps: float, duration_s: float = 37.0) -> Rotate:
    return there_and_back(axis, rate_dps, duration_s)[0]


EARLY = [turn(axis, 20) for axis in "xyz"]
LATE = [turn(axis, -20) for axis in "xyz"]
SLOW = [turn(axis, 3) for axis in "xyz"]


@pytest.mark.parametrize(
    ("steps", "weak"),
    [
        (EARLY, "xyz"),
        ([step for axis in "xyz" for step in there_and_back(axis, 20.0, 60.0)], "xyz"),
        ([step for axis in "xyz" for step in (turn(axis, 20), Rest(5.0), turn(axis, 20), turn(axis, -20))], "xyz"),
        ([*SLOW, Rest(60.0), *LATE], "xyz"),
        ([*EARLY, Rest(60.0), *SLOW], "xyz"),
        ([*EARLY[:2], Rest(60.0), *LATE], "z"),
        ([*EARLY, Rest(60.0), *LATE], ""),
        ([turn("x", 20), Rest(100.0), turn("x", -20)], ""),
    ],
    ids=["once", "forth and back", "three at once", "slow early", "slow late", "z late only", "early and late", "x"],
)
def test_axes_that_were_not_turned_far_apart_in_time_are_named(steps: list[Step], weak: str) -> None:
    recording = simulate(between_rests("", steps), {"array": DEVICE}, 1, site=SITE)
    found = coverage(recording, list(recording.sources.values()))
    assert {one.axis for one in found} == {step.axis for step in steps if isinstance(step, Rotate)}
    assert "".join(one.axis for one in found if not one.proved) == weak
    assert all(one.concerns == ("k", "sigma_j", "sigma_k", "gearing") for one in found)
    if weak:
        assert not_proved(found) == f"constancy not proved: {', '.join(weak)}"
    else:
        assert re.fullmatch(r"constancy not proved before \d+ s and after \d+ s", not_proved(found))
    assert bool(coverage_notes(found)) == bool(weak)


def test_a_source_that_ends_early_has_not_seen_the_late_turns() -> None:
    recording = simulate(between_rests("", [*EARLY, Rest(60.0), *LATE]), {"array": DEVICE}, 1, site=SITE)
    (data,) = recording.sources.values()
    half = len(data.t_ns) // 2
    short = replace(data, t_ns=data.t_ns[:half], rate_rps=data.rate_rps[:half])
    found = coverage(recording, [data, short])
    assert [one.axis for one in found if not one.proved] == ["x", "y", "z"]


def test_another_instruments_rates_show_constancy_without_gearing() -> None:
    t_ns = np.arange(0, 300_000_000_000, 20_000_000)
    rates = np.zeros((len(t_ns), 3))
    for column, spans_s in enumerate([[(10, 40), (200, 230)], [(50, 110)], []]):
        for start_s, end_s in spans_s:
            rates[(t_ns >= start_s * 1e9) & (t_ns < end_s * 1e9), column] = 0.5
    data = ImuData(tetrahedron(), t_ns, np.zeros((len(t_ns), 4)))
    recording = Recording({"imu": data}, RateReadings(t_ns, rates))
    x, y = coverage(recording, [data])
    assert (x.axis, x.proved, y.axis, y.proved) == ("x", True, "y", False)
    assert x.covered_s == pytest.approx((25, 215), abs=0.2)
    assert y.covered_s == pytest.approx((65, 95), abs=0.2)
    assert y.concerns == ("k", "sigma_j", "sigma_k")


@pytest.mark.parametrize(
    "tables",
    [
        {"table_reading": {"axis": "x", "from": "140 s", "angle": "0.5 %", "rate": "0.5 %"}},
        {"scale_step": {"size": ["0 ppm", "8000 ppm", "0 ppm", "0 ppm"], "at": "160 s"}},
        {"alignment_step": {"sigma_j": ["0 deg", "0 deg", "0.2 deg", "0 deg"], "at": "130 s"}},
    ],
    ids=["gearing", "scale factor", "alignment"],
)
def test_the_script_that_turns_each_axis_early_and_late_finds_what_the_paper_s_cannot(
    tables: dict[str, object],
) -> None:
    limits = load_bench(None).table.limits
    offered = early_and_late(paper_script(), limits, ("z", "y", "x"))
    assert offered is not None
    assert offered.least_s == pytest.approx(360)
    recording = simulate(offered, {"array": DEVICE}, 1, site=SITE, hidden=Hidden.of(tables))
    found = calibrate(recording, innovations=False)
    assert re.search(r"from \d+ (s on,|to \d+ s) .+ (differed|disagreed) by", found.spoilt[0])
    assert all(one.proved for one in found.constancy)


@pytest.mark.parametrize(("cycle", "from_s"), [(1, 20.0), (4, 20.0), (1, 200.0)])
def test_a_source_that_gives_the_same_samples_again_and_again_is_stuck(cycle: int, from_s: float) -> None:
    recording = simulate(paper_script(), {"array": DEVICE}, 1, site=SITE)
    ((name, data),) = recording.sources.items()
    first = int(from_s * len(data.t_ns) / paper_script().least_s)
    rates = data.rate_rps.copy()
    rates[first:] = rates[first : first + cycle][np.arange(len(rates) - first) % cycle]
    stuck = replace(recording, sources={name: replace(data, rate_rps=rates)})
    said = calibrate(stuck, innovations=False).spoilt[0]
    assert re.match(rf".*: the same samples were repeated from {from_s:.0f}\.\d s on for \d+\.\d s", said), said


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
