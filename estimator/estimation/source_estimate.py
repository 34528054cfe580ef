"""The estimate of one source, by any method; under white noise where there is too little data for more."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimator.calibration.budget import Contribution
from estimator.calibration.gyro import EffectValue
from estimator.calibration.values import UndeclaredEffect
from estimator.estimation.gram import gram_of, solve
from estimator.geometry.noise import NoiseFound, NoiseModel
from estimator.observations.blocks import Blocks
from estimator.observations.poses import estimate as estimate_poses
from estimator.observations.rows import row_length_s, sample_noise
from estimator.observations.timing import TimeOffset
from estimator.packaged import sentence
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import Poses
from estimator.types import Floats

Sources = Sequence[tuple[str, ImuData]]
_EXCESS = 2.0  # mean square from which on it is reported


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class SourceEstimate:
    """Estimate of the m gyros of one source: states ``x`` (m, 4) and by gyro the lines that their covariance sums up,
    noise, effects.

    ``data`` are its samples, with the time offset to the reference subtracted from their stamps where it is known;
    ``noise_rps`` (m,) is the noise of one sample. ``squares`` are those of block means about the estimate, over those
    of white noise, and ``dof`` is their number. ``blocks`` have the effects subtracted, for the parity check.
    ``expected_nis``: mean and standard deviation under the estimated noise.
    """

    source: str
    data: ImuData
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


@dataclass(frozen=True, slots=True, eq=False)
class DeviceEstimate:
    """Estimate of one device: its sources, ``notes`` that a person should know, and ``doubts`` against it.

    ``spoilt`` says what changed in mid-run, ``undeclared`` which effects cause which share of the sigmas.
    """

    sources: Sequence[SourceEstimate]
    notes: Sequence[str] = ()
    doubts: Sequence[str] = ()
    spoilt: Sequence[str] = ()
    undeclared: Sequence[UndeclaredEffect] = ()


def estimate_white(recording: Recording, source: str, data: ImuData) -> SourceEstimate:
    """Return the estimate of a source under white noise: for turns, or for too few samples to tell the kind of noise.

    For turns the noise is at least the stated one, and ``noise`` holds None for each gyro; otherwise it is the scatter
    of the residual. There are neither blocks for parity nor a time offset. RecordingError for too few turns or rows
    (``gram_of``).
    """
    gram, m = gram_of(recording, source, data), len(data.array)
    noise = None
    if recording.turns is not None:  # a few rows: their uncertainty is stated, not estimated
        # The rows are weighted by the noise of the worst channel, so the noise is relative to that.
        noise = np.maximum(sample_noise(data).max(), solve(gram, data.array, data.prior).noise_rps)
    found = solve(gram, data.array, data.prior, noise)
    kinds: list[NoiseFound | None] = [None] * m
    if noise is None:
        arw = found.noise_rps * np.sqrt(row_length_s(recording, data))
        kinds = [NoiseFound(NoiseModel(one), 0.0, 0.0) for one in arw.tolist()]
    lines = [(Contribution("noise", covariance),) for covariance in found.covariance]
    return SourceEstimate(
        source=source,
        data=data,
        x=found.x,
        lines=lines,
        noise=kinds,
        effects=[()] * m,
        noise_rps=found.noise_rps,
        samples=gram.rows * m,
    )


def estimate_laid(poses: Poses, sources: Sources) -> DeviceEstimate:
    """Return the estimates of sources whose reference is gravity at rests between turns.

    They have no noise model and no blocks. Each source gets a note on the number of turns, and a doubt if gravity is
    missed by far more than chance. RecordingError for gyros that do not span space, or gaps between all rests.
    """
    estimates, notes, doubts = list[SourceEstimate](), list[str](), list[str]()
    for source, data in sources:
        found, m = estimate_poses(data, poses, data.prior), len(data.array)
        own = [found.covariance[4 * i : 4 * i + 4, 4 * i : 4 * i + 4] for i in range(m)]
        lines = [(Contribution("noise", covariance),) for covariance in own]
        samples = len(data.t_ns) * m
        estimates.append(
            SourceEstimate(
                source=source,
                data=data,
                x=found.x,
                lines=lines,
                noise=[None] * m,
                effects=[()] * m,
                noise_rps=found.noise_rps,
                samples=samples,
            )
        )
        notes.append(f"{source}: gravity was propagated over {found.turns} turns between {len(poses.up)} rests")
        if found.excess > _EXCESS:
            doubts.append(sentence("estimation.gravity_missed", source=source, times=np.sqrt(found.excess)))
    return DeviceEstimate(estimates, notes, doubts)
