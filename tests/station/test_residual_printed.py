"""What is left, as people read it, as --json gives it, and in files."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from estimator.calibration.error_model import ErrorModel
from estimator.tracing.investigation import Investigation
from estimator.tracing.residuals.dependence import Dependence
from estimator.tracing.residuals.origin import Origin, Split
from estimator.tracing.residuals.residual import GyroResidual, Residual, Spectrum
from station.exports.investigation_file import write_investigation
from station.render.investigation_printed import print_investigation
from station.render.terminal import stdout
from station.report.pictures import draw_investigation
from station.views.investigation import investigation_object, investigation_of, investigation_view


@pytest.fixture
def found(asymmetry: tuple[Investigation, ErrorModel]) -> Investigation:
    return asymmetry[0]


def left(nis: float, *depends_on: tuple[str, float], origin: Origin = Origin.NOISE, spare: int = 1) -> Residual:
    """Return a residual of one gyro, made by hand."""
    spectrum = Spectrum(np.array([0.1, 1.0]), np.array([2e-9, 1e-9]), np.array([1e-9, 1e-9]))
    dependences = tuple(Dependence(variable, share, 0.0) for variable, share in depends_on)
    p = 1e-9 if dependences else 0.25
    gyro = GyroResidual(
        name="gyro1",
        nis=nis,
        nis_sd=0.06,
        lag1=0.3,
        lag1_sd=0.02,
        white_p=p,
        spectrum=spectrum,
        beyond=0.31 if dependences else 0.0,
        dependences=dependences,
    )
    return Residual((gyro,), Split(origin, 0.2, 0.1, None if origin == Origin.NOISE else 0.88, spare))


def printed(found: Investigation, capsys: pytest.CaptureFixture[str]) -> str:
    print_investigation(found, None, None, stdout())
    return capsys.readouterr().out


def test_before_and_after_stand_side_by_side(found: Investigation, capsys: pytest.CaptureFixture[str]) -> None:
    before = left(1.46, ("time", 0.62), ("rate", 0.03), ("temperature", 0.97), origin=Origin.OWN)
    text = printed(replace(found, residual_before=before, residual_after=left(1.01)), capsys)
    row = next(line for line in text.splitlines() if "1.46" in line)
    cells = [cell.strip() for cell in row.strip("│").split("│")]
    assert cells == ["gyro1", "1.46", "1.01", "< 0.0001", "0.25", "31%", "0%", "temperature 97%, time 62%", "nothing"]
    assert "misfit of noise: 1 ± 0.06" in text
    assert "individual? before: own to each, 88%; after: within noise" in " ".join(text.split())
    assert "Residual, verification run" not in text  # it is noise after


def test_a_verification_run_that_is_not_noise_is_shown(
    found: Investigation, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = left(3.2, ("states", 0.9), origin=Origin.COMMON)
    text = printed(replace(found, verified_before=wrong, verified_after=wrong), capsys)
    assert "Residual, verification run" in text
    assert "states 90%" in text


def test_it_is_said_how_far_the_gyros_can_tell_what_they_share(
    found: Investigation, capsys: pytest.CaptureFixture[str]
) -> None:
    four, five = (left(2.0, origin=Origin.COMMON, spare=spare) for spare in (1, 2))
    three = replace(four, split=None, no_split="3 gyros on 3 axes: why")
    said = [printed(replace(found, residual_before=one, residual_after=one), capsys) for one in (four, five, three)]
    said = [" ".join(text.split()) for text in said]
    assert "individual? common to all gyros, as far as one redundant gyro can show" in said[0]
    assert "individual? common to all gyros" in said[1]
    assert "as far as" not in said[1]
    assert "unknown: 3 gyros on 3 axes: why" in said[2]


def test_json_holds_what_is_left_before_and_after_of_all_runs(found: Investigation) -> None:
    kept = json.loads(json.dumps(investigation_object(investigation_view(found, None)), allow_nan=False))["residual"]
    assert set(kept) == {"before", "after", "verification"}
    for before, after in ((kept["before"], kept["after"]), tuple(kept["verification"].values())):
        assert before["split"]["origin"] == "own to each"
        assert after["split"]["origin"] == "within noise"
        for name in ("gyro1", "gyro2", "gyro3", "gyro4"):
            old, new = before["gyros"][name], after["gyros"][name]
            assert set(old) == {"nis", "nis_sd", "lag1", "lag1_sd", "white_p", "beyond", "depends_on", "spectrum"}
            assert old["nis"] > 1.3
            assert old["white_p"] < 1e-4
            assert new["nis"] == pytest.approx(1.0, abs=4 * new["nis_sd"])
            assert new["beyond"] == 0
    shares = {variable: d["share"] for variable, d in kept["before"]["gyros"]["gyro1"]["depends_on"].items()}
    assert max(shares, key=lambda variable: shares[variable]) == "rate"


def test_an_investigation_is_read_back_from_its_json(found: Investigation) -> None:
    view = investigation_view(found, Path("next.toml"), ["a.h5"], ["b.h5"])
    written = json.loads(json.dumps(investigation_object(view), allow_nan=False))
    assert view.residual is not None
    assert investigation_of({**written, "of a later version": 1}) == view
    for damaged in ({**written, "models": None}, {**written, "before": {}}, {**written, "in_sample": "no"}):
        with pytest.raises((KeyError, TypeError)):
            investigation_of(damaged)


def test_files_and_pictures_hold_the_spectra(found: Investigation, tmp_path: Path) -> None:
    path, picture = tmp_path / "found.h5", tmp_path / "found.png"
    write_investigation(path, found, investigation_object(investigation_view(found, None)))
    with h5py.File(path) as file:
        for group in ("spectrum", "spectrum_verification"):
            gyro = file["investigation"][group]["gyro2"]
            assert set(gyro) == {"frequency_hz", "before", "after", "noise"}
            slow = gyro["frequency_hz"][:] < 0.05
            assert np.mean(gyro["before"][slow]) > 3 * np.mean(gyro["after"][slow])
    draw_investigation(picture, found)
    assert picture.read_bytes().startswith(b"\x89PNG")
    draw_investigation(picture, replace(found, residual_before=None, verified_before=None))
