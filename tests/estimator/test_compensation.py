"""From outputs back to body rates: against the forward model, and against the physics of the twins."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from motions import simulate
from support import SITE

from estimator.calibration.calibration_file import read_calibration, write_calibration
from estimator.calibration.compensation import Compensation, CompensationError
from estimator.calibration.correction import compensate, needs_of
from estimator.calibration.error_model import ErrorModel, KnownEffect, Size
from estimator.calibration.gyro import EffectValue, GyroCalibration
from estimator.effects.catalogue import everything
from estimator.effects.conditions import Conditions, smoothed_slope
from estimator.effects.effect import Kind
from estimator.errors import RecordingError
from estimator.estimation.calibrate import calibrate
from estimator.geometry.array import SensorArray, dodecahedron, tetrahedron, triad
from estimator.geometry.kinematics import GRAVITY_MPS2
from estimator.recordings.motion.body_rates import BodyRates
from estimator.recordings.reference import TableReadings
from estimator.recordings.writing import write_recording
from sims.physics.hidden import Hidden
from station.opening import DeviceTruth
from station.scripts.loop_scripts import exploration_script

SIZES: dict[str, tuple[float, ...]] = {
    "thermal_bias": (2e-4,),
    "thermal_bias_quadratic": (3e-6,),
    "thermal_scale": (1e-4,),
    "warm_up": (2e-3,),
    "g_sensitivity": (2e-4, -1e-4, 3e-4),
    "scale_asymmetry": (2e-3,),
    "scale_quadratic": (3e-3,),
    "scale_cubic": (2e-3,),
}
SETTINGS: dict[str, dict[str, float | int | str]] = {
    "warm_up": {"time_constant_s": 40.0},
    "tone": {"frequency_hz": 7.3},
    "dead_band": {"width_rps": 1e-3},
    "table_harmonic": {"axis": "x", "order": 2},
}


LAWS: dict[str, tuple[float, ...]] = {
    "constructed lag(T, 58)*gx": (2e-5,),
    "constructed log1p(t/9); exp(-t/4)": (1e-4, 2e-3),
    "constructed abs(wx)*wy": (2e-3,),
    "constructed u*gs; speed**3": (1e-3, 1e-3),
}


def calibrated(array: SensorArray, sizes: dict[str, tuple[float, ...]]) -> tuple[list[GyroCalibration], ErrorModel]:
    """Return gyros with states and effects that differ from gyro to gyro, and their error model.

    Effects by name; "constructed LAW" for those without one.
    """
    random = np.random.default_rng(7)
    units = {entry.name.removesuffix("_1"): entry.parameters[0].unit for entry in everything() if entry.parameters}
    shared = {entry.name for entry in everything() if entry.shared}
    known = tuple(
        KnownEffect(
            name,
            name in shared,
            tuple(Size(f"part {n}", units.get(name, "rad/s per unit"), 0.0, abs(v)) for n, v in enumerate(values)),
            {"law": law} if law else SETTINGS.get(name, {}),
        )
        for (name, _, law), values in ((called.partition(" "), values) for called, values in sizes.items())
    )
    gyros = []
    for i, name in enumerate(array.names):
        states = random.normal(0, (5e-3, 2e-3, 2e-3, 2e-3))
        effects = tuple(
            EffectValue(
                effect=effect.called,
                parameter=size.name,
                value=value * (1 if effect.shared else random.uniform(0.5, 1.5)),
                sd=0.0,
                unit=size.unit,
                expected_sd=size.sd,
                shared=effect.shared,
            )
            for effect in known
            for size, value in zip(effect.sizes, sizes.get(effect.called, sizes.get(effect.name, ())), strict=True)
        )
        gyros.append(
            GyroCalibration(
                name=name,
                source="imu",
                states=states,
                covariance=np.eye(4) * 1e-12,
                noise_rps=1e-4,
                p=array.p[i],
                device="imu",
                effects=effects,
            )
        )
    return gyros, ErrorModel(known)


@pytest.mark.parametrize("array", [triad(), tetrahedron(), dodecahedron()], ids=["3", "4", "6"])
@pytest.mark.parametrize("sizes", [{}, SIZES, {**SIZES, **LAWS}], ids=["states alone", "effects", "laws"])
def test_the_rate_that_made_the_outputs_comes_back(array: SensorArray, sizes: dict[str, tuple[float, ...]]) -> None:
    gyros, model = calibrated(array, sizes)
    found = Compensation.of(gyros, {"imu": array}, model.text())
    t_s = np.arange(0, 60, 0.01)
    w = np.column_stack([0.8 * np.sin(t_s / 3 + phase) for phase in (0, 1, 2)])
    warm, force = 25 + 8 * np.sin(t_s / 20), GRAVITY_MPS2 * np.column_stack([np.sin(t_s), np.cos(t_s), 0 * t_s])
    none = np.empty((len(t_s), 0))
    conditions = Conditions(
        t_s=t_s,
        w_rps=w,
        wdot_rps2=0 * w,
        angle_rad=none,
        rate_rps=none,
        acceleration_rps2=none,
        gimbals=(),
        specific_force_mps2=force,
        temperature_c=warm,
    )
    outputs = np.empty((len(t_s), len(array)))
    for i, gyro in enumerate(gyros):
        k, b, sigma_j, sigma_k = gyro.states
        outputs[:, i] = (1 - k) * w @ (array.p[i] - sigma_k * array.j[i] + sigma_j * array.k[i]) - b
        for effect in model.effects:
            values = [value.value for value in gyro.effects if value.effect == effect.called]
            outputs[:, i] += effect.effect(()).columns(conditions, array, i) @ values
    assert np.abs(compensate(found, outputs, t_s, warm, force) - w).max() < 1e-12
    assert not found.left_out


def test_effects_of_rates_of_change_are_undone_to_what_the_sampling_allows() -> None:
    array = triad()
    t_s = np.arange(0, 100, 0.002)
    w = np.column_stack([0.5 * np.sin(t_s + phase) for phase in (0, 1, 2)])
    wdot = np.column_stack([0.5 * np.cos(t_s + phase) for phase in (0, 1, 2)])
    warm = 25 + 0.02 * t_s
    sizes = {"acceleration_sensitivity": (2e-3, -1e-3), "thermal_gradient": (0.1,)}
    gyros, model = calibrated(array, sizes)
    found = Compensation.of(gyros, {"imu": array}, model.text())
    outputs = w @ found.sensitivity.T - found.bias_rps
    for i, gyro in enumerate(gyros):
        a, b, gradient = (value.value for value in gyro.effects)
        outputs[:, i] += a * wdot @ array.j[i] + b * wdot @ array.k[i] + gradient * 0.02
    error = np.abs(compensate(found, outputs, t_s, warm) - w)
    # What is left: half a period of angular jerk, and exp(-10) of the slope that the smoothing has not come up to.
    assert error[-1000:].max() < 4e-6
    assert np.abs(compensate(Compensation(found.array, found.states), outputs, t_s) - w)[-1000:].max() > 1e-3
    assert smoothed_slope(t_s, warm)[-1] == pytest.approx(0.02, rel=1e-4)


@pytest.mark.parametrize(
    ("law", "size"),
    [
        ("lag(abs(u), 8)", 2e-3),
        ("u*lag(speed, 5)", 2e-3),
        ("play(u, 0.2)", 2e-3),
        ("last(u)", 1e-3),
        ("last(u, 0.05)*speed", 1e-3),
        ("sign(u)*sqrt(abs(u))", 1e-3),
        ("a*abs(u)", 2e-3),
        ("Tdot**2*u", 1.0),
    ],
)
def test_a_law_of_the_past_of_the_rate_or_with_a_jump_is_undone_but_for_its_effect_on_itself(
    law: str, size: float
) -> None:
    """What is left is the effect of the effect: of 1e-3 a few 1e-6."""
    array, t_s = tetrahedron(), np.arange(0, 60, 0.01)
    w = np.column_stack([0.8 * np.cos(t_s / 3 + phase) for phase in (0.1, 1, 2)])
    wdot = np.column_stack([-0.8 / 3 * np.sin(t_s / 3 + phase) for phase in (0.1, 1, 2)])
    warm, none = 25 + 0.05 * t_s, np.empty((len(t_s), 0))
    gyros, model = calibrated(array, {f"constructed {law}": (size,)})
    conditions = Conditions(
        t_s=t_s,
        w_rps=w,
        wdot_rps2=wdot,
        angle_rad=none,
        rate_rps=none,
        acceleration_rps2=none,
        gimbals=(),
        specific_force_mps2=np.full_like(w, np.nan),
        temperature_c=warm,
        causal=True,
    )
    effect = model.effects[0].effect(())
    found = Compensation.of(gyros, {"imu": array}, model.text())
    outputs = w @ found.sensitivity.T - found.bias_rps
    for i, gyro in enumerate(gyros):
        outputs[:, i] += effect.columns(conditions, array, i) @ [value.value for value in gyro.effects]
    error = compensate(found, outputs, t_s, warm) - w
    bare = compensate(Compensation(found.array, found.states), outputs, t_s) - w
    assert np.sqrt(np.mean(error**2)) < 0.02 * np.sqrt(np.mean(bare**2))


def test_what_the_laws_need_is_said() -> None:
    for law, needs in {
        "lag(T, 5)*u": {"temperature", "time"},
        "u*gx": {"specific force"},
        "sqrt(t)": {"time"},
        "a*u": {"time"},
        "u**4": set(),
    }.items():
        gyros, model = calibrated(triad(), {f"constructed {law}": (1e-3,)})
        assert needs_of(Compensation.of(gyros, {"imu": triad()}, model.text())) == needs, law


def test_a_law_of_the_axes_of_a_table_stays_with_that_table() -> None:
    gyros, model = calibrated(triad(), {"constructed last(rate_x)": (1e-3,), "constructed u_y*cos(angle_y)": (1e-3,)})
    found = Compensation.of(gyros, {"imu": triad()}, model.text())
    assert not found.effects
    assert all("axes of the table" in why for why in found.left_out.values())
    assert len(found.left_out) == 2


def test_a_lag_is_undone() -> None:
    array = triad()
    gyros, model = calibrated(array, {"bandwidth": (8e-3,)})
    found = Compensation.of(gyros, {"imu": array}, model.text())
    t_s = np.arange(0, 5, 0.0005)
    w = np.column_stack([np.where(t_s > 1, 0.5, 0.0)] * 3)  # a step: the lag shows at its worst
    lag = [gyro.effects[0].value for gyro in gyros]
    inputs = w @ found.sensitivity.T
    outputs = np.empty_like(inputs)
    for i, tau in enumerate(lag):
        value = 0.0
        for row, wanted in enumerate(inputs[:, i]):
            value += (wanted - value) * 0.0005 / (tau + 0.0005)
            outputs[row, i] = value
    assert np.abs(outputs - inputs).max() > 0.3
    assert np.abs(compensate(found, outputs - found.bias_rps, t_s) - w).max() < 1e-9


def test_the_twins_own_physics_is_undone() -> None:
    """Signs and axes, against a simulation that shares no code with the estimator."""
    array = tetrahedron()
    states = np.array(
        [[4e-3, 2e-3, 1e-3, -2e-3], [-3e-3, 1e-3, 2e-3, 1e-3], [5e-3, 0, 0, 0], [1e-3, -2e-3, 1e-3, 1e-3]]
    )
    tables = {
        "scale_asymmetry": {"size": ["1000 ppm", "-2000 ppm", "1500 ppm", "500 ppm"]},
        "thermal_bias": {"linear": ["0.01 deg/s/degC", "-0.02 deg/s/degC", "0.01 deg/s/degC", "0.005 deg/s/degC"]},
    }
    device = DeviceTruth(array, states, 1e-9, kind="tetrahedron")
    recording = simulate(exploration_script(), {"array": device}, 1, site=SITE, hidden=Hidden.of(tables))
    data, reference = recording.sources["array"], recording.reference
    assert isinstance(reference, TableReadings)
    known = (
        KnownEffect("scale_asymmetry", False, (Size("each direction", "1", 0.0, 1e-3),)),
        KnownEffect("thermal_bias", False, (Size("linear", "rad/s/K", 0.0, 1e-3),)),
    )
    dps = np.radians(1)
    values = [(1e-3, 0.01 * dps), (-2e-3, -0.02 * dps), (1.5e-3, 0.01 * dps), (5e-4, 0.005 * dps)]
    gyros = [
        GyroCalibration(
            name=name,
            source="array",
            states=states[i],
            covariance=np.eye(4),
            noise_rps=1e-9,
            p=array.p[i],
            device="array",
            effects=tuple(
                EffectValue(
                    effect=effect.called,
                    parameter=effect.sizes[0].name,
                    value=value,
                    sd=0.0,
                    unit=effect.sizes[0].unit,
                    expected_sd=1.0,
                    shared=False,
                )
                for effect, value in zip(known, values[i], strict=True)
            ),
        )
        for i, name in enumerate(data.array.names)
    ]
    found = Compensation.of(gyros, {"array": data.array}, ErrorModel(known).text())
    rates = BodyRates(reference.gimbals, recording.site)
    rates.add(reference.t_ns, reference.angle_rad, reference.rate_rps)
    rates.finish()
    inside = (data.t_ns > rates.starts_ns) & (data.t_ns < rates.final_until_ns)
    w = rates.at(data.t_ns[inside])
    temperature = data.temperature_c
    assert temperature is not None
    t_s = (data.t_ns[inside] - data.t_ns[0]) * 1e-9
    error = compensate(found, data.rate_rps[inside], t_s, temperature[inside]) - w
    bare = compensate(Compensation(found.array, found.states), data.rate_rps[inside], t_s) - w
    # The table's readings are those of encoders, and a temperature has steps of 0.01 degC.
    assert np.sqrt(np.mean(error**2)) < 5e-6 < 3e-4 < np.sqrt(np.mean(bare**2))


def test_no_effect_that_a_calibration_can_hold_is_dropped_silently() -> None:
    kept = [entry for entry in everything() if entry.record.kind is Kind.LAW or entry.name == "sample_hold"]
    for entry in kept:
        name = entry.name.removesuffix("_1")  # harmonics have their order in the name
        if name in ("bias_step", "table_harmonic_2", "table_harmonic_4"):  # a step is of one run, never of a model
            continue
        sizes = {name: (1e-3,) * (2 if name == "table_harmonic" else len(entry.parameters))}
        gyros, model = calibrated(triad(), sizes)
        found = Compensation.of(gyros, {"imu": triad()}, model.text())
        assert found.effects or found.delay_s or found.left_out, entry.name
        assert all(found.left_out.values())


def test_a_delay_is_given_apart() -> None:
    gyros, model = calibrated(triad(), {"latency": (4e-3,), "sample_hold": (1e-3,)})
    found = Compensation.of(gyros, {"imu": triad()}, model.text())
    assert found.delay_s == pytest.approx(5e-3)
    assert not found.effects


def test_gyros_in_a_plane_and_samples_without_temperature_are_refused() -> None:
    gyros, model = calibrated(triad(), {"thermal_bias": (1e-4,)})
    found = Compensation.of(gyros, {"imu": triad()}, model.text())
    with pytest.raises(CompensationError, match="needs temperature"):
        compensate(found, np.zeros((2, 3)), np.arange(2.0))
    with pytest.raises(CompensationError, match="do not span"):
        _ = Compensation.of(gyros[:2], {"imu": triad()}, model.text()).solution


def test_a_rate_that_cannot_be_undone_is_no_number() -> None:
    gyros, model = calibrated(triad(), {"scale_cubic": (0.5,)})
    found = Compensation.of(gyros, {"imu": triad()}, model.text())
    rate = compensate(found, np.array([[0.1, 0.1, 0.1], [9.0, 9.0, 9.0]]), np.arange(2.0))
    assert np.isfinite(rate[0]).all()
    assert np.isnan(rate[1]).all()


def test_what_a_simpler_form_holds_is_right_at_the_temperature_of_the_run() -> None:
    array = triad()
    gyros, model = calibrated(
        array, {"thermal_bias": (2e-4,), "thermal_scale": (1e-4,), "thermal_bias_quadratic": (1e-6,)}
    )
    found = Compensation.of(gyros, {"imu": array}, model.text())
    simple, dropped = found.simplified((), 31.0)
    outputs, t_s = np.random.default_rng(1).normal(0, 0.5, (20, 3)), np.arange(20.0)
    exact = compensate(found, outputs, t_s, np.full(20, 31.0))
    assert np.abs(compensate(simple, outputs, t_s) - exact).max() < 1e-12
    assert set(dropped) == {"thermal_bias", "thermal_scale", "thermal_bias_quadratic"}


def test_a_calibration_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    array = tetrahedron()
    device = DeviceTruth(array, np.zeros((4, 4)), 1e-4, kind="tetrahedron")
    hidden = Hidden.of({"scale_asymmetry": {"size": "2000 ppm"}})
    recording = simulate(exploration_script(), {"array": device}, 3, site=SITE, hidden=hidden)
    size = (Size("each direction", "1", 0.0, 3e-3),)
    calibration = calibrate(recording, model=ErrorModel((KnownEffect("scale_asymmetry", False, size),)))
    path = tmp_path / "r.h5"
    write_recording(path, recording)
    with pytest.raises(RecordingError, match="station calibrate --write"):
        read_calibration(path)
    write_calibration(path, calibration)
    found = read_calibration(path)
    assert (found.samples, found.lost, found.notes, found.model) == (
        calibration.samples,
        calibration.lost,
        calibration.notes,
        calibration.model,
    )
    assert found.nis_mean == calibration.nis_mean
    for read, written in zip(found.gyros, calibration.gyros, strict=True):
        assert (read.name, read.source, read.device, read.noise, read.effects) == (
            written.name,
            written.source,
            written.device,
            written.noise,
            written.effects,
        )
        for key in ("states", "covariance", "p"):
            assert np.array_equal(getattr(read, key), getattr(written, key)), key
        assert [line.name for line in read.budget] == [line.name for line in written.budget]
