"""Flexible laws: as many terms as the data need, and a sum of them that goes on beyond the data."""

from __future__ import annotations

import numpy as np

from estimator.effects.constructed import constructed
from estimator.estimation.evidence import Term
from estimator.tracing.augmented import Augmented, Part
from estimator.tracing.candidates import Candidate
from estimator.tracing.judging.expected import expected_squares
from estimator.tracing.laws.needed import needed

NODES = np.linspace(-0.95, 0.95, 39)
SIDES = np.where(NODES >= 0, 1.0, -1.0)
GYROS = 4


def bends(x: np.ndarray) -> np.ndarray:
    """Return columns that are zero up to a node, straight beyond, of unit mean square over -1 to 1."""

    def raw(at: np.ndarray) -> np.ndarray:
        return SIDES * np.maximum(SIDES * (at[:, None] - NODES), 0.0)

    return raw(x) / np.sqrt(np.mean(raw(np.linspace(-1, 1, 401)) ** 2, axis=0))


def squares(truth: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Return products of the bends, and those with what is to be explained, of gyros that see ``truth`` (n,)."""
    x = np.linspace(-1, 1, len(truth))
    columns = bends(x) / noise
    seen = [(truth * (1 + gyro) + noise * np.random.default_rng(gyro).standard_normal(len(x))) for gyro in range(GYROS)]
    return np.array([columns.T @ columns] * GYROS), np.array([columns.T @ one / noise for one in seen])


def test_a_function_with_two_bends_needs_few_terms_and_goes_on_beyond_the_data() -> None:
    x = np.linspace(-1, 1, 2001)
    truth = np.sign(x) * np.maximum(np.abs(x) - 0.5, 0.0)
    products, with_rest = squares(truth, noise=0.05)
    found = list(needed(products, with_rest).terms)
    assert 2 <= len(found) <= 4
    assert np.all(np.abs(np.abs(NODES[found]) - 0.5) < 0.11)
    beyond = np.array([-2.0, 2.0])
    for gyro in range(GYROS):
        sizes = np.linalg.solve(products[gyro][np.ix_(found, found)], with_rest[gyro, found])
        np.testing.assert_allclose(bends(beyond)[:, found] @ sizes, [-1.5 * (1 + gyro), 1.5 * (1 + gyro)], rtol=0.05)


def test_what_more_terms_cost_is_told_by_how_many_choices_there_were() -> None:
    x = np.linspace(-1, 1, 2001)
    products, with_rest = squares(np.maximum(x - 0.5, 0.0), noise=0.05)
    found = needed(products, with_rest)
    assert len(found.terms) == 1
    assert np.isclose(np.exp(found.log_tries), len(NODES) ** 2)  # as likely one term as two, and which one it is


def test_a_gyro_that_feels_nothing_of_a_flexible_law_has_an_expected_error() -> None:
    law = Candidate("law", constructed("abs(u)+(u); abs(u-1)+(u-1)", (1.0, 1.0)), flexible=True)
    states_and_law = np.zeros((2, 6))
    states_and_law[0, 4:] = 0.3, -0.1
    model = Augmented(
        names=("gyro1", "gyro2"),
        mean=states_and_law,
        covariance=np.array([np.eye(6)] * 2),
        parts=(Part(law, Term("law", (5, 6), False)),),
        prior=np.ones((2, 4)),
        arw=np.ones(2),
        instability=0.0,
        walk=0.0,
    )
    assert expected_squares([], 0, model, forms_known=True) == 0.0
