"""station export: every form, applied to raw samples, gives the rates that our own compensation gives."""

from __future__ import annotations

import csv
import functools
import hashlib
import importlib.util
import json
import operator
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import yaml
from scipy.io import loadmat
from support import station

from estimator.calibration.calibration_file import read_calibration, write_calibration
from estimator.calibration.compensation import Compensation, CompensationError
from estimator.calibration.correction import compensate, less_added
from estimator.calibration.error_model import ErrorModel, KnownEffect, Size
from estimator.calibration.gyro import EffectValue, GyroCalibration
from estimator.calibration.values import Calibration
from estimator.effects.catalogue import everything
from estimator.geometry.array import SensorArray, dodecahedron, sensor_array, tetrahedron, triad
from estimator.geometry.noise import NoiseFound, NoiseModel
from estimator.recordings.reading import read_recording
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import TableReadings
from estimator.recordings.writing import write_recording
from station.cli import main
from station.exports.exported import Exported, exported_of
from station.exports.formats import FORMATS
from station.exports.written import yaml_text

SAMPLES = 400
PERIOD_S = 0.01
SAME = 1e-9
SAME_SINGLE = 1e-5  # rad/s, of rates up to 2: 5e-6 of them
EFFECTS: dict[str, tuple[float, ...]] = {
    "thermal_bias": (2e-4,),
    "thermal_bias_quadratic": (3e-6,),
    "warm_up": (2e-3,),
    "g_sensitivity": (2e-4, -1e-4, 3e-4),
    "thermal_gradient": (0.2,),
    "thermal_scale": (1e-4,),
    "scale_asymmetry": (2e-3,),
    "scale_quadratic": (3e-3,),
    "scale_cubic": (2e-3,),
    "acceleration_sensitivity": (2e-3, -1e-3),
    "bandwidth": (4e-3,),
    "latency": (5e-3,),
}
LEFT_OUT: dict[str, tuple[float, ...]] = {
    "tone": (1e-4, 1e-4),
    "bias_drift": (1e-7,),
    "dead_band": (0.5,),
    "table_harmonic": (1e-4, 1e-4),
    "table_rate": (1e-5, 1e-5, 1e-5),
    "earth_rate": (7e-5, 0.0, 0.0),
}
SETTINGS: dict[str, dict[str, float | int | str]] = {
    "warm_up": {"time_constant_s": 40.0},
    "tone": {"frequency_hz": 7.3},
    "dead_band": {"width_rps": 1e-3},
    "table_harmonic": {"axis": "x", "order": 2},
}
ARRAYS = {
    "three": triad(),
    "four": tetrahedron(),
    "six": dodecahedron(),
    "skewed": sensor_array([[0.6, 0.8, 0.0], [0.0, 0.6, 0.8], [0.8, 0.0, 0.6]]),
}

LAWS: dict[str, tuple[float, ...]] = {
    f"constructed {law}": values
    for law, values in {
        "lag(T, 1.5)*gx": (2e-5,),
        "play(T, 3)": (2e-4,),
        "exp(T/12); Tdot**2": (3e-4, 2e-4),
        "last(Tdot)": (1e-3,),
        "log1p(t/2)*gs": (3e-4,),
        "abs(wx)*wy - u**3/9": (2e-3,),
        "tanh(u/0.3)*T; speed*gz": (1e-4, 1e-4),
        "u*t": (1e-4,),
        "sign(u)*sqrt(abs(u))": (1e-3,),
        "last(u)*speed": (1e-3,),
        "last(u, 0.3)": (1e-3,),
        "lag(u**2, 0.8)": (2e-3,),
        "play(u, 0.2); cos(wz)": (3e-3, 1e-3),
        "u*lag(speed, 0.5) + -jolt*1e-3": (2e-3,),
        "abs(a); wx*wy": (1e-6, 2e-3),
        "u*Tdot": (1e-3,),
    }.items()
}
OF_AXES = {"constructed cos(2*angle_x); sin(2*angle_x)": (1e-4, 1e-4), "constructed last(rate_z)": (1e-4,)}

Record = Callable[..., Path]


@pytest.fixture
def record(tmp_path: Path) -> Record:
    """Write a recording of arbitrary samples with a calibration that nobody estimated, effects and all."""

    def made(array: SensorArray, sizes: dict[str, tuple[float, ...]], *devices: str) -> Path:
        random = np.random.default_rng(5)
        t_ns = np.arange(SAMPLES, dtype=np.int64) * round(PERIOD_S * 1e9)
        gyros, sources, model = [], {}, _model(sizes)
        for device in devices or ("my-gyro 1",):
            sources[device] = ImuData(
                array,
                t_ns,
                random.normal(0, 0.4, (SAMPLES, len(array))),
                temperature_c=27 + 6 * np.sin(t_ns * 1e-9),
                accel_mps2=random.normal(0, 5, (SAMPLES, 3)),
                device=device,
            )
            gyros += [_gyro(random, array, i, device, model, sizes) for i in range(len(array))]
        still = TableReadings(
            t_ns=t_ns[[0, -1]], angle_rad=np.zeros((2, 3)), rate_rps=np.zeros((2, 3)), gimbals=("z", "y", "x")
        )
        path = tmp_path / "run.h5"
        identity = {"device_serial": "SN 7 \n*/ /* ü", "operator": "A. Müller", "script": 'the "script"'}
        write_recording(path, Recording(sources, still, attributes=identity))
        text = model.text() if sizes else ""
        write_calibration(
            path, Calibration(gyros=tuple(gyros), nis_mean=1.0, samples=SAMPLES, lost=0, notes=(), model=text)
        )
        return path

    return made


