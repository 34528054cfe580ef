"""The verdict over a calibration: which limit is broken, by which state of which gyro, and in which unit it is told."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from estimator.calibration.budget import UNSEEN, Contribution
from estimator.calibration.gyro import GyroCalibration
from estimator.calibration.values import Calibration
from estimator.observations.coverage import AxisCoverage
from estimator.observations.health import Excluded
from station.bench.bench import Limits
from station.run.outcome import Outcome, judge

LIMITS = Limits(
    k=0.01,
    b_rps=0.002,
    sigma_rad=0.003,
    sd_k=1e-4,
    sd_b_rps=1e-5,
    sd_sigma_rad=2e-4,
    nis_low=0.8,
    nis_high=1.2,
    lost=0.1,
)
ANY = Limits(*[np.inf] * 6, nis_low=0.0, nis_high=np.inf, lost=1.0)
AT_THE_LIMITS = np.array([0.01, 0.002, 0.003, 0.003])
SIGMAS_AT_THE_LIMITS = np.array([1e-4, 1e-5, 2e-4, 2e-4])


def calibration(states: np.ndarray, sd: np.ndarray, *, nis: float = 1.0, lost: int = 0, **more: object) -> Calibration:
    """Return a calibration of one gyro."""
    gyro = GyroCalibration(
        name="x",
        source="imu",
        states=states,
        covariance=np.diag(sd**2),
        noise_rps=1e-4,
        p=np.array([1.0, 0.0, 0.0]),
        device="imu",
    )
    return replace(Calibration(gyros=(gyro,), nis_mean=nis, samples=900, lost=lost, notes=()), **more)


def axis(name: str, covered_s: tuple[float, float] | None) -> AxisCoverage:
    return AxisCoverage(axis=name, covered_s=covered_s, length_s=100.0, concerns=("k",))


GOOD = calibration(AT_THE_LIMITS * 0.5, SIGMAS_AT_THE_LIMITS * 0.5)


def test_everything_within_its_limits_passes() -> None:
    verdict = judge(GOOD, LIMITS, ("the encoder jumped",))
    assert verdict.outcome is Outcome.PASS
    assert verdict.reason == "all states, sigmas, innovations and losses are within limits"


@pytest.mark.parametrize(("limits", "outcome"), [(LIMITS, Outcome.PASS), (None, Outcome.ESTIMATED)])
def test_a_verdict_that_is_no_fail_says_of_which_axes_constancy_is_not_proved(
    limits: Limits | None, outcome: Outcome
) -> None:
    found = replace(GOOD, constancy=(axis("x", (10.0, 90.0)), axis("z", (70.0, 90.0))), doubts=("odd",))
    verdict = judge(found, limits)
    assert verdict.outcome is outcome
    assert re.search(r"; constancy not proved: z; (but )?odd$", verdict.reason)
    proved = replace(GOOD, constancy=(axis("x", (10.0, 80.0)), axis("z", (20.0, 90.0))))
    assert judge(proved, limits).reason.endswith("; constancy not proved before 20 s and after 80 s")
    never = replace(GOOD, constancy=(axis("y", None),))
    assert judge(never, limits).reason.endswith("; constancy not proved: y")


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    ("state", "told"),
    [(0, "x k 20000 ppm > 10000 ppm"), (1, "x b 825.1 deg/h > 412.5 deg/h"),
     (2, "x sigma_j 6000 urad > 3000 urad"), (3, "x sigma_k 6000 urad > 3000 urad")],
)  # fmt: skip
def test_a_state_beyond_its_limit_is_named_with_its_unit(state: int, told: str, sign: int) -> None:
    states = AT_THE_LIMITS * 0.5
    states[state] *= 4 * sign
    verdict = judge(calibration(states, SIGMAS_AT_THE_LIMITS * 0.5), LIMITS)
    assert verdict.outcome is Outcome.FAIL
    assert verdict.reason == told


@pytest.mark.parametrize(
    ("state", "told"),
    [(0, "x sigma of k 200 ppm > 100 ppm"), (1, "x sigma of b 4.125 deg/h > 2.063 deg/h"),
     (2, "x sigma of sigma_j 400 urad > 200 urad"), (3, "x sigma of sigma_k 400 urad > 200 urad")],
)  # fmt: skip
def test_a_sigma_beyond_its_limit_is_named_with_its_unit(state: int, told: str) -> None:
    sd = SIGMAS_AT_THE_LIMITS * 0.5
    sd[state] *= 4
    assert judge(calibration(AT_THE_LIMITS * 0.5, sd), LIMITS).reason == told


def test_what_is_just_beyond_its_limit_is_told_with_digits_that_show_it() -> None:
    sd = SIGMAS_AT_THE_LIMITS * np.array([0.5, 1.00001, 0.5, 0.5])
    verdict = judge(calibration(AT_THE_LIMITS * 0.5, sd), LIMITS)
    found, limit = verdict.reason.removeprefix("x sigma of b ").split(" > ")
    assert found != limit
    (line,) = verdict.broken
    assert line.cells == ("x ± of b", "2.0627 deg/h", "2.0626 deg/h", "0.001 %")


def test_what_is_at_its_limit_is_within() -> None:
    within = calibration(-AT_THE_LIMITS, SIGMAS_AT_THE_LIMITS * (1 - 1e-12), nis=1.2, lost=100)
    assert judge(within, LIMITS).outcome is Outcome.PASS
    assert judge(replace(within, nis_mean=0.8), LIMITS).outcome is Outcome.PASS


def test_what_is_no_number_does_not_pass() -> None:
    states, sd = AT_THE_LIMITS * 0.5, SIGMAS_AT_THE_LIMITS * 0.5
    assert judge(calibration(np.full(4, np.nan), sd), LIMITS).outcome is Outcome.FAIL
    assert judge(calibration(states, np.full(4, np.nan)), LIMITS).outcome is Outcome.FAIL


@pytest.mark.parametrize("nis", [0.79, 1.21])
def test_innovations_that_do_not_fit_their_sigmas_fail(nis: float) -> None:
    verdict = judge(replace(GOOD, nis_mean=nis), LIMITS)
    assert verdict.outcome is Outcome.FAIL
    assert verdict.reason.startswith(f"mean NIS {nis:.3f} is outside 0.8 to 1.2")


def test_without_innovations_the_rest_is_judged() -> None:
    assert judge(replace(GOOD, nis_mean=np.nan), LIMITS).outcome is Outcome.PASS


def test_losses_count_by_their_share_of_all_samples() -> None:
    assert judge(replace(GOOD, lost=101), LIMITS).reason == "10.09 % of the samples lost > 10 %"
    nothing = replace(GOOD, samples=0, lost=0)
    assert judge(nothing, LIMITS).outcome is Outcome.PASS


def test_a_gyro_that_could_not_be_estimated_fails_with_its_reason() -> None:
    excluded = replace(GOOD, excluded=(Excluded("y", "its output never changes"),))
    assert judge(excluded, LIMITS).reason == "y is not estimated: its output never changes"


def test_a_failure_tells_what_may_be_behind_it_and_what_speaks_against_the_sigmas() -> None:
    doubtful = replace(GOOD, lost=200, doubts=("the table was read late",))
    reason = judge(doubtful, LIMITS, ("the encoder jumped",)).reason
    assert reason.startswith("the encoder jumped; the table was read late; ")
    assert reason.endswith("lost > 10 %")
    passed = judge(replace(GOOD, doubts=("the table was read late",)), LIMITS)
    assert passed.reason.endswith("within limits; but the table was read late")


@pytest.mark.parametrize("limits", [None, ANY])
def test_without_limits_it_is_estimated(limits: Limits | None) -> None:
    verdict = judge(replace(GOOD, doubts=("the table was read late",)), limits)
    assert verdict.outcome is Outcome.ESTIMATED
    assert verdict.reason == "estimated; the bench has no limits to compare with; the table was read late"


@pytest.mark.parametrize("name", ["k", "sd_b_rps", "nis_low", "nis_high", "lost"])
def test_one_limit_is_enough_to_judge_by(name: str) -> None:
    assert judge(GOOD, replace(ANY, **{name: getattr(LIMITS, name)})).outcome is Outcome.PASS


@pytest.mark.parametrize(("share", "told"), [(0.6, True), (0.4, False)])
def test_a_sigma_that_is_mostly_what_the_script_cannot_show_is_told_so(share: float, told: bool) -> None:
    sd = SIGMAS_AT_THE_LIMITS * np.array([2.0, 0.5, 0.5, 0.5])
    (gyro,) = calibration(AT_THE_LIMITS * 0.5, sd).gyros
    lines = (Contribution("noise", np.diag(sd**2) * (1 - share)), Contribution(UNSEEN, np.diag(sd**2) * share))
    verdict = judge(replace(GOOD, gyros=(replace(gyro, budget=lines),)), LIMITS)
    assert ("effects that this script cannot show" in verdict.reason) is told
    assert any("effects that this script cannot show" in cause for cause in verdict.because) is told


def test_exit_codes_tell_outcomes_apart() -> None:
    assert {outcome.value: outcome.exit_code for outcome in Outcome} == {
        "PASS": 0,
        "ESTIMATED": 0,
        "MANUAL": 0,
        "FAIL": 1,
        "ABORTED": 3,
        "FAULT": 4,
    }


def test_what_no_sigma_can_hold_fails_a_run_that_is_within_all_limits() -> None:
    said = "from 105 s on, k of gyro2 differed by +2e+03 ppm (8 sigma)"
    verdict = judge(replace(GOOD, doubts=(said,), spoilt=(said,)), LIMITS)
    assert (verdict.outcome, verdict.reason) == (Outcome.FAIL, said)
