"""From a recording to the calibration of its gyros."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.calibration.budget import TYPE_A, Contribution, table_budget
from estimator.calibration.error_model import ErrorModel
from estimator.calibration.values import Calibration, EffectValue, GyroCalibration, GyroParity, unseen_notes
from estimator.errors import RecordingError
from estimator.estimation.gram import gram_of, solve
from estimator.estimation.joint import Modelled, check_model, effect_notes, estimate_device
from estimator.estimation.noise_evidence import TooShort
from estimator.estimation.parity import parity
from estimator.geometry.model import decode, regressor_maps
from estimator.geometry.noise import NoiseFound, NoiseModel
from estimator.observations.blocks import Blocks
from estimator.observations.conditions_seen import holds_for
from estimator.observations.defects.reading_doubts import reading_doubts
from estimator.observations.foreign import at_rest, factor_notes, foreign_motion_notes, sparse_doubts
from estimator.observations.health import Excluded, usable
from estimator.observations.poses import estimate as estimate_poses
from estimator.observations.rests import RestNoise, motion_notes, rest_noise
from estimator.observations.rows import BLOCK_S, row_length_s, sample_noise, source_blocks
from estimator.observations.timing import TimeOffset
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import Poses, RateReadings, TableReadings, Turns
from estimator.types import Floats

_BLOCK_ROWS = 4  # fewer samples do not tell their scatter
_EXCESS = 2.0  # mean square from which on it is told
_CHANCE = 4.0  # standard deviations of the mean NIS
_NEAR = 0.05  # to which the noise is known beside that


@dataclass(frozen=True, slots=True, eq=False)
class _Estimate:
    """Of one source: states x (m, 4), what their covariance is the sum of, noise, effects, noise of one sample (m,).

    ``squares`` of block means about the estimate, over those of white noise, and their number ``dof``; ``blocks``
    without what effects say, for the parity; ``expected_nis``: mean and standard deviation under the noise found.
    """

    x: Floats
    lines: Sequence[tuple[Contribution, ...]]
    noise: Sequence[NoiseFound | None]
    effects: Sequence[tuple[EffectValue, ...]]
    noise_rps: Floats
    samples: int
    squares: float = 0.0
    dof: int = 0
    blocks: Blocks | None = None
    expected_nis: tuple[float, float] = (1.0, 0.0)
    growth_s: float = 0.0
    offset: TimeOffset | None = None


def calibrate(
    recording: Recording,
    *,
    innovations: bool = True,
    model: ErrorModel | None = None,
    excluded: frozenset[str] | None = None,
) -> Calibration:
    """Return the batch estimate of every gyro under its data sheet's prior, the noise taken from the data.

    The noise may be coloured (``estimator.estimation.noise_evidence``). The offset in time of each source
    is estimated too; against another instrument sigmas hold errors that hang together. ``innovations`` also gives the
    mean NIS, else that is NaN. With a ``model`` its effects are estimated with the states, and what the recording does
    not show of them is in the sigmas.
    Without one ``excluded`` names the effects of the catalogue that device and table do not have: what the others could
    do to the states unseen is in the sigmas then; None leaves that out.

    Raises RecordingError if a source has no samples that the reference covers, or no gyro can be estimated; ModelError
    if the recording lacks what the model needs.
    """
    if model is not None:
        check_model(model, recording)
        model = model if model.effects else None
    notes: list[str] = []
    defective: list[Excluded] = []
    sources: list[tuple[str, ImuData]] = []
    for source, data in recording.sources.items():
        found = usable(data, fine=isinstance(recording.reference, TableReadings))
        notes.extend(found.notes)
        defective.extend(found.excluded)
        sources.extend((source, part) for part in found.parts)
    if not sources:
        reasons = "; ".join(f"{e.name}: {e.reason}" for e in defective)
        raise RecordingError(f"{recording.name}: no gyro of it can be estimated: {reasons}")
    notes.extend(f"{e.name} is not estimated: {e.reason}; the others are" for e in defective)
    notes += [*motion_notes(recording), *foreign_motion_notes(recording)]
    gyros: list[GyroCalibration] = []
    estimates: list[_Estimate] = []
    checks: list[GyroParity] = []
    doubts = sparse_doubts(recording)
    offsets: dict[str, TimeOffset] = {}
    for device in dict.fromkeys(data.device for _, data in sources):
        own = [pair for pair in sources if pair[1].device == device]
        own, found_of, said, doubtful = _device(recording, own, model, excluded)
        its_gyros = [g for pair, one in zip(own, found_of, strict=True) for g in _gyros(recording, *pair, one)]
        checks += _parity(own, found_of, its_gyros)
        notes += said
        for gyro in its_gyros:
            prior = next(data.prior for name, data in own if name == gyro.source)
            if not at_rest(recording.reference):  # else the body rests, and that was told
                notes += unseen_notes(gyro.name, _type_a(gyro), prior)
                notes += factor_notes(gyro.name, float(gyro.states[0]), float(gyro.sd[0]))
        gyros += its_gyros
        estimates += found_of
        offsets |= {name: one.offset for (name, _), one in zip(own, found_of, strict=True) if one.offset is not None}
        doubts += doubtful
    squares, dof = sum(one.squares for one in estimates), sum(one.dof for one in estimates)
    nis = squares / dof if dof and innovations else float("nan")
    doubts += _nis_doubts(nis, estimates)
    if isinstance(recording.reference, TableReadings):
        doubts += reading_doubts(recording.reference)
    order = [name for data in recording.sources.values() for name in data.array.names]
    return Calibration(
        tuple(sorted(gyros, key=lambda gyro: order.index(gyro.name))),
        nis,
        sum(one.samples for one in estimates),
        sum(data.lost * len(data.array) for data in recording.sources.values()),
        (*notes, *_parity_notes(checks), *effect_notes(gyros), *doubts),
        tuple(defective),
        tuple(checks),
        model.text() if model is not None else "",
        tuple(doubts),
        holds_for(recording),
        offsets,
    )


def _device(
    recording: Recording,
    sources: list[tuple[str, ImuData]],
    model: ErrorModel | None,
    excluded: frozenset[str] | None,
) -> tuple[list[tuple[str, ImuData]], list[_Estimate], tuple[str, ...], tuple[str, ...]]:
    """Return the sources of one device as they were estimated, the estimates, notes, and doubts about the sigmas."""
    if isinstance(recording.reference, Poses):
        return sources, *_laid(recording.reference, sources)
    if isinstance(recording.reference, Turns) and model is None:
        return sources, [_white(recording, *pair) for pair in sources], (), ()
    try:
        found = estimate_device(recording, sources, model, excluded)
    except TooShort:
        if model is not None:
            raise
        return sources, [_white(recording, *pair) for pair in sources], (), ()
    block_s = max(_block_s(data) for _, data in found.aligned)
    estimates = [
        replace(_joint(recording, data, own, block_s), offset=found.offsets.get(name))
        for (name, data), own in zip(found.aligned, found.sources, strict=True)
    ]
    return list(found.aligned), estimates, found.notes, found.doubts


def _white(recording: Recording, source: str, data: ImuData) -> _Estimate:
    """Return the estimate of a source under white noise: of turns, or of too few samples to tell what it is like."""
    gram, m = gram_of(recording, source, data), len(data.array)
    noise = None
    if isinstance(recording.reference, Turns):  # a few rows: their doubt is stated, not found
        # The rows are weighted by the noise of the worst channel, so that is what the noise is relative to.
        noise = np.maximum(sample_noise(data).max(), solve(gram, data.array, data.prior).noise_rps)
    found = solve(gram, data.array, data.prior, noise)
    kinds: list[NoiseFound | None] = [None] * m
    if noise is None:
        arw = found.noise_rps * np.sqrt(row_length_s(recording, data))
        kinds = [NoiseFound(NoiseModel(one), 0.0, 0.0) for one in arw.tolist()]
    lines = [(Contribution("noise", covariance),) for covariance in found.covariance]
    return _Estimate(found.x, lines, kinds, [()] * m, found.noise_rps, gram.rows * m)


def _laid(poses: Poses, sources: list[tuple[str, ImuData]]) -> tuple[list[_Estimate], tuple[str, ...], tuple[str, ...]]:
    """Return the estimates of sources of which gravity at rests is the reference, notes, and doubts."""
    estimates, notes, doubts = list[_Estimate](), list[str](), list[str]()
    for source, data in sources:
        found, m = estimate_poses(data, poses, data.prior), len(data.array)
        own = [found.covariance[4 * i : 4 * i + 4, 4 * i : 4 * i + 4] for i in range(m)]
        lines = [(Contribution("noise", covariance),) for covariance in own]
        estimates.append(_Estimate(found.x, lines, [None] * m, [()] * m, found.noise_rps, len(data.t_ns) * m))
        notes.append(f"{source}: gravity was carried over {found.turns} turns between {len(poses.up)} rests")
        if found.excess > _EXCESS:
            doubts.append(
                f"{source}: the turns miss gravity by {np.sqrt(found.excess):.1f} times what noise and accelerometer "
                "explain; the sigmas are larger by as much"
            )
    return estimates, tuple(notes), tuple(doubts)


def _joint(recording: Recording, data: ImuData, found: Modelled, block_s: float) -> _Estimate:
    """Return the joint estimate of a source, with the innovations of its means over blocks of so many seconds."""
    m = len(data.array)
    if isinstance(recording.reference, (TableReadings, RateReadings)):
        blocks = source_blocks(recording, data, block_s)
        if at_rest(recording.reference):
            blocks = replace(blocks, w_rps=np.zeros_like(blocks.w_rps))
        if found.said_rps.any():
            since_ns = float(recording.reference.t_ns[0])
            blocks = replace(blocks, z_rps=blocks.z_rps - found.said_at(blocks.t_s + since_ns * 1e-9))
        noise_rps = _sample_noise_of(blocks, data, found.x)
        squares, dof = _block_squares(blocks, data, found.x, noise_rps)
        samples = int(blocks.rows.sum()) * m
    else:
        blocks, full = None, int((found.run.weight > 0).sum())
        length_s = found.run.length_s if found.run.stated_rps else row_length_s(recording, data)
        noise_rps = found.white / np.sqrt(length_s)
        squares = float(np.sum((found.left_rps / found.white) ** 2)) * found.run.length_s
        dof, samples = max((full - 4) * m, 0), round(full * found.run.length_s / length_s) * m
    its = found.x, found.lines, found.noise, found.effects
    return _Estimate(*its, noise_rps, samples, squares, dof, blocks, found.expected_nis, found.run.growth_s)


def _gyros(recording: Recording, source: str, data: ImuData, found: _Estimate) -> list[GyroCalibration]:
    """Return the gyros of a source, the table's own uncertainty and the noise of its rests beside what was found."""
    reference, m = recording.reference, len(data.array)
    table: list[tuple[Contribution, ...]] = [()] * m
    rests: list[RestNoise | None] = [None] * m
    if isinstance(reference, TableReadings):
        arw = np.array([one.mean.arw if one else 0.0 for one in found.noise])
        table = table_budget(reference, recording.site, data.array, data.prior, arw)
    if isinstance(reference, TableReadings) or at_rest(reference):
        rests = [*rest_noise(data, reference)] or rests
    gyros = []
    for i, name in enumerate(data.array.names):
        own = found.lines[i]  # the offset in time, if it was estimated, in place of what the table states of its timing
        kinds = (*own, *(line for line in table[i] if line.name not in {one.name for one in own}))
        states, covariance = decode(found.x[i], np.sum([c.covariance for c in kinds], axis=0))
        gyros.append(
            GyroCalibration(
                name,
                source,
                states,
                covariance,
                float(found.noise_rps[i]),
                data.array.p[i],
                data.device,
                tuple(Contribution(c.name, decode(found.x[i], c.covariance)[1]) for c in kinds),
                found.noise[i],
                rests[i],
                found.effects[i],
            )
        )
    return gyros