def _model(sizes: dict[str, tuple[float, ...]]) -> ErrorModel:
    listed = {entry.name.removesuffix("_1"): entry for entry in everything() if entry.parameters}
    effects = []
    for called, values in sizes.items():
        name, _, law = called.partition(" ")
        unit = "rad/s per unit" if law else listed[name].parameters[0].unit
        parts = tuple(Size(f"part {n}", unit, 0.0, abs(value) + 1e-9) for n, value in enumerate(values))
        settings = {"law": law} if law else SETTINGS.get(name, {})
        effects.append(KnownEffect(name, not law and listed[name].shared, parts, settings))
    return ErrorModel(tuple(effects))


def _gyro(
    random: np.random.Generator,
    array: SensorArray,
    i: int,
    device: str,
    model: ErrorModel,
    sizes: dict[str, tuple[float, ...]],
) -> GyroCalibration:
    effects = tuple(
        EffectValue(
            effect=e.called,
            parameter=size.name,
            value=value * (1 if e.shared else float(random.uniform(0.5, 1.5))),
            sd=1e-6,
            unit=size.unit,
            expected_sd=size.sd,
            shared=e.shared,
        )
        for e in model.effects
        for size, value in zip(e.sizes, sizes.get(e.called, sizes.get(e.name, ())), strict=True)
    )
    states = random.normal(0, (5e-3, 2e-2, 2e-3, 2e-3))
    noise = NoiseFound(NoiseModel(1e-4, 1e-6, 1e-7), 2e-6, 2e-7)
    return GyroCalibration(
        name=array.names[i],
        source=device,
        states=states,
        covariance=np.eye(4) * 1e-10,
        noise_rps=1e-3,
        p=array.p[i],
        device=device,
        noise=noise,
        effects=effects,
    )


def export(path: Path, form: str, *options: str) -> Path:
    """Run the command; return the file that it wrote."""
    target = path.with_name(f"out-{form}")
    target.unlink(missing_ok=True)
    assert main(["export", str(path), "--format", form, "-o", str(target), *options]) == 0
    return target


def samples(exported: Exported) -> tuple[Any, ...]:
    """Return the raw samples that a form is applied to: outputs, instants, temperature, specific force."""
    with h5py.File(exported.path) as file:
        groups = [file[f"imu/{source}"] for source in dict.fromkeys(gyro.source for gyro in exported.gyros)]
        rate = np.hstack([group["rate_rps"][()] for group in groups])
        first = groups[0]
        return rate, first["t_ns"][()] * 1e-9, first["temperature_c"][()], first["accel_mps2"][()]


def ours(exported: Exported) -> Any:
    """Return the body rates of our own compensation."""
    return compensate(exported.compensation, *samples(exported))


CASES = {
    "none": {},
    "all": EFFECTS,
    "laws": {**EFFECTS, **LAWS},
    **{law: {law: LAWS[law]} for law in LAWS},
    **{name: {name: value} for name, value in EFFECTS.items()},
}


EACH = [(array, effects) for array in ("three", "four", "six") for effects in ("none", "all")]
EACH += [("four", name) for name in (*EFFECTS, *LAWS, "laws")]


def by_python(exported: Exported, *given: Any) -> tuple[Any, Any]:
    """Return the rates that the Python module makes of samples as ``samples`` gives them, and the module."""
    text = FORMATS["python"].write(exported).text
    assert "numpy" not in text
    module = exported.path.with_name("made.py")
    module.write_text(text, encoding="utf-8")
    spec = importlib.util.spec_from_file_location("made", module)
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    correct = made.Correction().correct if hasattr(made, "Correction") else made.correct
    names = correct.__code__.co_varnames[: correct.__code__.co_argcount]
    rate, t_s, warm, force = given
    columns = {"rate_rps": rate.tolist(), "temperature_c": warm.tolist(), "accel": force.tolist()}
    columns["dt_s"] = np.diff(t_s, prepend=t_s[0]).tolist()
    found = [correct(**{name: columns[name][row] for name in names if name != "self"}) for row in range(len(rate))]
    return np.array(found), made


