"""The states of the accelerometers of a source, their lever arm and their delay, from a run on a table.

All are estimated jointly, under noise that is found from the data (``estimator.estimation.noise_evidence``). The force
depends on the lever arm and the states on the force: the estimate is repeated with the arm and the delay found, until
neither changes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.calibration.accelerometer import AccelerometerCalibration, ForceCalibration, ForceEffectValues
from estimator.calibration.budget import Contribution
from estimator.calibration.error_model import KnownForceEffect
from estimator.effects.conditions import Conditions
from estimator.estimation.accelerometers.force_effects import BY_NAME, laws_of_model
from estimator.estimation.accelerometers.force_runs import ForceRun, ForceSamples, force_run
from estimator.estimation.accelerometers.laws import (
    APART,
    ARM,
    DELAY,
    GRAVITY,
    LEVEL,
    ORTHOGONALITY,
    RESOLUTION,
    laws_beside,
    rest_angle_law,
)
from estimator.estimation.accelerometers.output_steps import coarse_steps
from estimator.estimation.accelerometers.resolution import with_rest_angles
from estimator.estimation.noise_evidence import Joint, Law, joint_estimate
from estimator.geometry.kinematics import gravity_at
from estimator.geometry.model import decode, decoding
from estimator.geometry.noise import NoiseModel
from estimator.observations.timing import TimeOffset, expected_sd_s
from estimator.packaged import sentence
from estimator.recordings.recording import Recording
from estimator.types import Floats

_MOST_STEPS = 8
_SETTLED = 0.01  # of a standard deviation
_SETTLED_ARM_M, _SETTLED_DELAY_S = 1e-7, 1e-8
_FEWEST_STEPS = 100
_LINES = (LEVEL, ORTHOGONALITY, GRAVITY, RESOLUTION)


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Settled:
    """The joint estimate at the end, and the arm (3,), delay and gravity that were subtracted before it."""

    joint: Joint
    run: ForceRun
    arm_m: Floats
    delay_s: float
    gravity_mps2: float


def estimate_forces(
    recording: Recording,
    source: str,
    samples: ForceSamples,
    noise: NoiseModel | None = None,
    effects: Sequence[KnownForceEffect] = (),
) -> ForceCalibration:
    """Return the calibration of the accelerometers of a source on a table; ``noise`` is that of their data sheet, None
    if it states none.

    The ``effects`` of a model are estimated with the states, and so are the angles of axes that stand, if the encoders
    round them. ``arm_m`` is the mean of their places; ``excluded`` stays empty. Doubts are outputs in steps that their
    noise does not average. Raises TooShort for too few samples beside readings of the table, ModelError for an effect
    that cannot be estimated.
    """
    settled, rest_angle_share = _with_rest_angles(settle(recording, source, samples, noise, effects))
    joint = settled.joint
    laws = {law.called: number for number, law in enumerate(joint.laws)}
    delay, delay_variance = _parameters(joint, laws[DELAY], 0)
    device = recording.sources[source].device
    found = []
    for number, name in enumerate(samples.array.names):
        states, covariance = decode(joint.means[number][:4], joint.covariances[number][:4, :4])
        place, place_covariance = _place(joint, laws, number)
        found.append(
            AccelerometerCalibration(
                name=name,
                source=source,
                device=device,
                p=samples.array.p[number],
                j=samples.array.j[number],
                k_axis=samples.array.k[number],
                states=states,
                covariance=covariance,
                noise_mps2=_sample_noise(settled, samples, number),
                place_m=settled.arm_m + place,
                place_covariance_m2=place_covariance,
                budget=_budget(joint, number),
                noise=joint.noise[number],
            )
        )
    return ForceCalibration(
        source=source,
        device=device,
        accelerometers=tuple(found),
        covariance=_covariance(joint),
        arm_m=np.mean([one.place_m for one in found], axis=0),
        arm_covariance_m2=_middle_covariance(joint, laws),
        gravity_mps2=settled.gravity_mps2,
        doubts=tuple(
            sentence("estimation.accelerometer_steps", name=one.name, step=one.step_mps2, size=one.sd_mps2)
            for one in coarse_steps(settled.run)
        ),
        gravity_from=gravity_at(recording.site).source,
        offset=TimeOffset(settled.delay_s + float(delay[0]), float(np.sqrt(delay_variance[0, 0]))),
        effects=tuple(_effect_values(settled, laws[known.name], known.name) for known in effects),
        rest_angle_share=rest_angle_share,
    )


def _effect_values(settled: Settled, law: int, name: str) -> ForceEffectValues:
    """Return the parameters of an effect of the model for each accelerometer, and their standard deviations, in its
    unit, and about which conditions the states hold.

    ``law`` is the number of its law in the joint estimate.
    """
    joint = settled.joint
    found = [_parameters(joint, law, number) for number in range(len(joint.means))]
    return ForceEffectValues(
        name=name,
        unit=BY_NAME[name].unit,
        parameters=BY_NAME[name].parameters,
        values=np.array([values for values, _ in found]),
        sd=np.array([np.sqrt(np.diag(covariance)) for _, covariance in found]),
        about=BY_NAME[name].about(settled.run.grid),
    )


def settle(
    recording: Recording,
    source: str,
    samples: ForceSamples,
    noise: NoiseModel | None,
    effects: Sequence[KnownForceEffect] = (),
) -> Settled:
    """Return the joint estimate of the accelerometers of a source about the lever arm and the delay that it finds.

    The arm and the delay are subtracted and estimated again until neither changes, at most ``_MOST_STEPS`` times; the
    last estimate counts even if they still change. With ``effects`` the states are those at the mean temperature and in
    the middle of the run. Raises TooShort for too few samples beside readings of the table, ModelError for an effect
    that the run cannot show.
    """
    gravity_mps2 = gravity_at(recording.site).value_mps2
    arm_m = np.zeros(3)
    delay_s = 0.0
    for step in range(_MOST_STEPS):
        run = force_run(recording, source, samples, arm_m=arm_m, delay_s=delay_s, gravity_mps2=gravity_mps2)
        if effects:
            run = replace(run, grid=_about_its_mean(run.grid))
        laws_of_run = [*_laws(run, samples, arm_m, delay_s), *laws_of_model(effects, run.grid.offers)]
        joint = joint_estimate([run], laws_of_run, noise)
        laws = {law.called: number for number, law in enumerate(joint.laws)}
        arm_step, arm_covariance = _parameters(joint, laws[ARM], 0)
        delay_step, delay_variance = _parameters(joint, laws[DELAY], 0)
        arm_moves = np.abs(arm_step) > _SETTLED * np.sqrt(np.diag(arm_covariance)) + _SETTLED_ARM_M
        delay_moves = abs(delay_step[0]) > _SETTLED * np.sqrt(delay_variance[0, 0]) + _SETTLED_DELAY_S
        if step == _MOST_STEPS - 1 or not (arm_moves.any() or delay_moves):
            break
        arm_m = arm_m + arm_step
        delay_s += float(delay_step[0])
    return Settled(joint=joint, run=run, arm_m=arm_m, delay_s=delay_s, gravity_mps2=gravity_mps2)


def _about_its_mean(grid: Conditions) -> Conditions:
    """Return conditions whose thermal effects are zero at their mean temperature, if that was measured."""
    if grid.temperature_c is None:
        return grid
    return replace(grid, reference_c=float(np.nanmean(grid.temperature_c)))


def _with_rest_angles(settled: Settled) -> tuple[Settled, float]:
    """Return the estimate with the angles at rest and the size of their errors (0 to 1, see ``with_rest_angles``).

    Return ``settled`` itself and 0 if the encoders do not round them.
    """
    table = settled.run.recording.table
    law = rest_angle_law(table) if table is not None else None
    if law is None:
        return settled, 0.0
    joint, share = with_rest_angles(settled.joint, law)
    return replace(settled, joint=joint), share


def _laws(run: ForceRun, samples: ForceSamples, arm_m: Floats, delay_s: float) -> list[Law]:
    """Return all laws beside the states, about the lever arm (3,) and the delay that were subtracted.

    What is expected of the delay follows from the table's stated timing and the round trips of its readings.
    """
    recording = run.recording
    table = recording.table
    assert table is not None
    timing_s = table.uncertainty.timing_s if table.uncertainty is not None else 0.0
    return laws_beside(
        samples.prior,
        table.gimbals,
        table.uncertainty,
        gravity_at(recording.site),
        delay_sd_s=expected_sd_s(timing_s, table.half_width_ns),
        arm_m=arm_m,
        delay_s=delay_s,
    )


def _parameters(joint: Joint, law: int, accelerometer: int) -> tuple[Floats, Floats]:
    """Return the parameters (p,) of a law as an accelerometer has them, and their covariance (p, p)."""
    where = joint.slice_of(law)
    sd = joint.laws[law].sd
    values = joint.means[accelerometer][where] * sd + joint.laws[law].mean
    covariance = joint.covariances[accelerometer][where, where] * np.outer(sd, sd)
    return values, covariance


def _place(joint: Joint, laws: dict[str, int], accelerometer: int) -> tuple[Floats, Floats]:
    """Return where an accelerometer sits relative to the subtracted arm (3,), and the covariance (3, 3)."""
    weights = _place_weights(joint, laws)
    mean = _parameters(joint, laws[ARM], accelerometer)[0] + _parameters(joint, laws[APART], accelerometer)[0]
    return mean, np.asarray(weights @ joint.covariances[accelerometer] @ weights.T)


def _place_weights(joint: Joint, laws: dict[str, int]) -> Floats:
    """Return the weights (3, c) of the parameters of an accelerometer in where it sits: common arm plus own part."""
    weights = np.zeros((3, len(joint.means[0])))
    for law in (laws[ARM], laws[APART]):
        weights[:, joint.slice_of(law)] += np.diag(joint.laws[law].sd)
    return weights


def _middle_covariance(joint: Joint, laws: dict[str, int]) -> Floats:
    """Return the covariance (3, 3) of the mean place of all accelerometers."""
    weights = _place_weights(joint, laws)
    count = len(joint.means)
    pairs = [(i, j) for i in range(count) for j in range(count)]
    return np.asarray(sum(weights @ _across(joint, i, j) @ weights.T for i, j in pairs) / count**2)


def _across(joint: Joint, first: int, second: int) -> Floats:
    """Return the covariance (c, c) between the parameters [states, laws] of two accelerometers, not decoded; that of
    one for equal numbers.

    Two accelerometers have in common what the shared laws leave open, and nothing else.
    """
    own = joint.covariances[first]
    if first == second:
        return own
    shared = [number for number, law in enumerate(joint.laws) if law.effect.shared]
    places = np.concatenate([np.arange(len(own))[joint.slice_of(number)] for number in shared])
    other = joint.covariances[second]
    return np.asarray(own[:, places] @ np.linalg.solve(own[np.ix_(places, places)], other[places]))


def _budget(joint: Joint, accelerometer: int) -> tuple[Contribution, ...]:
    """Return the contributions to the covariance of the states: noise, errors of the table, rounded angles.

    The errors of the table count one after the other, each with what those before it leave; those without a law have no
    line. Laws that have no line count as noise. Covariances are those of the decoded states.
    """
    covariance = joint.covariances[accelerometer]
    lines: list[Contribution] = []
    known: list[int] = []
    before = np.zeros((4, 4))
    for line in _LINES:
        own = [number for number, law in enumerate(joint.laws) if law.line == line]
        if not own:
            continue
        known += own
        through = joint.through(covariance, known)
        lines.append(Contribution(line, through - before))
        before = through
    lines.insert(0, Contribution("noise", covariance[:4, :4] - before))
    x = joint.means[accelerometer][:4]
    return tuple(Contribution(line.name, decode(x, line.covariance)[1]) for line in lines)


def _covariance(joint: Joint) -> Floats:
    """Return the covariance (4 a, 4 a) of the decoded states of all accelerometers, four for each in turn."""
    count = len(joint.means)
    rows = [[_across(joint, i, j)[:4, :4] for j in range(count)] for i in range(count)]
    jacobian = np.zeros((4 * count, 4 * count))
    for number, mean in enumerate(joint.means):
        own = slice(4 * number, 4 * number + 4)
        jacobian[own, own] = decoding(mean[:4])
    return np.asarray(jacobian @ np.block(rows) @ jacobian.T)


def _sample_noise(settled: Settled, samples: ForceSamples, accelerometer: int) -> float:
    """Return the noise of one sample in m/s2, from differences of neighbours at rest.

    With fewer than ``_FEWEST_STEPS`` of these it is taken from the white noise of the estimate. While the table turns,
    its own errors are in the outputs.
    """
    output, t_ns = samples.output_mps2[:, accelerometer], samples.t_ns
    table = settled.run.recording.table
    steps = []
    for first_ns, last_ns in table.rests_ns if table is not None else []:
        own = output[(t_ns >= first_ns) & (t_ns <= last_ns)]
        steps.append(np.diff(own[np.isfinite(own)]))
    found = np.concatenate([np.empty(0), *steps])
    if len(found) >= _FEWEST_STEPS:
        return float(np.sqrt(np.mean(found**2) / 2))
    period_s = float(np.median(np.diff(t_ns))) * 1e-9
    return float(settled.joint.white[accelerometer] / np.sqrt(period_s))
