"""The paper's experiment run again: to the letter of its statement, and with this station's script and estimator.

To the letter means: its printed axes, body rates of exactly 20 deg/s about x, y, z for 75 s each without ramps,
the output of its eq. 6, its linear model, its filter on every sample with P0 = I and R = 1e-3 I in its own units, and
no Earth rate in the model. Whether its data had Earth rate is not said, so both are run. The filter itself runs once;
the other cases take the batch form of the same estimate, and how far the two are apart is part of the result.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from drivers.types import Floats
from estimator.estimation.calibrate import calibrate
from estimator.estimation.gram import Gram, solve
from estimator.estimation.live.filter import LiveFilter
from estimator.geometry.array import SensorArray, tetrahedron
from estimator.geometry.kinematics import Site
from estimator.geometry.model import Prior, decode
from estimator.geometry.noise import NoiseModel
from estimator.observations.rows import BLOCK_S, block_rows, observations
from estimator.recordings.recording import Recording
from estimator.recordings.reference import RateReadings
from estimator.recordings.writing import write_recording, write_results
from station.campaigns.campaigns import Failure, run_all
from station.errors import UsageError
from station.opening.simulate import DeviceTruth, simulate
from station.scripts.script import Rest, Rotate, Script, paper_script
from station.studies.paper_filter import FilterRun, bound, covariance_filter
from station.studies.published import (
    LATITUDE_DEG,
    NOISE_DPH,
    RATE_DPS,
    SAMPLE_HZ,
    TABLE_1,
    from_si,
    relative_percent,
    tetrahedron_as_printed,
    to_si,
)

SOURCE = "array"
HEADINGS_DEG = tuple(range(0, 360, 30))
BARS_PERCENT = np.array([0.8, 1.0, 2.5, 2.5])
"""Mean relative errors of b, k, sigma_j, sigma_k that the default must keep below at the noise of a MEMS gyro."""

# The table starts and stops half a sample after a sample, so that no sample falls into the jump of the rate.
_REST_S, _TURN_S, _LATE_S = 67.5, 75.0, 0.005
_JUMP_RPS2 = math.radians(4e4)  # 0.5 ms to 20 deg/s
_LETTER_PRIOR = Prior(1.0, math.radians(1.0), math.radians(1.0))  # k without unit; 1 ppm could not move to 5000
_LETTER_R_ROOT_RPS = math.radians(math.sqrt(1e-3))
# The twins' bias instability: Gauss-Markov processes whose Allan deviation has its floor at 0.664 of it.
_WANDER_TIMES_S = (1.0, 10.0, 100.0, 1000.0)
_WANDER_SHARE = 0.664 / 0.775
_CURVE_EVERY = round(SAMPLE_HZ)


PAPER_NOISE = NoiseModel(math.radians(NOISE_DPH / 3600) / math.sqrt(SAMPLE_HZ))
MEMS_NOISE = NoiseModel(math.radians(0.005), math.radians(2.0 / 3600))


@dataclass(frozen=True, slots=True)
class Letter:
    """A run to the letter: heading of the table, None for data without Earth rate; with the paper's noise or none."""

    heading_deg: float | None
    noisy: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class LetterErrors:
    """Errors (n, 4) of its linear states, and of the same filter's states decoded with the product kept."""

    linear: Floats
    decoded: Floats

    @classmethod
    def of(cls, x: Floats) -> LetterErrors:
        """Return the errors of the filter's own states x (n, 4)."""
        decoded = np.array([decode(x_i, np.zeros((4, 4)))[0] for x_i in x])
        return cls(from_si(x) - TABLE_1, from_si(decoded) - TABLE_1)


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """States and sigmas (k, n, 4) over time (k,), in the paper's units and order."""

    t_s: Floats
    states: Floats
    sd: Floats


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PaperStudy:
    """All results of the study. Errors are (n, 4), shares (4,) in percent, in the paper's units and order.

    ``clean`` and ``noise_free`` are runs to the letter without Earth rate, with the paper's noise and with none;
    ``headings`` are runs with Earth rate in the data, by heading in degrees. ``letter`` is the convergence of the
    paper's filter on the run of ``clean``; ``filter_apart_sd`` is the largest difference between its end and the batch
    form of the same estimate, in the filter's sigmas. ``ours`` are the errors of this station at the paper's noise.
    ``mems_percent`` is its mean relative error over ``seeds`` runs at the noise of MEMS gyros, ``mems_bound_percent``
    that of an estimator that reaches the Cramer-Rao bound. ``bias_bound_dps`` is the bound of a bias at the paper's
    noise. ``failures`` are the seeds that raised an error.
    """

    clean: LetterErrors
    noise_free: LetterErrors
    headings: dict[int, LetterErrors]
    letter: Curve
    filter_apart_sd: float
    ours: Floats
    mems_percent: Floats
    mems_bound_percent: Floats
    bias_bound_dps: float
    seeds: int
    failures: tuple[Failure, ...]