MAIN = """
#include <stdio.h>
#include "made.h"
#include "made.h"
int main(void)
{{
    {real} rate_rps[{p}_gyros], temperature_c, accel[3], dt_s, w_rps[3];
    double read[6];
    int i;
    {state}
    if ({p}_self_test() != 0) return 2;
    for (;;) {{
        for (i = 0; i < {p}_gyros; i++) {{
            if (scanf("%lf", &read[0]) != 1) return 0;
            rate_rps[i] = ({real})read[0];
        }}
        for (i = 0; i < 5; i++)
            if (scanf("%lf", &read[i]) != 1) return 1;
        temperature_c = ({real})read[0];
        accel[0] = ({real})read[1];
        accel[1] = ({real})read[2];
        accel[2] = ({real})read[3];
        dt_s = ({real})read[4];
        (void)temperature_c;
        (void)accel;
        (void)dt_s;
        i = {p}_correct({arguments});
        printf("%d %.17g %.17g %.17g\\n", i, (double)w_rps[0], (double)w_rps[1], (double)w_rps[2]);
    }}
}}
"""
WARNED = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-pedantic", "-Werror"]


def by_c(exported: Exported, *given: Any, form: str = "c", spoil: Callable[[str], str] = str) -> tuple[Any, Any]:
    """Return the rates that the C function makes of samples as ``samples`` gives them, and what it returned for each.

    It is compiled without a warning, and tests itself, first. ``spoil`` changes the header.
    """
    path, text, p = exported.path, spoil(FORMATS[form].write(exported).text), "my_gyro_1" + form[1:].replace("-", "_")
    signature = text.rpartition(f"static inline int {p}_correct(")[2].partition(")")[0]
    arguments = [word.split("[")[0].split()[-1].lstrip("*") for word in signature.split(",")]
    state = f"{p}_state kept; {p}_reset(&kept);" if "state" in arguments else ""
    called = ", ".join(arguments).replace("state,", "&kept,")
    source = MAIN.format(state=state, arguments=called, p=p, real="double" if form == "c" else "float")
    path.with_name("made.h").write_text(text, encoding="utf-8")
    path.with_name("made.c").write_text(source, encoding="utf-8")
    program = path.with_name("made")
    built = subprocess.run(
        ["cc", *WARNED, str(path.with_name("made.c")), "-o", str(program), "-lm"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, built.stderr
    rate, t_s, warm, force = given
    rows = np.column_stack([rate, warm, force, np.diff(t_s, prepend=t_s[0])])
    fed = "\n".join(" ".join(f"{value:.17g}" for value in row) for row in rows)
    run = subprocess.run([str(program)], input=fed, capture_output=True, text=True, check=False)
    assert run.returncode == 0, "the self-test fails" if run.returncode == 2 else run.returncode
    found = np.array([[float(word) for word in line.split()] for line in run.stdout.splitlines()])
    return found[:, 1:], found[:, 0]


needs_cc = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc) here")


@pytest.mark.parametrize(("array", "effects"), EACH)
def test_the_python_module_gives_our_rates(record: Record, array: str, effects: str) -> None:
    exported = exported_of(record(ARRAYS[array], CASES[effects]))
    found, made = by_python(exported, *samples(exported))
    assert np.abs(found - ours(exported)).max() < SAME
    assert pytest.approx(EFFECTS["latency"][0] if "latency" in CASES[effects] else 0.0) == made.DELAY_S


@needs_cc
@pytest.mark.parametrize(("array", "effects"), EACH)
def test_the_c_header_compiles_without_a_warning_and_gives_our_rates(record: Record, array: str, effects: str) -> None:
    exported = exported_of(record(ARRAYS[array], CASES[effects]))
    found, codes = by_c(exported, *samples(exported))
    assert np.abs(found - ours(exported)).max() < SAME
    assert not codes.any()


@needs_cc
@pytest.mark.parametrize(("array", "effects"), [("three", "none"), ("four", "all"), ("six", "all"), ("four", "laws")])
def test_the_single_precision_header_gives_our_rates_to_its_digits(record: Record, array: str, effects: str) -> None:
    exported = exported_of(record(ARRAYS[array], CASES[effects]))
    found, codes = by_c(exported, *samples(exported), form="c-float")
    assert np.abs(found - ours(exported)).max() < SAME_SINGLE
    assert not codes.any()


@needs_cc
@pytest.mark.parametrize("form", ["c", "c-float"])
@pytest.mark.parametrize("table", ["solution", "bias", "scale_cubic"])
def test_the_header_tests_itself(record: Record, form: str, table: str) -> None:
    exported = exported_of(record(ARRAYS["four"], EFFECTS))

    def spoil(text: str) -> str:
        """Change the first number of a table by a half, as a bad copy would."""
        changed, count = re.subn(
            rf"(_{table}\[.*?= \{{[^-\d]*)(-?[\d.]+)",
            lambda m: f"{m[1]}{float(m[2]) * 1.5}",
            text,
            count=1,
            flags=re.S,
        )
        assert count == 1
        return changed

    with pytest.raises(AssertionError, match="the self-test fails"):
        by_c(exported, *samples(exported), form=form, spoil=spoil)


@pytest.mark.parametrize("form", ["python", pytest.param("c", marks=needs_cc)])
def test_a_bad_sample_is_told_and_soon_over(record: Record, form: str) -> None:
    exported = exported_of(record(ARRAYS["four"], EFFECTS))
    rate, t_s, warm, force = samples(exported)
    rate[0], rate[20], rate[40, 1], rate[60, 2], warm[80], rate[100] = 0.0, 1e9, np.nan, np.inf, np.nan, -1e300
    t_s[120] = t_s[119]  # the same instant again
    bad = [20, 21, 40, 60, 80, 100, 101]  # the lag is undone by differences: after what is huge, the next is, too
    assert not np.isfinite(compensate(exported.compensation, rate, t_s, warm, force)[bad]).any()
    expected = np.delete(compensate(exported.compensation, rate, t_s, warm, force), bad, axis=0)
    found, told = (by_python if form == "python" else by_c)(exported, rate, t_s, warm, force)
    assert np.isfinite(expected).all()
    assert np.abs(np.delete(found, bad, axis=0) - expected).max() < SAME
    if form == "python":
        assert np.isnan(found[bad]).all()
    else:
        assert np.flatnonzero(told).tolist() == bad


@pytest.mark.parametrize("array", ["three", "four", "six"])
def test_json_and_yaml_hold_all_that_our_rates_are_made_of(record: Record, array: str) -> None:
    exported = exported_of(record(ARRAYS[array], {**EFFECTS, **LAWS, **LEFT_OUT, **OF_AXES}))
    held = json.loads(FORMATS["json"].write(exported).text)
    assert held == yaml.safe_load(FORMATS["yaml"].write(exported).text)
    rate, t_s, _, _ = samples(exported)
    plain = Compensation(exported.compensation.array, exported.compensation.states)
    found = (rate + np.array(held["bias_b_rps"])) @ np.array(held["solution_h"]).T
    assert np.abs(found - compensate(plain, rate, t_s)).max() < SAME
    assert held["identity"]["operator"] == "A. Müller"
    assert held["identity"]["serial_number"] == "SN 7 */ /* ü"
    called = [" ".join([entry["effect"], *([entry["law"]] if "law" in entry else [])]) for entry in held["effects"]]
    assert set(called) == {*EFFECTS, *LAWS} - {"latency"}
    for entry, name in zip(held["effects"], called, strict=True):
        effect = next(e for e in exported.compensation.effects if name in (e.name, e.known.called))
        assert np.array_equal(entry["values"], effect.values)
    assert held["delay_s"] == pytest.approx(5e-3)
    assert len(held["not_corrected"]) == len({**LEFT_OUT, **OF_AXES})
    for told, gyro in zip(held["gyros"], exported.gyros, strict=True):
        assert np.array_equal(list(told["states"].values()), gyro.states)
        assert np.array_equal(told["covariance"], gyro.covariance)


@pytest.mark.parametrize("array", ["three", "four", "six"])
def test_csv_holds_the_rows_that_our_rates_are_made_of(record: Record, array: str) -> None:
    path = record(ARRAYS[array], {"scale_asymmetry": EFFECTS["scale_asymmetry"]})
    with export(path, "csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    exported = exported_of(path)
    rate, t_s, _, _ = samples(exported)
    g = np.array([[float(row[f"g_{axis}"]) for axis in "xyz"] for row in rows])
    b = np.array([float(row["b_rps (rad/s)"]) for row in rows])
    plain = Compensation(exported.compensation.array, exported.compensation.states)
    assert np.abs((rate + b) @ np.linalg.pinv(g).T - compensate(plain, rate, t_s)).max() < SAME
    asymmetry = [float(row["scale_asymmetry: part 0 (1)"]) for row in rows]
    assert asymmetry == [gyro.effects[0].value for gyro in exported.gyros]


def at_mean_temperature(path: Path, keep: tuple[str, ...]) -> tuple[Compensation, tuple[Any, ...]]:
    """Return our compensation less what a form says that it does not hold, and the raw samples."""
    exported = exported_of(path)
    return exported.compensation.simplified(keep, exported.seen.temperature_c[1])[0], samples(exported)


@pytest.mark.parametrize("array", ["three", "skewed"])
def test_the_ros_file_holds_scale_misalignment_and_bias(
    record: Record, array: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = record(ARRAYS[array], EFFECTS)
    held = yaml.safe_load(export(path, "ros").read_text(encoding="utf-8"))
    said = capsys.readouterr().err
    assert held["SM"] == np.eye(3).ravel().tolist()
    assert held["bias"] == [0.0, 0.0, 0.0]
    plain, (rate, t_s, _, _) = at_mean_temperature(path, ())
    found = rate @ np.reshape(held["gyro_SM"], (3, 3)).T - held["gyro_bias"]
    assert np.abs(found - compensate(plain, rate, t_s)).max() < SAME
    for word in ("g sensitivity", "scale cubic", "delay", "accelerometer", "does not read gyro_SM"):
        assert word in said, word


@pytest.mark.parametrize("array", ["three", "skewed"])
def test_the_kalibr_file_predicts_the_outputs_that_we_undo(record: Record, array: str) -> None:
    path = record(ARRAYS[array], EFFECTS)
    held = yaml.safe_load(export(path, "kalibr").read_text(encoding="utf-8"))
    m, a, c = (np.array(held["gyroscopes"][key]) for key in ("M", "A", "C_gyro_i"))
    assert np.array_equal(m, np.tril(m))
    assert np.abs(c @ c.T - np.eye(3)).max() < 1e-12
    assert np.linalg.det(c) > 0
    assert held["model"] == "scale-misalignment"
    assert held["update_rate"] == pytest.approx(1 / PERIOD_S)
    assert held["gyroscope_noise_density"] == pytest.approx(1e-4)
    plain, (rate, t_s, _, force) = at_mean_temperature(path, ("g_sensitivity",))
    w = compensate(plain, rate, t_s, None, force)
    predicted = w @ (m @ c).T + force @ (a @ c).T - plain.bias_rps
    assert np.abs(predicted - rate).max() < SAME


@pytest.mark.parametrize("array", ["three", "skewed"])
def test_openvins_undoes_what_we_undo(record: Record, array: str) -> None:
    path = record(ARRAYS[array], EFFECTS)
    text = export(path, "openvins").read_text(encoding="utf-8")
    assert text.startswith("%YAML:1.0\n")  # what cv::FileStorage asks for, and no other YAML takes
    held = yaml.safe_load(text.partition("\n")[2])["imu0"]
    tw, tg, r = (np.array(held[key]) for key in ("Tw", "Tg", "R_IMUtoGYRO"))
    assert held["model"] == "kalibr"
    dw = np.tril(np.linalg.inv(tw))  # it takes the lower triangle
    plain, (rate, t_s, _, force) = at_mean_temperature(path, ("g_sensitivity",))
    found = (rate + plain.bias_rps - force @ tg.T) @ (r.T @ dw).T
    assert np.abs(found - compensate(plain, rate, t_s, None, force)).max() < SAME


@pytest.mark.parametrize("array", ["three", "skewed"])
def test_vectornav_register_84_makes_our_rates(record: Record, array: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = record(ARRAYS[array], {**EFFECTS, **LAWS})
    lines = export(path, "vectornav-84").read_text(encoding="utf-8").splitlines()
    said = capsys.readouterr().err
    command = next(line for line in lines if line.startswith("$"))
    fields, checksum = command[1:].split("*")
    assert f"{functools.reduce(operator.xor, fields.encode()):02X}" == checksum
    words = fields.split(",")
    assert words[:2] == ["VNWRG", "84"]
    values = np.float32(words[2:]).astype(float)  # what the device keeps
    plain, (rate, t_s, _, _) = at_mean_temperature(path, ())
    found = (rate - values[9:]) @ values[:9].reshape(3, 3).T
    about_its_axes = compensate(plain, rate, t_s) @ ARRAYS[array].p.T
    assert np.abs(found - about_its_axes).max() < 3e-7
    assert lines[-1].startswith("$VNWNV*")
    for word in ("identity", "g sensitivity", "delay"):
        assert word in said, word


def test_the_stim300_is_told_what_it_adds(record: Record) -> None:
    path = record(triad(), {})
    lines = [line for line in export(path, "stim300-trim").read_text(encoding="utf-8").splitlines() if line[0] != "#"]
    offsets = {name: float(offset) for name, offset in map(str.split, lines)}
    assert offsets == {gyro.name: round(np.degrees(gyro.states[1]), 5) for gyro in exported_of(path).gyros}


def test_matlab_reads_what_json_holds(record: Record) -> None:
    path = record(ARRAYS["four"], {**EFFECTS, **LAWS, **LEFT_OUT})
    held = json.loads(export(path, "json").read_text(encoding="utf-8"))
    written = export(path, "matlab")
    found = loadmat(written, simplify_cells=True)["calibration"]

    def compare(ours: Any, theirs: Any) -> None:
        if isinstance(ours, dict):
            for key, value in ours.items():
                if value is not None:
                    compare(value, theirs[re.sub(r"\W", "_", key)])
        elif isinstance(ours, list) and ours and not isinstance(ours[0], int | float | list):
            theirs = [theirs] if len(ours) == 1 and not isinstance(theirs, np.ndarray) else theirs
            for one, other in zip(ours, theirs, strict=True):
                compare(one, other)
        elif isinstance(ours, str):
            assert str(theirs) == ours or (ours == "" and len(theirs) == 0)
        else:
            assert np.array_equal(np.squeeze(np.array(ours)), theirs)

    compare(held, found)
    first = written.read_bytes()
    assert export(path, "matlab").read_bytes() == first


def parameters(path: Path) -> dict[str, float]:
    """Return the parameters of a PX4 or ArduPilot file by name."""
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    fields = [line.split("\t")[2:4] if "\t" in line else line.split(",") for line in lines]
    return {name: float(value) for name, value in fields}


@pytest.mark.parametrize("thermal", [False, True])
def test_px4_takes_off_what_we_take_off(record: Record, thermal: bool, capsys: pytest.CaptureFixture[str]) -> None:
    kept = {name: EFFECTS[name] for name in ("thermal_bias", "thermal_bias_quadratic")} if thermal else {}
    path = record(triad(), {**kept, "scale_asymmetry": (1e-3,)})
    held = parameters(export(path, "px4", "--instance", "1"))
    said = capsys.readouterr().err
    plain, (rate, t_s, warm, _) = at_mean_temperature(path, tuple(kept))
    offset = np.array([held[f"CAL_GYRO1_{axis}OFF"] for axis in "XYZ"])
    if thermal:
        assert held["TC_G_ENABLE"] == 1
        above = warm[:, None] - held["TC_G1_TREF"]
        offset = offset + sum(
            np.array([held[f"TC_G1_X{order}_{axis}"] for axis in range(3)]) * above**order for order in range(4)
        )
    assert np.abs(rate - offset - less_added(plain, rate, t_s, warm)).max() < SAME
    for word in ("scale factor", "CAL_GYRO1_ID", "scale asymmetry"):
        assert word in said, word


@pytest.mark.parametrize("thermal", [False, True])
def test_ardupilot_takes_off_what_we_take_off(
    record: Record, thermal: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = {name: EFFECTS[name] for name in ("thermal_bias", "thermal_bias_quadratic")} if thermal else {}
    path = record(triad(), kept)
    held = parameters(export(path, "ardupilot", "--instance", "1"))
    plain, (rate, t_s, warm, _) = at_mean_temperature(path, tuple(kept))
    found = rate - np.array([held[f"INS_GYR2OFFS_{axis}"] for axis in "XYZ"])
    if thermal:
        coefficients = [np.array([held[f"INS_TCAL2_GYR{order}_{axis}"] for axis in "XYZ"]) for order in (1, 2, 3)]

        def polynomial(temperature_c: Any) -> Any:
            above = np.atleast_1d(temperature_c)[:, None] - 35.0
            return sum(c * 1e-6 * above**order for order, c in enumerate(coefficients, 1))

        found = found - polynomial(warm) + polynomial(held["INS_GYR2_CALTEMP"])
        assert held["INS_TCAL2_TMIN"] <= warm.min() + 1e-9
        assert held["INS_TCAL2_TMAX"] >= warm.max() - 1e-9
    assert np.abs(found - less_added(plain, rate, t_s, warm)).max() < SAME
    assert "INS_GYR_CAL" in capsys.readouterr().err
    assert "INS_GYROFFS_X" in parameters(export(path, "ardupilot"))


def test_gyros_along_minus_axes_and_in_another_order_get_the_right_parameter(record: Record) -> None:
    array = sensor_array([[0, 0, 1.0], [-1.0, 0, 0], [0, 1.0, 0]], names=("c", "a", "b"))
    path = record(array, {})
    held = parameters(export(path, "px4"))
    b = {gyro.name: gyro.states[1] for gyro in exported_of(path).gyros}
    assert held == {"CAL_GYRO0_XOFF": b["a"], "CAL_GYRO0_YOFF": -b["b"], "CAL_GYRO0_ZOFF": -b["c"]}


@pytest.mark.parametrize("form", ["ros", "kalibr", "openvins", "vectornav-84", "px4", "ardupilot"])
def test_an_array_of_four_is_not_squeezed_into_three(
    record: Record, form: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = record(tetrahedron(), {})
    assert main(["export", str(path), "--format", form]) == 2
    assert "--format c" in capsys.readouterr().err


def test_every_text_form_says_what_of_the_calibration_is_not_in_it(
    record: Record, capsys: pytest.CaptureFixture[str]
) -> None:
    path = record(triad(), {**EFFECTS, **LEFT_OUT})
    for form in ("c", "python", "ros", "kalibr", "openvins", "vectornav-84", "px4", "ardupilot"):
        text = export(path, form).read_text(encoding="utf-8")
        said = capsys.readouterr().err
        for name in LEFT_OUT:
            for where in (text, said):
                assert name.replace("_", " ") in where, (form, name)
        assert "0.005" in said  # the delay


def test_a_law_of_a_tables_axes_is_named_with_the_reason_where_it_is_left_out(
    record: Record, capsys: pytest.CaptureFixture[str]
) -> None:
    path = record(triad(), {**OF_AXES, "constructed u**2": (1e-3,)})
    for form in ("c", "python", "json"):
        text = export(path, form).read_text(encoding="utf-8")
        assert "bias proportional to cos of (2 times angle of axis x)" in text, form
        assert "and is absent elsewhere" in text
    assert "bias proportional to the square of the rate about the sense axis: it is not corrected" in (
        export(path, "ros").read_text(encoding="utf-8")
    )


@pytest.mark.parametrize("form", ["python", pytest.param("c", marks=needs_cc)])
def test_memory_of_a_law_outlives_a_bad_sample(record: Record, form: str) -> None:
    exported = exported_of(record(ARRAYS["four"], LAWS))
    rate, t_s, warm, force = samples(exported)
    rate[0, 1], rate[40, 1], warm[80], t_s[120] = np.nan, np.nan, np.nan, t_s[119]
    expected = compensate(exported.compensation, rate, t_s, warm, force)
    found, _ = (by_python if form == "python" else by_c)(exported, rate, t_s, warm, force)
    good = np.delete(np.arange(SAMPLES), [0, 40, 80])
    assert not np.isfinite(expected[[0, 40, 80]]).any()
    assert np.isfinite(expected[good]).all()
    assert np.abs(found[good] - expected[good]).max() < SAME


def test_two_devices_are_told_apart_or_taken_as_one_array(record: Record, capsys: pytest.CaptureFixture[str]) -> None:
    path = record(triad(), {}, "left", "right")
    assert main(["export", str(path), "--format", "c"]) == 2
    assert "left, right" in capsys.readouterr().err
    assert "right_correct(" in export(path, "c", "--device", "right").read_text()
    both = export(path, "python", "--device", "left", "--device", "right")
    names: dict[str, Any] = {}
    exec(both.read_text(encoding="utf-8"), names)
    assert names["GYROS"] == ["left x", "left y", "left z", "right x", "right y", "right z"]
    exported = exported_of(path)
    rate = samples(exported)[0]
    found = np.array([names["correct"](row) for row in rate.tolist()])
    assert np.abs(found - ours(exported)).max() < SAME
    assert main(["export", str(path), "--format", "c", "--device", "middle"]) == 2
    assert "left, right" in capsys.readouterr().err


def test_a_recording_of_the_station_is_exported_to_stdout(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    turn = '[[step]]\nkind = "rotate"\naxis = "{}"\nrate = "40 deg/s"\nacceleration = "20 deg/s2"\nduration = "6 s"\n'
    rest = '[[step]]\nkind = "rest"\nduration = "3 s"\n'
    script = tmp_path / "s.toml"
    script.write_text('name = "s"\n' + rest + "".join(map(turn.format, "xyz")))
    path = tmp_path / "run.h5"
    assert main(["run", "--script", str(script), "--device", "stim300", "-o", str(path)]) in (0, 1)
    capfd.readouterr()
    assert main(["export", str(path), "--format", "json"]) == 0
    assert len(json.loads(capfd.readouterr().out)["gyros"]) == 3
    assert main(["export", str(path), "--format", "kalibr"]) == 0
    held = yaml.safe_load(capfd.readouterr().out)
    assert held["gyroscopes"]["M"][0][0] == pytest.approx(1 - 300e-6, abs=5e-4)
    assert main(["export", str(path), "--format", "px4", "-o", str(tmp_path / "new" / "p.params"), "--json"]) == 0
    told = json.loads(capfd.readouterr().out)
    assert Path(told["file"]).is_file()
    assert told["not_held"]


def test_bad_input_is_refused_with_what_to_do(
    record: Record, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = record(triad(), {})
    good = path.read_bytes()

    def refused(*arguments: str | Path) -> str:
        assert main(["export", *map(str, arguments)]) == 2
        said = capsys.readouterr()
        assert said.out == ""
        return said.err

    assert "station export --list" in refused(path)
    with h5py.File(path, "r+") as file:
        del file["calibration"]
    assert f"station calibrate --write {path}" in refused(path, "--format", "c")
    path.write_bytes(good)
    with h5py.File(path, "r+") as file:
        del file["calibration/covariance"]
    assert "damaged calibration" in refused(path, "--format", "c")
    path.write_bytes(good)
    with h5py.File(path, "r+") as file:
        file.attrs["format_version"] = 99
    assert "format version 99" in refused(path, "--format", "c")
    path.write_bytes(good[: len(good) // 2])
    assert "cannot be read" in refused(path, "--format", "c")
    assert "is not a file" in refused(tmp_path / "none.h5", "--format", "c")
    model = tmp_path / "model.json"
    model.write_text(_model({"scale_cubic": (1e-3,)}).text())
    assert "station calibrate --model" in refused(model, "--format", "c")
    path.write_bytes(good)
    there = tmp_path / "there.h"
    there.write_text("mine")
    assert "not overwritten" in refused(path, "--format", "c", "-o", there)
    assert there.read_text() == "mine"
    assert main(["export", str(path), "--format", "c", "-o", str(there), "--force"]) == 0
    assert "my_gyro_1_correct" in there.read_text()
    capsys.readouterr()
    assert "cannot be written" in refused(path, "--format", "c", "-o", there / "x.h")
    assert "not a file" in refused(path, "--format", "c", "-o", tmp_path, "--force")
    assert main(["export", str(path), "--format", "c", "--json"]) == 2
    assert "--output" in json.loads(capsys.readouterr().out)["reason"]
    assert "0 to 3" in refused(path, "--format", "px4", "--instance", "4")


def test_a_run_that_was_no_pass_is_exported_with_a_warning(record: Record, capsys: pytest.CaptureFixture[str]) -> None:
    path = record(triad(), {})
    with h5py.File(path, "r+") as file:
        file.attrs.update({"outcome": "FAIL", "reason": "k of gyro x is beyond 1 %"})
        file["calibration"].attrs["notes"] = ["x: bias b is not determined by this run"]
    text = export(path, "c").read_text(encoding="utf-8")
    said = capsys.readouterr().err
    assert "did not pass: FAIL k of gyro x" in said
    assert "1 note of the calibration: --details" in said
    path.with_suffix(".txt").unlink(missing_ok=True)
    assert main(["export", str(path), "--format", "c", "--details"]) == 0
    assert "not determined by this run" in capsys.readouterr().err
    assert "outcome: FAIL" in text


def test_gyros_that_tell_no_body_rate_are_exported_as_data_only(
    record: Record, capsys: pytest.CaptureFixture[str]
) -> None:
    array = sensor_array([[1.0, 0, 0]], part_of_array=True)
    path = record(array, {})
    assert json.loads(export(path, "json").read_text())["solution_h"] is None
    assert main(["export", str(path), "--format", "c"]) == 2
    assert "do not span" in capsys.readouterr().err


def test_the_list_of_formats_has_all_of_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", "--list", "--json"]) == 0
    assert list(json.loads(capsys.readouterr().out)) == list(FORMATS)
    assert main(["export", "--list"]) == 0
    assert "CAL_GYROn" in capsys.readouterr().out


def test_whatever_the_locale_the_file_is_utf_8(record: Record) -> None:
    path = record(triad(), {})
    done = station("export", path, "--format", "yaml")
    assert done.returncode == 0
    assert "Müller" in done.stdout


def test_a_text_that_looks_like_a_number_stays_a_text_in_every_version_of_yaml() -> None:
    text = yaml_text({"serial": "1e5", "device": "yes", "rows": [[1.0, 1e-9]]})
    assert text == "serial: \"1e5\"\ndevice: 'yes'\nrows:\n- [1.0, 1.0e-09]\n"


def test_all_forms_that_can_hold_a_calibration_are_written_at_once(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, folder = record(tetrahedron(), {}), tmp_path / "forms"
    assert main(["export", str(path), "--all", str(folder), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert {"json", "c", "c-float", "python", "csv", "matlab"} <= said["files"].keys()
    assert said["files"].keys() | said["refused"].keys() == set(FORMATS)
    assert all(Path(file).stat().st_size for file in said["files"].values())
    assert sorted(folder.iterdir()) == sorted(map(Path, said["files"].values()))
    assert "three gyros" in said["refused"]["px4"]
    assert main(["export", str(path), "--all", str(folder)]) == 2
    assert "exists already" in capsys.readouterr().err


@pytest.mark.parametrize("form", ["c", "c-float"])
def test_a_program_can_check_identity_and_validity_of_the_header(record: Record, form: str, tmp_path: Path) -> None:
    path = record(tetrahedron(), {})
    (tmp_path / "made.h").write_bytes(export(path, form).read_bytes())
    prefix = "MY_GYRO_1" if form == "c" else "MY_GYRO_1_FLOAT"
    (tmp_path / "check.c").write_text(
        f"""#include <stdio.h>
#include "made.h"
#if !defined({prefix}_RECORDING_SHA256)
#error no hash
#endif
int main(void) {{
    printf("%s|%s|%s|%g|%g", {prefix}_SERIAL_NUMBER, {prefix}_RECORDING, {prefix}_RECORDING_SHA256,
        (double){prefix}_TEMPERATURE_MIN_C, (double){prefix}_RATE_MAX_RPS);
    return 0;
}}"""
    )
    subprocess.run(["gcc", "-o", tmp_path / "check", tmp_path / "check.c", "-lm"], check=True)
    said = subprocess.run([tmp_path / "check"], capture_output=True, text=True, check=True).stdout.split("|")
    assert said[:3] == ["SN 7 */ /* ?", "run.h5", hashlib.sha256(path.read_bytes()).hexdigest()]
    (data,) = read_recording(path).sources.values()
    assert data.temperature_c is not None
    assert float(said[3]) == pytest.approx(data.temperature_c.min(), rel=1e-5)
    assert float(said[4]) == pytest.approx(np.abs(data.rate_rps).max(), rel=1e-5)


def test_a_calibration_corrects_arrays_and_frames(record: Record) -> None:
    path = record(tetrahedron(), {"thermal_bias": EFFECTS["thermal_bias"]})
    recording = read_recording(str(path))
    calibration = read_calibration(str(path))
    (data,) = recording.sources.values()
    t_s = data.t_ns * 1e-9
    expected = compensate(exported_of(path).compensation, data.rate_rps, t_s, data.temperature_c)
    given = {"t_s": t_s, "temperature_c": data.temperature_c}
    assert calibration.apply(data.rate_rps, **given) == pytest.approx(expected)
    corrected = calibration.apply(data.to_frame()[list(reversed(data.array.names))], **given)
    assert corrected.to_numpy() == pytest.approx(expected)
    assert list(corrected.columns) == ["x_rps", "y_rps", "z_rps"]
    assert corrected.index.name == "t_s"
    for wrong, said in (({"t_s": t_s}, "temperature"), ({**given, "device": "other"}, "no calibrated device")):
        with pytest.raises(CompensationError, match=said):
            calibration.apply(data.rate_rps, **wrong)
    with pytest.raises(CompensationError, match="an array of N x 4"):
        calibration.apply(data.rate_rps[:, :3], **given)


def test_a_calibration_becomes_a_dataset(record: Record) -> None:
    calibration = read_calibration(record(tetrahedron(), {}))
    dataset = calibration.to_xarray()
    assert dataset["value"].sel(gyro="gyro2", state="b_rps").item() == calibration.gyros[1].states[1]
    assert dataset["covariance"].dims == ("gyro", "state", "other_state")
