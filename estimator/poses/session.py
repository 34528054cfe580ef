"""One session by hand: rests are found, judged and fitted, and the result says what it does not know."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.errors import RecordingError
from estimator.geometry.kinematics import Gravity
from estimator.poses.calibration import PoseCalibration, PoseRest
from estimator.poses.gross import check_alive, check_responding, check_unit, faults_at_rest, gross_errors
from estimator.poses.intrinsic import NAMES, Intrinsic, Lengths
from estimator.poses.noise import variance_of_means
from estimator.poses.norm_fit import PARAMETERS, Doubtful, NormFit, Rests, fit_robustly, start_of
from estimator.poses.resting import StillSpan, find_rests
from estimator.types import Flags, Floats

_FEWEST = 3  # rests; fewer show not even the scale of each axis
_MEANS_SD = 1e-3  # assumed of given means, in g, until residuals show their noise
_ROUNDED = 12**-0.5  # standard deviation of a rounded value, in steps


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class PoseSamples:
    """Outputs (n, 3) of accelerometers about x, y, z at instants (n,), in m/s2, or in counts unless ``scale_known``.

    ``name`` is that of the file. ``t_s`` is None if each row is the mean of one rest.
    """

    name: str
    t_s: Floats | None
    outputs: Floats
    scale_known: bool = True


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class _Means:
    """Means (n, 3) of rests, covariances (n, 3, 3), variances by what does not average out, and faults (n,).

    ``spans`` are None for given means.
    """

    outputs: Floats
    covariance: Floats
    wander: Floats
    files: Sequence[str]
    spans: Sequence[StillSpan | None]
    faults: Sequence[str]

    def __len__(self) -> int:
        return len(self.files)


def calibrate_poses(sessions: Sequence[PoseSamples], gravity: Gravity, least_s: float) -> PoseCalibration:
    """Return the nine parameters of one device from the rests of all its files, each of at least ``least_s``.

    Rests that disagree with the others, or in which an axis is at fault, are refused and listed with the reason. If the
    unit of any file is not known, all outputs count as counts, and their unit is not checked. Parameters that the poses
    do not show are marked in ``shown``, not left out. RecordingError, naming the file, for gross errors, files without
    rests, and poses that are fewer than ``_FEWEST`` or show nothing.
    """
    for samples in sessions:
        check_alive(samples.name, samples.outputs)
    means = _joined([_means_of(samples, least_s) for samples in sessions])
    name = ", ".join(samples.name for samples in sessions)
    scale_known = all(samples.scale_known for samples in sessions)
    good = np.array([not fault for fault in means.faults])
    if good.sum() < _FEWEST:
        wrong = "; ".join(sorted({fault for fault in means.faults if fault}))
        raise RecordingError(
            f"{name} has {good.sum()} usable rests: lay the body in at least {PARAMETERS} poses in general "
            f"position{': ' if wrong else ''}{wrong}"
        )
    rests = Rests(
        outputs=means.outputs[good],
        covariance=means.covariance[good],
        wander=means.wander[good],
        gravity_mps2=gravity.value_mps2,
        noise_known=any(span is not None for span in means.spans),
    )
    if scale_known:
        check_unit(name, rests.outputs, gravity.value_mps2)
    start = start_of(rests, scale_known=scale_known)
    check_responding(name, rests.outputs, start.scale * gravity.value_mps2)
    fit, doubtful = fit_robustly(rests, start)
    if not fit.shown.any():
        raise RecordingError(
            f"{name}: at least {PARAMETERS} poses in general position are needed; these {len(rests)} show "
            "neither scale nor bias nor angles"
        )
    errors = gross_errors(fit.parameters, fit.shown, gravity.value_mps2, scale_known=scale_known)
    if errors:
        raise RecordingError(f"{name}: gross error, not a calibration: {'; '.join(errors)}")
    unit = "m/s2" if scale_known else "counts"
    return _result(unit, gravity, means, good, start, fit, doubtful)


def _joined(parts: Sequence[_Means]) -> _Means:
    """Return the rests of all files, one after the other."""
    return _Means(
        outputs=np.vstack([part.outputs for part in parts]),
        covariance=np.concatenate([part.covariance for part in parts]),
        wander=np.concatenate([part.wander for part in parts]),
        files=[file for part in parts for file in part.files],
        spans=[span for part in parts for span in part.spans],
        faults=[fault for part in parts for fault in part.faults],
    )


def _means_of(samples: PoseSamples, least_s: float) -> _Means:
    """Return the means of the rests of a file, each of ``least_s`` or more, with their variances and faults.

    A file without times holds means already, one for each row. RecordingError if nothing rests.
    """
    outputs = samples.outputs
    if samples.t_s is None:
        return _given_means(samples.name, outputs)
    try:
        spans = find_rests(samples.t_s, outputs, least_s)
    except RecordingError as error:
        raise RecordingError(f"{samples.name}: {error}") from None
    means = np.array([outputs[span.first : span.stop].mean(axis=0) for span in spans])
    radial = [
        (outputs[span.first : span.stop] - mean) @ _direction(mean)
        for span, mean in zip(spans, _centred(means, scale_known=samples.scale_known), strict=True)
    ]
    period_s = float(np.median(np.diff(samples.t_s)))
    session_s = float(samples.t_s[-1] - samples.t_s[0])
    variance, wander = variance_of_means(radial, spans, period_s, session_s)
    variance = variance + _rounding(outputs, radial) ** 2
    return _Means(
        outputs=means,
        covariance=variance[:, None, None] * np.eye(3),
        wander=wander,
        files=[samples.name] * len(spans),
        spans=spans,
        faults=faults_at_rest(outputs, spans),
    )


def _given_means(name: str, outputs: Floats) -> _Means:
    """Return rests of which only the means (n, 3) are known, with an assumed noise of 1 mg and without times.

    A rest with a blank has that as its fault.
    """
    whole: Flags = np.asarray(np.isfinite(outputs).all(axis=1))
    size = np.median(np.linalg.norm(outputs[whole], axis=1)) if whole.any() else 1.0
    return _Means(
        outputs=outputs,
        covariance=np.tile((_MEANS_SD * size) ** 2 * np.eye(3), (len(outputs), 1, 1)),
        wander=np.zeros(len(outputs)),
        files=[name] * len(outputs),
        spans=[None] * len(outputs),
        faults=["" if good else "a value is missing" for good in whole.tolist()],
    )


def _centred(means: Floats, *, scale_known: bool) -> Floats:
    """Return means (n, 3) of which the zero is known at least roughly: raw counts are taken from their middle."""
    return means if scale_known else means - 0.5 * (means.min(axis=0) + means.max(axis=0))


def _direction(mean: Floats) -> Floats:
    return np.asarray(mean / max(float(np.linalg.norm(mean)), np.finfo(float).tiny))


def _rounding(outputs: Floats, radial: Sequence[Floats]) -> float:
    """Return the standard deviation by which steps that noise does not smooth displace a mean, in the output's unit."""
    steps = np.abs(np.diff(outputs, axis=0))
    step = float(np.min(steps, where=steps > 0, initial=np.inf))
    noise = float(np.median([own.std() for own in radial]))
    return step * _ROUNDED if np.isfinite(step) and noise < step * _ROUNDED else 0.0


