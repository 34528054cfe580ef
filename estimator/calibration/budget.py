"""The table's own uncertainty in the states of a gyro: type B contributions, combined according to the GUM.

Each imperfection of the table is put into the body rate that the estimate believes in, at the size of its standard
uncertainty, and what the states move by is its contribution (GUM 5.1.3: sensitivity times standard uncertainty).
Imperfections of different axes and kinds are independent; their contributions add in squares.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from estimator.geometry.array import SensorArray
from estimator.geometry.kinematics import AXES, Site, body_rate, into_body
from estimator.geometry.model import Prior, regressor_maps
from estimator.recordings.reference import TableReadings
from estimator.types import Floats

KINDS = ("rate", "wobble", "orthogonality", "timing")
"""Names of the contributions of a table."""
TYPE_A = ("noise", "effects")
"""Names of what comes from the scatter of the data, and from effects of an error model that they do not show."""
UNSEEN = "unseen_effects"
"""Name of what undeclared effects of the catalogue could do to the states without being seen (type B)."""
UNMEASURED = "unmeasured_conditions"
"""Name of what they could do by conditions that were not recorded: temperature, pose (type B)."""


_FEWEST = 8  # readings of a table
_STEP_RAD = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Contribution:
    """One line of a gyro's budget: its covariance (4, 4) in the states [k, b, s_j, s_k]."""

    name: str
    covariance: Floats

    @property
    def u(self) -> Floats:
        """Standard uncertainty of each state (4,) from this line."""
        return np.sqrt(np.diag(self.covariance))


def merged(lines: Sequence[Contribution]) -> tuple[Contribution, ...]:
    """Return lines of which each name comes once, with the sum of the covariances."""
    found: dict[str, Floats] = {}
    for line in lines:
        found[line.name] = found.get(line.name, np.zeros((4, 4))) + line.covariance
    return tuple(Contribution(name, covariance) for name, covariance in found.items())


def table_budget(
    readings: TableReadings, site: Site | None, array: SensorArray, prior: Prior, arw_rps_rthz: Floats
) -> list[tuple[Contribution, ...]]:
    """Return for each of m gyros the contributions of the table, one for each of ``KINDS``.

    They are empty tuples if the table states no uncertainty or has fewer than eight readings. ``arw_rps_rthz`` (m,)
    only determines the weight of the prior relative to the data, as in the estimate itself.
    """
    if readings.uncertainty is None or len(readings.t_ns) < _FEWEST:
        return [() for _ in array.names]
    fit = _Fit.of(readings, site, array, prior, arw_rps_rthz)
    covariances = {kind: np.zeros((len(array), 4, 4)) for kind in KINDS}
    for kind, change in _changes(readings, fit.t_s, fit.w_rps):
        shifts = fit.shifts(slice(None), change)
        covariances[kind] += shifts[:, :, None] * shifts[:, None, :]
    return [tuple(Contribution(kind, covariances[kind][i]) for kind in KINDS) for i in range(len(array))]


def rest_angle_covariances(
    readings: TableReadings,
    site: Site | None,
    array: SensorArray,
    prior: Prior,
    arw_rps_rthz: Floats,
    sd_rad: Floats,
) -> Floats:
    """Return the covariances (m, 4, 4) of the states that come of axes which stand off their readings.

    ``sd_rad`` (g,) is the standard deviation of the angle at which an axis stands, the same until it moves again; 0 or
    infinite for axes whose readings are not rounded. ``arw_rps_rthz`` (m,) is as in ``table_budget``. They are 0 for
    fewer than eight readings.
    """
    covariances = np.zeros((len(array), 4, 4))
    if len(readings.t_ns) >= _FEWEST:
        fit = _Fit.of(readings, site, array, prior, arw_rps_rthz)
        for place, (sd, stands_ns) in enumerate(zip(sd_rad.tolist(), readings.stands_ns, strict=True)):
            if not 0 < sd < np.inf:
                continue
            moved_rad = readings.angle_rad.copy()
            moved_rad[:, place] += _STEP_RAD
            moved_rps = body_rate(moved_rad, readings.centred_rps, readings.gimbals, site)
            change = (moved_rps - fit.w_rps) * (sd / _STEP_RAD)
            for first_ns, last_ns in stands_ns:
                begin, end = np.searchsorted(readings.t_ns, [first_ns, last_ns + 1])
                shifts = fit.shifts(slice(int(begin), int(end)), change[begin:end])
                covariances += shifts[:, :, None] * shifts[:, None, :]
    return covariances


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class _Fit:
    """A fit of the states of m gyros to n readings of a table, under white noise.

    ``w_rps`` (n, 3) is the body rate, ``regressors`` (n, 4) are one and the rate, ``gains`` (m, 4, 4) turn the sums of
    their products with the output error of a gyro, times ``period_s``, into its states.
    """

    t_s: Floats
    w_rps: Floats
    period_s: float
    regressors: Floats
    gains: Floats
    p: Floats

    @classmethod
    def of(
        cls, readings: TableReadings, site: Site | None, array: SensorArray, prior: Prior, arw_rps_rthz: Floats
    ) -> Self:
        """Return the fit to at least ``_FEWEST`` readings; ``arw_rps_rthz`` (m,) gives the weight of the prior."""
        t_s = (readings.t_ns - readings.t_ns[0]) * 1e-9
        period_s = float(t_s[-1]) / (len(t_s) - 1)
        w_rps = body_rate(readings.angle_rad, readings.centred_rps, readings.gimbals, site)
        regressors = np.column_stack([np.ones(len(w_rps)), w_rps])
        shared = regressors.T @ regressors * period_s
        gains = []
        for arw, own in zip(arw_rps_rthz.tolist(), regressor_maps(array), strict=True):
            information = own @ shared @ own.T + arw**2 * np.diag(1 / prior.variances())
            gains.append(np.linalg.solve(information, own))
        return cls(t_s=t_s, w_rps=w_rps, period_s=period_s, regressors=regressors, gains=np.array(gains), p=array.p)

    def shifts(self, rows: slice, change_rps: Floats) -> Floats:
        """Return by how much the states (m, 4) move if the body rate is off by ``change_rps`` (k, 3) at k ``rows``."""
        seen = self.regressors[rows].T @ change_rps * self.period_s  # (4, 3): the output error receives p . change
        return np.asarray(np.einsum("mij,jx,mx->mi", self.gains, seen, self.p))


def _changes(readings: TableReadings, t_s: Floats, w: Floats) -> Iterator[tuple[str, Floats]]:
    """Yield (kind, change) of each imperfection of the table: the change (rows, 3) of the body rate ``w`` by one sigma.

    Kinds are rate, orthogonality, wobble and timing, all but the last once or more for each axis. Nothing if the table
    states no uncertainty.
    """
    u, gimbals = readings.uncertainty, readings.gimbals
    if u is None:
        return
    for column, axis in enumerate(gimbals):
        angle, rate = readings.angle_rad[:, column], readings.centred_rps[:, column]
        inner_angles, inner = readings.angle_rad[:, column + 1 :], gimbals[column + 1 :]
        own = np.eye(3)[AXES.index(axis)]
        yield "rate", u.rate * rate[:, None] * into_body(own, inner_angles, inner)
        for other in range(3):
            if AXES[other] == axis:
                continue
            across = into_body(np.eye(3)[other], inner_angles, inner)
            yield "orthogonality", u.orthogonality_rad * rate[:, None] * across
            for wave in (np.cos(angle), np.sin(angle)):
                yield "wobble", u.wobble_rad * (wave * rate)[:, None] * across
    yield "timing", u.timing_s * np.gradient(w, t_s, axis=0)
