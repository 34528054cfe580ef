"""The live filter of accelerometers: the batch estimate of its model by another road, whatever the samples are like."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from estimator.estimation.live.forces import LiveForces, white_forces
from estimator.geometry.kinematics import GRAVITY_MPS2
from estimator.recordings.motion.body_rates import BodyRates
from estimator.recordings.recording import ImuData, Recording
from sims.physics.accelerometer import AccelerometerTruth
from station.bench.bench import read_bench
from station.opening.simulate import simulate_bench
from station.opening.twins import force_truth_of
from station.scripts.script import load_script

BENCH = Path(__file__).parents[1] / "data" / "benches" / "full_imu.toml"
DEVICE = "mti"
SURE = 4.5  # sigmas, for some twenty values


@dataclass(frozen=True, slots=True, kw_only=True)
class Samples:
    """Samples of a source as a driver gives them."""

    t_ns: np.ndarray
    accel_mps2: np.ndarray | None


@cache
def run() -> tuple[Recording, AccelerometerTruth]:
    """Return a run of turns and poses, and the truth of its accelerometers."""
    folder = BENCH.parents[1]
    bench = read_bench(BENCH.read_text(encoding="utf-8").replace('rate = "100 Hz"', 'rate = "50 Hz"'), "bench")
    (imu,) = bench.imus
    felt = force_truth_of(bench.twin.truths.again(), imu, bench.site)
    assert felt is not None
    return simulate_bench(bench, load_script(folder / "scripts" / "poses_and_turns.toml"), 1), felt[0]


def data() -> ImuData:
    return run()[0].sources[DEVICE]


def outputs() -> np.ndarray:
    """Return the outputs of the accelerometers (n, 3), to be changed."""
    found = data().accel_mps2
    assert found is not None
    return found.copy()


def with_outputs(changed: np.ndarray) -> Recording:
    """Return the run with other outputs of its accelerometers."""
    return replace(run()[0], sources={DEVICE: replace(data(), accel_mps2=changed)})


def replayed(recording: Recording, kept: np.ndarray | None = None) -> LiveForces:
    """Return the live filter after a recording, whose readings and samples arrive a second at a time.

    ``kept`` are flags (n,) of the samples that arrive.
    """
    table, own = recording.table, recording.sources[DEVICE]
    assert table is not None
    assert own.accel_mps2 is not None
    live = LiveForces.of(recording, DEVICE)
    rates = BodyRates(table.gimbals, recording.site)
    kept = np.ones(len(own.t_ns), dtype=bool) if kept is None else kept
    for since_ns in range(int(table.t_ns[0]), int(table.t_ns[-1]) + 1, 1_000_000_000):
        read = (table.t_ns >= since_ns) & (table.t_ns < since_ns + 1_000_000_000)
        taken = (own.t_ns >= since_ns) & (own.t_ns < since_ns + 1_000_000_000) & kept
        half_ns = None if table.half_width_ns is None else table.half_width_ns[read]
        rates.add(table.t_ns[read], table.angle_rad[read], table.rate_rps[read], half_ns, table.rate_window_ns)
        live.add(Samples(t_ns=own.t_ns[taken], accel_mps2=own.accel_mps2[taken]))
        live.advance(rates)
    rates.finish()
    live.advance(rates, flush=True)
    return live


def difference_in_sigmas(recording: Recording, live: LiveForces) -> float:
    """Return the largest difference between the live filter and the batch estimate of its model, in sigmas."""
    x, covariance = live.state()
    batch = white_forces(recording, DEVICE, live)
    sd = np.sqrt(np.diag(batch.covariance))
    assert np.sqrt(np.diag(covariance)) == pytest.approx(sd, rel=1e-6)
    return float(np.abs((x - batch.x) / sd).max())


def errors_in_sigmas(live: LiveForces) -> np.ndarray:
    """Return the errors of the states (3, 4) over their sigmas; gravity of the twin is stated."""
    truth = run()[1]
    true_states = np.column_stack([truth.k, truth.b_mps2, truth.sigma_j_rad, truth.sigma_k_rad])
    states, sd = live.decoded()
    return np.asarray((states - true_states) / sd)


def test_states_places_and_delay_are_those_of_the_twin_and_of_the_batch() -> None:
    recording, truth = run()
    live = replayed(recording)
    assert difference_in_sigmas(recording, live) < 1e-6
    assert np.abs(errors_in_sigmas(live)).max() < SURE
    _, sd = live.decoded()
    assert sd[:, 0].max() < 3e-4  # of a data sheet's 1 %
    arm_m, arm_sd_m = live.arm()
    assert arm_m == pytest.approx(np.mean(truth.places_m, axis=0), abs=SURE * arm_sd_m.max())
    assert arm_sd_m.max() < 2e-3
    assert live.delay.offset_s == pytest.approx(1.5e-3, abs=SURE * live.delay.sd_s)
    assert live.nis_mean == pytest.approx(1.0, abs=0.1)
    assert live.left_out == ("", "", "")


def dead(changed: np.ndarray) -> None:
    changed[:, 1] = np.random.default_rng(1).normal(0.0, 0.01, len(changed))


def constant(changed: np.ndarray) -> None:
    changed[:, 1] = 0.3


def none(changed: np.ndarray) -> None:
    changed[:, 1] = np.nan


def stuck(changed: np.ndarray) -> None:
    changed[len(changed) // 2 :, 1] = changed[len(changed) // 2, 1]


def saturated(changed: np.ndarray) -> None:
    changed[:, 1] = np.clip(changed[:, 1], -9.5, 9.5)


def spiked(changed: np.ndarray) -> None:
    changed[100::997, 1] = 1e6


def knocked(changed: np.ndarray) -> None:
    middle = len(changed) // 2
    changed[middle : middle + 25, 1] += 30.0  # half a second


def slower(changed: np.ndarray) -> None:
    changed[np.arange(len(changed)) % 4 != 1, 1] = np.nan


def repeated(changed: np.ndarray) -> None:
    changed[:, 1] = np.repeat(changed[::4, 1], 4)[: len(changed)]


@pytest.mark.parametrize("defect", [dead, constant, none, stuck, saturated, spiked, knocked, slower, repeated])
def test_one_bad_accelerometer_spoils_neither_itself_nor_the_others(defect) -> None:  # type: ignore[no-untyped-def]
    changed = outputs()
    defect(changed)
    recording = with_outputs(changed)
    live = replayed(recording)
    assert difference_in_sigmas(recording, live) < 1e-6
    errors = errors_in_sigmas(live)
    assert np.abs(errors).max() < SURE
    never = defect in (dead, constant, none)
    assert bool(live.left_out[1]) == (never or defect is stuck)
    places_m = run()[1].places_m
    middle_m = places_m[[0, 2]].mean(axis=0) if never else places_m.mean(axis=0)
    arm_m, arm_sd_m = live.arm()
    assert np.abs((arm_m - middle_m) / arm_sd_m).max() < SURE
    assert arm_sd_m.max() < 1.2e-3  # that of one of which nothing comes would be 5 mm, a third of which counted
    if never:
        assert live.decoded()[1][1, 0] > 5e-3  # still that of the data sheet
    else:
        assert live.decoded()[1][1, 0] < 1e-3


def test_gaps_and_an_early_end() -> None:
    recording = run()[0]
    t_s = (data().t_ns - data().t_ns[0]) * 1e-9
    kept = (t_s < 60) & ~((t_s > 20) & (t_s < 23.3)) & (np.arange(len(t_s)) % 7 != 3)
    live = replayed(recording, kept)
    own = data()
    assert own.accel_mps2 is not None
    fewer = replace(own, t_ns=own.t_ns[kept], rate_rps=own.rate_rps[kept], accel_mps2=own.accel_mps2[kept])
    assert difference_in_sigmas(replace(recording, sources={DEVICE: fewer}), live) < 1e-6
    assert np.abs(errors_in_sigmas(live)).max() < SURE


def test_gravity_that_nobody_states_is_a_part_of_the_sigmas_of_scale() -> None:
    recording = replace(run()[0], site=None)
    live = replayed(recording)
    assert live.gravity_mps2 == GRAVITY_MPS2
    assert difference_in_sigmas(recording, live) < 1e-6
    assert np.abs(errors_in_sigmas(live)).max() < SURE
    _, sd = live.decoded()
    assert sd[:, 0].min() > 1e-3


def test_without_samples_everything_is_as_the_data_sheet_has_it() -> None:
    recording = run()[0]
    live = replayed(recording, np.zeros(len(data().t_ns), dtype=bool))
    sheet = data().accel_sheet
    assert sheet is not None
    assert np.square(live.decoded()[1]) == pytest.approx(np.tile(sheet.prior.variances(), (3, 1)))
    assert np.isnan(live.nis_mean)
