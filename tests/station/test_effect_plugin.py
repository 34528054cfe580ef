"""An effect of one's own, a file of its own: planned for, found, estimated, exported and reported like ours."""

from __future__ import annotations

import importlib.util
import json
import re
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
from compensating import compensate
from support import SITE, TABLE_1

from estimator.calibration.calibration_file import read_calibration
from estimator.calibration.compensation import Compensation
from estimator.effects import catalogue
from estimator.effects.effect import EffectError, Parameter, Record
from estimator.geometry.array import tetrahedron
from estimator.recordings.reading import read_recording
from estimator.recordings.writing import write_recording
from sims.physics.hidden import Hidden
from station.cli import main
from station.opening import DeviceTruth, simulate
from station.scripts.loop_scripts import exploration_script

PLUGIN = Path(__file__).parents[1] / "data" / "plugins" / "my_effect.py"
SIZES = np.radians([0.02, -0.02, 0.015, 0.02])


def loaded() -> Record:
    """The record in the file."""
    spec = importlib.util.spec_from_file_location("my_effect", PLUGIN)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    record: Record = module.EFFECT
    return record


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> Record:
    """The catalogue with the effect, for one test."""
    monkeypatch.setattr(catalogue, "_BY_NAME", dict(catalogue._BY_NAME))
    record = loaded()
    catalogue.register(record)
    return record


def test_a_file_of_its_own_is_all_that_an_effect_takes(
    known: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert len(PLUGIN.read_text(encoding="utf-8").splitlines()) <= 150

    assert main(["plan", "--json"]) == 0
    planned = {effect["name"]: effect for effect in json.loads(capsys.readouterr().out)["effects"]}
    assert planned["sticking_mass"]["parameters"][0]["smallest"]["gyro1"] < SIZES[0]

    noise = {"arw_rps_rthz": np.radians(0.005), "bias_instability_rps": np.radians(2 / 3600)}
    device = DeviceTruth(tetrahedron(), np.tile(TABLE_1, (4, 1)), **noise, kind="tetrahedron")
    hidden = Hidden.of({"hysteresis": {"size": [f"{np.degrees(size):g} deg/s" for size in SIZES]}})
    run = tmp_path / "run.h5"
    write_recording(run, simulate(exploration_script(), {"array": device}, 2, site=SITE, hidden=hidden))
    assert main(["investigate", "run.h5", "-o", "model.h5", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [added["effect"] for added in found["added"]] == ["sticking_mass"]

    assert main(["calibrate", "--write", "--model", "model.h5", "run.h5"]) in (0, 1)
    assert "sticking mass" in capsys.readouterr().out
    calibration = read_calibration(run)
    for gyro, size in zip(calibration.gyros, SIZES, strict=True):
        assert abs(gyro.effects[0].value - size) < 4 * gyro.effects[0].sd < 1e-4

    recording = read_recording(run)
    data = recording.sources["array"]
    own = Compensation.of(calibration.gyros, {"array": data.array}, calibration.model)
    rate, t_s = data.rate_rps[:300], (data.t_ns[:300] - data.t_ns[0]) * 1e-9
    ours = compensate(own, rate, t_s)
    for form, name in (("python", "made.py"), ("c", "made.h")):
        assert main(["export", "run.h5", "--format", form, "-o", name]) == 0
    assert re.search(r"_sticking_mass\[4\] = \{", Path("made.h").read_text(encoding="utf-8"))
    made: dict[str, object] = {}
    exec(Path("made.py").read_text(encoding="utf-8"), made)
    correction = made["Correction"]()  # type: ignore[operator]
    exported = [correction.correct(row) for row in rate.tolist()]
    np.testing.assert_allclose(exported, ours, rtol=0, atol=1e-12)

    assert main(["report", "run.h5", "-o", "report.html"]) == 0
    text = Path("report.html").read_text(encoding="utf-8")
    assert "sticking mass" in text
    assert "last(<var>u</var>" in text


def test_an_installed_package_that_cannot_be_used_costs_a_line(monkeypatch: pytest.MonkeyPatch, known: Record) -> None:
    group = catalogue.GROUP
    entries = [EntryPoint("mine", "no_such_module:EFFECT", group), EntryPoint("other", "math:pi", group)]
    monkeypatch.setattr(catalogue, "entry_points", lambda group: entries)
    absent, wrong = catalogue.load_entry_points()
    assert absent == (
        "the effect mine (no_such_module:EFFECT) is not used: ModuleNotFoundError: No module named 'no_such_module'"
    )
    assert "other (math:pi) is not used" in wrong


@pytest.mark.parametrize(
    ("record", "said"),
    [
        (Record(name="Mine!", parameters=()), "no name of small letters"),
        (Record(name="mine", parameters=(Parameter("a", "rad/s", 1.0),), law="u; T"), "2 terms for 1 parameters"),
        (Record(name="mine", parameters=(Parameter("a", "rad/s", 1.0),), law="phlogiston"), "no law.*phlogiston"),
        (Record(name="mine", parameters=(Parameter("a", "rad/s", 1.0),)), "neither a law nor regressors"),
        (Record(name="thermal_bias", parameters=(Parameter("a", "rad/s", 1.0),), law="u"), "thermal_bias already"),
    ],
)
def test_a_record_that_is_none_is_refused_with_what_it_lacks(record: Record, said: str) -> None:
    with pytest.raises(EffectError, match=said):
        catalogue.register(record)
