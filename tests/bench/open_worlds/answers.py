"""What the program answers to a case: values that can be stored, beside the true errors of the models it ends with."""

from __future__ import annotations

import resource
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.estimation.runs.build import runs_of
from estimator.estimation.runs.run import Run
from estimator.geometry.model import decode
from estimator.recordings.recording import Recording
from estimator.tracing.augmented import Augmented
from estimator.tracing.investigate import investigate
from estimator.tracing.investigation import Added, GyroErrors, Investigation
from open_worlds.cases import STATES, Case, made, sizes_of
from open_worlds.oracle import oracle_of

Floats = NDArray[np.float64]

_SIGMAS = 1.96


@dataclass(frozen=True, slots=True)
class Addition:
    """An effect that was added: a name of the catalogue, or a law that was constructed, with its expression."""

    name: str
    probability: float
    constructed: bool
    expression: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """What came of a case. Errors are in rad/s: ``true_*`` on the verification run without noise, ``told_*`` stated.

    ``ratio``, ``low``, ``high``: the stated improvement and its interval, NaN if none was stated. ``scales`` counts k,
    sigma_j, sigma_k (12) whose 95 % interval holds, ``biases`` b (4) at the zero of the effect, ``biases_met`` those
    whose interval meets what the bias really was within the runs. ``cpu_s`` is the processor time of the investigation,
    ``peak_mb`` the most memory that its process had until it ended, other cases before it included.
    """

    case: Case
    verdict: str
    reason: str
    added: tuple[Addition, ...]
    rivals: tuple[tuple[str, ...], ...]
    depends_on: str
    true_before: float
    true_after: float
    oracle: float
    chance: float
    told_before: float
    told_after: float
    ratio: float
    low: float
    high: float
    scales: int
    biases: int
    biases_met: int
    effect: float
    cpu_s: float
    peak_mb: float


def answer_of(case: Case) -> Answer:
    """Return what the program answers to a case, beside the truth."""
    world = made(case)
    began_s = time.process_time()
    found = investigate(list(world.fitted), [world.verification])
    cpu_s = time.process_time() - began_s
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    oracle = oracle_of(case, world)
    true_before, true_after = true_errors(found, world.clean)
    scales, biases, biases_met = covered(found, _bias_ranges(case, world.columns))
    improvement = found.improvement
    unexplained = found.unexplained
    return Answer(
        case=case,
        verdict=str(found.finding),
        reason=found.reason,
        added=tuple(_addition(added) for added in found.added),
        rivals=found.rivals,
        depends_on="" if unexplained is None else str(unexplained.depends_on),
        true_before=true_before,
        true_after=true_after,
        oracle=oracle.error_rps,
        chance=oracle.chance_rps,
        told_before=found.before.rms_rps,
        told_after=found.after.rms_rps,
        ratio=improvement.ratio if improvement else float("nan"),
        low=improvement.low if improvement else float("nan"),
        high=improvement.high if improvement else float("nan"),
        scales=scales,
        biases=biases,
        biases_met=biases_met,
        effect=world.effect_rps,
        cpu_s=cpu_s,
        peak_mb=peak_mb,
    )


def true_errors(found: Investigation, clean: Recording) -> tuple[float, float]:
    """Return the rms (rad/s) that the states alone, and the last model, leave of a recording without noise."""
    run = _by_sample(clean)
    assert found.model is not None
    after = [run.z_rps[:, gyro] - _predicted(found.model, run, gyro) for gyro in range(len(run.array))]
    before = [_of(found, name).states_before for name in run.array.names]
    return error_of_states(np.array(before), clean), _rms(after, run)


def error_of_states(states: Floats, clean: Recording) -> float:
    """Return the rms (rad/s) that states (m, 4) leave of a recording without noise."""
    run = _by_sample(clean)
    columns = run.state_columns()
    left = [run.z_rps[:, gyro] - columns[gyro] @ _encoded(own) for gyro, own in enumerate(states)]
    return _rms(left, run)


def _by_sample(clean: Recording) -> Run:
    return runs_of(clean, 1 / 100)[0][0]  # blocks short enough for tones


def _predicted(model: Augmented, run: Run, gyro: int) -> Floats:
    return np.asarray(model.predict(run, 99, gyro)[0])  # the number of a run that was not fitted


def _rms(left: Sequence[Floats], run: Run) -> float:
    """Return the rms of what is left (m, b) of the blocks that hold samples; the others have weight 0 and no value."""
    holds = run.weight > 0
    return float(np.sqrt(np.mean(np.square(left)[:, holds])))


def _encoded(states: Floats) -> Floats:
    """Return [k, b, s_j, s_k] of decoded states: s = (1 - k) sigma."""
    gain = 1 - states[0]
    return np.array([states[0], states[1], gain * states[2], gain * states[3]])


def _of(found: Investigation, name: str) -> GyroErrors:
    return next(gyro for gyro in found.gyros if gyro.name == name)


def _addition(added: Added) -> Addition:
    return Addition(added.effect, added.probability, added.constructed, added.expression)


def covered(found: Investigation, ranges: Floats) -> tuple[int, int, int]:
    """Return how many intervals hold k and the tilts, b, and how many meet the range (m, 2) of the true bias."""
    scales = biases = met = 0
    assert found.model is not None
    for gyro, name in enumerate(found.model.names):
        mean, sd = states_of(found, name)
        inside = np.abs(mean - STATES[gyro]) < _SIGMAS * sd
        scales += int(inside[[0, 2, 3]].sum())
        biases += int(inside[1])
        low, high = mean[1] - _SIGMAS * sd[1], mean[1] + _SIGMAS * sd[1]
        met += int(low <= ranges[gyro, 1] and high >= ranges[gyro, 0])
    return scales, biases, met


def states_of(found: Investigation, name: str) -> tuple[Floats, Floats]:
    """Return the states of a gyro after the investigation and their standard deviations, each (4,)."""
    gyro = _of(found, name)
    stated = getattr(gyro, "sd_after", None)
    if stated is not None:
        return gyro.states_after, np.asarray(stated)
    assert found.model is not None
    g = found.model.names.index(name)
    states, covariance = decode(found.model.mean[g, :4], found.model.covariance[g, :4, :4])
    return states, np.sqrt(np.diag(covariance))


def _bias_ranges(case: Case, columns: Sequence[Floats]) -> Floats:
    """Return the least and the largest bias (m, 2) of each gyro: what an effect adds, a bias takes off."""
    added = np.vstack([sizes_of(case) * c for c in columns])
    return np.column_stack([STATES[:, 1] - added.max(axis=0), STATES[:, 1] - added.min(axis=0)])
