"""--model: the next device of a type is calibrated with the effects that an investigation of another one added."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from motions import simulate
from support import SITE, TABLE_1

from drivers.types import ImuBlock
from estimator.calibration.error_model import ErrorModel, KnownEffect, Size
from estimator.effects.catalogue import catalogue
from estimator.estimation.live.sample_columns import SampleColumns, white_solution
from estimator.estimation.live.source import LiveSource
from estimator.geometry.array import tetrahedron
from estimator.recordings.reference import TableReadings
from estimator.recordings.writing import write_recording
from sims.physics.hidden import Hidden
from station.bench.bench import default_bench_text
from station.cli import main
from station.opening import DeviceTruth
from station.run.live import LiveEstimate
from station.run.table_watch import TableRow
from station.scripts.loop_scripts import exploration_script
from station.scripts.script import Script, load_script, paper_script

DEG = np.pi / 180
REST = '[[step]]\nkind = "rest"\nduration = "6 s"\n'
TURN = '[[step]]\nkind = "rotate"\naxis = "{}"\nrate = "{} deg/s"\nacceleration = "30 deg/s2"\nduration = "8 s"\n'
SIZES = (1200e-6, -2500e-6, -1800e-6, 800e-6)
HIDDEN = f"[scale_asymmetry]\nsize = {[f'{1e6 * size:g} ppm' for size in SIZES]}\n".replace("'", '"')


@pytest.fixture
def script(tmp_path: Path) -> Path:
    """Both directions about each axis, at two rates."""
    path = tmp_path / "both.toml"
    turns = "".join(TURN.format(axis, rate) for axis in "zyx" for rate in (30, -30))
    path.write_text(f'name = "both ways"\n{REST}{turns}{REST}', encoding="utf-8")
    return path


@pytest.fixture
def bench(tmp_path: Path) -> Path:
    """The built-in bench with twins whose scale factors differ by direction; limits suit a short script."""
    (tmp_path / "hidden.toml").write_text(HIDDEN, encoding="utf-8")
    text = default_bench_text().replace("[twin]\n", '[twin]\nhidden = "hidden.toml"\n', 1)
    for name in ("scale_factor_error", "bias", "misalignment"):
        text = text.replace(f"sd_{name} = ", f"# sd_{name} = ")
    path = tmp_path / "bench.toml"
    path.write_text(text, encoding="utf-8")
    return path


def asymmetric() -> ErrorModel:
    """The model of gyros whose scale factors differ by direction, by 3000 ppm or so."""
    return ErrorModel((KnownEffect("scale_asymmetry", False, (Size("each direction", "1", 0.0, 3e-3),)),))


def written(model: ErrorModel, folder: Path) -> Path:
    """Write a model."""
    path = folder / "model.json"
    path.write_text(model.text(), encoding="utf-8")
    return path


def simulated(script: Script, seed: int, hidden: dict[str, Any]) -> Any:
    device = DeviceTruth(tetrahedron(), np.tile(TABLE_1, (4, 1)), arw_rps_rthz=0.005 * DEG, kind="tetrahedron")
    return simulate(script, {"array": device}, seed, site=SITE, hidden=Hidden.of(hidden))


@pytest.mark.full
def test_what_investigate_keeps_of_one_device_is_what_calibrate_begins_with_on_the_next(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = {"scale_asymmetry": {"size": ["2000 ppm", "-2000 ppm", "1500 ppm", "2000 ppm"]}}
    second = {"scale_asymmetry": {"size": [f"{1e6 * size:g} ppm" for size in SIZES]}}
    paths = [str(tmp_path / f"{n}.h5") for n in range(3)]
    scripts = (paper_script(), exploration_script(), exploration_script())
    for n, (path, script) in enumerate(zip(paths, scripts, strict=True)):
        write_recording(Path(path), simulated(script, n, first if n < 2 else second))
    kept = str(tmp_path / "investigation.h5")
    assert main(["investigate", *paths[:2], "--json", "-o", kept]) == 0
    capsys.readouterr()
    assert main(["calibrate", paths[2], "--json", "--model", kept]) == 0
    result = json.loads(capsys.readouterr().out)
    for gyro, size in zip(result["gyros"], SIZES, strict=True):
        value, sd, unit = gyro["effects"]["scale_asymmetry"]["each direction"]
        assert unit == "1"
        assert abs(value - size) < 4 * sd < 4e-4
        assert abs(gyro["k"] - TABLE_1[0]) < 4 * gyro["sd"]["k"] < 4e-4
    assert main(["calibrate", paths[2], "--model", kept, "--write"]) == 0
    printed = capsys.readouterr().out
    assert "Effects of the error model" in printed
    assert "ppm" in printed.split("Effects of the error model")[1].split("Uncertainty budget")[0]
    assert main(["calibrate", paths[1], "--model", paths[1]]) == 2  # a recording is no model
    assert "investigate" in capsys.readouterr().err


def test_a_run_begins_with_the_model_live_and_batch(
    tmp_path: Path, bench: Path, script: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, path = written(asymmetric(), tmp_path), tmp_path / "run.h5"
    arguments = ["--bench", str(bench), "--script", str(script), "--json"]
    assert main(["run", *arguments, "--model", str(model), "-o", str(path)]) == 0
    result = json.loads(capsys.readouterr().out)
    assert 0.9 < result["nis_mean"] < 1.1
    for gyro, size in zip(result["gyros"], SIZES, strict=True):
        value, sd, _ = gyro["effects"]["scale_asymmetry"]["each direction"]
        assert abs(value - size) < 4 * sd < 1e-3
        assert abs(gyro["k"] - TABLE_1[0]) < 4 * gyro["sd"]["k"] < 1e-3
    with h5py.File(path) as file:
        assert file["calibration"].attrs["live_batch_difference_sigma"] < 1e-6
        last, sd = file["estimate/gyro2/states"][-1, 0], file["estimate/gyro2/sd"][-1, 0]
        assert (np.abs(last - TABLE_1) < 4 * sd).all()
    assert main(["calibrate", str(path), "--json", "--model", str(model)]) == 0
    assert json.loads(capsys.readouterr().out)["gyros"] == result["gyros"]
    assert main(["calibrate", str(path), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["nis_mean"] > 1.2


def test_every_effect_that_can_be_live_gives_the_batch_estimate_however_the_samples_come(script: Path) -> None:
    hidden = {
        "temperature": {"rise": "8 degC", "time_constant": "30 s"},
        "tone": {"size": "0.05 deg/s", "frequency": "7.3 Hz"},
    }
    recording = simulated(load_script(script), 5, hidden)
    reference, data = recording.reference, recording.sources["array"]
    assert isinstance(reference, TableReadings)
    settings = {"warm_up": {"time_constant_s": 120.0}, "tone": {"frequency_hz": 2.3}}
    known = []
    for effect in catalogue(reference.gimbals, 60.0):
        if effect.name.startswith(("bias_step", "table_harmonic")):
            continue
        sizes = (Size(p.name, p.unit, 0.1 * p.largest * effect.shared, p.largest) for p in effect.parameters)
        known.append(KnownEffect(effect.name, effect.shared, tuple(sizes), settings.get(effect.name, {})))
    known.append(KnownEffect("constructed", False, (Size("of u", "rad/s per unit", 0.0, 1.0),), {"law": "lag(u, 3)"}))
    harmonic = tuple(Size(part, "rad/s", 0.0, 1e-3) for part in ("cosine", "sine"))
    known.append(KnownEffect("table_harmonic", False, harmonic, {"axis": "y", "order": 2}))
    columns = SampleColumns(ErrorModel(tuple(known)), reference.gimbals, recording.site, data.array)
    notes = [note.partition(" needs")[0] for note in columns.notes]
    lagged = "constructed: bias proportional to rate about the sense axis lagged by 3 s"
    assert notes == ["thermal gradient", "bandwidth", lagged]
    assert data.temperature_c is not None
    warm = data.temperature_c.copy()
    warm[:150] = np.nan  # the first temperature comes late
    live = LiveEstimate(reference.gimbals, recording.site)
    source = live.sources["array"] = LiveSource(
        array=data.array, rate_hz=100.0, noise_rps=0.05 * DEG, prior=data.prior, effects=columns
    )
    random, used = np.random.default_rng(0), 0
    for row, t_ns in enumerate(reference.t_ns.tolist()):
        until = int(np.searchsorted(data.t_ns, t_ns)) - int(random.integers(0, 20))
        if until > used:
            part = slice(used, until)
            source.add(
                ImuBlock(
                    t_ns=data.t_ns[part],
                    arrival_ns=data.t_ns[part],
                    rate_rps=data.rate_rps[part],
                    temperature_c=warm[part],
                )
            )
            used = until
        if live.add_row(TableRow(t_ns, reference.angle_rad[row], reference.rate_rps[row], 0)):
            live.advance()
    rest = slice(used, None)
    source.add(
        ImuBlock(
            t_ns=data.t_ns[rest], arrival_ns=data.t_ns[rest], rate_rps=data.rate_rps[rest], temperature_c=warm[rest]
        )
    )
    live.finish()
    held = ImuBlock(t_ns=data.t_ns, arrival_ns=data.t_ns, rate_rps=data.rate_rps, temperature_c=warm)
    assert source.history.blocks > 200
    batch = white_solution(
        recording,
        type(data)(data.array, held.t_ns, held.rate_rps, temperature_c=warm, prior=data.prior),
        columns,
        data.prior,
        source.noise_rps,
    )
    x, covariance = source.filter.state()
    sd = np.sqrt(np.diagonal(batch.covariance, axis1=1, axis2=2))
    assert np.abs((x - batch.x) / sd).max() < 1e-6
    assert np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)) == pytest.approx(sd, rel=1e-6)


def test_models_that_do_not_fit_are_refused_before_anything_moves(
    tmp_path: Path, bench: Path, script: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(*arguments: str | Path) -> str:
        code = main(["run", "--bench", str(bench), "--script", str(script), *map(str, arguments)])
        assert code == 2
        return capsys.readouterr().err

    assert "investigate" in refused("--model", script)
    assert "not a file" in refused("--model", tmp_path / "none.h5")
    assert "--end-early" in refused("--model", written(asymmetric(), tmp_path), "--end-early")
    thermal = ErrorModel((KnownEffect("thermal_bias", False, (Size("linear", "rad/s/K", 0.0, 1e-3),)),))
    bench.write_text(bench.read_text().replace(', temperature = "GYRO2_TEMPERATURE.Temperature"', ""))
    assert "temperature signal" in refused("--model", written(thermal, tmp_path))
    assert main(["calibrate", str(tmp_path), "--model", str(bench)]) == 2
    assert not list(tmp_path.glob("*.h5"))
