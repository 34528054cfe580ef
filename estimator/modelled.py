"""States and effects estimated together, under an error model and coloured noise.

The machinery is that of tracing: block means in the cosine domain, all noise models at once. What an effect could do
that the motion does not show stays as wide as it typically is, and the sigmas of the states hold it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.budget import Contribution
from estimator.calibration import Calibration, EffectValue, GyroCalibration, unseen_notes
from estimator.coloured import NoiseFound, quantile
from estimator.effects.constructed import readable
from estimator.effects.effect import Effect
from estimator.error_model import ErrorModel, KnownEffect, ModelError
from estimator.errors import RecordingError
from estimator.foreign import CLUSTER_S, COLOURED, FEWEST_CLUSTERS, at_rest, factor_notes, foreign_motion_notes
from estimator.model import decode
from estimator.noise import NoiseModel
from estimator.recording import ImuData, Recording
from estimator.reference import Turns
from estimator.rows import row_length_s
from estimator.tracing.evidence import Evidence, Posterior, Term
from estimator.tracing.runs import Run, run_of
from estimator.tracing.spectra import NoiseShapes, Z, gyro_spectra
from estimator.tracing.tones import TONE, samples_of, tone_columns

Floats = NDArray[np.float64]

_UNSEEN = 0.7  # of what is expected of a parameter: a larger sigma says that the run did not show it


@dataclass(frozen=True, slots=True, eq=False)
class Modelled:
    """Estimate of the gyros (m) of one source.

    ``x`` (m, 4) and ``covariance`` (m, 4, 4) are of the states [k, b, s_j, s_k]; ``of_effects`` (m, 4, 4) is the part
    of the covariance that would be gone if the effects were known. ``noise`` and ``effects`` are by gyro;
    ``said_rps`` (b, m) is what the effects add to the output over the blocks of ``run``.
    """

    x: Floats
    covariance: Floats
    of_effects: Floats
    noise: list[NoiseFound]
    effects: list[tuple[EffectValue, ...]]
    said_rps: Floats
    run: Run
    notes: tuple[str, ...] = ()

    def budget(self, gyro: int) -> tuple[Contribution, ...]:
        """Return what noise and effects contribute to the covariance of a gyro's states [k, b, s_j, s_k]."""
        noise = self.covariance[gyro] - self.of_effects[gyro]
        return Contribution("noise", noise), Contribution("effects", self.of_effects[gyro])

    def said_at(self, t_s: Floats) -> Floats:
        """Return what the effects add to the outputs (rows, m) at instants on the recording's clock."""
        return np.column_stack([np.interp(t_s, self.run.t_s, column) for column in self.said_rps.T])

    @property
    def left_rps(self) -> Floats:
        """Output errors (b, m) of the blocks that neither states nor effects explain; zero where there are no data."""
        explained = np.einsum("mbi,mi->bm", self.run.state_columns(), self.x) + self.said_rps
        return np.asarray((self.run.z_rps - explained) * self.run.weight[:, None])


def check_model(model: ErrorModel, recording: Recording) -> None:
    """See that effects can be estimated against the reference of a recording at all; ModelError if not."""
    if isinstance(recording.reference, Turns):
        raise ModelError(
            f"{recording.name}: of turns only their angles are known, not what happens within them, so no effects can "
            "be estimated beside the states: leave out --model"
        )


def estimate_device(
    model: ErrorModel, recording: Recording, sources: Sequence[tuple[str, ImuData]], *, clustered: bool = False
) -> list[Modelled]:
    """Return the estimate of the sources of one device.

    ``clustered``: the errors of the reference hang together over 5 s, and the covariances hold it.

    Raises ModelError for a model that needs what the recording lacks, RecordingError for too little data.
    """
    runs = [_run(recording, number, source, data) for number, (source, data) in enumerate(sources)]
    try:
        made = model.made(runs[0].grid.gimbals, frozenset.intersection(*(run.grid.offers for run in runs)))
    except ModelError as error:
        raise ModelError(f"{recording.name}: {error}") from None
    parts = sorted((_Part(known, e) for known, e in zip(model.effects, made, strict=True)), key=lambda p: p.shared)
    columns = [_columns(run, parts) for run in runs]
    mean = np.concatenate([part.mean for part in parts])
    shifted = [replace(r, z_rps=r.z_rps - np.einsum("mbp,p->bm", c, mean)) for r, c in zip(runs, columns, strict=True)]
    spectra = gyro_spectra(shifted)
    if len(spectra) < sum(len(run.array) for run in runs):
        raise RecordingError(_too_little(recording, sources[0][0]))
    for gyro in spectra:
        gyro.add([_of_stretch(gyro.name, runs[s.run], columns[s.run], s.blocks) for s in gyro.stretches])
    span_s = max(float(run.t_s[-1] - run.t_s[0]) + run.length_s for run in runs)
    shapes = NoiseShapes.over(span_s)
    # One recording is of one power-on: no bias changes but by wandering.
    evidence = Evidence(spectra, shapes.select(shapes.turn_on == 0))
    terms = _terms(parts)
    evidence.narrow([[], terms])
    weight = evidence.noise_weight(terms)
    posterior = evidence.posterior(terms, weight)
    found, first = [], 0
    for run, moved, own in zip(runs, shifted, columns, strict=True):
        gyros = range(first, first + len(run.array))
        first = gyros.stop
        means = [np.concatenate([posterior.own[g], posterior.shared]) for g in gyros]
        covariances = [_whole(posterior, g) for g in gyros]
        notes: list[str] = []
        if clustered:
            for i, g in enumerate(gyros):
                covariances[i], said = _clustered(moved, i, own[i], means[i], covariances[i], spectra[g].arw)
                notes += said
        noise = [_noise(spectra[g].arw, evidence.shapes, weight) for g in gyros]
        found.append(_modelled(run, parts, own, means, covariances, noise, tuple(notes)))
    return found


