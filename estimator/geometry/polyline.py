"""An axis whose rate is constant, linear between corners, constant again; and the angle that this sums up to.

Parameters ``p`` (2 k + 2,): instants of k corners in s, rates at them, the angle at the first, and the scale of rate
readings, by which no rate here is multiplied but the slopes of ``modelled``.
"""

import numpy as np

from estimator.types import Floats


def turned(p: Floats, t_s: Floats, window_s: float = 0.0) -> tuple[Floats, Floats]:
    """Return angles and rates at instants (..., n) for a polyline of rates with parameters ``p``.

    ``p`` (2 k + 2,) has the ascending instants of the k corners, the rates there, the angle at the first corner, and
    the scale of rates, which is not used. Before the first and after the last corner the rate is constant. Rates are
    means over the ``window_s`` before each instant, if given.
    """
    k = len(p) // 2 - 1
    corners, rates = p[:k], p[k : 2 * k]
    angle = p[2 * k] + rates[0] * np.minimum(t_s - corners[0], 0.0) + rates[-1] * np.maximum(t_s - corners[-1], 0.0)
    for i, slope in enumerate((np.diff(rates) / np.diff(corners)).tolist()):
        since = np.clip(t_s - corners[i], 0.0, corners[i + 1] - corners[i])
        angle = angle + rates[i] * since + 0.5 * slope * since**2
    if window_s:
        return angle, (angle - turned(p, t_s - window_s)[0]) / window_s
    return angle, np.interp(t_s, corners, rates)


def modelled(p: Floats, t_s: Floats, window_s: float = 0.0) -> tuple[Floats, Floats, Floats]:
    """Return angles and rates at instants (n,) as ``turned``, and their derivatives (2 n, parameters), angles first.

    The derivatives are those of angles and of scaled rates; the rates returned are not scaled.
    """
    k = len(p) // 2 - 1
    corners, rates, scale = p[:k], p[k : 2 * k], p[-1]
    d_angle, d_rate = _slopes(corners, rates, t_s)
    angle = p[2 * k] + rates @ d_angle[k : 2 * k]
    rate = rates @ d_rate[k : 2 * k]
    if window_s:
        before, _ = _slopes(corners, rates, t_s - window_s)
        d_rate = (d_angle - before) / window_s
        rate = rates @ d_rate[k : 2 * k]
    slopes = np.empty((len(p), 2 * len(t_s)))
    slopes[:, : len(t_s)] = d_angle
    slopes[:-1, len(t_s) :] = scale * d_rate[:-1]
    slopes[-1, len(t_s) :] = rate
    return angle, rate, slopes.T


def _slopes(corners: Floats, rates: Floats, t_s: Floats) -> tuple[Floats, Floats]:
    """Return the derivatives (2 k + 2, n) of angles and of rates at instants ``t_s`` (n,) by the parameters.

    ``corners`` and ``rates`` (k,) are those of the polyline; angle and scale follow. Those by the scale are 0.
    ``modelled`` takes the values from those by rates.
    """
    k = len(corners)
    lengths = (corners[1:] - corners[:-1])[:, None]
    bends = (rates[1:] - rates[:-1])[:, None] / lengths
    begun = t_s >= corners[:, None]
    inside = begun[:-1] & ~begun[1:]
    since = np.minimum(np.maximum(t_s - corners[:-1, None], 0.0), lengths)
    x = since / lengths
    # Rate within: rates[i] (1 - x) + rates[i + 1] x, with x = (t - corners[i]) / length.
    share_after = np.where(inside, x, 0.0)
    share_before = np.where(inside, 1 - x, 0.0)
    turned_after = 0.5 * since * x
    turned_before = since - turned_after
    d_angle, d_rate = np.zeros((2, 2 * k + 2, len(t_s)))
    for slopes, before, after in ((d_angle, turned_before, turned_after), (d_rate, share_before, share_after)):
        slopes[: k - 1] -= bends * before
        slopes[1:k] -= bends * after
        slopes[k : 2 * k - 1] += before
        slopes[k + 1 : 2 * k] += after
    d_angle[0] -= rates[0]
    d_angle[k] += np.minimum(t_s - corners[0], 0.0)
    d_angle[2 * k - 1] += np.maximum(t_s - corners[-1], 0.0)
    d_angle[2 * k] = 1.0
    d_rate[k] += ~begun[0]
    d_rate[2 * k - 1] += begun[-1]
    return d_angle, d_rate