def _type_a(gyro: GyroCalibration) -> Floats:
    """Return what the data leave open of a gyro's states (4, 4), whatever may be wrong with the reference."""
    own = [line.covariance for line in gyro.budget if line.name in TYPE_A]
    return np.asarray(np.sum(own, axis=0))


def _parity(
    sources: Sequence[tuple[str, ImuData]], estimates: Sequence[_Estimate], gyros: Sequence[GyroCalibration]
) -> list[GyroParity]:
    """Return the parity check of the gyros of a device, none where there are no blocks to check."""
    blocks = [one.blocks for one in estimates if one.blocks is not None]
    if len(blocks) < len(estimates):
        return []
    noise = [gyro.noise.mean for gyro in gyros if gyro.noise is not None]
    states, growth_s = np.array([gyro.states for gyro in gyros]), max(one.growth_s for one in estimates)
    return parity([data.array for _, data in sources], blocks, states, noise, growth_s)


def _block_s(data: ImuData) -> float:
    """Return the length of blocks: what is usual, or longer so that a slow source has some samples in each."""
    period_s = float(np.median(np.diff(data.t_ns))) * 1e-9 if len(data.t_ns) > 1 else 0.0
    return max(BLOCK_S, _BLOCK_ROWS * period_s)


def _sample_noise_of(blocks: Blocks, data: ImuData, x: Floats) -> Floats:
    """Return the scatter of single samples within blocks (m,), in rad/s, about the states x (m, 4)."""
    array = data.array
    maps = regressor_maps(array)[:, :, 1:]
    rows = max(int(blocks.rows.sum()) - len(blocks.rows), 1)
    slopes = np.einsum("mi,mij->mj", x, maps)
    squares = np.empty(len(array))
    for i, slope in enumerate(slopes):
        weights_of = np.concatenate([-slope, np.eye(len(array))[i]])
        squares[i] = weights_of @ blocks.within @ weights_of
    return np.maximum(np.sqrt(np.maximum(squares / rows, 0.0)), 1e-3 * sample_noise(data))