def against_reference(
    model: ErrorModel, recording: Recording, sources: Sequence[tuple[str, ImuData]], innovations: bool
) -> Calibration:
    """Return the estimate against an attitude or a rate, whose own errors hang together over clusters of 5 s."""
    gyros: list[GyroCalibration] = []
    notes = foreign_motion_notes(recording)
    squares, dof, samples = 0.0, 0, 0
    for device in dict.fromkeys(data.device for _, data in sources):
        members = [pair for pair in sources if pair[1].device == device]
        for (source, data), found in zip(
            members, estimate_device(model, recording, members, clustered=True), strict=True
        ):
            notes += found.notes
            length_s = row_length_s(recording, data)
            arw = np.array([noise.mean.arw for noise in found.noise])
            for i, name in enumerate(data.array.names):
                states, covariance = decode(found.x[i], found.covariance[i])
                gyros.append(
                    GyroCalibration(
                        name,
                        source,
                        states,
                        covariance,
                        float(arw[i] / np.sqrt(length_s)),
                        data.array.p[i],
                        data.device,
                        tuple(Contribution(c.name, decode(found.x[i], c.covariance)[1]) for c in found.budget(i)),
                        found.noise[i],
                        effects=found.effects[i],
                    )
                )
                notes += unseen_notes(name, found.covariance[i], data.prior)
                notes += factor_notes(name, float(states[0]), float(np.sqrt(covariance[0, 0])))
            full = int(found.run.weight.sum())
            samples += round(full * found.run.length_s / length_s) * len(data.array)
            squares += float(np.sum((found.left_rps / arw) ** 2)) * found.run.length_s
            dof += max((full - 4) * len(data.array), 0)
    nis = squares / dof if dof and innovations else float("nan")
    return Calibration(tuple(gyros), nis, samples, 0, (*notes, *effect_notes(gyros)), model=model.text())


def effect_notes(gyros: Sequence[GyroCalibration]) -> list[str]:
    """Return which effects of the model a recording did not show, in words."""
    unseen: dict[str, list[str]] = {}
    for gyro in gyros:
        for name in dict.fromkeys(value.effect for value in gyro.effects if not value.shared):
            if any(v.sd > _UNSEEN * v.expected_sd for v in gyro.effects if v.effect == name):
                unseen.setdefault(name, []).append(gyro.name)
    by_gyros: dict[tuple[str, ...], list[str]] = {}
    for name, who in unseen.items():
        by_gyros.setdefault(tuple(who), []).append(readable(name))
    return [
        f"not seen by this run on {', '.join(who)}, of the effects of the model: {', '.join(names)}; the sigmas of the "
        "states hold what is typical of them"
        for who, names in by_gyros.items()
    ]


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    known: KnownEffect
    effect: Effect

    @property
    def shared(self) -> bool:
        return self.effect.shared

    @property
    def mean(self) -> Floats:
        """What is expected of each parameter, in its own sigmas: columns are scaled by these."""
        return self.known.mean / self.known.sd


def _run(recording: Recording, number: int, source: str, data: ImuData) -> Run:
    # Two sources may have gyros of the same names.
    named = replace(data, array=replace(data.array, names=tuple(f"{number} {name}" for name in data.array.names)))
    run = run_of(recording, source, named)
    if run is None:
        raise RecordingError(_too_little(recording, source))
    if at_rest(recording.reference):  # Earth rate is too slow to tell k from other effects
        return replace(run, w_rps=np.zeros_like(run.w_rps))
    return run


def _too_little(recording: Recording, source: str) -> str:
    return (
        f"{recording.name}: source {source} holds too little data to estimate effects beside the states: 8 s of "
        "samples that the reference covers are needed"
    )