def run_study(seeds: int, **where: Any) -> PaperStudy:
    """Run every case to the letter, and this station on seeds from 0 to below ``seeds``; those that fail are listed.

    The seeds have the noise of MEMS gyros; with the paper's noise this station runs once. Cramer-Rao bounds of both are
    added. ``where`` goes to ``run_all``: scheduler, workers, quiet. UsageError if a case to the letter fails, or every
    seed.
    """
    cases = [Letter(None), Letter(None, noisy=False), *(Letter(heading) for heading in HEADINGS_DEG)]
    letters, failed_letters = run_all(letter_states, cases, label="the paper's runs", **where)
    states = [x for x in letters if x is not None]
    ours, failed_seeds = run_all(partial(our_errors, MEMS_NOISE), range(seeds), label="this station", **where)
    errors = [e for e in ours if e is not None]
    if failed_letters or not errors:
        worst = (*failed_letters, *failed_seeds)[0]
        raise UsageError(f"the study has no result: {worst.item}: {worst.reason}")
    recording = letter_recording(cases[0])
    run = letter_filter(recording)
    filter_sd = np.sqrt(np.diagonal(run.covariance, axis1=2, axis2=3))
    return PaperStudy(
        clean=LetterErrors.of(run.x[-1]),
        noise_free=LetterErrors.of(states[1]),
        headings={h: LetterErrors.of(x) for h, x in zip(HEADINGS_DEG, states[2:], strict=True)},
        letter=Curve(recording.sources[SOURCE].t_ns[run.rows] / 1e9, from_si(run.x), from_si(filter_sd)),
        filter_apart_sd=float(np.abs((run.x[-1] - states[0]) / filter_sd[-1]).max()),
        ours=our_errors(PAPER_NOISE, 0),
        mems_percent=relative_percent(np.array(errors)),
        mems_bound_percent=expected_percent(our_bound(MEMS_NOISE)),
        bias_bound_dps=float(our_bound(PAPER_NOISE)[:, 0].mean()),
        seeds=len(errors),
        failures=tuple(failed_seeds),
    )


def truth(array: SensorArray) -> Floats:
    """Return the paper's set values for each gyro, (n, 4) as in ``estimator.geometry.model.STATES``."""
    return np.tile(to_si(TABLE_1), (len(array), 1))


def letter_recording(letter: Letter) -> Recording:
    """Return what the paper simulates, with or without Earth rate and noise as ``letter`` says.

    The reference is the rate the table was told, without Earth rate. With x outermost and z innermost the three turns
    are about body x, y and z, wherever the ones before ended.
    """
    turns = (
        Rotate(axis, math.radians(RATE_DPS), _TURN_S, _JUMP_RPS2, f"{axis} at {RATE_DPS:g} deg/s") for axis in "xyz"
    )
    script = Script("letter", (Rest(_REST_S + _LATE_S), *turns, Rest(_REST_S - _LATE_S)))
    array = tetrahedron_as_printed()
    site = None if letter.heading_deg is None else _site(letter.heading_deg)
    device = DeviceTruth(array, truth(array), PAPER_NOISE.arw if letter.noisy else 0.0, rate_hz=SAMPLE_HZ)
    run = simulate(script, {SOURCE: device}, 0, site=site, gimbals=("x", "y", "z"), earth_turns=site is not None)
    t_ns = run.sources[SOURCE].t_ns
    starts_s = _REST_S + _LATE_S + _TURN_S * np.arange(3)
    since_s = t_ns[:, None] * 1e-9 - starts_s
    told_rps = np.where((since_s > 0) & (since_s < _TURN_S), math.radians(RATE_DPS), 0.0)
    return Recording(run.sources, RateReadings(t_ns, told_rps))


def letter_filter(recording: Recording) -> FilterRun:
    """Run the paper's filter, with its P0 and R, over a recording."""
    w_rps, y_rps = rows_of(recording)
    array = recording.sources[SOURCE].array
    prior_sd = np.sqrt(_LETTER_PRIOR.variances())
    return covariance_filter(w_rps, y_rps, array, prior_sd, _LETTER_R_ROOT_RPS, every=_CURVE_EVERY)