def _block_squares(blocks: Blocks, data: ImuData, x: Floats, noise_rps: Floats) -> tuple[float, int]:
    """Return the squares of block means about the estimate, over those of white noise, and their number."""
    regressors = np.column_stack([np.ones(len(blocks.index)), blocks.w_rps])
    rest = blocks.z_rps - np.einsum("rj,mij,mi->rm", regressors, regressor_maps(data.array), x)
    squares = float(np.sum(blocks.rows[:, None] * (rest / noise_rps) ** 2))
    return squares, max(rest.size - 4 * len(data.array), 0)


def _nis_doubts(nis: float, estimates: Sequence[_Estimate]) -> list[str]:
    """Return, in words, that a mean NIS is not what the noise found makes it, if it is not."""
    dof = sum(one.dof for one in estimates)
    if not dof or not np.isfinite(nis):
        return []
    mean = sum(one.dof * one.expected_nis[0] for one in estimates) / dof
    sd = np.hypot(
        np.sqrt(sum((one.dof * one.expected_nis[1]) ** 2 for one in estimates)) / dof, np.sqrt(2 / dof) * mean
    )
    if abs(nis - mean) <= _CHANCE * sd + _NEAR * mean:
        return []
    return [
        f"mean NIS {nis:.3g}, where the noise that was found gives {mean:.3g} +- {sd:.2g}: single samples and "
        "means do not tell of the same noise"
    ]


def _parity_notes(checks: list[GyroParity]) -> list[str]:
    suspects = [check for check in checks if check.suspect]
    if not suspects:
        return []
    worst = max(suspects, key=lambda check: check.worst_sigma)
    where = f"{worst.worst_sigma:.0f} sigma at {worst.worst_t_s:.0f} s"
    if worst.told_apart:
        return [f"{worst.name} disagrees with the other gyros of its device (parity {where}): check it"]
    return [f"the gyros {', '.join(c.name for c in suspects)} disagree (parity {where}): one of them is wrong"]
