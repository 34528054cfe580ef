"""Flexible laws: any function of a law's variable, as a sum of terms with a coefficient each.

A law in closed form, such as ``tanh(u/c)``, is one function of its variable among all. These stand for the others: a
function in straight pieces, a memory that is any sum of first-order lags, a hysteresis that is any sum of plays
(Prandtl, Ishlinskii), a relaxation that is any sum of decays (Prony). Where a closed form is right it explains as much
with far fewer numbers, so it is the more probable; where it is not, they are.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from estimator.effects.constructed import constructed
from estimator.estimation.runs.run import Run
from estimator.types import Floats

_PIECES = (10, 26)
_HALVINGS = 9
_TAUS_S = np.geomspace(4.0, 400.0, 6)
_PLAYS = np.array([0.02, 0.05, 0.1, 0.2, 0.4, 0.8])  # of the range


def flexible_laws(runs: Sequence[Run], offers: frozenset[str]) -> list[tuple[str, str]]:
    """Return flexible laws, each with the kind of the constant {c} that is still to be found in it ("" for none).

    ``offers`` are the quantities beside rates and times that all runs hold; without a temperature its laws are left
    out. Laws without terms are left out, too.
    """
    speed, decays = _halved("speed", runs), _each("expm1(-t/{})", _TAUS_S)
    laws = [(terms, "") for terms in (_halved("u", runs), speed, _times(speed, "u"), decays, _times(decays, "u"))]
    laws += [(_each("play(u,{})", _PLAYS * _range_of("u", runs)), "")]
    laws += [(_lagged(speed), "lag"), (_times(_lagged(speed), "u"), "lag")]
    if "temperature" in offers:
        warmth, finer = (_pieces("T", runs, count) for count in _PIECES)
        memory = _each("lag(T,{})-T", _TAUS_S)
        laws += [(terms, "") for terms in (warmth, finer, _times(warmth, "u"), memory, _times(memory, "u"))]
        laws += [(_each("play(T,{})", _PLAYS * _range_of("T", runs)), "")]
        laws += [(_with("T", "lag(T,{c})", warmth), "lag")]
    return [("; ".join(terms), kind) for terms, kind in laws if terms]


def values_of(name: str, runs: Sequence[Run]) -> list[Floats]:
    """Return the values (n, 1) of a variable, of each gyro of each run."""
    effect = constructed(name)
    return [effect.columns(run.grid, run.array, gyro) for run in runs for gyro in range(len(run.array))]


def _range_of(name: str, runs: Sequence[Run]) -> float:
    low, high = _ends(name, runs)
    return high - low


def _ends(name: str, runs: Sequence[Run]) -> tuple[float, float]:
    """Return the least and the largest value of a variable over all gyros of the runs."""
    values = values_of(name, runs)
    return min(float(np.nanmin(one)) for one in values), max(float(np.nanmax(one)) for one in values)


def _halved(name: str, runs: Sequence[Run]) -> list[str]:
    """Return the terms of a function of a rate in pieces that get shorter toward rest; none if the rate is always
    zero.
    """
    low, high = _ends(name, runs)
    top = max(abs(low), abs(high))
    if top <= 0:
        return []
    above = top * 0.5 ** np.arange(_HALVINGS, dtype=np.float64)[::-1]
    below = -above[::-1] if low < 0 else above[:0]
    return _straight(name, [*below.tolist(), 0.0, *above.tolist()])


def _pieces(name: str, runs: Sequence[Run], count: int) -> list[str]:
    """Return the terms of a function of a variable in about ``count`` pieces of equal length; none if it does not
    vary.
    """
    low, high = _ends(name, runs)
    if not high > low:
        return []
    step = (high - low) / count
    first = step * np.floor(low / step)
    return _straight(name, (first + step * np.arange(count + 2)).tolist())


def _straight(name: str, nodes: Sequence[float]) -> list[str]:
    """Return the terms of a function that is straight from node to node, flat beyond, and zero at zero.

    Each term rises over one piece, and is zero on its side nearer to zero.
    """
    shown = [float(f"{node:.4g}") for node in nodes]
    terms = []
    for near, far in pairwise(shown):
        rising = f"abs({_less(name, near)})-abs({_less(name, far)})"
        constant = far - near if near >= 0 or abs(near) < abs(far) else near - far
        terms.append(f"{rising}{constant:+.6g}")
    return terms


def _less(name: str, value: float) -> str:
    return f"{name}{-value:+.6g}" if value else name


def _each(term: str, constants: Floats) -> list[str]:
    return [term.format(f"{constant:.4g}") for constant in constants.tolist() if constant > 0]


def _times(terms: Sequence[str], factor: str) -> list[str]:
    return [f"{factor}*({term})" for term in terms]


def _lagged(terms: Sequence[str]) -> list[str]:
    return [f"lag({term},{{c}})" for term in terms]


def _with(name: str, other: str, terms: Sequence[str]) -> list[str]:
    return [term.replace(name, other) for term in terms]