def _result(
    unit: str,
    gravity: Gravity,
    means: _Means,
    good: Flags,
    start: Intrinsic,
    fit: NormFit,
    doubtful: Sequence[Doubtful],
) -> PoseCalibration:
    """Return the result with every rest and the notes.

    ``good`` (n,) are the rests without a fault of an axis, of which those in ``doubtful`` are refused. ``start`` are
    the parameters before the fit; ``unit`` is that of the outputs.
    """
    numbers = np.flatnonzero(good)
    reasons = list(means.faults)
    for rest in doubtful:
        reasons[int(numbers[rest.rest])] = (
            f"its force is {abs(rest.off_mps2):.3g} m/s2 {'more' if rest.off_mps2 > 0 else 'less'} than gravity by the "
            f"others ({rest.sigmas:.3g} sigma): bumped, moving, or pushed"
        )
    used = np.array([not reason for reason in reasons])
    before = Lengths.of(start, means.outputs).length_mps2
    after = Lengths.of(fit.parameters, means.outputs).length_mps2
    sds = np.full(len(means), np.nan)
    sds[used] = fit.sd_mps2
    rests = [
        PoseRest(
            number=at + 1,
            file=means.files[at],
            start_s=span.start_s if span else None,
            duration_s=span.duration_s if span else None,
            mean=means.outputs[at],
            before_mps2=float(before[at]),
            after_mps2=float(after[at]),
            sd_mps2=float(sds[at]) if used[at] else None,
            refused=reasons[at],
        )
        for at, span in enumerate(means.spans)
    ]
    scale = np.concatenate([fit.parameters.scale, np.zeros(6)])
    result = PoseCalibration(
        intrinsic=fit.parameters,
        covariance=fit.covariance + gravity.sd**2 * np.outer(scale, scale),
        shown=fit.shown,
        factor=fit.factor,
        freedom=fit.freedom,
        gravity=gravity,
        unit=unit,
        before_mps2=float(np.std(before[used])),
        after_mps2=float(np.std(fit.residual_mps2)),
        between_mps2=fit.between_mps2,
        rests=tuple(rests),
        notes=(),
    )
    return replace(result, notes=tuple(_notes(result)))


def _notes(result: PoseCalibration) -> list[str]:
    """Return sentences on what the result does not show and what it rests on.

    They say whether poses are too few for all parameters, or for a test of the model, and whether many rests were
    refused; the handedness of the axes is always named.
    """
    notes = []
    count = len(result.used)
    timed = result.rests[0].start_s is not None
    if not result.shown.all():
        notes.append(
            f"at least {PARAMETERS} poses in general position are needed; these {count} show {_shown_words(result)}"
        )
    elif result.freedom == 0:
        notes.append(
            f"{count} rests for {PARAMETERS} parameters leave nothing to test the model by: the sigmas rest on "
            f"{'the noise within the rests' if timed else 'an assumed noise of 1 mg'}. Record 12 to 18 poses"
        )
    elif result.freedom < PARAMETERS // 3:
        notes.append(f"{count} rests test the model hardly, so the intervals are wide. Record 12 to 18 poses")
    if 4 * len(result.refused) >= len(result.rests):
        notes.append("a quarter of the rests or more disagree with the others: do not use the result without a look")
    notes.append("order and handedness of the axes are not shown by the length of gravity alone")
    return notes


def _shown_words(result: PoseCalibration) -> str:
    """Return which parameters are shown and which are not, by kind where a kind is complete."""
    kinds = {"scale": NAMES[:3], "bias": NAMES[3:6], "angles": NAMES[6:]}
    shown: list[str] = []
    hidden: list[str] = []
    flags = dict(zip(NAMES, result.shown.tolist(), strict=True))
    for kind, names in kinds.items():
        seen = [name for name in names if flags[name]]
        if len(seen) == len(names):
            shown.append(kind)
        elif not seen:
            hidden.append(kind)
        else:
            shown += seen
            hidden += [name for name in names if not flags[name]]
    return f"{_listed(shown, 'and')} but no {_listed(hidden, 'and')}"


def _listed(words: Sequence[str], last: str) -> str:
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} {last} {words[-1]}"
