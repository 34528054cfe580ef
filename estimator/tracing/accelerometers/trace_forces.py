"""Find which effect accelerometers have beside their states, and what it changes on a run that was not used.

Every effect is judged by how much more probable it makes the runs that are fitted, averaged over its size, beside those
that were added before. Functions that nobody has named are rivals of the named effects: where one of them explains the
rest better, there is an effect, but no name.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from estimator.estimation.accelerometers.calibrate_forces import usable_forces
from estimator.estimation.accelerometers.estimate import Settled, settle
from estimator.estimation.accelerometers.force_effects import BY_NAME, EFFECTS, ForceEffect
from estimator.estimation.accelerometers.force_runs import ForceRun, ForceSamples, force_run
from estimator.estimation.accelerometers.laws import rest_angle_law
from estimator.estimation.evidence import SCALES, Term, log_mean
from estimator.estimation.noise_evidence import Joint, TooShort, columns_of, expected_of, joint_estimate, terms_of
from estimator.estimation.spectra import Z
from estimator.recordings.recording import Recording
from estimator.types import Floats

CERTAIN = 0.95
"""Probability from which on an effect is named."""
_EXPECTED = 0.2  # probability, before the data, that accelerometers have any of the effects in a size that shows
_RIVAL = 0.05
_MEAN_S = 2.0  # of the means whose scatter is compared before and after
_MOST = 3


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class FoundEffect:
    """An effect that was added: by accelerometer its parameters (a, p) with standard deviations, and its probability.

    ``rivals`` are other effects that may be it, with their probabilities, the most probable first.
    """

    effect: ForceEffect
    probability: float
    values: Floats
    sd: Floats
    rivals: Mapping[str, float] = field(default_factory=dict)


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class ForceFinding:
    """What accelerometers of one source lack: the effects added, and the error before and after.

    ``names`` are the accelerometers. ``before_mps2`` and ``after_mps2`` (a,) are the rms errors of means over
    ``_MEAN_S`` on the verification runs, noise included, after a constant for each run; on the fitted runs if there are
    none (``verified`` False). ``suspects`` are effects, with their probabilities, of a rest that none explains for
    certain. ``dropped`` are effects that made the fitted runs more probable and the verification runs worse.
    ``left_out`` are by recording the reasons why it was not used; without any that was, there are no ``names``.
    """

    source: str
    names: tuple[str, ...]
    effects: tuple[FoundEffect, ...]
    before_mps2: Floats
    after_mps2: Floats
    verified: bool
    suspects: Mapping[str, float] = field(default_factory=dict)
    dropped: tuple[str, ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class _Fitted:
    """One fitted run with all effects that are looked for beside its laws, and the columns of each effect."""

    settled: Settled
    rich: Joint
    shared: Sequence[Term]
    own: tuple[int, ...]
    columns: Mapping[str, tuple[int, ...]]

    def log_evidence(self, effects: Sequence[str], tried: str = "") -> float:
        """Return the log evidence of the run with some effects, expected at their largest plausible size.

        ``tried`` names one more effect, averaged over all sizes; "" for none.
        """
        own = [Term("own", self._columns(effects), shared=False)]
        if not tried:
            return self.rich.evidence.of([*own, *self.shared])
        logs = [
            self.rich.evidence.of([*own, Term(tried, self.columns[tried], shared=False, scale=scale), *self.shared])
            for scale in SCALES.tolist()
        ]
        return log_mean(np.array(logs))

    def _columns(self, effects: Sequence[str]) -> tuple[int, ...]:
        """Return the columns of the laws of single accelerometers and of some effects."""
        return (*self.own, *(column for name in effects for column in self.columns[name]))


def trace_forces(fitted: Sequence[Recording], judging: Sequence[Recording] = ()) -> list[ForceFinding]:
    """Return what the accelerometers of each source lack, by runs on a table that are fitted and runs that verify.

    A source is looked at if it states a data sheet for its accelerometers and a fitted run has samples that can be
    used; an empty list without such sources. Recordings that are too short are named with the reason in ``left_out``.
    """
    usable = [_usable(recording) for recording in (*fitted, *judging)]
    sources = dict.fromkeys(source for own in usable[: len(fitted)] for source in own)
    found = []
    for source in sources:
        samples = {place: own[source] for place, own in enumerate(usable) if source in own}
        finding = _trace(source, fitted, judging, samples)
        if finding is not None:
            found.append(finding)
    return found


def effect_sigmas(recording: Recording, source: str) -> dict[str, Floats]:
    """Return by name of effect the standard deviations (p,) of its parameters, in its unit, in a recording, each effect
    alone.

    They are rms over the accelerometers of the source; those of effects that need what was not measured are missing.
    Empty if no accelerometer of it can be used; TooShort for too few samples.
    """
    samples = _usable(recording).get(source)
    if samples is None:
        return {}
    run = _fitted(recording, source, samples)
    found: dict[str, Floats] = {}
    for effect in (name for name in run.columns if BY_NAME[name].named):
        _, sd = _parameters([_with_effects(run, [effect])], effect)
        found[effect] = np.asarray(np.sqrt(np.mean(sd**2, axis=0)))
    return found


def _usable(recording: Recording) -> dict[str, ForceSamples]:
    """Return by source the samples of the accelerometers of a recording on a table that can be calibrated."""
    return {source: seen.samples for source, seen in usable_forces(recording) if seen.samples is not None}


def _trace(
    source: str, fitted: Sequence[Recording], judging: Sequence[Recording], samples: Mapping[int, ForceSamples]
) -> ForceFinding | None:
    """Return what the accelerometers of one source lack; None if no fitted run has samples that can be used.

    ``samples`` are by the number of the recording, those that verify after those that are fitted. Only accelerometers
    that can be used in all of them count. At most ``_MOST`` effects are added, the most probable first, while one is
    certain. If something is missing but no effect is certain, the likely ones are ``suspects``. Recordings that are too
    short are left out with the reason. If all fitted ones are, the finding has no accelerometers.
    """
    names = _common_names(list(samples.values()))
    chosen = {place: _only(own, names) for place, own in samples.items()} if names else {}
    runs: list[_Fitted] = []
    left_out: dict[str, str] = {}
    for place, recording in enumerate(fitted):
        if place in chosen:
            try:
                runs.append(_fitted(recording, source, chosen[place]))
            except TooShort as error:
                left_out[recording.name] = str(error)
    if not runs:
        return _not_examined(source, left_out) if left_out else None
    checks: list[ForceRun] = []
    for place, recording in enumerate(judging, len(fitted)):
        if place in chosen:
            try:
                checks.append(_as_the_first(runs, recording, chosen[place]))
            except TooShort as error:
                left_out[recording.name] = str(error)
    added: list[str] = []
    found: dict[str, tuple[float, dict[str, float]]] = {}
    suspects: dict[str, float] = {}
    while len(added) < _MOST:
        chances = _chances(runs, added)
        best = max(chances, key=lambda name: chances[name])
        if 1 - chances[""] < CERTAIN:
            break
        if chances[best] < CERTAIN or not BY_NAME[best].named:
            suspects = {name: chance for name, chance in chances.items() if name and chance > _RIVAL}
            break
        rivals = {name: chance for name, chance in chances.items() if name not in ("", best) and chance > _RIVAL}
        found[best] = (chances[best], rivals)
        added.append(best)
    return replace(_judged(source, runs, checks, added, found, suspects), left_out=left_out)


def _not_examined(source: str, left_out: Mapping[str, str]) -> ForceFinding:
    """Return that no recording could be used."""
    return ForceFinding(
        source=source,
        names=(),
        effects=(),
        before_mps2=np.zeros(0),
        after_mps2=np.zeros(0),
        verified=False,
        left_out=left_out,
    )


def _common_names(samples: Sequence[ForceSamples]) -> list[str]:
    """Return the names of the accelerometers that can be used in all of some samples, in the order of the first."""
    if not samples:
        return []
    return [name for name in samples[0].array.names if all(name in own.array.names for own in samples)]


def _only(samples: ForceSamples, names: Sequence[str]) -> ForceSamples:
    """Return the samples of the accelerometers with these names, in this order."""
    columns = [samples.array.names.index(name) for name in names]
    return replace(samples, array=samples.array.select(columns), output_mps2=samples.output_mps2[:, columns])


def _fitted(recording: Recording, source: str, samples: ForceSamples) -> _Fitted:
    """Return a run with all effects as laws beside its own, those left out that need what was not measured.

    Angles at rest that encoders round are a law, too. TooShort for too few samples.
    """
    sheet, table = recording.sources[source].accel_sheet, recording.table
    assert sheet is not None
    assert table is not None
    settled = settle(recording, source, samples, sheet.noise)
    laws = settled.joint.laws
    own_laws = [law for law in laws if not law.effect.shared]
    shared_laws = [law for law in laws if law.effect.shared]
    rest_angles = rest_angle_law(table)  # rounded angles are errors that depend on the pose, as effects are
    shared_laws += [] if rest_angles is None else [rest_angles]
    tried = [effect for effect in EFFECTS if effect.needs in ("", *settled.run.grid.offers)]
    rich = joint_estimate([settled.run], [*own_laws, *(effect.law() for effect in tried), *shared_laws], sheet.noise)
    width = sum(len(law.sd) for law in own_laws)
    columns: dict[str, tuple[int, ...]] = {}
    first = Z + 1 + width
    for effect in tried:
        columns[effect.name] = tuple(range(first, first + len(effect.parameters)))
        first += len(effect.parameters)
    shared = [term for term in terms_of(rich.laws) if term.shared]
    own = tuple(range(Z + 1, Z + 1 + width))
    return _Fitted(settled=settled, rich=rich, shared=shared, own=own, columns=columns)


def _chances(runs: Sequence[_Fitted], added: Sequence[str]) -> dict[str, float]:
    """Return the probability of each effect that is left, and of "" for none, beside those that were added.

    Only effects that all runs can show are among them.
    """
    left = [name for name in runs[0].columns if name not in added and all(name in run.columns for run in runs)]
    base = sum(run.log_evidence(added) for run in runs)
    logs = {"": np.log(1 - _EXPECTED)}
    for name in left:
        gain = sum(run.log_evidence(added, name) for run in runs) - base
        logs[name] = np.log(_EXPECTED / len(left)) + gain
    most = max(logs.values())
    weights = {name: float(np.exp(log - most)) for name, log in logs.items()}
    total = sum(weights.values())
    return {name: weight / total for name, weight in weights.items()}


def _judged(
    source: str,
    runs: Sequence[_Fitted],
    checks: Sequence[ForceRun],
    added: Sequence[str],
    found: Mapping[str, tuple[float, dict[str, float]]],
    suspects: Mapping[str, float],
) -> ForceFinding:
    """Return the finding, without those effects that make the verification runs worse.

    Effects are dropped, the last added first, until the squared errors are no larger than without any. They are named
    in ``dropped``. ``found`` has by effect its probability and its rivals. Without ``checks`` the fitted runs are
    judged.
    """
    kept = list(added)
    dropped: list[str] = []
    others = [_as_the_first(runs, run.settled.run.recording, run.settled.run.samples) for run in runs[1:] if checks]
    joints = [run.settled.joint for run in runs]
    before = after = _errors(runs, joints, others, checks, kept=())
    if kept:
        joints = [_with_effects(run, kept) for run in runs]
        after = _errors(runs, joints, others, checks, kept)
    while kept and np.sum(after**2) > np.sum(before**2):
        dropped.append(kept.pop())
        joints = [_with_effects(run, kept) for run in runs]
        after = _errors(runs, joints, others, checks, kept)
    effects = []
    for name in kept:
        probability, rivals = found[name]
        values, sd = _parameters(joints, name)
        effects.append(FoundEffect(effect=BY_NAME[name], probability=probability, values=values, sd=sd, rivals=rivals))
    return ForceFinding(
        source=source,
        names=runs[0].settled.run.array.names,
        effects=tuple(effects),
        before_mps2=before,
        after_mps2=after,
        verified=bool(checks),
        suspects=suspects,
        dropped=tuple(dropped),
    )


def _with_effects(run: _Fitted, effects: Sequence[str]) -> Joint:
    """Return the joint estimate of a fitted run with some effects."""
    joint = run.settled.joint
    if not effects:
        return joint
    return _joint(run.settled.run, run, effects)


def _joint(run: ForceRun, about: _Fitted, effects: Sequence[str]) -> Joint:
    """Return the joint estimate of a run with some effects beside the laws of a fitted one."""
    laws = [*about.settled.joint.laws, *(BY_NAME[name].law() for name in effects)]
    sheet = about.settled.run.data.accel_sheet
    return joint_estimate([run], laws, sheet.noise if sheet is not None else None)


def _parameters(joints: Sequence[Joint], name: str) -> tuple[Floats, Floats]:
    """Return the parameters (a, p) of an effect and their standard deviations (a, p), combined over the fitted runs.

    Each run counts by the inverse of the variance. Each of the ``joints`` must have the effect.
    """
    shape = len(joints[0].means), len(BY_NAME[name].parameters)
    weights, sums = np.zeros(shape), np.zeros(shape)
    for joint in joints:
        number = next(n for n, law in enumerate(joint.laws) if law.called == name)
        where = joint.slice_of(number)
        sd = joint.laws[number].sd
        values = np.array([mean[where] for mean in joint.means]) * sd
        precision = 1 / (np.array([np.diag(c)[where] for c in joint.covariances]) * sd**2)
        weights = weights + precision
        sums = sums + precision * values
    return np.asarray(sums / weights), np.asarray(1 / np.sqrt(weights))


def _as_the_first(runs: Sequence[_Fitted], recording: Recording, samples: ForceSamples) -> ForceRun:
    """Return a recording as a run about the lever arm and the delay that the first fitted run found.

    Raises TooShort for too few samples beside readings of the table.
    """
    settled = runs[0].settled
    return force_run(
        recording,
        settled.run.source,
        samples,
        arm_m=settled.arm_m,
        delay_s=settled.delay_s,
        gravity_mps2=settled.gravity_mps2,
    )


def _errors(
    runs: Sequence[_Fitted],
    joints: Sequence[Joint],
    others: Sequence[ForceRun],
    checks: Sequence[ForceRun],
    kept: Sequence[str],
) -> Floats:
    """Return the rms errors (a,) of a model with the effects ``kept``, of which ``joints`` are the fitted runs' own.

    They are those on the verification runs, as all fitted runs together predict them, ``others`` being the fitted runs
    but the first, about what that found. Without verification runs they are those on the fitted runs.
    """
    if checks:
        joint = _together([joints[0], *(_joint(run, runs[0], kept) for run in others)])
        squares = [_squares(joint, run) for run in checks]
    else:
        squares = [_squares(joint, run.settled.run) for joint, run in zip(joints, runs, strict=True)]
    return np.asarray(np.sqrt(np.mean(squares, axis=0)))


def _together(joints: Sequence[Joint]) -> Joint:
    """Return the first of some estimates of the same parameters, its means combined with the others by covariances; its
    own covariances stay.
    """
    if len(joints) == 1:
        return joints[0]
    means = []
    for number in range(len(joints[0].means)):
        precisions = [np.linalg.inv(joint.covariances[number]) for joint in joints]
        weighed = [precision @ joint.means[number] for precision, joint in zip(precisions, joints, strict=True)]
        means.append(np.linalg.solve(np.sum(precisions, axis=0), np.sum(weighed, axis=0)))
    return replace(joints[0], means=means)


def _squares(joint: Joint, run: ForceRun) -> Floats:
    """Return the mean squares (a,) in (m/s2)^2 of what an estimate leaves of a run, in means over ``_MEAN_S``.

    Their mean is subtracted. Blocks without weight, and those at the end that fill no mean, are left out.
    """
    columns = columns_of(run, joint.laws)
    values = [mean[4:] + expected_of(joint.laws) for mean in joint.means]
    states = run.state_columns()
    width = max(round(_MEAN_S / run.length_s), 1)
    good = np.flatnonzero(run.weight > 0)
    found = []
    for number, mean in enumerate(joint.means):
        left = run.z_rps[:, number] - states[number] @ mean[:4] - columns[number] @ values[number]
        count = len(good) // width
        means = left[good[: count * width]].reshape(count, width).mean(axis=1)
        found.append(float(np.mean((means - means.mean()) ** 2)))
    return np.array(found)
