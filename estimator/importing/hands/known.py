"""Sessions by hand whose poses and turns are stated, section by section (Ferraris)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.errors import RecordingError
from estimator.importing.hands.log import HandLog
from estimator.importing.hands.mapping import PoseMapping
from estimator.importing.mapping.reference import KnownSections, Turn
from estimator.importing.spans import of_sections
from estimator.poses.calibration import PoseCalibration, PoseRest, PoseSession, Triad
from estimator.poses.gross import check_alive, check_unit, faults_at_rest, gross_errors
from estimator.poses.intrinsic import Intrinsic, Lengths
from estimator.poses.known import (
    KnownRest,
    KnownTurn,
    check_poses,
    intrinsic_covariance,
    known_accelerometers,
    known_gyros,
)
from estimator.poses.noise import variance_of_means
from estimator.poses.resting import StillSpan
from estimator.types import Floats


def known_session(
    mapping: PoseMapping, known: KnownSections, logs: Sequence[HandLog], refused: Sequence[str]
) -> PoseSession:
    """Return the calibration from stated poses and turns of all files; ``refused`` are files left out before.

    The result lists these, all rests, also refused ones, and the notes of the files, and has no ``gyro``: its
    ``triads`` are the accelerometers, then the gyros, which are calibrated only if there are turns and a mapping of
    gyros. RecordingError for gross errors, and if no rest can be used.
    """
    rests: list[KnownRest] = []
    turns: list[KnownTurn] = []
    listed: list[PoseRest] = []
    for log in logs:
        check_alive(log.name, log.force)
        own_rests, own_turns, own_listed = _sections(mapping, known, log, len(listed))
        rests += own_rests
        turns += own_turns
        listed += own_listed
    name = ", ".join(log.name for log in logs)
    if not rests:
        raise RecordingError(f"{name} has no usable rest: {'; '.join(rest.refused for rest in listed)}")
    check_unit(name, np.array([rest.mean for rest in rests]), mapping.gravity.value_mps2)
    check_poses(name, rests)
    force = known_accelerometers(rests, mapping.gravity, mapping.accuracy)
    triads = [force]
    if turns and mapping.gyro is not None:
        triads.append(known_gyros(rests, turns, mapping.accuracy))
    accelerometer = _intrinsic(mapping, force, listed)
    errors = gross_errors(accelerometer.intrinsic, accelerometer.shown, mapping.gravity.value_mps2, scale_known=True)
    if errors:
        raise RecordingError(f"{name}: gross error, not a calibration: {'; '.join(errors)}")
    return PoseSession(
        device=mapping.device,
        licence=mapping.licence,
        source=mapping.source,
        mapping=mapping.text,
        files=tuple(log.name for log in logs),
        notes=tuple(note for log in logs for note in log.notes),
        refused_files=tuple(refused),
        accelerometer=accelerometer,
        triads=tuple(triads),
    )


def _sections(
    mapping: PoseMapping, known: KnownSections, log: HandLog, count: int
) -> tuple[list[KnownRest], list[KnownTurn], list[PoseRest]]:
    """Return the rests and turns of a file, and its rests as they are listed, numbered after ``count`` others.

    Turns are left out without gyros. RecordingError for sections that the file does not have, or of fewer than two
    rows.
    """
    assert log.log is not None
    assert log.kept is not None
    assert log.t_s is not None
    limits, left_out = of_sections(mapping.name, known, log.log, lambda name, a, b: (name, a, b))
    if left_out:
        raise RecordingError("; ".join(map(str, left_out)))
    rate = log.rate_rps
    if rate is not None and mapping.gyro is not None:
        rate = rate @ np.linalg.pinv(mapping.gyro.array.p).T
    period_s = float(np.median(np.diff(log.t_s)))
    turns: list[KnownTurn] = []
    spans: list[StillSpan] = []
    names: list[str] = []
    for name, a, b in limits:
        first, stop = np.searchsorted(log.kept, [a, b]).tolist()
        if stop - first < 2:
            raise RecordingError(f"{log.name}, section {name}: it has {stop - first} usable rows, too few")
        stated = known.sections[name]
        length_s = float(log.t_s[stop - 1] - log.t_s[first])
        if not isinstance(stated, Turn):
            names.append(name)
            start_s = float(log.t_s[first])
            spans.append(StillSpan(first=first, stop=stop, start_s=start_s, duration_s=length_s + period_s))
        elif rate is not None:
            turn_rad = stated.angle_rad * np.array(stated.axis)
            summed = np.asarray(np.trapezoid(rate[first:stop], log.t_s[first:stop], axis=0))
            turns.append(KnownTurn(name=name, turn_rad=turn_rad, summed_rad=summed, length_s=length_s))
    rests, listed = _rests(known, log, rate, names, spans, count)
    return rests, turns, listed


def _rests(
    known: KnownSections, log: HandLog, rate: Floats | None, names: Sequence[str], spans: list[StillSpan], count: int
) -> tuple[list[KnownRest], list[PoseRest]]:
    """Return the rests in ``spans`` as observations, and the same as listed in the result.

    ``names`` are those of their sections in ``known``; ``rate`` (rows, 3) is that of the gyros, None without. Rests in
    which an axis is at fault are only listed, as refused and without sigma. Lengths after calibration are not known
    yet: those before stand for them. ``count`` rests were listed before, and numbers go on from there.
    """
    assert log.t_s is not None
    if not spans:
        return [], []
    means = np.array([log.force[span.first : span.stop].mean(axis=0) for span in spans])
    radial = [
        (log.force[span.first : span.stop] - mean) @ (mean / np.linalg.norm(mean))
        for span, mean in zip(spans, means, strict=True)
    ]
    period_s = float(np.median(np.diff(log.t_s)))
    white, wander = variance_of_means(radial, spans, period_s, float(log.t_s[-1] - log.t_s[0]))
    faults = faults_at_rest(log.force, spans)
    rests: list[KnownRest] = []
    listed: list[PoseRest] = []
    for at, (name, span) in enumerate(zip(names, spans, strict=True)):
        length = float(np.linalg.norm(means[at]))
        listed.append(
            PoseRest(
                number=count + at + 1,
                file=log.name,
                start_s=span.start_s,
                duration_s=span.duration_s,
                mean=means[at],
                before_mps2=length,
                after_mps2=length,
                sd_mps2=None if faults[at] else float(np.sqrt(white[at] + wander[at])),
                refused=f"section {name}: {faults[at]}" if faults[at] else "",
            )
        )
        if faults[at]:
            continue
        pose = known.sections[name]
        assert not isinstance(pose, Turn)
        own = None if rate is None else rate[span.first : span.stop]
        rests.append(
            KnownRest(
                name=name,
                up=np.array(pose.up),
                mean=means[at],
                variance=float(white[at] + wander[at]),
                rate_rps=None if own is None else own.mean(axis=0),
                rate_variance=0.0 if own is None else float(own.var(axis=0).max() / len(own)),
            )
        )
    return rests, listed


def _intrinsic(mapping: PoseMapping, force: Triad, listed: Sequence[PoseRest]) -> PoseCalibration:
    """Return the nine intrinsic parameters that follow from twelve states, with the lengths of gravity at the rests.

    The rests in ``listed`` get their lengths after calibration; refused ones do not count for the scatter of lengths.
    The three angles are shown all or none.
    """
    parameters = Intrinsic.of_matrix(force.matrix, force.bias)
    means = np.array([rest.mean for rest in listed])
    after = Lengths.of(parameters, means).length_mps2.tolist()
    rests = [replace(rest, after_mps2=length) for rest, length in zip(listed, after, strict=True)]
    used = [rest for rest in rests if not rest.refused]
    angles = bool(force.shown[6:].all())
    return PoseCalibration(
        intrinsic=parameters,
        covariance=intrinsic_covariance(force),
        shown=np.array([*force.shown[:6].tolist(), angles, angles, angles]),
        factor=force.factor,
        freedom=max(3 * len(used) - 12, 0),
        gravity=mapping.gravity,
        unit="m/s2",
        before_mps2=float(np.std([rest.before_mps2 for rest in used])),
        after_mps2=float(np.std([rest.after_mps2 for rest in used])),
        between_mps2=0.0,
        rests=tuple(rests),
        notes=(),
    )
