"""Recordings with something wrong: what is missing is named, and what can be estimated is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support import TABLE_1, direct_recording

from estimator.calibration.values import Calibration
from estimator.estimation.calibrate import calibrate
from estimator.geometry.array import dodecahedron
from estimator.recordings.recording import Recording
from estimator.recordings.writing import columns_of
from station.scripts.script import Rest, Rotate, Script

DEG = np.pi / 180


def turn(axis: str, sign: int = 1) -> Rotate:
    return Rotate(axis, sign * 40 * DEG, 20.0, 20 * DEG, f"{axis} {sign:+d}")


def changed(recording: Recording, change: object) -> Recording:
    data = recording.sources["array"]
    rate = data.rate_rps.copy()
    change(rate)  # type: ignore[operator]
    return replace(recording, sources={"array": replace(data, rate_rps=rate)})


def right(calibration: Calibration, names: set[str]) -> bool:
    return {g.name for g in calibration.gyros} == names and all(
        np.all(np.abs(g.states - TABLE_1) < 4.5 * g.sd) for g in calibration.gyros
    )


@pytest.fixture(scope="module")
def run() -> Recording:
    return direct_recording(3)


ALL = {"gyro1", "gyro2", "gyro3", "gyro4"}


def test_without_rest_the_rest_is_missed_and_all_is_estimated() -> None:
    script = Script("no rest", tuple(turn(axis, sign) for axis in "xyz" for sign in (1, -1)))
    calibration = calibrate(direct_recording(0, script=script))
    assert right(calibration, ALL)
    assert any("no rest" in note for note in calibration.notes)


def test_without_motion_only_the_bias_is_estimated() -> None:
    calibration = calibrate(direct_recording(0, script=Script("still", (Rest(60.0),))))
    assert right(calibration, ALL)
    assert any("does not move" in note for note in calibration.notes)
    assert all(g.sd[1] < 0.01 * DEG and g.sd[0] > 0.04 for g in calibration.gyros)


def test_turns_about_one_axis_are_named() -> None:
    calibration = calibrate(direct_recording(0, script=Script("x", (Rest(20.0), turn("x"), turn("x", -1)))))
    assert right(calibration, ALL)
    assert any("turns about x only" in note for note in calibration.notes)


def test_numbers_that_are_none_are_left_out(run: Recording) -> None:
    def spoil(rate: np.ndarray) -> None:
        rate[100:400, 1] = np.nan

    calibration = calibrate(changed(run, spoil))
    assert right(calibration, ALL)
    assert any("gyro2: 300 of" in note for note in calibration.notes)


def test_a_constant_channel_is_named_and_the_others_are_estimated(run: Recording) -> None:
    def spoil(rate: np.ndarray) -> None:
        rate[:, 2] = 0.25

    calibration = calibrate(changed(run, spoil))
    assert right(calibration, ALL - {"gyro3"})
    assert [(e.name, "constant at 14.32 deg/s" in e.reason) for e in calibration.excluded] == [("gyro3", True)]


def test_a_channel_that_saturates_is_named_and_what_it_saw_below_is_used(run: Recording) -> None:
    def spoil(rate: np.ndarray) -> None:
        np.clip(rate[:, 1], -15 * DEG, 15 * DEG, out=rate[:, 1])

    calibration = calibrate(changed(run, spoil))
    assert right(calibration, ALL)
    assert any("gyro2 saturates at 15 deg/s" in note for note in calibration.notes)
    by_name = {g.name: g for g in calibration.gyros}
    assert by_name["gyro2"].sd[0] > 2 * by_name["gyro1"].sd[0]


def test_a_gyro_that_fails_in_mid_run_is_found_by_the_parity_of_six() -> None:
    recording = direct_recording(0, kind="dodecahedron", array=dodecahedron(), states=np.tile(TABLE_1, (6, 1)))
    assert not any(check.suspect for check in calibrate(recording).parity)

    def spoil(rate: np.ndarray) -> None:
        rate[20000:21000, 4] += 1 * DEG

    calibration = calibrate(changed(recording, spoil))
    worst = max(calibration.parity, key=lambda check: check.worst_sigma)
    assert worst.suspect
    assert worst.told_apart
    assert worst.name == "gyro5"
    assert any("gyro5 disagrees" in note for note in calibration.notes)


def by_source(recording: Recording, lost: int = 0) -> Recording:
    """Return the same gyros as sources of their own, which lose so many of 400 samples, each others."""
    data, own = recording.sources["array"], {}
    for i, name in enumerate(data.array.names):
        kept = (np.arange(len(data.t_ns)) + 100 * i) % 400 >= lost
        columns = {key: values[kept] for key, values in columns_of(data).items()}
        columns["rate_rps"] = columns["rate_rps"][:, [i]]
        own[name] = replace(data, array=data.array.select([i]), **columns)
    return replace(recording, sources=own)


@pytest.mark.parametrize("lost", [0, 20])
def test_gyros_with_samples_of_their_own_are_compared_at_the_same_body_rate(run: Recording, lost: int) -> None:
    checks = calibrate(by_source(run, lost)).parity
    assert len(checks) == 4
    assert not any(check.suspect for check in checks)


def test_a_gyro_that_fails_among_sources_is_seen_when_it_does(run: Recording) -> None:
    def spoil(rate: np.ndarray) -> None:
        rate[20000:20500, 1] += 0.2 * DEG

    calibration = calibrate(by_source(changed(run, spoil)))
    assert all(check.suspect and 199 < check.worst_t_s < 206 for check in calibration.parity)
    assert any("One of them is wrong" in note for note in calibration.notes)


def test_a_fault_beside_a_slower_gyro_is_seen_when_it_happens(run: Recording) -> None:
    def spoil(rate: np.ndarray) -> None:
        rate[20000:20500, 1] += 0.5 * DEG

    sources = dict(by_source(changed(run, spoil)).sources)
    slow = sources["gyro1"]
    sources["gyro1"] = replace(slow, **{key: values[::10] for key, values in columns_of(slow).items()})
    checks = calibrate(replace(run, sources=sources)).parity
    assert all(check.suspect and 199 < check.worst_t_s < 206 for check in checks)
