"""Flexible laws: any function of a law's variable, as a sum of terms with a coefficient each.

A law in closed form, such as ``tanh(u/c)``, is one function of its variable among all. These stand for the others: a
function that bends at some of many nodes, or changes near some of many angles, a memory that is any sum of first-order
lags, a hysteresis that is any sum of plays (Prandtl, Ishlinskii), a relaxation that is any sum of decays (Prony). Where
a closed form is right it explains as much with far fewer numbers, so it is the more probable; where it is not, they
are. Of their many terms those are left out that the data do not need (``needed``).
"""

from collections.abc import Sequence

import numpy as np

from estimator.effects.constructed import constructed
from estimator.effects.law import needs_of
from estimator.estimation.runs.run import Run
from estimator.types import Floats

_NODES, _FORCE_NODES = 32, 12
_ALIKE, _NEAR = 16, 6  # nodes at equal distances up to the largest rate, and halvings of the first towards rest
_DIRECTIONS, _WIDTH_RAD = 24, np.pi / 8
_TAUS_S = np.geomspace(4.0, 400.0, 6)
_PLAYS = np.array([0.02, 0.05, 0.1, 0.2, 0.4, 0.8])  # of the range


def flexible_laws(runs: Sequence[Run], offers: frozenset[str], gimbals: Sequence[str]) -> list[tuple[str, str]]:
    """Return flexible laws as texts, with the kind of the constant {c} that is still to be found in each ("" for none).

    A flexible law is a sum of terms that together follow any function of a variable, separated by "; ". ``offers`` are
    the quantities beside rates and times that all runs hold; without a temperature its laws are left out. ``gimbals``
    are the axes of the table to follow functions of. Laws without terms are left out, too.
    """
    size, speed = (_bends(name, _nodes_of_rate(name, runs)) for name in ("abs(u)", "speed"))
    decays = _each("expm1(-t/{})", _TAUS_S)
    plays = _each("play(u,{})", _PLAYS * _range_of("u", runs))
    fixed = [_bends("u", _nodes_of_rate("u", runs)), size, _times(size, "sign(u)"), speed, _times(speed, "u")]
    fixed += [decays, _times(decays, "u"), plays]
    for axis in gimbals:
        around = _bumps(f"angle_{axis}")
        fixed += [around, _times(around, f"u_{axis}")]
        if len(gimbals) > 1:  # the rate of a single axis is that of the body
            fixed.append(_bends(f"rate_{axis}", _nodes_of_rate(f"rate_{axis}", runs)))
    fixed.append(_bends("a", _nodes_of_rate("a", runs)))
    forces = [name for name in ("gs", "gx", "gy", "gz") if needs_of(name) <= offers]
    fixed += [_bends(name, _nodes(name, runs, _FORCE_NODES)) for name in forces]
    lagged = [_lagged(speed), _times(_lagged(speed), "u")]
    if "temperature" in offers:
        warmth = _bends("T", _nodes("T", runs))
        memory = _each("lag(T,{})-T", _TAUS_S)
        fixed += [warmth, _times(warmth, "u"), memory, _times(memory, "u")]
        fixed += [_each("play(T,{})", _PLAYS * _range_of("T", runs))]
        lagged += [_with("T", "lag(T,{c})", warmth)]
    laws = [(terms, "") for terms in fixed] + [(terms, "lag") for terms in lagged]
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


def _nodes_of_rate(name: str, runs: Sequence[Run]) -> list[float]:
    """Return nodes at equal distances over the range of a rate, and closer and closer towards rest.

    Nodes below 0 mirror those above, if the rate is ever negative. Empty without a rate.
    """
    low, high = _ends(name, runs)
    top = max(abs(low), abs(high))
    if top <= 0:
        return []
    step = top / _ALIKE
    above = [*(step * 0.5**n for n in range(_NEAR, 0, -1)), *(step * n for n in range(1, _ALIKE))]
    below = [-node for node in reversed(above)] if low < 0 else []
    return [*below, 0.0, *above]


def _nodes(name: str, runs: Sequence[Run], count: int = _NODES) -> list[float]:
    """Return ``count`` nodes at equal distances over the range of a variable in the runs; empty if it does not vary.

    They are whole multiples of their distance, above the lowest value and up to the highest; NaN is ignored.
    """
    low, high = _ends(name, runs)
    if not high > low:
        return []
    step = (high - low) / count
    first = step * np.floor(low / step)
    return [float(first + step * n) for n in range(1, count + 1)]


def _bends(name: str, nodes: Sequence[float]) -> list[str]:
    """Return a term for each node, which is zero on the side of the node where 0 is, and a straight line on the other.

    ``name`` is the variable. Their sum with any coefficients goes on beyond the last nodes as it came there.
    """
    terms = []
    for node in nodes:
        shown = float(f"{node:.4g}")
        away = "+" if shown >= 0 else "-"
        terms.append(f"abs({_less(name, shown)}){away}({_less(name, shown)})")
    return terms


def _bumps(name: str) -> list[str]:
    """Return a term for each of many directions of an angle ``name``: positive near the direction, zero elsewhere."""
    edge = f"{np.cos(_WIDTH_RAD):.4g}"
    near = [f"cos({_less(name, float(f'{at:.4g}'))})-{edge}" for at in np.arange(_DIRECTIONS) * 2 * np.pi / _DIRECTIONS]
    return [f"abs({one})+({one})" for one in near]


def _less(name: str, value: float) -> str:
    """Return a variable less a value."""
    return f"{name}{-value:+.6g}" if value else name


def _each(term: str, constants: Floats) -> list[str]:
    return [term.format(f"{constant:.4g}") for constant in constants.tolist() if constant > 0]


def _times(terms: Sequence[str], factor: str) -> list[str]:
    return [f"{factor}*({term})" for term in terms]


def _lagged(terms: Sequence[str]) -> list[str]:
    return [f"lag({term},{{c}})" for term in terms]


def _with(name: str, other: str, terms: Sequence[str]) -> list[str]:
    return [term.replace(name, other) for term in terms]
