"""station export of accelerometers: every form, applied to their outputs, gives the specific force that made them."""

from __future__ import annotations

import csv
import json
import re
import subprocess
from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.io import loadmat
from test_export import (
    EFFECTS,
    LAWS,
    WARNED,
    Record,
    at_mean_temperature,
    export,
    needs_cc,
    parameters,
    record,
)

from estimator.calibration.accelerometer import AccelerometerCalibration, ForceCalibration, ForceEffectValues
from estimator.calibration.calibration_file import read_calibration, write_calibration
from estimator.calibration.correction import compensate
from estimator.geometry.array import SensorArray, sensor_array, tetrahedron, triad
from estimator.geometry.noise import NoiseFound, NoiseModel
from estimator.observations.health import Excluded
from estimator.observations.timing import TimeOffset
from station.cli import main
from station.exports.exported import exported_of
from station.exports.formats import FORMATS

SAME = 1e-6
"""Relative to the largest force."""
DELAY_S = 1.5e-3
ARM_M = np.array([0.04, -0.025, 0.015])
DEVICE = "my-gyro 1"
TURNED = [[0.6, 0.8, 0.0], [0.0, 0.0, 1.0], [0.8, -0.6, 0.0]]
MOUNTINGS: dict[str, SensorArray] = {
    "body": triad(),
    "reversed": sensor_array([[0, 0, -1.0], [-1.0, 0, 0], [0, 1.0, 0]], names=("c", "a", "b")),
    "turned": sensor_array(TURNED, names=("x", "y", "z")),
}

NEED_FORCES = ("vectornav-25", "imu_tk-acc", "imucal")
"""Forms that cannot do without accelerometers."""

OF_FORCE: dict[str, tuple[str, int, Callable[..., Any]]] = {
    "asymmetry": ("1", 1, lambda a, aj, ak, c: c[0] * np.abs(a) / 2),
    "second_order": ("1/g", 1, lambda a, aj, ak, c: c[0] * a**2 / 9.80665),
    "third_order": ("1/g2", 1, lambda a, aj, ak, c: c[0] * a**3 / 9.80665**2),
    "cross_j": ("1/g", 1, lambda a, aj, ak, c: c[0] * a * aj / 9.80665),
    "cross_k": ("1/g", 1, lambda a, aj, ak, c: c[0] * a * ak / 9.80665),
    "cross_axis_square": ("1/g", 2, lambda a, aj, ak, c: (c[0] * aj**2 + c[1] * ak**2) / 9.80665),
}
"""Effects of the specific force: unit, number of parameters, what they add to the output (IEEE 1293)."""

RecordForces = Callable[..., Path]
__all__ = ["record"]  # the fixture


@pytest.fixture
def record_forces(record: Record) -> RecordForces:
    """Write a recording with a calibration of gyros and accelerometers that nobody estimated."""

    def made(
        array: SensorArray,
        sizes: dict[str, tuple[float, ...]] | None = None,
        *,
        devices: tuple[str, ...] = (DEVICE,),
        with_forces: tuple[str, ...] = (DEVICE,),
        misaligned: bool = True,
        states: np.ndarray | None = None,
        excluded: tuple[Excluded, ...] = (),
    ) -> Path:
        path = record(triad(), sizes or {}, *devices)
        forces = tuple(_forces(array, device, misaligned, states, excluded) for device in with_forces)
        write_calibration(path, replace(read_calibration(path), forces=forces))
        return path

    return made


