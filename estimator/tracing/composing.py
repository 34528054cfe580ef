"""Laws that the catalogue does not hold, composed of what was measured: what is tried, and how much it is expected.

The grammar is that of ``effects.law``, to a depth of two: a variable or a simple function of one; that through
a lag, or a play, each with one constant to be found; the product of two. Longer laws are the rarer: all laws of one
length together are expected as often as a shorter one less some (Rissanen 1983).
"""

import tomllib
from collections.abc import Iterable, Sequence
from functools import partial
from importlib.resources import files
from itertools import combinations

import numpy as np

from estimator.effects.constructed import constructed
from estimator.effects.effect import Effect
from estimator.effects.law import needs_of
from estimator.estimation.runs.run import Run
from estimator.tracing.candidates import Candidate

_LARGEST_RPS = float(np.radians(0.5))
_RARE = -3.0  # log expectation of a law without a name beside the catalogue's
_LONGER = -1.5  # of each further element of it
_LAGS_S = np.geomspace(4.0, 400.0, 6)
_SHARES = np.array([0.05, 0.2, 0.5])  # of the range of a variable: plays and bends that are looked for first
_LARGEST_SCALE = 1e9
_LAWS = tomllib.loads(files("estimator.tracing").joinpath("laws.toml").read_text(encoding="utf-8"))["length"]


def laws_of(runs: Sequence[Run]) -> list[Candidate]:
    """Return the laws to try on runs, each as a candidate; constants stand at values to begin with."""
    offers = frozenset.intersection(*(run.grid.offers for run in runs))
    gimbals = runs[0].grid.gimbals if len(runs[0].grid.gimbals) > 1 else ()
    found: list[Candidate] = []
    for length, (plain, bent) in enumerate(_listed(offers, gimbals), 1):
        count = len(plain) + len(bent)
        prior = _RARE + _LONGER * (length - 1) - float(np.log(max(count, 1)))
        found += [c for law in plain if (c := _candidate(runs, law, prior)) is not None]
        for law, kind in bent:
            one = _bent(runs, law, kind, prior)
            if one is not None:
                found.append(one)
    return found


def _listed(offers: frozenset[str], gimbals: Sequence[str]) -> Iterable[tuple[list[str], list[tuple[str, str]]]]:
    """Yield by length the laws without a constant, and those with one: text with {c} and what c is."""
    for one in _LAWS:
        bent = [(law, kind) for kind, texts in one.get("bent", {}).items() for law in texts]
        bent += [(law, "lag") for law in one.get("without_temperature", ()) if "temperature" not in offers]
        yield (
            [law for text in one["plain"] for law in _on_axes(text, offers, gimbals)],
            [(law, kind) for text, kind in bent for law in _on_axes(text, offers, gimbals)],
        )


def _on_axes(text: str, offers: frozenset[str], gimbals: Sequence[str]) -> list[str]:
    """Return the laws that a text stands for on a table, but those of what is not known."""
    laws = [text]
    if "{one}" in text:
        laws = [text.replace("{one}", one).replace("{other}", other) for one, other in combinations(gimbals, 2)]
    elif "{axis}" in text:
        laws = [text.replace("{axis}", axis) for axis in gimbals]
    elif "{rates}" in text:
        laws = [text.replace("{rates}", "+".join(f"abs(rate_{axis})" for axis in gimbals))] if gimbals else []
    return [law for law in laws if needs_of(law.replace("{c}", "1")) <= offers]


def _candidate(runs: Sequence[Run], law: str, prior: float) -> Candidate | None:
    largest = _largest(runs, law)
    return None if largest is None else Candidate(f"law: {law}", constructed(law, largest), prior)


def _bent(runs: Sequence[Run], law: str, kind: str, prior: float) -> Candidate | None:
    """Return a law with a constant that is looked for; None where it would be nothing."""
    start = _LAGS_S
    if kind != "lag":
        start = _SHARES * (_range(runs, kind.removeprefix("share ")) if kind.startswith("share") else 0.2)
    if not start[0] > 0:
        return None
    largest = _largest(runs, law.format(c=f"{start[1]:.6g}"))
    if largest is None:
        return None
    of = partial(_made, law, largest)
    return Candidate(
        f"law: {law}",
        of(float(start[1])),
        prior,
        theta=float(start[1]),
        of=of,
        start=start,
        range_log=float(np.log(start[-1] / start[0])),
    )


def _made(law: str, largest: tuple[float, ...], constant: float) -> Effect:
    return constructed(law.format(c=f"{constant:.4g}"), largest)


def _largest(runs: Sequence[Run], law: str) -> tuple[float, ...] | None:
    """Return the coefficients with which the terms of a law vary by the largest bias there is; None if they do not."""
    effect = constructed(law)
    squares = np.zeros(len(effect.parameters))
    for run in runs:
        columns = effect.columns(run.grid, run.array, 0)
        squares = np.maximum(squares, np.nan_to_num(np.mean(columns**2, axis=0), nan=0.0, posinf=0.0))
    if not np.all(squares > _LARGEST_SCALE**-2):
        return None
    return tuple((_LARGEST_RPS / np.sqrt(squares)).tolist())


def _range(runs: Sequence[Run], name: str) -> float:
    values = [constructed(name).columns(run.grid, run.array, 0) for run in runs]
    return max(float(np.ptp(one)) for one in values)