def letter_states(letter: Letter) -> Floats:
    """Return the paper's estimate x (n, 4) at the end of a run to the letter, in SI, by the batch form."""
    recording = letter_recording(letter)
    w_rps, y_rps = rows_of(recording)
    array = recording.sources[SOURCE].array
    return solve(Gram.of(w_rps, y_rps), array, _LETTER_PRIOR, np.full(len(array), _LETTER_R_ROOT_RPS)).x


def our_recording(noise: NoiseModel, seed: int, script: Script | None = None) -> Recording:
    """Return a run of the 360 s script (or another) on a turning Earth, x of the table to the north.

    The gyros are the tetrahedron with right-handed triads, the paper's set values and this noise.
    """
    array, wander = tetrahedron(), noise.instability
    device = DeviceTruth(
        array, truth(array), noise.arw, bias_instability_rps=wander, rate_hz=SAMPLE_HZ, kind="tetrahedron"
    )
    return simulate(script or paper_script(), {SOURCE: device}, seed, site=_site(0.0))


def our_errors(noise: NoiseModel, seed: int) -> Floats:
    """Return the errors (n, 4) of this station's calibration, in the paper's units and order."""
    calibration = calibrate(our_recording(noise, seed), innovations=False)
    return np.asarray(from_si(np.array([gyro.states for gyro in calibration.gyros])) - TABLE_1)


def our_bound(noise: NoiseModel) -> Floats:
    """Return the Cramer-Rao bound of one run of the 360 s script as sigmas (n, 4), in the paper's units and order.

    The instability of ``noise`` is taken as the sum of Gauss-Markov processes of the twins.
    """
    recording = our_recording(replace(noise, arw=0.0, instability=0.0), 0)
    w_rps = rows_of(recording)[0]
    rows = block_rows(recording.sources[SOURCE])
    means = w_rps[: len(w_rps) // rows * rows].reshape(-1, rows, 3).mean(axis=1)
    array = tetrahedron()
    wander = tuple((_WANDER_SHARE * noise.instability, time_s) for time_s in _WANDER_TIMES_S if noise.instability)
    return from_si(bound(means, array, truth(array), Prior(), BLOCK_S, noise.arw, wander))


def expected_percent(sd: Floats) -> Floats:
    """Return the mean relative error (4,) in percent of an efficient estimator with these sigmas (n, 4)."""
    return relative_percent(math.sqrt(2 / math.pi) * sd)


def rows_of(recording: Recording) -> tuple[Floats, Floats]:
    """Return the body rates (rows, 3) and outputs (rows, n) of a recording, in rad/s."""
    parts = list(observations(recording, recording.sources[SOURCE]))
    return np.vstack([part.w_rps for part in parts]), np.vstack([part.y_rps for part in parts])


def our_curve(recording: Recording) -> Curve:
    """Return how this station's live filter converges on a recording, once a second, for the noise of a MEMS gyro.

    The filter is given the white part of ``MEMS_NOISE``. Rows at the end that do not fill a block are left out.
    """
    data = recording.sources[SOURCE]
    w_rps, y_rps = rows_of(recording)
    live = LiveFilter(data.array, np.full(len(data.array), MEMS_NOISE.arw * math.sqrt(SAMPLE_HZ)), data.prior)
    rows = block_rows(data)
    ends = range(rows, len(w_rps) + 1, rows)
    times_s, states, sd = [], [], []
    for end in ends:
        live.update(w_rps[end - rows : end], y_rps[end - rows : end])
        if end % _CURVE_EVERY == 0:
            decoded = [decode(x, covariance) for x, covariance in zip(*live.state(), strict=True)]
            times_s.append(end / SAMPLE_HZ)
            states.append([s for s, _ in decoded])
            sd.append([np.sqrt(np.diag(c)) for _, c in decoded])
    return Curve(np.array(times_s), from_si(np.array(states)), from_si(np.array(sd)))


def write_curves(path: Path, recording: Recording, ours: Curve, letter: Curve) -> None:
    """Write the recording behind our curve, that curve as /estimate/array, the paper's filter's as /study/letter.

    RecordingError if the file exists or cannot be written.
    """
    write_recording(path, replace(recording, attributes={"script": paper_script().name, "seed": 0}))
    cases = (
        (f"estimate/{SOURCE}", ours, "live filter of this station on this recording"),
        ("study/letter", letter, "the paper's filter on a run of its own, to the letter of its statement"),
    )
    for group, curve, about in cases:
        values = {
            "t_ns": np.round(curve.t_s * 1e9).astype(np.int64),
            "states": to_si(curve.states),
            "sd": to_si(curve.sd),
        }
        write_results(path, group, values, {"set_values": to_si(TABLE_1), "about": about})


def _site(heading_deg: float) -> Site:
    return Site(math.radians(LATITUDE_DEG), math.radians(heading_deg))
