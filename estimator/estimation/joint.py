"""The gyros of one device against its reference: states, effects of an error model, time offset of each source.

All are estimated jointly (``estimator.estimation.noise_evidence``). What an effect could do that the motion does not
show stays as wide as it typically is, and the sigmas of the states hold it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from estimator.calibration.budget import UNMEASURED, UNSEEN, Contribution, merged
from estimator.calibration.error_model import ErrorModel, KnownEffect, ModelError
from estimator.calibration.gyro import EffectValue, GyroCalibration
from estimator.calibration.values import UndeclaredEffect
from estimator.effects.catalogue import records
from estimator.effects.constructed import readable
from estimator.effects.dynamics import LATENCY
from estimator.effects.effect import Acts
from estimator.effects.site import EARTH_RATE
from estimator.estimation.constancy import changes, halves
from estimator.estimation.noise_evidence import Joint, Law, TooShort, bias_notes, expected_of, joint_estimate
from estimator.estimation.runs.build import run_of
from estimator.estimation.runs.run import FEWEST_TURNS, Run, growth_notes
from estimator.estimation.source_estimate import DeviceEstimate, SourceEstimate, Sources
from estimator.estimation.spectra import Z
from estimator.estimation.undeclared import Undeclared, effects_by_state, moved_by, of_rates, undeclared
from estimator.geometry.model import regressor_maps
from estimator.geometry.noise import NoiseModel
from estimator.observations.alignment import body_turned, delay_by_motion
from estimator.observations.blocks import Blocks, block_squares
from estimator.observations.external import CLUSTER_S, COLOURED, FEWEST_CLUSTERS
from estimator.observations.rows import BLOCK_S, coarser, row_length_s, sample_noise, source_blocks
from estimator.observations.timing import TimeOffset, expected_sd_s
from estimator.packaged import sentence
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import RateReadings, TableReadings
from estimator.types import Floats

EFFECTS = "effects"
"""Line of the budget that holds what the data do not show of the effects of an error model."""
_DELAY = "delay of the reference"
_TIMING = "timing"
_SETTLED_S = 2e-4
_LARGEST_STEP_S = 0.05  # beyond, a motion is no straight line any more
_MOST_STEPS = 12
_KNOWN = 0.2  # sigma of k below which the sign of an output is known
_TOLD = 3.0  # sigmas from which on a delay is reported
_UNSEEN = 0.7  # of a parameter's expected sigma: a larger one means that the run did not show it
_REDUNDANT = 4  # gyros whose blocks can be compared with each other
_BLOCK_ROWS = 4  # fewer samples give no scatter


def check_model(model: ErrorModel, recording: Recording) -> None:
    """Check that the reference of a recording can show effects at all, for a model that has some.

    Raises ModelError for poses, and for turns with an effect that acts within turns or fewer than ``FEWEST_TURNS``
    turns. For all other references it does nothing.
    """
    if recording.reference.poses is not None:
        raise ModelError(f"{recording.name}: effects cannot be estimated from gravity between rests. Leave out --model")
    turns = recording.turns
    if turns is None:
        return
    within = [known.called for known in model.effects if known.record.within_turns]
    if within:
        raise ModelError(sentence("estimation.within_turns", recording=recording.name, effects=", ".join(within)))
    if len(turns.sd_rad) < FEWEST_TURNS:
        raise ModelError(
            f"{recording.name}: {len(turns.sd_rad)} turns are too few to estimate effects in addition "
            f"to the states; at least {FEWEST_TURNS} are needed. Leave out --model"
        )


def is_external(recording: Recording) -> bool:
    """Return whether the reference is another moving instrument, whose stamps and errors are unknown."""
    own = recording.table is not None and "bench" in recording.attributes
    return not own and not recording.reference.at_rest and recording.turns is None


def estimate_device(
    recording: Recording, sources: Sources, model: ErrorModel | None, excluded: frozenset[str] | None
) -> DeviceEstimate:
    """Return the estimate of the sources of one device under coloured noise.

    ``model`` holds effects that are estimated with the states. ``excluded`` are effects of the catalogue that device
    and table do not have; the others then widen the sigmas. None, or a model, leaves this out. The time offset between
    the reference and each source is estimated with the states, except at rest, for turns, and with a model that holds a
    delay. For the reference of another instrument the covariances allow for errors correlated over 5 s, and ``doubts``
    say if the halves of the recording disagree; for all others ``spoilt`` says what changed in mid-run. ``notes`` are
    on what is unsettled, correlated, late, or grows, and on biases that differ between files.

    Raises ModelError for a model that needs what the recording lacks, TooShort for too little data.
    """
    external = is_external(recording)
    moved, delays_s, laws, plain, unsettled = _aligned(recording, sources, model)
    stated = sources[0][1].noise
    joint = plain
    covariances, notes = _clustered(plain) if external else (plain.covariances, [])
    left_s = _delays(plain, covariances)
    notes += unsettled
    notes += growth_notes(plain.runs)
    further: Sequence[Sequence[Contribution]] | None = None
    by_state: tuple[UndeclaredEffect, ...] = ()
    if excluded is not None and model is None:
        made = [_run(recording, number, *pair) for number, pair in enumerate(moved)]
        found = undeclared(made, excluded | {law.effect.record.name for law in laws})
        kept = [law for law in found.laws if not (_by_another(made) and of_rates(law.effect))]
        if kept:
            joint = joint_estimate(found.runs, [*laws, *kept], stated)
            covariances = _clustered(joint)[0] if external else joint.covariances
        whole = joint if len(kept) == len(found.laws) else joint_estimate(found.runs, [*laws, *found.laws], stated)
        further = _further(joint, whole, found)
        by_state = effects_by_state(whole, covariances if whole is joint else whole.covariances)
    if recording.several_files:
        weight = joint.weight.mean(axis=1)
        notes += bias_notes(recording, weight, joint.evidence.shapes.turn_on, float(joint.arw.mean()))
    offsets = {name: TimeOffset(delays_s[name] + left, sd_s) for name, (left, sd_s) in left_s.items()}
    notes += _offset_notes(recording, offsets, external)
    block_s = max(_block_s(data) for _, data in moved)
    estimates = []
    for number, (name, data) in enumerate(moved):
        doubt = covariances, further
        estimates.append(_estimated(recording, joint, number, data, doubt, block_s, offsets.get(name)))
    if external:
        return DeviceEstimate(estimates, notes, halves(joint, CLUSTER_S), undeclared=by_state)
    return DeviceEstimate(estimates, notes, spoilt=changes(_beside_earth(joint, stated)), undeclared=by_state)


def _by_another(runs: Sequence[Run]) -> bool:
    """Return whether another instrument measures how the body turns.

    The residual may then hold errors of that instrument, which follow the rate as well, so that it does not decide on
    effects of the gyros that do so.
    """
    return any(run.by_another for run in runs)


def _further(joint: Joint, whole: Joint, undeclared: Undeclared) -> list[tuple[Contribution, ...]]:
    """Return for each gyro the budget lines of undeclared effects that widen its uncertainty and leave its states.

    ``joint`` is the estimate to be widened. ``whole`` also fits the undeclared laws that only widen; it is the same
    object if there are none, and the line ``UNSEEN`` is then left out. Laws in ``undeclared`` that are merely assumed
    add the line ``UNMEASURED``. Without either a gyro has no lines.
    """
    lines: list[tuple[Contribution, ...]] = [()] * len(joint.means)
    if whole is not joint:
        wider = [n for n, law in enumerate(whole.laws) if law.line == UNSEEN and of_rates(law.effect)]
        lines = [(Contribution(UNSEEN, whole.through(covariance, wider)),) for covariance in whole.covariances]
    if undeclared.assumed:
        moved = moved_by(joint, undeclared)
        lines = [(*own, Contribution(UNMEASURED, more)) for own, more in zip(lines, moved, strict=True)]
    return lines


def _beside_earth(joint: Joint, stated: NoiseModel | None) -> Joint:
    """Return the estimate with Earth rate fitted too, for a table whose site is not stated; else ``joint`` itself."""
    grid = joint.runs[0].grid
    if grid.site is not None or not grid.gimbals or any(law.effect.record is EARTH_RATE for law in joint.laws):
        return joint
    earth = undeclared(joint.runs, frozenset(record.name for record in records()) - {EARTH_RATE.name})
    return joint_estimate(earth.runs, [*joint.laws, *earth.laws], stated) if earth.laws else joint


def _aligned(
    recording: Recording, sources: Sources, model: ErrorModel | None
) -> tuple[Sources, dict[str, float], list[Law], Joint, list[str]]:
    """Return (sources with stamps moved to the reference's, seconds moved by source, laws, estimate, notes).

    Gauss-Newton iteration from the offset at which the motions of both match best: each offset found is subtracted from
    the stamps and estimated again until it changes no more, at most by 50 ms a step. A note names each source that has
    not settled after ``_MOST_STEPS``. At rest, for turns and with a model that holds a delay nothing is moved, and no
    delay is added to the laws.
    """
    # A model with a delay estimates it itself.
    timed = not recording.reference.at_rest and recording.turns is None
    timed &= model is None or all(known.record.acts is not Acts.STAMPS for known in model.effects)
    begun_s = {name: _delay_by_motion(recording, data) if timed else 0.0 for name, data in sources}
    delays_s = dict(begun_s)
    moved = _shifted(sources, delays_s)
    for step in range(_MOST_STEPS):
        runs = [_run(recording, number, *pair) for number, pair in enumerate(moved)]
        laws = _model_laws(model, recording, runs)
        if timed:
            laws += [_delay_law(recording, name, delay_s - begun_s[name]) for name, delay_s in delays_s.items()]
        joint = joint_estimate(runs, laws, sources[0][1].noise)
        steps_s = {}
        for name, (step_s, sd_s) in _delays(joint, joint.covariances).items():
            gyros = joint.gyros_of([run.source for run in joint.runs].index(name))
            # An output that is opposite to the reference has its delay the other way round, too.
            gains = [1 - joint.means[g][0] for g in gyros if joint.covariances[g][0, 0] < _KNOWN**2]
            step_s *= float(np.sign(np.median(gains or [1.0])))
            if abs(step_s) >= max(_SETTLED_S, 0.01 * sd_s):
                steps_s[name] = float(np.clip(step_s, -_LARGEST_STEP_S, _LARGEST_STEP_S))
        if not steps_s or step == _MOST_STEPS - 1:
            notes = [
                sentence("estimation.delay_unsettled", source=name, step_ms=1e3 * step_s, steps=_MOST_STEPS)
                for name, step_s in steps_s.items()
            ]
            break
        delays_s = {name: delay_s + steps_s.get(name, 0.0) for name, delay_s in delays_s.items()}
        moved = _shifted(sources, delays_s)
    return moved, delays_s, laws, joint, notes


def _delay_by_motion(recording: Recording, data: ImuData) -> float:
    """Return the delay in s at which the search begins, 0 for a table's own readings."""
    if not recording.reference.by_turns:
        return 0.0
    return delay_by_motion(data, recording.reference, recording.site)


def _shifted(sources: Sources, delays_s: Mapping[str, float]) -> Sources:
    """Return sources with their stamps earlier by ``delays_s``."""
    return [(name, replace(data, t_ns=data.t_ns - round(delays_s[name] * 1e9))) for name, data in sources]


def effect_notes(gyros: Sequence[GyroCalibration]) -> list[str]:
    """Return, in sentences, which effects of the model the recording did not show, by the gyros concerned.

    An effect is not shown if a parameter's sigma is hardly below the expected one. Shared effects are never named.
    """
    unseen: dict[str, list[str]] = {}
    for gyro in gyros:
        for name in dict.fromkeys(value.effect for value in gyro.effects if not value.shared):
            if any(v.sd > _UNSEEN * v.expected_sd for v in gyro.effects if v.effect == name):
                unseen.setdefault(name, []).append(gyro.name)
    by_gyros: dict[tuple[str, ...], list[str]] = {}
    for name, who in unseen.items():
        by_gyros.setdefault(tuple(who), []).append(readable(name))
    return [
        sentence("estimation.effects_unseen", gyros=", ".join(who), effects=", ".join(names))
        for who, names in by_gyros.items()
    ]


def _run(recording: Recording, number: int, source: str, data: ImuData) -> Run:
    """Return a source as a run, its gyros prefixed with its number; at rest with body rate 0. TooShort: too few
    blocks.
    """
    # Two sources may have gyros of the same names.
    named = replace(data, array=replace(data.array, names=tuple(f"{number} {name}" for name in data.array.names)))
    run = run_of(recording, source, named)
    if run is None:
        raise TooShort(sentence("estimation.short_for_effects", recording=recording.name, source=source))
    if recording.reference.at_rest:  # Earth rate is too slow to distinguish k from other effects
        return replace(run, w_rps=np.zeros_like(run.w_rps))
    return run


def _model_laws(model: ErrorModel | None, recording: Recording, runs: Sequence[Run]) -> list[Law]:
    """Return the effects of a model as laws for what all runs offer, none without a model; ModelError if runs
    lack it.
    """
    if model is None:
        return []
    try:
        made = model.made(runs[0].grid.gimbals, frozenset.intersection(*(run.grid.offers for run in runs)))
    except ModelError as error:
        raise ModelError(f"{recording.name}: {error}") from None
    return [
        Law(called=known.called, effect=effect, mean=known.mean, sd=known.sd, line=EFFECTS, hz=_hz(known))
        for known, effect in zip(model.effects, made, strict=True)
    ]


def _hz(known: KnownEffect) -> float | None:
    return float(known.settings["frequency_hz"]) if "frequency_hz" in known.settings else None


def _delay_law(recording: Recording, source: str, taken_off_s: float) -> Law:
    """Return the law of a source's time offset, of which ``taken_off_s`` was subtracted; its mean is ``-taken_off_s``.

    Its sigma is that of the table's stated timing and of its readings' instants, else the usual one. It has a line of
    the budget only if the table states an uncertainty.
    """
    table = recording.table
    sd_s = expected_sd_s()
    line = ""
    if table is not None:
        stated = table.uncertainty
        sd_s = expected_sd_s(stated.timing_s if stated else 0.0, table.half_width_ns)
        line = _TIMING if stated else ""
    return Law(
        called=_DELAY,
        effect=LATENCY.effect(),
        mean=np.array([-taken_off_s]),
        sd=np.array([sd_s]),
        line=line,
        source=source,
    )


def _delays(joint: Joint, covariances: Sequence[Floats]) -> dict[str, tuple[float, float]]:
    """Return by source the delay that is left in s and its standard deviation; all gyros of a source have the same.

    ``covariances`` are by gyro those of [states, laws]. Sources without a law of the delay are left out.
    """
    found = {}
    for number, law in enumerate(joint.laws):
        if law.called == _DELAY:
            at = joint.slice_of(number).start
            value = float(np.mean([mean[at] for mean in joint.means])) * law.sd[0] + law.mean[0]
            sd = float(np.mean([np.sqrt(c[at, at]) for c in covariances]) * law.sd[0])
            found[law.source] = (float(value), sd)
    return found


def _offset_notes(recording: Recording, offsets: dict[str, TimeOffset], external: bool) -> list[str]:
    """Return sentences on the time offsets beyond chance and, of a table, beyond its stated timing, and on who is late.

    A table without a stated uncertainty gets none. ``external``: the reference is another instrument. ``offsets`` are
    by source. A sentence that is the same for several sources comes once.
    """
    stated = recording.table.uncertainty if recording.table is not None else None
    notes = []
    for source, found in offsets.items():
        sure = np.hypot(found.sd_s, stated.timing_s if stated else 0.0)
        if abs(found.offset_s) < _TOLD * sure or not (external or stated):
            continue
        later = "gyros" if found.offset_s > 0 else "reference" if external else "table's readings"
        notes.append(
            f"{'reference' if external else 'table'} and {'gyros' if external else source} are "
            f"{1e3 * abs(found.offset_s):.1f} +- {max(1e3 * found.sd_s, 0.1):.1f} ms apart, the {later} late by "
            "their stamps: the states are those without this delay"
        )
    return list(dict.fromkeys(notes))


def _estimated(
    recording: Recording,
    joint: Joint,
    number: int,
    data: ImuData,
    doubt: tuple[Sequence[Floats], Sequence[Sequence[Contribution]] | None],
    block_s: float,
    offset: TimeOffset | None,
) -> SourceEstimate:
    """Return the estimate of source ``number`` out of the joint estimate.

    ``doubt`` holds by gyro the covariances, and further lines of the budget or None. For table and rate references,
    unless the reference is too coarse for few gyros, the result has blocks of ``block_s`` for the parity check, less
    what the effects explain. Its noise and scatter come from single samples if the reference is fine enough for that,
    else from the run's block means.
    """
    run, gyros, m = joint.runs[number], joint.gyros_of(number), len(data.array)
    covariances, further = doubt
    lines = [merged((*_lines(joint, covariances[g]), *(further[g] if further else ()))) for g in gyros]
    columns, expected = joint.columns[number], expected_of(joint.laws)
    x, own = np.array([joint.means[g][:4] for g in gyros]), np.array([joint.means[g][4:] for g in gyros])
    values = own + expected
    blocks, begin_s = None, 0.0
    coarse = run.turns and coarser(recording.reference, data)
    if isinstance(recording.reference, (TableReadings, RateReadings)) and not (coarse and m < _REDUNDANT):
        blocks = source_blocks(recording, data, block_s)
        begin_s = float(recording.reference.t_ns[0]) * 1e-9
        if recording.reference.at_rest:
            blocks = replace(blocks, w_rps=np.zeros_like(blocks.w_rps))
        said_rps = np.einsum("mbp,mp->mb", columns, values)
        if said_rps.any():
            at_s = blocks.t_s + begin_s
            said = np.column_stack([np.interp(at_s, run.t_s, one) for one in said_rps])
            blocks = replace(blocks, z_rps=blocks.z_rps - said)
    if blocks is not None and not coarse:
        noise_rps = _sample_noise_of(blocks, data, x)
        file = recording.file_of(blocks.t_s + begin_s)
        squares, dof = block_squares(blocks, data.array, x, noise_rps, file)
        samples = int(blocks.rows.sum()) * m
    else:
        full = int((run.weight > 0).sum())
        white = joint.white[gyros.start : gyros.stop]
        length_s = run.length_s if run.stated_rps else row_length_s(recording, data)
        noise_rps = white / np.sqrt(length_s)
        explained = np.einsum("mbi,mi->bm", run.state_columns(), x) + np.einsum("mbp,mp->bm", columns, own)
        left_rps = (run.z_rps - explained) * run.weight[:, None]
        squares = float(np.sum((left_rps / white) ** 2)) * run.length_s
        dof = max((full - 4) * m, 0)
        body = body_turned(recording.reference, recording.site)
        if body is None:
            samples = round(full * run.length_s / length_s) * m
        else:
            samples = int(body.known(np.asarray(data.t_ns * 1e-9, dtype=np.float64)).sum()) * m
    effects = [_values(joint, v, covariances[g]) for g, v in zip(gyros, values, strict=True)]
    return SourceEstimate(
        source=run.source,
        data=data,
        x=x,
        lines=lines,
        noise=[joint.noise[g] for g in gyros],
        effects=effects,
        noise_rps=noise_rps,
        samples=samples,
        squares=squares,
        dof=dof,
        blocks=blocks,
        expected_nis=joint.expected_nis,
        growth_s=run.growth_s,
        offset=offset,
    )


def _block_s(data: ImuData) -> float:
    """Return the length of blocks: the usual one, or longer so that a slow source has some samples in each."""
    period_s = float(np.median(np.diff(data.t_ns))) * 1e-9 if len(data.t_ns) > 1 else 0.0
    return max(BLOCK_S, _BLOCK_ROWS * period_s)


def _sample_noise_of(blocks: Blocks, data: ImuData, x: Floats) -> Floats:
    """Return the scatter of single samples within blocks (m,), in rad/s, about the states x (m, 4).

    It is at least a thousandth of ``sample_noise``.
    """
    array = data.array
    maps = regressor_maps(array)[:, :, 1:]
    rows = max(int(blocks.rows.sum()) - len(blocks.rows), 1)
    slopes = np.einsum("mi,mij->mj", x, maps)
    squares = np.empty(len(array))
    for i, slope in enumerate(slopes):
        weights_of = np.concatenate([-slope, np.eye(len(array))[i]])
        squares[i] = weights_of @ blocks.within @ weights_of
    return np.maximum(np.sqrt(np.maximum(squares / rows, 0.0)), 1e-3 * sample_noise(data))


def _lines(joint: Joint, covariance: Floats) -> tuple[Contribution, ...]:
    """Return the contributions to the covariance (4, 4) of the states: noise first, then each line that the laws name.

    A line contributes what would vanish if its laws were known; each in turn, so that nothing counts twice. Laws
    without a line count as noise.
    """
    known: list[int] = []
    known_before, lines = np.zeros((4, 4)), []
    for name in dict.fromkeys(law.line for law in joint.laws if law.line):
        # One line after the other: what two laws can only determine together, each would claim all.
        known += [n for n, law in enumerate(joint.laws) if law.line == name]
        through = joint.through(covariance, known)
        lines.append(Contribution(name, through - known_before))
        known_before = through
    left = covariance[:4, :4] - known_before
    return Contribution("noise", left), *lines


def _values(joint: Joint, shares: Floats, covariance: Floats) -> tuple[EffectValue, ...]:
    """Return the parameters of the model's effects as estimated on a gyro, in their own units.

    ``shares`` are the parameters in units of their expected sigma, ``covariance`` that of [states, laws]. Laws that are
    not of the model (``EFFECTS``) are left out.
    """
    doubts = np.sqrt(np.diag(covariance)[4:])
    edges = np.cumsum([0, *(len(law.sd) for law in joint.laws)]).tolist()
    return tuple(
        EffectValue(
            effect=law.called,
            parameter=p.name,
            value=float(v * sd),
            sd=float(d * sd),
            unit=p.unit,
            expected_sd=float(sd),
            shared=law.effect.shared,
        )
        for law, (a, b) in zip(joint.laws, pairwise(edges), strict=True)
        if law.line == EFFECTS
        for p, v, d, sd in zip(law.effect.parameters, shares[a:b], doubts[a:b], law.sd, strict=True)
    )


def _clustered(joint: Joint) -> tuple[list[Floats], list[str]]:
    """Return the covariances by gyro for residuals correlated within clusters (Liang, Zeger 1986), and notes.

    No direction gets less than its covariance under coloured noise. With fewer clusters than ``FEWEST_CLUSTERS`` the
    covariances stay as they are, which a note says. Another note gives the increase of the sigmas if it is large.
    """
    runs, n, whole = joint.runs, len(joint.means), len(joint.means[0])
    own = 4 + sum(len(law.sd) for law in joint.laws if not law.effect.shared)
    begin = min(float(run.t_s[0]) for run in runs)
    clusters = [((run.t_s - begin) / CLUSTER_S).astype(np.intp) for run in runs]
    used = np.unique(np.concatenate([c[run.weight > 0] for run, c in zip(runs, clusters, strict=True)]))
    who = ", ".join(dict.fromkeys(run.source for run in runs))
    if len(used) < FEWEST_CLUSTERS:
        return joint.covariances, [
            f"{who}: too short to estimate the correlation of the residual; sigmas assume white noise"
        ]
    places = [np.r_[g * own : (g + 1) * own, n * own : n * own + whole - own] for g in range(n)]
    precision = np.ones(n * own + whole - own)
    information = np.zeros((len(precision),) * 2)
    scores = np.zeros((np.concatenate(clusters).max() + 1, len(precision)))
    for g, place in enumerate(places):
        t_s, rows = joint.whitened(g)
        both = np.delete(rows, Z, axis=1)
        information[np.ix_(place, place)] += both.T @ both
        cluster = ((t_s - begin) / CLUSTER_S).astype(np.intp)
        first = np.flatnonzero(np.diff(cluster, prepend=-1))
        rest = both * (rows[:, Z] - both @ joint.means[g])[:, None]
        scores[cluster[first][:, None], place] += np.add.reduceat(rest, first, axis=0)
        precision[place[:4]] = 1 / joint.evidence.gyros[g].prior
    white = np.linalg.inv(information + np.diag(precision))
    # A few clusters fit the parameters of a gyro, as far as the data determine these: the scores are too small by that.
    fitted = float(np.trace(white @ information)) / n
    meat = scores.T @ scores * (len(used) / max(len(used) - fitted, len(used) / 4)) + np.diag(precision)
    sandwich, out, notes, grown = white @ meat @ white, list[Floats](), list[str](), list[Floats]()
    for number, run in enumerate(runs):
        for g, states in zip(joint.gyros_of(number), run.state_columns(), strict=True):
            out.append(_larger(joint.covariances[g], sandwich[np.ix_(places[g], places[g])]))
            seen = states * (run.weight * np.sqrt(run.length_s) / joint.arw[g])[:, None]
            of_white = np.linalg.inv(seen.T @ seen + np.diag(1 / run.prior.variances()))
            grown.append((np.diag(out[-1])[:4] / np.diag(of_white))[[0, 2, 3]])  # a bias always wanders
    if np.mean(grown) > COLOURED**2:
        worst = float(np.sqrt(np.max(grown)))
        notes.append(f"{who}: the residual is not white; sigmas were increased up to {worst:.1f} times")
    return out, notes


def _larger(covariance: Floats, other: Floats) -> Floats:
    """Return the covariance (c, c) that has in each direction the larger of two variances."""
    root = np.linalg.cholesky(covariance)
    half = np.linalg.solve(root, other)
    ratio, directions = np.linalg.eigh(np.linalg.solve(root, half.T))
    basis = root @ directions
    return np.asarray(basis @ np.diag(np.maximum(ratio, 1.0)) @ basis.T)
