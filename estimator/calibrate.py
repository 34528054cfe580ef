"""From a recording to the calibration of its gyros."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.array import SensorArray
from estimator.blocks import Blocks
from estimator.budget import Contribution, table_budget
from estimator.calibration import Calibration, EffectValue, GyroCalibration, unseen_notes
from estimator.coloured import (
    FEWEST_BLOCKS,
    GridFit,
    NoiseFound,
    NoiseGrid,
    Part,
    coarse,
    combine,
    fit_grids,
    weights,
)
from estimator.error_model import ErrorModel
from estimator.errors import RecordingError
from estimator.foreign import against_foreign, at_rest, factor_notes, foreign_motion_notes
from estimator.health import Excluded, usable
from estimator.model import decode, regressor_maps
from estimator.modelled import against_reference, check_model, effect_notes, estimate_device
from estimator.parity import GyroParity, parity
from estimator.recording import ImuData, Recording
from estimator.reference import RateReadings, TableReadings
from estimator.rests import RestNoise, motion_notes, rest_noise
from estimator.rows import BLOCK_S, enough, source_blocks

Floats = NDArray[np.float64]

_BLOCK_ROWS = 4  # fewer samples do not tell their scatter


@dataclass(frozen=True, slots=True, eq=False)
class _Estimate:
    """Of one source: states x (m, 4), what their covariance is the sum of, noise, effects, blocks without these."""

    x: Floats
    kinds: list[tuple[Contribution, ...]]
    noise: list[NoiseFound]
    effects: list[tuple[EffectValue, ...]]
    blocks: Blocks


def calibrate(recording: Recording, *, innovations: bool = True, model: ErrorModel | None = None) -> Calibration:
    """Return the batch estimate of every gyro under its data sheet's prior, the noise taken from the data.

    Against a table, or at rest, the noise may be coloured (``estimator.coloured``); against other foreign references
    sigmas come from clusters of residuals. ``innovations`` also gives the mean NIS, else that is NaN. With a ``model``
    its effects are estimated with the states, and what the recording does not show of them is in the sigmas.

    Raises RecordingError if a source has no samples that the reference covers, or no gyro can be estimated; ModelError
    if the recording lacks what the model needs.
    """
    if model is not None:
        check_model(model, recording)
        model = model if model.effects else None
    notes: list[str] = []
    excluded: list[Excluded] = []
    sources: list[tuple[str, ImuData]] = []
    for source, data in recording.sources.items():
        found = usable(data, fine=isinstance(recording.reference, TableReadings))
        notes.extend(found.notes)
        excluded.extend(found.excluded)
        sources.extend((source, part) for part in found.parts)
    if not sources:
        reasons = "; ".join(f"{e.name}: {e.reason}" for e in excluded)
        raise RecordingError(f"{recording.name}: no gyro of it can be estimated: {reasons}")
    notes.extend(f"{e.name} is not estimated: {e.reason}; the others are" for e in excluded)
    if isinstance(recording.reference, TableReadings) or at_rest(recording.reference):
        result = _against_table(recording, recording.reference, sources, innovations, model)
    elif model is not None:
        result = against_reference(model, recording, sources, innovations)
    else:
        result = against_foreign(recording, sources, innovations)
    order = [name for data in recording.sources.values() for name in data.array.names]
    return Calibration(
        tuple(sorted(result.gyros, key=lambda gyro: order.index(gyro.name))),
        result.nis_mean,
        result.samples,
        sum(data.lost * len(data.array) for data in recording.sources.values()),
        (*notes, *result.notes),
        tuple(excluded),
        result.parity,
        result.model,
    )


def _against_table(
    recording: Recording,
    reference: TableReadings | RateReadings,
    sources: list[tuple[str, ImuData]],
    innovations: bool,
    model: ErrorModel | None,
) -> Calibration:
    blocks = [source_blocks(recording, data, _block_s(data)) for _, data in sources]
    for (source, data), own in zip(sources, blocks, strict=True):
        enough(recording, source, data, int(own.rows.sum()))
    if isinstance(reference, RateReadings):  # at rest: Earth rate is taken off, too slow to tell k from other effects
        blocks = [replace(own, w_rps=np.zeros_like(own.w_rps)) for own in blocks]
    notes = [*motion_notes(recording), *foreign_motion_notes(recording)]
    span_s = max(float(b.t_s[-1] - b.t_s[0]) + b.length_s for b in blocks)
    gyros: list[GyroCalibration] = []
    checks: list[GyroParity] = []
    squares, dof = 0.0, 0
    for device in dict.fromkeys(data.device for _, data in sources):
        members = [n for n, (_, data) in enumerate(sources) if data.device == device]
        its_blocks, its_sources = [blocks[n] for n in members], [sources[n] for n in members]
        if model is None:
            estimates = _estimates(its_blocks, [data for _, data in its_sources], span_s)
        else:
            estimates = _with_effects(model, recording, reference, its_sources, its_blocks)
        for n, found in zip(members, estimates, strict=True):
            source, data = sources[n]
            x, noise = found.x, found.noise
            sample = _sample_noise_of(blocks[n], data.array, x)
            arw = np.array([one.mean.arw for one in noise])
            table: list[tuple[Contribution, ...]] = [()] * len(data.array)  # a body at rest has no errors of a table
            if isinstance(reference, TableReadings):
                table = table_budget(reference, recording.site, data.array, data.prior, arw)
            rests: list[RestNoise | None] = [*rest_noise(data, reference)] or [None] * len(data.array)
            for i, name in enumerate(data.array.names):
                kinds = (*found.kinds[i], *table[i])
                type_a = np.sum([c.covariance for c in found.kinds[i]], axis=0)
                states, covariance = decode(x[i], np.sum([c.covariance for c in kinds], axis=0))
                gyros.append(
                    GyroCalibration(
                        name,
                        source,
                        states,
                        covariance,
                        noise_rps=sample[i],
                        p=data.array.p[i],
                        device=device,
                        budget=tuple(Contribution(c.name, decode(x[i], c.covariance)[1]) for c in kinds),
                        noise=noise[i],
                        rest=rests[i],
                        effects=found.effects[i],
                    )
                )
                if isinstance(reference, TableReadings):  # else the body rests, and that was told
                    notes.extend(unseen_notes(name, type_a, data.prior))
                    notes.extend(factor_notes(name, float(states[0]), float(np.sqrt(covariance[0, 0]))))
            if innovations:
                chi, count = _block_squares(found.blocks, data.array, x, sample)
                squares, dof = squares + chi, dof + count
        own_gyros = gyros[len(gyros) - sum(len(sources[n][1].array) for n in members) :]
        checks += parity(
            [sources[n][1].array for n in members],
            [coarse(found.blocks) for found in estimates],
            np.array([g.states for g in own_gyros]),
            [g.noise.mean for g in own_gyros if g.noise],
        )
    samples = sum(int(b.rows.sum()) * b.z_rps.shape[1] for b in blocks)
    nis = squares / dof if dof else float("nan")
    notes += [*_parity_notes(checks), *effect_notes(gyros)]
    text = model.text() if model is not None else ""
    return Calibration(tuple(gyros), nis, samples, 0, tuple(notes), (), tuple(checks), text)


def _estimates(blocks: list[Blocks], data: list[ImuData], span_s: float) -> list[_Estimate]:
    """Return the estimates of the sources of one device."""
    fits = _device_fits([coarse(own) for own in blocks], data, span_s)
    found = []
    for own, fit, weight in zip(blocks, fits, weights(fits), strict=True):
        x, covariances, noise = combine(fit, weight)
        kinds = [(Contribution("noise", covariance),) for covariance in covariances]
        found.append(_Estimate(x, [*kinds], noise, [()] * len(x), own))
    return found


def _with_effects(
    model: ErrorModel,
    recording: Recording,
    reference: TableReadings | RateReadings,
    sources: Sequence[tuple[str, ImuData]],
    blocks: Sequence[Blocks],
) -> list[_Estimate]:
    """Return the same under an error model; blocks are rid of what its effects say."""
    found = []
    for own, one in zip(blocks, estimate_device(model, recording, sources), strict=True):
        cleaned = replace(own, z_rps=own.z_rps - one.said_at(own.t_s + float(reference.t_ns[0]) * 1e-9))
        found.append(_Estimate(one.x, [one.budget(i) for i in range(len(one.x))], one.noise, one.effects, cleaned))
    return found


def _block_s(data: ImuData) -> float:
    """Return the length of blocks: what is usual, or longer so that a slow source has some samples in each."""
    period_s = float(np.median(np.diff(data.t_ns))) * 1e-9 if len(data.t_ns) > 1 else 0.0
    return max(BLOCK_S, _BLOCK_ROWS * period_s)


def _device_fits(merged: list[Blocks], data: list[ImuData], span_s: float) -> list[GridFit]:
    parts = [Part(b, d.array, d.prior) for b, d in zip(merged, data, strict=True)]
    long_enough = min(len(b.index) for b in merged) >= FEWEST_BLOCKS
    grid = NoiseGrid.over(span_s, data[0].noise) if long_enough else NoiseGrid.white()
    return fit_grids(parts, grid)


def _sample_noise_of(blocks: Blocks, array: SensorArray, x: Floats) -> Floats:
    """Return the scatter of single samples within blocks (m,), in rad/s, about the states x (m, 4)."""
    maps = regressor_maps(array)[:, :, 1:]
    rows = max(int(blocks.rows.sum()) - len(blocks.rows), 1)
    slopes = np.einsum("mi,mij->mj", x, maps)
    squares = np.empty(len(array))
    for i, slope in enumerate(slopes):
        weights_of = np.concatenate([-slope, np.eye(len(array))[i]])
        squares[i] = weights_of @ blocks.within @ weights_of
    return np.sqrt(np.maximum(squares / rows, 1e-30))


def _block_squares(blocks: Blocks, array: SensorArray, x: Floats, noise_rps: Floats) -> tuple[float, int]:
    """Return the squares of block means about the estimate, over those of white noise, and their number."""
    regressors = np.column_stack([np.ones(len(blocks.index)), blocks.w_rps])
    rest = blocks.z_rps - np.einsum("rj,mij,mi->rm", regressors, regressor_maps(array), x)
    squares = float(np.sum(blocks.rows[:, None] * (rest / noise_rps) ** 2))
    return squares, max(rest.size - 4 * len(array), 0)


def _parity_notes(checks: list[GyroParity]) -> list[str]:
    suspects = [check for check in checks if check.suspect]
    if not suspects:
        return []
    worst = max(suspects, key=lambda check: check.worst_sigma)
    where = f"{worst.worst_sigma:.0f} sigma at {worst.worst_t_s:.0f} s"
    if worst.told_apart:
        return [f"{worst.name} disagrees with the other gyros of its device (parity {where}): check it"]
    return [f"the gyros {', '.join(c.name for c in suspects)} disagree (parity {where}): one of them is wrong"]
