"""What a table's angles say of its rates: jumps, signs and scales are named, and nothing else is."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.observations.defects.reading_doubts import reading_doubts
from estimator.recordings.reference import TableReadings

T_S = np.arange(0, 30, 0.05)
RATE = np.radians(20.0) * np.clip(np.minimum(T_S - 3, 25 - T_S), 0, 1)
ANGLE = np.concatenate([[0.0], np.cumsum((RATE[1:] + RATE[:-1]) / 2 * np.diff(T_S))])


def readings(angle: np.ndarray, rate: np.ndarray, noise_rps: float = 0.0) -> TableReadings:
    rate = rate + np.random.default_rng(1).normal(0, 1, len(rate)) * noise_rps
    t_ns = np.round(T_S * 1e9).astype(np.int64)
    still = np.zeros(len(T_S))
    width = np.full(len(T_S), 1_000_000)
    return TableReadings(
        t_ns=t_ns,
        angle_rad=np.column_stack([still, angle]),
        rate_rps=np.column_stack([still, rate]),
        gimbals=("z", "x"),
        uncertainty=None,
        half_width_ns=width,
    )


def test_readings_that_agree_are_not_doubted_noise_or_not() -> None:
    assert reading_doubts(readings(ANGLE, RATE)) == ()
    assert reading_doubts(readings(ANGLE, RATE, np.radians(0.5))) == ()
    assert reading_doubts(readings(np.mod(ANGLE, 2 * np.pi), RATE)) == ()


@pytest.mark.parametrize(
    ("angle", "rate", "says"),
    [
        (ANGLE + np.radians(3.0) * (T_S > 15.02), RATE, "the encoder of axis x jumped by +3.00 deg at 15.1 s"),
        (ANGLE - np.radians(1.0) * (T_S > 27.52), RATE, "the encoder of axis x jumped by -1.00 deg at 27.6 s"),
        (ANGLE, -RATE, "the rates of axis x have the other sign than its angles"),
        (ANGLE, 1.01 * RATE, "the rates of axis x are +1.00 % off what its angles say"),
        (ANGLE, 0.999 * RATE, "the rates of axis x are -0.10 % off what its angles say"),
        (
            ANGLE + np.radians(0.01) * np.clip(T_S - 27, 0, 2.5),
            RATE,
            "the angle of axis x moved by +0.025 deg from 25.0 s on while its rate stood at 0 deg/s",
        ),
        (
            ANGLE,
            np.where(T_S > 24.02, RATE[480], RATE),
            "the angle of axis x stood still from 25.0 s on while its rates moved it by +99.0 deg",
        ),
        (
            np.where((T_S > 10.02) & (T_S < 11.98), ANGLE[200], ANGLE),
            RATE,
            "the angle of axis x stood still from 10.0 s on while its rates moved it by +39.0 deg",
        ),
    ],
)
def test_what_is_wrong_with_a_table_is_named(angle: np.ndarray, rate: np.ndarray, says: str) -> None:
    noise_rps = 0.0 if "stood" in says else np.radians(0.01)
    assert says in reading_doubts(readings(angle, rate, noise_rps))