def _forces(
    array: SensorArray, device: str, misaligned: bool, states: np.ndarray | None, excluded: tuple[Excluded, ...]
) -> ForceCalibration:
    """Return the calibration of the accelerometers of an array, of arbitrary states."""
    random = np.random.default_rng(11)
    count = len(array)
    if states is None:
        states = random.normal(0, (5e-3, 5e-2, 2e-3, 2e-3), (count, 4))
    if not misaligned:
        states[:, 2:] = 0.0
    root = random.normal(0, 1e-5, (4 * count, 4 * count))
    covariance = root @ root.T
    accelerometers = tuple(
        AccelerometerCalibration(
            name=f"accel {name}",
            source=device,
            device=device,
            p=array.p[i],
            j=array.j[i],
            k_axis=array.k[i],
            states=states[i],
            covariance=covariance[4 * i : 4 * i + 4, 4 * i : 4 * i + 4],
            noise_mps2=6e-3,
            place_m=ARM_M + random.normal(0, 1e-3, 3),
            place_covariance_m2=np.eye(3) * 1e-8,
            noise=NoiseFound(NoiseModel(6e-4, 1e-4, 2e-6), 2e-4, 4e-6),
        )
        for i, name in enumerate(array.names)
    )
    return ForceCalibration(
        source=device,
        device=device,
        accelerometers=accelerometers,
        covariance=covariance,
        arm_m=ARM_M,
        arm_covariance_m2=np.eye(3) * 1e-8,
        gravity_mps2=9.80665,
        offset=TimeOffset(DELAY_S, 1e-5),
        excluded=excluded,
    )


@pytest.fixture
def record_effects(record_forces: RecordForces) -> RecordForces:
    """Write such a recording in which accelerometers also have effects of the specific force, and one of the warmth."""

    def made(array: SensorArray) -> Path:
        path = record_forces(array)
        found = read_calibration(path)
        random = np.random.default_rng(5)
        effects = [
            ForceEffectValues(
                name=name,
                unit=unit,
                parameters=("coefficient",) if count == 1 else ("along j", "along k"),
                values=random.normal(0, 1e-3, (len(array), count)),
                sd=np.full((len(array), count), 1e-5),
            )
            for name, (unit, count, _) in OF_FORCE.items()
        ]
        one = np.full((len(array), 1), 1e-4)
        warmth = ForceEffectValues(
            name="scale_over_temperature",
            unit="1/K",
            parameters=("coefficient",),
            values=one,
            sd=one,
            about="T0 = 30 degC",
        )
        forces = tuple(replace(one, effects=(*effects, warmth)) for one in found.forces)
        write_calibration(path, replace(found, forces=forces))
        return path

    return made


