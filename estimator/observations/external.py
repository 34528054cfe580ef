"""Notes on a calibration against another instrument: an attitude, a rate, an encoder."""

import numpy as np

from estimator.geometry.kinematics import axis_text
from estimator.observations.rows import MEAN_S
from estimator.observations.turned import Turned
from estimator.packaged import sentence
from estimator.recordings.recording import Recording
from estimator.recordings.reference import RateReadings

CLUSTER_S = 5.0
"""Length over which residuals against a foreign reference may hang together without the sigma being wrong."""
FAR_OFF = 0.2
"""A factor this far from 1 is no scale factor error of a gyro but a wrong unit, count or sign."""
FEWEST_CLUSTERS = 8
COLOURED = 2.0  # sigmas that grow by more than this are reported
_TURNED = 1e-3  # share of the largest mean square rate from which on a direction counts as turned about
_SELDOM = 1e-3  # that k may be off by


def external_motion_notes(recording: Recording) -> list[str]:
    """Return sentences on what the motion measured by a rate or attitude reference leaves unobserved.

    That is everything for a body at rest, and the other axes for one or two axes of turning. Empty for a body that
    turns about three, without a finite rate, and for other references.
    """
    if recording.reference.at_rest:
        return [sentence("observations.rests_only")]
    rates = recording.reference.external_rates()
    if rates is None:
        return []
    rate = rates.rate_rps[np.isfinite(rates.rate_rps).all(axis=1)]
    if not len(rate):
        return []
    square, directions = np.linalg.eigh(rate.T @ rate)
    turned = directions[:, square > _TURNED * square[-1]].T
    if len(turned) > 2:
        return []
    what = " and ".join(axis_text(v / v[np.argmax(np.abs(v))], 0.99).strip('"') for v in turned)
    return [sentence("observations.one_axis", axes=what)]


def sparse_doubts(recording: Recording) -> list[str]:
    """Return a sentence if a rate reference is read too seldom to give the motion between its readings; else none.

    The gyros' own data, sampled at its instants only, are compared with all of them. Other references, and bodies at
    rest, are not doubted.
    """
    reference = recording.reference
    if not isinstance(reference, RateReadings) or reference.at_rest:
        return []
    read_s = reference.t_ns * 1e-9
    step_s = float(np.median(np.diff(read_s, prepend=0.0)))
    for data in recording.sources.values() if step_s > MEAN_S else ():
        t_s = data.t_ns * 1e-9
        thin = np.column_stack([np.interp(read_s, t_s, column) for column in data.rate_rps.T])
        edges = np.arange(max(t_s[0], read_s[0]), min(t_s[-1], read_s[-1]), 2 * step_s)
        both = Turned.of_rates(data.t_ns, data.rate_rps), Turned.of_rates(reference.t_ns, thin, np.inf)
        means = np.stack([one.means(edges[:-1], edges[1:]) for one in both])
        whole, seen = means[:, np.isfinite(means).all(axis=(0, 2))]
        if len(whole) < FEWEST_CLUSTERS:
            continue
        slope = np.sum((whole - whole.mean(axis=0)) * seen) / np.sum((whole - whole.mean(axis=0)) ** 2)
        if abs(slope - 1) > _SELDOM:
            return [sentence("observations.seldom_read", step_s=step_s)]
    return []


def factor_notes(name: str, k: float, sd: float) -> list[str]:
    """Return, in words, that k is no scale factor error but a wrong sign or unit, if it is."""
    if abs(k) < FAR_OFF + 3 * sd:
        return []
    if abs(k - 2) < FAR_OFF:
        return [f"{name}: its output is opposite to the reference, so k is near 2. Reverse the sign of its axis"]
    return [sentence("observations.far_off", gyro=name, factor=1 - k)]
