"""Laws that the catalogue does not hold, composed of what was measured: what is tried, and how much it is expected.

The grammar is that of ``effects.constructed``, to a depth of two: a variable or a simple function of one; that through
a lag, or a play, each with one constant to be found; the product of two. Longer laws are the rarer: all laws of one
length together are expected as often as a shorter one less some (Rissanen 1983).
"""

from collections.abc import Iterable, Sequence
from functools import partial

import numpy as np

from estimator.effects.constructed import constructed
from estimator.effects.effect import Effect
from estimator.estimation.runs.run import Run
from estimator.tracing.candidates import Candidate

_LARGEST_RPS = float(np.radians(0.5))
_RARE = -3.0  # log expectation of a law without a name beside the catalogue's
_LONGER = -1.5  # of each further element of it
_LAGS_S = np.geomspace(4.0, 400.0, 6)
_SHARES = np.array([0.05, 0.2, 0.5])  # of the range of a variable: plays and bends that are looked for first
_LARGEST_SCALE = 1e9


def laws_of(runs: Sequence[Run]) -> list[Candidate]:
    """Return the laws to try on runs, each as a candidate; constants stand at values to begin with."""
    offers = frozenset.intersection(*(run.grid.offers for run in runs))
    gimbals = runs[0].grid.gimbals if len(runs[0].grid.gimbals) > 1 else ()
    found: list[Candidate] = []
    lists = _listed("temperature" in offers, "specific force" in offers, gimbals)
    for length, (plain, bent) in enumerate(lists, 1):
        count = len(plain) + len(bent)
        prior = _RARE + _LONGER * (length - 1) - float(np.log(max(count, 1)))
        found += [c for law in plain if (c := _candidate(runs, law, prior)) is not None]
        for law, kind in bent:
            one = _bent(runs, law, kind, prior)
            if one is not None:
                found.append(one)
    return found


def _listed(warm: bool, heavy: bool, gimbals: Sequence[str]) -> Iterable[tuple[list[str], list[tuple[str, str]]]]:
    """Yield by length the laws without a constant, and those with one: text with {c} and what c is."""
    forces = ["gx", "gy", "gz", "gs"] if heavy else []
    rates = ["u", "wx", "wy", "wz"]
    waves = [f"cos({m}*angle_{axis}); sin({m}*angle_{axis})" for axis in gimbals for m in range(1, 7)]
    first = ["abs(u)", "u**2", "u**3", "sign(u)", "last(u)", "speed", "abs(a)", "jolt", "t", *forces, *waves]
    first += [f"last(rate_{axis})" for axis in gimbals] + [f"abs(rate_{axis})" for axis in gimbals]
    first += ["T", "Tdot"] if warm else []
    yield first, []
    second = ["u**4", "sqrt(abs(u))", "sign(u)*sqrt(abs(u))", "a**2", "jolt**2", "speed**2", "sqrt(t)"]
    second += ["last(u)*speed", "a*abs(u)", "u*jolt", "a*u", "a*t"]
    second += ["T**2", "T**3", "Tdot**2", "abs(Tdot)", "last(Tdot)", "T*t", "T*a"] if warm else []
    products = [*rates, "abs(u)", "t", *(["T"] if warm else [])]
    second += [f"{x}*{f}" for x in products for f in forces]
    second += [f"{x}*{y}" for n, x in enumerate(rates[1:]) for y in rates[n + 1 :]]
    second += [f"u*{x}" for x in ("t", "wx", "wy", "wz", *(["T"] if warm else []))] + [
        f"abs(u)*{x}" for x in ("t", *(["T"] if warm else []))
    ]
    second += [f"{x}*{y}" for n, x in enumerate(forces) for y in forces[n:]] + [f"abs({f})" for f in forces]
    for axis in gimbals:
        for m in range(1, 5):
            second.append(f"u_{axis}*cos({m}*angle_{axis}); u_{axis}*sin({m}*angle_{axis})")
            second.append(f"abs(rate_{axis})*cos({m}*angle_{axis}); abs(rate_{axis})*sin({m}*angle_{axis})")
    for n, one in enumerate(gimbals):
        for other in gimbals[n + 1 :]:
            for sign in "+-":
                both = f"angle_{one}{sign}angle_{other}"
                second.append(f"cos({both}); sin({both})")
    bent = [(f"lag({x}, {{c}})", "lag") for x in ("abs(u)", "speed", "sign(u)")]
    bent += [(f"lag({x}, {{c}})", "lag") for x in ("u**2", "speed**2", "speed")] if not warm else []
    bent += [("lag(T, {c})", "lag"), ("play(T, {c})", "share T"), ("exp(T/{c})", "share T")] if warm else []
    bent += [("log1p(t/{c})", "share t"), ("exp(-t/{c})", "share t")]
    bent += [("sign(u)*log1p(abs(u)/{c})", "share u"), ("tanh(u/{c})", "share u"), ("log1p(abs(u)/{c})", "share u")]
    bent += [(f"play(angle_{axis}, {{c}})", "small") for axis in gimbals]
    yield second, bent
    third = [("lag(u**2, {c})", "lag"), ("lag(speed**2, {c})", "lag"), ("lag(jolt, {c})", "lag")]
    third += [("u*lag(T, {c})", "lag"), ("abs(u)*lag(T, {c})", "lag"), ("u*play(T, {c})", "share T")] if warm else []
    third += [(f"{f}*lag(T, {{c}})", "lag") for f in forces] if warm else []
    third += [("u*lag(speed, {c})", "lag"), ("u*log1p(t/{c})", "share t"), ("u*exp(-t/{c})", "share t")]
    third += [(f"lag(abs(rate_{axis}), {{c}})", "lag") for axis in gimbals]
    total = "+".join(f"abs(rate_{axis})" for axis in gimbals)
    third += [(f"lag({total}, {{c}})", "lag")] if gimbals else []
    yield [f"abs({x})*{y}" for x in rates[1:] for y in rates[1:] if x != y], third


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