def felt(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return specific forces (n, 3) and the outputs (n, a) that the accelerometers of a recording make of them."""
    force = np.random.default_rng(3).normal(0, 10, (200, 3))
    (calibration,) = read_calibration(path).forces
    columns = []
    for one in calibration.accelerometers:
        k, b, sigma_j, sigma_k = one.states
        axis = one.p - sigma_k * one.j + sigma_j * one.k_axis
        columns.append((1 - k) * (force @ axis) - b)
    for effect in calibration.effects:
        if effect.name in OF_FORCE:
            for column, one, values in zip(columns, calibration.accelerometers, effect.values, strict=True):
                along = (force @ axis for axis in (one.p, one.j, one.k_axis))
                column += OF_FORCE[effect.name][2](*along, values)
    return force, np.column_stack(columns)


def assert_same(found: np.ndarray, force: np.ndarray, tolerance: float = SAME) -> None:
    assert np.abs(found - force).max() < tolerance * np.abs(force).max()


@pytest.mark.parametrize("array", [*MOUNTINGS.values(), tetrahedron()], ids=[*MOUNTINGS, "four"])
def test_json_yaml_and_matlab_hold_all_of_the_accelerometers(record_forces: RecordForces, array: SensorArray) -> None:
    path = record_forces(array)
    held = json.loads(export(path, "json").read_text(encoding="utf-8"))
    assert held == yaml.safe_load(export(path, "yaml").read_text(encoding="utf-8"))
    (found,) = held["accelerometers"]
    force, outputs = felt(path)
    assert_same((outputs + np.array(found["bias_b_mps2"])) @ np.array(found["solution_m"]).T, force)
    (calibration,) = read_calibration(path).forces
    assert np.array_equal(found["covariance"], calibration.covariance)
    assert found["lever_arm"]["value_m"] == ARM_M.tolist()
    assert np.array_equal(found["lever_arm"]["covariance_m2"], calibration.arm_covariance_m2)
    assert found["delay"] == {"value_s": DELAY_S, "sd_s": 1e-5}
    assert found["intrinsic"]["sensitivity"] == pytest.approx(np.linalg.norm(found["sensitivity_s"], axis=1))
    for told, one in zip(found["accelerometers"], calibration.accelerometers, strict=True):
        assert [told[key] for key in ("k", "b_mps2", "sigma_j_rad", "sigma_k_rad")] == one.states.tolist()
        assert np.array_equal(told["covariance"], one.covariance)
        assert np.array_equal(told["p"], one.p)
        assert told["place_m"] == one.place_m.tolist()
    matlab = loadmat(export(path, "matlab"), simplify_cells=True)["calibration"]["accelerometers"]
    matlab = matlab if isinstance(matlab, dict) else matlab[0]
    assert_same((outputs + matlab["bias_b_mps2"]) @ matlab["solution_m"].T, force)


def test_csv_has_a_line_an_accelerometer(record_forces: RecordForces) -> None:
    path = record_forces(MOUNTINGS["turned"])
    with export(path, "csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["gyro"] for row in rows] == ["x", "y", "z", "", "", ""]
    rows = [row for row in rows if row["accelerometer"]]
    sensitivity = np.array([[float(row[f"g_{axis}"]) for axis in "xyz"] for row in rows])
    bias = np.array([float(row["b_mps2 (m/s2)"]) for row in rows])
    force, outputs = felt(path)
    assert_same((outputs + bias) @ np.linalg.inv(sensitivity).T, force)
    (calibration,) = read_calibration(path).forces
    assert [float(row["place_y (m)"]) for row in rows] == [one.place_m[1] for one in calibration.accelerometers]
    assert {float(row["delay (s)"]) for row in rows} == {DELAY_S}


@pytest.mark.parametrize("array", [*MOUNTINGS.values(), tetrahedron()], ids=[*MOUNTINGS, "four"])
@pytest.mark.parametrize("sizes", [{}, {**EFFECTS, **LAWS}], ids=["plain", "state"])
def test_the_python_module_gives_the_force(
    record_forces: RecordForces, array: SensorArray, sizes: dict[str, tuple[float, ...]]
) -> None:
    path = record_forces(array, sizes)
    module: dict[str, Any] = {}
    exec(export(path, "python").read_text(encoding="utf-8"), module)
    force, outputs = felt(path)
    assert_same(np.array([module["correct_force"](row) for row in outputs.tolist()]), force)
    assert list(module["LEVER_ARM_M"]) == ARM_M.tolist()
    assert module["FORCE_DELAY_S"] == DELAY_S
    assert module["ACCELEROMETERS"] == [f"accel {name}" for name in array.names]


FORCE_MAIN = """
#include <stdio.h>
#include "made.h"
int main(void)
{{
    {real} outputs[{p}_accelerometers], force[3];
    double read;
    int i;
    int failed = {p}_self_test();
    printf("%d %.9g %.9g\\n", failed, (double){upper}_LEVER_ARM_Y_M, (double){upper}_FORCE_DELAY_S);
    for (;;) {{
        for (i = 0; i < {p}_accelerometers; i++) {{
            if (scanf("%lf", &read) != 1) return 0;
            outputs[i] = ({real})read;
        }}
        {p}_correct_force(outputs, force);
        printf("%.17g %.17g %.17g\\n", (double)force[0], (double)force[1], (double)force[2]);
    }}
}}
"""


def by_c(path: Path, form: str, outputs: np.ndarray, spoil: Callable[[str], str] = str) -> tuple[int, np.ndarray]:
    """Return the answer of the self-test, and the forces (n, 3) that the compiled header makes of outputs."""
    folder = path.parent
    (folder / "made.h").write_text(spoil(export(path, form).read_text(encoding="utf-8")), encoding="utf-8")
    p = "my_gyro_1" if form == "c" else "my_gyro_1_float"
    source = FORCE_MAIN.format(p=p, upper=p.upper(), real="double" if form == "c" else "float")
    (folder / "made.c").write_text(source, encoding="utf-8")
    command = ["cc", *WARNED, str(folder / "made.c"), "-o", str(folder / "made"), "-lm"]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    fed = "\n".join(" ".join(f"{value:.17g}" for value in row) for row in outputs)
    run = subprocess.run([str(folder / "made")], input=fed, capture_output=True, text=True, check=True)
    first, *lines = run.stdout.splitlines()
    failed, arm_y_m, delay_s = first.split()
    assert float(arm_y_m) == pytest.approx(ARM_M[1])
    assert float(delay_s) == pytest.approx(DELAY_S)
    return int(failed), np.array([[float(word) for word in line.split()] for line in lines])


@needs_cc
@pytest.mark.parametrize("form", ["c", "c-float"])
@pytest.mark.parametrize(
    ("array", "sizes"),
    [(MOUNTINGS["turned"], {}), (MOUNTINGS["reversed"], {**EFFECTS, **LAWS}), (tetrahedron(), {})],
    ids=["turned", "state", "four"],
)
def test_the_c_header_gives_the_force(
    record_forces: RecordForces, form: str, array: SensorArray, sizes: dict[str, tuple[float, ...]]
) -> None:
    path = record_forces(array, sizes)
    force, outputs = felt(path)
    failed, found = by_c(path, form, outputs)
    assert failed == 0
    assert_same(found, force)


@pytest.mark.parametrize("array", [MOUNTINGS["turned"], tetrahedron()], ids=["turned", "four"])
def test_the_python_module_corrects_effects_of_the_force_and_says_what_it_leaves(
    record_effects: RecordForces, array: SensorArray
) -> None:
    path = record_effects(array)
    text = export(path, "python").read_text(encoding="utf-8")
    module: dict[str, Any] = {}
    exec(text, module)
    force, outputs = felt(path)
    assert_same(np.array([module["correct_force"](row) for row in outputs.tolist()]), force)
    (line,) = [line for line in text.splitlines() if "effects of the accelerometers" in line]
    assert "scale over temperature" in line
    assert "asymmetry" not in line


@needs_cc
@pytest.mark.parametrize("form", ["c", "c-float"])
def test_the_c_header_corrects_effects_of_the_force(record_effects: RecordForces, form: str) -> None:
    path = record_effects(MOUNTINGS["turned"])
    force, outputs = felt(path)
    failed, found = by_c(path, form, outputs)
    assert failed == 0
    assert_same(found, force)


def test_json_says_what_each_effect_of_the_accelerometers_adds(record_effects: RecordForces) -> None:
    path = record_effects(MOUNTINGS["turned"])
    held = json.loads(export(path, "json").read_text(encoding="utf-8"))
    assert "effects" in held["force_formula"]
    (found,) = held["accelerometers"]
    force, outputs = felt(path)
    for place, told in enumerate(found["accelerometers"]):
        axes = {"a": told["p"], "aj": told["j"], "ak": told["k_axis"]}
        known = {name: force @ axis for name, axis in axes.items()} | {
            "g": 9.80665,
            "fabs": np.abs,
            "T": 30.0,
            "T0": 30.0,
        }
        added = sum(
            effect[told["name"]][parameter]["value"] * eval(adds, dict(known))
            for effect in found["effects"].values()
            for parameter, adds in effect["adds"].items()
        )
        linear = force @ np.array(found["sensitivity_s"][place]) - found["bias_b_mps2"][place]
        np.testing.assert_allclose(linear + added, outputs[:, place], atol=1e-12)
    assert found["effects"]["scale_over_temperature"]["about"] == "T0 = 30 degC"


@needs_cc
@pytest.mark.parametrize("form", ["c", "c-float"])
@pytest.mark.parametrize("table", ["force_solution", "force_bias"])
def test_the_header_tests_its_accelerometers(record_forces: RecordForces, form: str, table: str) -> None:
    path = record_forces(MOUNTINGS["turned"])

    def reverse(text: str) -> str:
        """Change the sign of the first number of a table."""
        pattern = rf"(_{table}\[[^=]*= \{{\s*\{{?)(-?)(?=\d)"
        changed, count = re.subn(pattern, lambda m: m[1] + ("" if m[2] else "-"), text, count=1)
        assert count == 1
        return changed

    failed, _ = by_c(path, form, felt(path)[1], reverse)
    assert failed > 8  # the eight samples of gyros pass


each_mounting = pytest.mark.parametrize("array", MOUNTINGS.values(), ids=MOUNTINGS)


@each_mounting
def test_the_ros_file_corrects_the_force(record_forces: RecordForces, array: SensorArray) -> None:
    path = record_forces(array)
    held = yaml.safe_load(export(path, "ros").read_text(encoding="utf-8"))
    force, outputs = felt(path)
    assert_same(outputs @ np.reshape(held["SM"], (3, 3)).T - held["bias"], force)


def listed(pattern: str, text: str) -> np.ndarray:
    """Return the numbers in the first brackets behind a pattern."""
    found = re.search(rf"{pattern}[^\[]*\[([^\]]*)\]", text)
    assert found is not None
    return np.array([float(word) for word in found[1].split(",")])


@each_mounting
def test_kalibr_predicts_both_sensors_in_the_axes_that_it_states(
    record_forces: RecordForces, array: SensorArray
) -> None:
    path = record_forces(array, EFFECTS)
    text = export(path, "kalibr").read_text(encoding="utf-8")
    held = yaml.safe_load(text)
    assert held["model"] == "scale-misalignment-size-effect"
    turned = listed("axes of the IMU, by rows", text).reshape(3, 3)
    m = np.array(held["accelerometers"]["M"])
    assert np.array_equal(m, np.tril(m))
    bias = listed("outputs without force", text)
    force, outputs = felt(path)
    assert_same(force @ turned.T @ m.T + bias, outputs)
    gyros = {key: np.array(value) for key, value in held["gyroscopes"].items()}
    plain, (rate, t_s, _, accel) = at_mean_temperature(path, ("g_sensitivity",))
    w = compensate(plain, rate, t_s, None, accel) @ turned.T
    c = gyros["C_gyro_i"]
    predicted = w @ (gyros["M"] @ c).T + accel @ turned.T @ (gyros["A"] @ c).T - plain.bias_rps
    assert np.abs(predicted - rate).max() < 1e-9
    (calibration,) = read_calibration(path).forces
    first, second, _ = (one.place_m for one in calibration.accelerometers)
    assert held["accelerometers"]["rx_i"] == [0.0, 0.0, 0.0]
    assert turned.T @ held["accelerometers"]["ry_i"] == pytest.approx(second - first, abs=1e-12)
    assert held["accelerometer_noise_density"] == pytest.approx(6e-4)
    assert held["accelerometer_random_walk"] == pytest.approx(2e-6)


@each_mounting
def test_openvins_corrects_the_force(record_forces: RecordForces, array: SensorArray) -> None:
    path = record_forces(array)
    text = export(path, "openvins").read_text(encoding="utf-8")
    held = yaml.safe_load(text.partition("\n")[2])["imu0"]
    da = np.tril(np.linalg.inv(held["Ta"]))  # it takes the lower triangle
    force, outputs = felt(path)
    found = (outputs - listed("outputs without force", text)) @ (np.transpose(held["R_IMUtoACC"]) @ da).T
    assert_same(found, force)


@pytest.mark.parametrize("form", ["kalibr", "openvins"])
def test_a_left_handed_triad_of_accelerometers_is_left_out(
    record_forces: RecordForces, form: str, capsys: pytest.CaptureFixture[str]
) -> None:
    text = export(record_forces(triad().select([0, 2, 1])), form).read_text(encoding="utf-8")
    assert "left-handed one in their order" in capsys.readouterr().err
    assert "#accelerometer_noise_density" in text


@pytest.mark.parametrize("array", ["body", "reversed"])
@pytest.mark.parametrize(
    ("form", "offset", "scale"),
    [
        ("px4", "CAL_ACC1_{}OFF", "CAL_ACC1_{}SCALE"),
        ("ardupilot", "INS_ACC2OFFS_{}", "INS_ACC2SCAL_{}"),
    ],
)
def test_autopilots_take_off_and_multiply(
    record_forces: RecordForces, array: str, form: str, offset: str, scale: str
) -> None:
    path = record_forces(MOUNTINGS[array], misaligned=False)
    held = parameters(export(path, form, "--instance", "1"))
    force, outputs = felt(path)
    along = outputs @ MOUNTINGS[array].p  # as the sensor has them along its x, y and z
    offsets, scales = ([held[name.format(axis)] for axis in "XYZ"] for name in (offset, scale))
    assert_same((along - offsets) * scales, force)
    if form == "ardupilot":
        assert held["INS_ACC2_CALTEMP"] == pytest.approx(29.5, abs=0.1)
        assert "INS_ACCOFFS_X" in parameters(export(path, form))


@pytest.mark.parametrize("form", ["px4", "ardupilot"])
def test_autopilots_are_told_what_they_leave_in(
    record_forces: RecordForces, form: str, capsys: pytest.CaptureFixture[str]
) -> None:
    states = np.array([[1e-3, 1e-3, 1.5e-3, 0.0], [0.0, 2e-3, 0.0, -7e-4], [-2e-3, 0.0, 0.0, 0.0]])
    path = record_forces(triad(), states=states)
    export(path, form)
    assert "(1500, 0, 0, -700, 0, 0 urad)" in capsys.readouterr().err
    path.unlink()
    export(record_forces(MOUNTINGS["turned"]), form)
    said = capsys.readouterr().err
    assert "these do not lie along these axes" in said


@each_mounting
def test_register_25_of_vectornav_corrects_the_force(
    record_forces: RecordForces, array: SensorArray, capsys: pytest.CaptureFixture[str]
) -> None:
    path = record_forces(array)
    lines = export(path, "vectornav-25").read_text(encoding="utf-8").splitlines()
    assert "identity" in capsys.readouterr().err
    command = next(line for line in lines if line.startswith("$"))
    fields, checksum = command[1:].split("*")
    assert f"{reduce(xor, fields.encode()):02X}" == checksum
    words = fields.split(",")
    assert words[:2] == ["VNWRG", "25"]
    values = np.float32(words[2:]).astype(float)  # what the device keeps
    force, outputs = felt(path)
    found = (outputs - values[9:]) @ values[:9].reshape(3, 3).T
    assert_same(found, force @ array.p.T)
    assert lines[-1].startswith("$VNWNV*")


def imu_tk(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return T, K and b as imu_tk reads them, 21 numbers from the beginning, and R as the file states it."""
    text = path.read_text(encoding="utf-8")
    values = np.array([float(word) for word in text.split()[:21]])
    turned = listed("R by rows", text).reshape(3, 3)
    return values[:9].reshape(3, 3), values[9:18].reshape(3, 3), values[18:], turned


@each_mounting
def test_imu_tk_corrects_the_force_in_its_own_axes(record_forces: RecordForces, array: SensorArray) -> None:
    path = record_forces(array)
    t, k, b, turned = imu_tk(export(path, "imu_tk-acc"))
    assert np.array_equal(t, np.triu(t))
    assert np.array_equal(np.diag(t), np.ones(3))
    assert np.array_equal(k, np.diag(np.diag(k)))
    assert np.abs(turned @ turned.T - np.eye(3)).max() < 1e-12
    force, outputs = felt(path)
    assert_same((outputs - b) @ (t @ k).T, force @ turned.T)


@pytest.mark.parametrize("with_forces", [(DEVICE,), ()], ids=["both", "gyros"])
def test_imu_tk_corrects_gyros_in_the_axes_of_the_accelerometers(
    record_forces: RecordForces, with_forces: tuple[str, ...]
) -> None:
    path = record_forces(triad(), with_forces=with_forces)
    t, k, b, turned = imu_tk(export(path, "imu_tk-gyro"))
    assert np.diag(t) == pytest.approx(np.ones(3), abs=1e-15)
    plain, (rate, t_s, _, _) = at_mean_temperature(path, ())
    assert np.abs((rate - b) @ (t @ k).T - compensate(plain, rate, t_s) @ turned.T).max() < 1e-9
    expected = imu_tk(export(path, "imu_tk-acc"))[3] if with_forces else np.eye(3)
    assert np.array_equal(turned, expected)


def test_imu_tk_refuses_a_left_handed_triad_and_another_order(
    record_forces: RecordForces, capsys: pytest.CaptureFixture[str]
) -> None:
    path = record_forces(triad().select([0, 2, 1]))
    assert main(["export", str(path), "--format", "imu_tk-acc"]) == 2
    assert "left-handed" in capsys.readouterr().err
    path.unlink()
    path = record_forces(MOUNTINGS["turned"])
    assert main(["export", str(path), "--format", "imu_tk-gyro"]) == 2
    assert "in the order of the accelerometers" in capsys.readouterr().err


@each_mounting
def test_imucal_corrects_both_sensors(record_forces: RecordForces, array: SensorArray) -> None:
    path = record_forces(array, {"g_sensitivity": EFFECTS["g_sensitivity"]})
    held = json.loads(export(path, "imucal").read_text(encoding="utf-8"))
    assert (held["cal_type"], held["_format_version"]) == ("Turntable", "2.0.0")
    assert (held["from_acc_unit"], held["from_gyr_unit"]) == ("m/s^2", "deg/s")
    of = {key: np.array(held[key]) for key in ("K_a", "R_a", "b_a", "K_g", "R_g", "K_ga", "b_g")}
    force, outputs = felt(path)
    assert_same((outputs - of["b_a"]) @ np.linalg.inv(of["K_a"] @ of["R_a"]).T, force)
    plain, (rate, t_s, _, accel) = at_mean_temperature(path, ("g_sensitivity",))
    found = (np.degrees(rate) - accel @ of["K_ga"].T - of["b_g"]) @ np.linalg.inv(of["K_g"] @ of["R_g"]).T
    assert np.abs(np.radians(found) - compensate(plain, rate, t_s, None, accel)).max() < 1e-9
    assert "lever arm of the accelerometers" in held["comment"]
    assert "SN 7" in held["comment"]


@pytest.mark.parametrize("form", NEED_FORCES)
def test_a_form_of_accelerometers_refuses_a_calibration_without(
    record_forces: RecordForces, form: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = record_forces(triad(), with_forces=())
    assert main(["export", str(path), "--format", form]) == 2
    assert "[imu.accelerometers]" in capsys.readouterr().err
    path.unlink()
    few = record_forces(triad().select([0, 1]), excluded=(Excluded("accel z", "it is constant"),))
    assert main(["export", str(few), "--format", form]) == 2
    assert "accel z: it is constant" in capsys.readouterr().err


@pytest.mark.parametrize(("form", "where"), [("vectornav-84", "--format vectornav-25"), ("stim300-trim", "--format c")])
def test_a_form_of_gyros_says_where_the_accelerometers_are(
    record_forces: RecordForces, form: str, where: str, capsys: pytest.CaptureFixture[str]
) -> None:
    text = export(record_forces(triad()), form).read_text(encoding="utf-8")
    for told in (text, capsys.readouterr().err):
        assert re.search(rf"accelerometers: .*{where}", told)


THREE = ("ros", "kalibr", "openvins", "px4", "ardupilot")


@pytest.mark.parametrize("form", THREE)
def test_four_accelerometers_are_not_squeezed_into_three(
    record_forces: RecordForces, form: str, capsys: pytest.CaptureFixture[str]
) -> None:
    export(record_forces(tetrahedron()), form)
    assert "holds three, but this device has 4" in capsys.readouterr().err


@pytest.mark.parametrize("form", [*THREE, *NEED_FORCES])
def test_a_form_of_three_says_what_it_lacks_of_the_accelerometers(
    record_forces: RecordForces, form: str, capsys: pytest.CaptureFixture[str]
) -> None:
    text = export(record_forces(triad()), form).read_text(encoding="utf-8")
    said = capsys.readouterr().err
    for where in (text, said):
        for word in ("delay of the acc", "lever arm of the acc", "covariances of the acc", "temperature of the acc"):
            assert word in where, word
        assert "not calibrated here" not in where


def test_accelerometers_of_another_device_change_nothing(record_forces: RecordForces) -> None:
    """Whatever the form, gyros whose device has no calibrated accelerometers are exported as they always were."""
    path = record_forces(triad(), EFFECTS, devices=("left", "right"), with_forces=("right",))
    beside = exported_of(path, ["left"])
    write_calibration(path, replace(read_calibration(path), forces=()))
    without = exported_of(path, ["left"])
    texts = {name: form.write(without) for name, form in FORMATS.items() if name not in NEED_FORCES}
    for name, before in texts.items():
        after = FORMATS[name].write(beside)
        assert after.not_held == before.not_held, name
        if name == "yaml":  # which style it takes depends on whether the file's hash begins with a digit
            assert _values(after.text) == _values(before.text)
        else:
            assert _without_hash(after.text) == _without_hash(before.text), name


def _values(text: str | bytes) -> dict[str, Any]:
    """Return the values of a YAML file without the hash of the recording."""
    values: dict[str, Any] = yaml.safe_load(text)
    del values["identity"]["sha256_of_the_recording"]
    return values


def _without_hash(text: str | bytes) -> str:
    decoded = text.decode("latin-1") if isinstance(text, bytes) else text
    return re.sub(r"[0-9a-f]{64}", "", decoded)


def test_a_device_without_three_accelerometers_is_exported_with_the_reason(
    record_forces: RecordForces, capsys: pytest.CaptureFixture[str]
) -> None:
    path = record_forces(triad().select([0, 1]), excluded=(Excluded("accel z", "it is constant"),))
    held = json.loads(export(path, "json").read_text(encoding="utf-8"))
    assert held["accelerometers"][0]["solution_m"] is None
    assert held["accelerometers"][0]["excluded"] == {"accel z": "it is constant"}
    capsys.readouterr()
    for form in ("c", "python"):
        assert main(["export", str(path), "--format", form]) == 0
        said = capsys.readouterr()
        assert "accel z: it is constant" in said.err
        assert "correct_force" not in said.out


def test_two_devices_in_two_places_make_no_common_force(
    record_forces: RecordForces, capsys: pytest.CaptureFixture[str]
) -> None:
    path = record_forces(triad(), devices=("left", "right"), with_forces=("left", "right"))
    assert main(["export", str(path), "--format", "python", "--device", "left", "--device", "right"]) == 0
    said = capsys.readouterr()
    assert "at its own place" in said.err
    assert "correct_force" not in said.out
    assert "correct_force" in export(path, "python", "--device", "left").read_text(encoding="utf-8")


@pytest.mark.parametrize("form", ["c", "python"])
def test_source_code_says_what_it_lacks_of_the_accelerometers(
    record_forces: RecordForces, form: str, capsys: pytest.CaptureFixture[str]
) -> None:
    text = export(record_forces(triad()), form).read_text(encoding="utf-8")
    said = capsys.readouterr().err
    for where in (text, said):
        for word in ("delay of the accelerometers of 0.0015 s", "covariances of the acc", "temperature of the acc"):
            assert word in where, word
        assert "lever arm of the" not in where  # it is held