def _columns(run: Run, parts: Sequence[_Part]) -> Floats:
    """Return the block means (m, b, p) of all effects, scaled by what is expected of each parameter."""
    waves: dict[str, Floats] = {}
    tones = [part.known for part in parts if part.known.name == TONE]
    if tones:
        samples = samples_of(run)
        waves = {tone.called: tone_columns(float(tone.settings["frequency_hz"]), run, samples) for tone in tones}
    of_gyros = []
    for gyro in range(len(run.array)):
        own = [
            (waves[p.known.called] if p.known.called in waves else run.columns(p.effect, gyro)) * p.known.sd
            for p in parts
        ]
        of_gyros.append(np.hstack(own))
    return np.array(of_gyros)


def _of_stretch(name: str, run: Run, columns: Floats, blocks: slice) -> Floats:
    return np.asarray((columns[run.array.names.index(name)] * run.weight[:, None])[blocks])


def _terms(parts: Sequence[_Part]) -> list[Term]:
    terms, start = [], Z + 1
    for part in parts:
        stop = start + len(part.known.sizes)
        terms.append(Term(part.known.called, tuple(range(start, stop)), part.shared))
        start = stop
    return terms


def _whole(posterior: Posterior, gyro: int) -> Floats:
    """Return the covariance (c, c) of [states, own effects, shared effects] of a gyro."""
    own, cross = posterior.own_covariance[gyro], posterior.cross[gyro]
    return np.block([[own, cross], [cross.T, posterior.shared_covariance]])


def _noise(arw: float, shapes: NoiseShapes, weight: Floats) -> NoiseFound:
    instability, walk = shapes.instability * arw, shapes.walk * arw
    mean = NoiseModel(arw, float(weight @ instability), float(weight @ walk))
    return NoiseFound(mean, quantile(instability, weight), quantile(walk, weight))


def _modelled(
    run: Run,
    parts: Sequence[_Part],
    columns: Floats,
    means: Sequence[Floats],
    covariances: Sequence[Floats],
    noise: list[NoiseFound],
    notes: tuple[str, ...],
) -> Modelled:
    expected = np.concatenate([part.mean for part in parts])
    effects, of_effects, said = [], [], []
    for mean, covariance, own in zip(means, covariances, columns, strict=True):
        shares = mean[4:] + expected
        doubts = np.sqrt(np.diag(covariance)[4:])
        said.append(own @ shares)
        effects.append(_values(parts, shares, doubts))
        across = covariance[:4, 4:]
        of_effects.append(across @ np.linalg.solve(covariance[4:, 4:], across.T))
    states = np.array([mean[:4] for mean in means])
    whole = np.array([covariance[:4, :4] for covariance in covariances])
    return Modelled(states, whole, np.array(of_effects), noise, effects, np.column_stack(said), run, notes)


def _values(parts: Sequence[_Part], shares: Floats, doubts: Floats) -> tuple[EffectValue, ...]:
    values, at = [], 0
    for part in parts:
        for size in part.known.sizes:
            value, sd = float(shares[at] * size.sd), float(doubts[at] * size.sd)
            values.append(EffectValue(part.known.called, size.name, value, sd, size.unit, size.sd, part.shared))
            at += 1
    return tuple(values)


def _clustered(
    run: Run, gyro: int, columns: Floats, mean: Floats, covariance: Floats, arw: float
) -> tuple[Floats, list[str]]:
    """Return a covariance (c, c) that holds for residuals correlated within clusters (Liang, Zeger 1986), and notes.

    No direction gets less than the covariance under coloured noise.
    """
    both = np.hstack([run.state_columns()[gyro], columns]) * run.weight[:, None]
    rest = (run.z_rps[:, gyro] * run.weight - both @ mean) * (run.length_s / arw**2)
    rows = max(round(CLUSTER_S / run.length_s), 1)
    scores = np.add.reduceat(both * rest[:, None], np.arange(0, len(rest), rows), axis=0)
    name = run.data.array.names[gyro].partition(" ")[2]
    if len(scores) < FEWEST_CLUSTERS:
        return covariance, [f"{name}: too short to tell how the residual hangs together; sigmas assume its spectrum"]
    precision = np.diag(np.concatenate([1 / run.prior.variances(), np.ones(columns.shape[1])]))
    white = np.linalg.inv(both.T @ both * (run.length_s / arw**2) + precision)
    found = white @ (scores.T @ scores * (len(scores) / (len(scores) - 1)) + precision) @ white
    root = np.linalg.cholesky(covariance)
    ratio, directions = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, found).T))
    basis = root @ directions
    out = basis @ np.diag(np.maximum(ratio, 1.0)) @ basis.T
    worst = float(np.sqrt(np.max(np.diag(out)[:4] / np.diag(covariance)[:4])))
    if worst > COLOURED:
        return out, [f"{name}: the residual hangs together; sigmas are up to {worst:.1f} times those of its spectrum"]
    return out, []
