"""station allan: noise at rest with intervals, and why there is none."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support import direct_recording

from estimator.geometry.array import sensor_array
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import RateReadings
from estimator.recordings.writing import write_recording
from station.cli import main

RATE_HZ = 50.0
ARW = np.radians(0.005)
VRW = 1e-3


def resting(span_s: float, *, turning: bool = False) -> Recording:
    """Return a recording of three gyros and accelerometers that rest, with white noise alone."""
    random = np.random.default_rng(8)
    n = round(span_s * RATE_HZ)
    t_ns = np.round(np.arange(n) * 1e9 / RATE_HZ).astype(np.int64)
    rate = np.radians(0.1) + ARW * np.sqrt(RATE_HZ) * random.standard_normal((n, 3))
    force = [0.0, 0.0, 9.8] + VRW * np.sqrt(RATE_HZ) * random.standard_normal((n, 3))
    data = ImuData(sensor_array(np.eye(3), names=("x", "y", "z")), t_ns, rate, accel_mps2=force)
    body_rps = np.full((n, 3), 0.1 if turning else 0.0)
    return Recording({"imu": data}, RateReadings(t_ns, body_rps))


def changed(recording: Recording, *, keep: np.ndarray | None = None, stuck: int | None = None) -> Recording:
    """Return a recording with only the samples to keep, or with one gyro stuck and the next without numbers."""
    data = recording.sources["imu"]
    rows = np.full(len(data.t_ns), True) if keep is None else keep
    rate = data.rate_rps.copy()
    if stuck is not None:
        rate[:, stuck] = rate[0, stuck]
        rate[:, stuck + 1] = np.nan
    assert data.accel_mps2 is not None
    fewer = replace(data, t_ns=data.t_ns[rows], rate_rps=rate[rows], accel_mps2=data.accel_mps2[rows])
    return replace(recording, sources={"imu": fewer})


def written(folder: Path, recording: Recording) -> str:
    path = folder / "rest.h5"
    write_recording(path, recording)
    return str(path)


def test_gyros_and_accelerometers_have_intervals_lengths_and_a_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, picture = written(tmp_path, resting(200.0)), tmp_path / "allan.svg"
    assert main(["allan", file, "--json", "--plot", str(picture), "--uncertainty", "5 %"]) == 0
    found = json.loads(capsys.readouterr().out)
    sensors = {sensor["name"]: sensor for sensor in found["sensors"]}
    assert [*sensors] == ["x", "y", "z", "accel x", "accel y", "accel z"]
    for name, unit, true in (("x", "rad/s", ARW), ("accel z", "m/s2", VRW)):
        sensor = sensors[name]
        low, high = sensor["N"]["interval"]
        assert sensor["unit"] == unit
        assert 0.99 * low < true < 1.01 * high
        assert high < 1.1 * low
        assert sensor["B"]["seen"] is False
        assert sensor["B"]["interval"][0] == 0
        assert sensor["N"]["record_s"] < 200 < sensor["B"]["record_s"]
        curve = sensor["curve"]
        assert len(curve["tau_s"]) == len(curve["deviation"]) == len(curve["edf"])
        assert all(a < b < c for a, b, c in zip(curve["low"], curve["deviation"], curve["high"], strict=True))
    drawn = picture.read_text()
    assert "<svg" in drawn
    assert main(["allan", file]) == 0
    shown = capsys.readouterr().out
    assert "deg/s/rtHz" in shown
    assert "ug/rtHz" in shown
    assert "at most" in shown


def test_of_a_device_that_turns_only_the_rests_count(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = direct_recording(1)
    assert main(["allan", written(tmp_path, recording), "--json"]) == 0
    for sensor in json.loads(capsys.readouterr().out)["sensors"]:
        assert sensor["span_s"] == pytest.approx(135, abs=2)
        assert sensor["longest_s"] == pytest.approx(67.5, abs=1)
        assert sensor["N"]["interval"][0] < 1.02 * ARW
        assert sensor["N"]["interval"][1] > 0.98 * ARW


def test_short_gaps_are_passed_over_and_gyros_without_noise_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = resting(100.0)
    keep = np.arange(5000) % 500 >= 10
    assert main(["allan", written(tmp_path, changed(recording, keep=keep, stuck=1)), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [sensor["name"] for sensor in found["sensors"]][:2] == ["x", "accel x"]
    assert found["sensors"][0]["longest_s"] > 97
    assert any(note.startswith("y: the output does not change") for note in found["notes"])
    assert any(note.startswith("z: no numbers") for note in found["notes"])
    assert any("90 samples are missing" in note for note in found["notes"])


@pytest.mark.parametrize(
    ("recording", "said"),
    [
        (resting(100.0, turning=True), "no rest of 5 s and more is known in it"),
        (changed(resting(100.0), keep=np.arange(5000) % 10 >= 2), "20% of the samples at rest are missing"),
        (changed(resting(100.0), keep=np.arange(5000) % 100 < 10), "record a longer rest"),
    ],
    ids=["it turns", "gaps", "too short"],
)
def test_what_cannot_be_used_is_refused_with_what_to_do(
    recording: Recording, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["allan", written(tmp_path, recording), "--json"]) == 2
    printed = capsys.readouterr()
    assert said in printed.err
    assert json.loads(printed.out)["sensors"] == []


@pytest.mark.parametrize("share", ["10", "0 %", "80 %", "10 deg"])
def test_an_uncertainty_is_a_share(share: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["allan", written(tmp_path, resting(10.0)), "--uncertainty", share]) == 2
    assert "--uncertainty" in capsys.readouterr().err
