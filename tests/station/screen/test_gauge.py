"""`station history --gauge`: repeatability and reproducibility of a station, from its recordings."""

from __future__ import annotations

import json
import re
import shutil
from itertools import product
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from estimator.geometry.model import STATES
from station.cli import main

_NOON_S = 1_795_262_400  # 2026-11-21 12:00:00 UTC
DEVICES, BENCHES, REPEATS = 3, 2, 2
DEVICE_SIGMAS, BENCH_SIGMAS, RUN_SIGMAS = 20.0, 3.0, 1.0


def write_run(folder: Path, runs: Path, shift: Any, **attributes: str) -> None:
    """Write the first recording again as that of another run, its states off by ``shift`` (gyros, 4) sigmas."""
    number = len(list(folder.iterdir()))
    path = folder / f"run-{number:02d}.h5"
    shutil.copy(runs / "first.h5", path)
    with h5py.File(path, "r+") as file:
        file.attrs.update({"clock_zero_utc_s": float(_NOON_S + 3600 * number), **attributes})
        file["calibration/states"][...] = file["calibration/states"][()] + shift * file["calibration/sd"][()]


@pytest.fixture
def studied(place: Path, runs: Path) -> tuple[Path, Any]:
    """Return a folder of a balanced study, and its values (devices, benches, repeats, gyros, 4) in SI."""
    with h5py.File(runs / "first.h5") as file:
        states, sd = (file[f"calibration/{key}"][()] for key in ("states", "sd"))
    chance, gyros = np.random.default_rng(5), len(states)
    shift = (
        DEVICE_SIGMAS * chance.normal(size=(DEVICES, 1, 1, gyros, 4))
        + BENCH_SIGMAS * chance.normal(size=(1, BENCHES, 1, 1, 4))
        + BENCH_SIGMAS * chance.normal(size=(DEVICES, BENCHES, 1, gyros, 4))
        + RUN_SIGMAS * chance.normal(size=(DEVICES, BENCHES, REPEATS, gyros, 4))
    )
    folder = place / "study"
    folder.mkdir()
    for device, bench, repeat in product(range(DEVICES), range(BENCHES), range(REPEATS)):
        told = {"device_serial": f"SN-000{device}", "station": f"bench {bench}"}
        write_run(folder, runs, shift[device, bench, repeat], **told)
    return folder, states + shift * sd


def history(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """Return what `station history` prints."""
    capsys.readouterr()
    assert main(["history", *map(str, arguments)]) == 0
    return capsys.readouterr().out


def test_figures_are_those_of_a_balanced_study_by_hand(
    studied: tuple[Path, Any], runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, values = studied
    with h5py.File(runs / "first.h5") as file:
        sd = file["calibration/sd"][()]
    for outcome in ("ABORTED", "FAULT"):  # which are no measurements
        write_run(folder, runs, 1e6, device_serial="SN-0001", station="bench 1", outcome=outcome)
    (study,) = json.loads(history(capsys, folder, "--gauge", "--json"))["gauge"]
    assert (study["devices"], study["runs"], study["benches"]) == (DEVICES, 12, ["bench 0", "bench 1"])
    table = np.moveaxis(values, 3, 1).reshape(-1, BENCHES, REPEATS, 4)  # each gyro of a device is a part
    parts = len(table)
    cell, part, bench, mean = table.mean(2), table.mean((1, 2)), table.mean((0, 2)), table.mean((0, 1, 2))
    within = ((table - cell[:, :, None]) ** 2).sum((0, 1, 2)) / (parts * BENCHES * (REPEATS - 1))
    mixed = REPEATS * ((cell - part[:, None] - bench + mean) ** 2).sum((0, 1)) / ((parts - 1) * (BENCHES - 1))
    of_benches = parts * REPEATS * ((bench - mean) ** 2).sum(0) / (BENCHES - 1)
    of_parts = BENCHES * REPEATS * ((part - mean) ** 2).sum(0) / (parts - 1)
    between = np.maximum((of_benches - mixed) / (parts * REPEATS), 0) + (mixed - within) / REPEATS
    device = (of_parts - mixed) / (BENCHES * REPEATS)
    for s, state in enumerate(STATES):
        found = {key: study["study"][key][state] for key in study["study"]}
        assert found["repeatability"] ** 2 == pytest.approx(within[s])
        assert found["reproducibility"] ** 2 == pytest.approx(between[s])
        assert found["parts"] ** 2 == pytest.approx(device[s])
        assert found["grr"] ** 2 == pytest.approx((within + between)[s] / (within + between + device)[s])
        assert found["ratio"] == pytest.approx(np.sqrt(within[s] / np.mean(sd[:, s] ** 2)))
        assert found["ratio_low"] < found["ratio"] < found["ratio_high"]


def test_a_study_fits_80_columns_with_its_sources(
    studied: tuple[Path, Any], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("NO_COLOR", "1")
    shown = re.sub(r"\x1b\[[0-9;]*m", "", history(capsys, studied[0], "--gauge"))
    assert max(map(len, shown.splitlines())) <= 80
    assert "…" not in shown
    assert all(word in shown for word in ("3 devices", "2 benches", "AIAG", "ISO 5725-2", "%GRR"))
    assert len(re.findall(r"^│ (?:k|b|sigma_j|sigma_k) \(", shown, re.MULTILINE)) == 4


def test_what_too_few_runs_do_not_tell_is_said(
    studied: tuple[Path, Any], runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = studied
    shown = history(capsys, folder, "--gauge", "--bench", "bench 0")
    assert "reproducibility is unknown" in shown
    assert "two or more devices" in history(capsys, folder, "--gauge", "--serial", "SN-0001")
    assert json.loads(history(capsys, folder, "--gauge", "--serial", "SN-0001", "--json"))["gauge"][0]["study"] is None
    assert "no run" in history(capsys, folder, "--gauge", "--serial", "SN-9999")
    write_run(folder, runs, 0.0, device_serial="SN-0001", station="bench 0", operator="")
    assert "without a stated operator" in history(capsys, folder, "--gauge")


def test_a_study_is_no_line_of_a_file_each(studied: tuple[Path, Any], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["history", str(studied[0]), "--gauge", "--csv"]) == 2
    assert "--json" in capsys.readouterr().err
