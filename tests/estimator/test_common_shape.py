"""One shape for all gyros: it is found where there is one, from the terms that it needs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimator.effects.constructed import constructed
from estimator.effects.law import in_words
from estimator.tracing.candidates import Candidate
from estimator.tracing.laws.common_shape import joined, shape_of, shape_of_needed, shaped
from estimator.tracing.laws.needed import needed

ROWS, TERMS = 400, 12
SIZES = np.array([0.3, -0.2, 0.1, 0.4])


def products(coefficients: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the products of bends with each other and with outputs of gyros of these coefficients (gyros, p)."""
    random = np.random.default_rng(seed)
    position = np.linspace(0, 1, ROWS)
    columns = np.column_stack([30 * np.maximum(position - n / TERMS, 0.0) for n in range(TERMS)])
    outputs = coefficients @ columns.T + random.standard_normal((len(coefficients), ROWS))
    return np.array([columns.T @ columns] * len(coefficients)), outputs @ columns


def test_the_shape_of_all_gyros_is_found_from_the_terms_that_it_needs() -> None:
    true = np.zeros(TERMS)
    true[[2, 7]] = 1.0, -1.5
    found = shape_of_needed(*products(np.outer(SIZES, true), 1))
    assert found.terms == (2, 7)
    assert found.along * np.sign(found.along[0]) == pytest.approx(true[[2, 7]] / np.hypot(1, 1.5), abs=0.02)


def test_one_shape_is_the_more_probable_where_gyros_have_one_and_not_where_they_differ() -> None:
    random = np.random.default_rng(2)
    shape = random.standard_normal(TERMS)
    alike = products(np.outer(SIZES, shape), 3)
    differing = products(random.standard_normal((4, TERMS)), 3)
    assert shape_of(*alike).worth > needed(*alike).worth + 5
    assert shape_of_needed(*differing).worth < needed(*differing).worth - 5


def test_a_law_of_one_shape_is_the_sum_of_its_terms_and_keeps_its_constant_open() -> None:
    def law(lag_s: float) -> object:
        return constructed(f"lag(T, {lag_s:g}); T**2", (2.0, 1.0))

    candidate = Candidate.among("law: lag(T, {c}); T**2", law, np.array([5.0, 50.0]), 1, unit="s")  # type: ignore[arg-type]
    found = shape_of(*(one[..., :2, :2] if one.ndim == 3 else one[..., :2] for one in products(np.ones((2, TERMS)), 4)))
    one = shaped(candidate, found)
    assert one is not None
    assert len(one.effect.parameters) == 1
    assert "lag(T, 50)" in one.law
    assert one.of is not None
    assert "lag(T, 7)" in one.of(7.0).law
    assert in_words(one.law).startswith("bias proportional to ")
    assert (one.log_tries, one.log_choices) == (candidate.log_tries, found.log_tries)
    assert joined([one, candidate]) is None


def test_laws_are_joined_to_one_whose_constant_stays_open() -> None:
    tuned = Candidate.among("law: lag(T, {c})", lambda s: constructed(f"lag(T, {s:g})", (2.0,)), np.array([5.0, 50.0]))
    plain = Candidate("law: T**2", constructed("T**2", (3.0,)), log_prior=-4.0)
    both = joined([tuned, plain])
    assert both is not None
    assert both.law == "lag(T, 5); T**2"
    assert both.of is not None
    assert both.of(7.0).law == "lag(T, 7); T**2"
    assert both.log_prior == -4.0
    assert both.effect.largest == pytest.approx([2.0, 3.0])
    long = Candidate("law: long", constructed("; ".join(["abs(u - 0.12345)"] * 100)))
    assert joined([long, replace(long, name="law: other")]) is None


def test_a_sum_of_many_terms_is_described_by_what_it_depends_on() -> None:
    law = "+".join(f"({n + 1}e-2)*(abs(T-{n})+(T-{n}))" for n in range(6))
    assert in_words(law) == "bias that depends on temperature above 25 degC (6 bends, one shape for all gyros)"
    assert in_words("(1)*(u*gs)+(-0.5)*(t)") == (
        "bias proportional to 1 x (rate about the sense axis times specific force along the sense axis)"
        " - 0.5 x (time since the start)"
    )
