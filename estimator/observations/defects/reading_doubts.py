"""A table's angles compared with its own rates: an encoder that jumped, a rate of the wrong sign or scale."""

import numpy as np

from estimator.recordings.reference import TableReadings
from estimator.types import Floats, Stamps

_JUMP_RAD = float(np.radians(0.3))
_TURNING_RPS = float(np.radians(1.0))
_GAP = 3.0  # times the usual step between readings
_FEWEST = 20
_WELL_S = 1e-3  # to which an instant needs to be known
_SIGMAS = 5.0  # of the estimate and of the stated value, by which a scale must be off
_UNSTATED = 1e-4  # standard uncertainty of rates of which none is stated: units of registers are rounded
_STILL_RAD, _STILL_SHARE = float(np.radians(0.02)), 0.01  # by which angles and rates differ while one stands still
_FEWEST_STILL = 5
_STEADY_SHARE = 0.01  # by which a mean rate may change for its scale to be judged


def reading_doubts(readings: TableReadings) -> tuple[str, ...]:
    """Return sentences on the readings of each axis that contradict each other; empty if angles and rates agree.

    They are on angles or rates that stand still, jumps of the encoder, and rates of another scale or sign. Rates that
    were derived from the angles are not compared.
    """
    if not readings.own_rates:
        return ()
    step_s = np.diff(readings.t_ns) * 1e-9
    near = step_s <= _GAP * np.median(step_s)
    width_s = np.zeros(len(step_s) + 1) if readings.half_width_ns is None else readings.half_width_ns * 1e-9
    doubts = []
    for axis, angle, rate in zip(readings.gimbals, readings.angle_rad.T, readings.centred_rps.T, strict=True):
        turned, most = np.diff(angle), np.maximum(np.abs(rate[1:]), np.abs(rate[:-1]))
        summed = (rate[1:] + rate[:-1]) / 2 * step_s
        turned = turned - 2 * np.pi * np.round((turned - summed) / (2 * np.pi))  # angles within one turn
        beyond = np.abs(turned) - most * (1.5 * step_s + width_s[1:] + width_s[:-1]) - _JUMP_RAD
        beyond[~near] = 0.0
        if stood := _still_doubts(axis, readings.t_ns, np.where(near, turned, np.nan), summed, rate):
            doubts += stood
        elif beyond.max(initial=0.0) > 0.0:
            at = int(beyond.argmax())
            off_deg, at_s = np.degrees(turned[at] - summed[at]), (readings.t_ns[at + 1] - readings.t_ns[0]) * 1e-9
            doubts.append(f"the encoder of axis {axis} jumped by {off_deg:+.2f} deg at {at_s:.1f} s")
        # Readings with a far more uncertain instant than most give no information on a scale.
        well = width_s <= 2 * np.median(width_s) + _WELL_S
        steady = (
            near & well[1:] & well[:-1] & (beyond <= 0.0) & (np.abs(np.diff(rate)) < 0.1 * most) & (most > _TURNING_RPS)
        )
        steady &= _change(readings.t_ns, rate, readings.rate_window_ns) <= _STEADY_SHARE * most
        stated = readings.uncertainty.rate if readings.uncertainty else _UNSTATED
        coarse = _quantum(rate) / max(float(most.max(initial=0.0)), _TURNING_RPS)
        doubts += _scale_doubts(axis, turned[steady], summed[steady], max(_SIGMAS * stated, coarse))
    return tuple(doubts)


def _change(t_ns: Stamps, rate: Floats, window_ns: int) -> Floats:
    """Return the change of the rate (n + 1,) within a window before and after each interval (n,); 0 for rates at an
    instant.

    A rate that is a mean over a window is wrong near the corners of ramps.
    """
    if not window_ns:
        return np.zeros(len(t_ns) - 1)
    before = np.searchsorted(t_ns, t_ns[:-1] - window_ns)
    after = np.minimum(np.searchsorted(t_ns, t_ns[1:] + window_ns), len(t_ns) - 1)
    ways = (rate[before], rate[:-1], rate[1:], rate[after])
    return np.asarray(np.max(ways, axis=0) - np.min(ways, axis=0))


def _still_doubts(axis: str, t_ns: Stamps, turned: Floats, summed: Floats, rate: Floats) -> list[str]:
    """Return at most one sentence on angles or rates of ``axis`` that stand still while the others show motion: the
    worst.

    ``turned`` (n,) is how far the angles moved between two of the n + 1 readings, ``summed`` (n,) the integral of their
    ``rate`` (n + 1,).
    """
    worst, told = 0.0, []
    fine_rad, fine_rps = _quantum(np.abs(turned[np.isfinite(turned)])), _quantum(rate)
    for of_angle, still in ((True, turned == 0), (False, (np.diff(rate) == 0) & np.isfinite(turned))):
        edges = np.flatnonzero(np.diff(still.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
        for a, b in edges[np.diff(edges)[:, 0] >= _FEWEST_STILL].tolist():
            way, ought = float(turned[a:b].sum()), float(summed[a:b].sum())
            known = _STILL_RAD + 2 * fine_rad + _STILL_SHARE * max(abs(way), abs(ought))
            known += _SIGMAS * float(np.std(np.diff(turned[a:b] - summed[a:b]))) * (b - a) ** 0.5
            known += fine_rps * (t_ns[b] - t_ns[a]) * 1e-9
            if abs(way - ought) - known <= worst:
                continue
            worst, since = abs(way - ought) - known, f"from {(t_ns[a] - t_ns[0]) * 1e-9:.1f} s on while its"
            if of_angle:
                told = [f"the angle of axis {axis} stood still {since} rates moved it by {np.degrees(ought):+.1f} deg"]
            else:
                stood = f"{since} rate stood at {np.degrees(rate[a]):.3g} deg/s"
                told = [f"the angle of axis {axis} moved by {np.degrees(way):+.3f} deg {stood}"]
    return told


def _quantum(values: Floats) -> float:
    """Return the step in which values come."""
    steps = np.diff(np.unique(values))
    return float(steps.min(initial=np.inf)) if len(steps) else 0.0


def _scale_doubts(axis: str, turned: Floats, summed: Floats, known: float) -> list[str]:
    """Return at most one sentence: the rates' integral differs in scale or sign from the angles, taken as true.

    ``turned`` (n,) is how far the angles of ``axis`` moved between readings, ``summed`` (n,) the integral of its rates;
    ``known`` is the relative uncertainty of the rates. Empty for fewer than ``_FEWEST`` intervals.
    """
    if len(turned) < _FEWEST:
        return []
    share = float(turned @ summed / (turned @ turned))
    sd = float(np.sqrt(np.mean((summed - share * turned) ** 2) / (turned @ turned)))
    if share < 0.0:
        return [f"the rates of axis {axis} have the other sign than its angles"]
    if abs(share - 1) > max(known, _SIGMAS * sd):
        return [f"the rates of axis {axis} are {share - 1:+.2%} off what its angles say".replace("%", " %")]
    return []
