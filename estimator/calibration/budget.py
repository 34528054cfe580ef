"""The table's own uncertainty in the states of a gyro: type B contributions, combined according to the GUM.

Each imperfection of the table is put into the body rate that the estimate believes in, at the size of its standard
uncertainty, and what the states move by is its contribution (GUM 5.1.3: sensitivity times standard uncertainty).
Imperfections of different axes and kinds are independent; their contributions add in squares.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

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
    """Return the contributions of the table for each gyro, one for each of ``KINDS``.

    Without any for each if the table states no uncertainty or has fewer than eight readings.

    ``arw_rps_rthz`` (m,) only determines the weight of the prior relative to the data, as in the estimate itself.
    """
    if readings.uncertainty is None or len(readings.t_ns) < 8:
        return [() for _ in array.names]
    t_s = (readings.t_ns - readings.t_ns[0]) * 1e-9
    period_s = float(t_s[-1]) / (len(t_s) - 1)
    w = body_rate(readings.angle_rad, readings.centred_rps, readings.gimbals, site)
    regressors = np.column_stack([np.ones(len(w)), w])
    shared = regressors.T @ regressors * period_s
    maps = regressor_maps(array)
    gains = []
    for i in range(len(array)):
        information = maps[i] @ shared @ maps[i].T + arw_rps_rthz[i] ** 2 * np.diag(1 / prior.variances())
        gains.append(np.linalg.solve(information, maps[i]))
    covariances = {kind: np.zeros((len(array), 4, 4)) for kind in KINDS}
    for kind, change in _changes(readings, t_s, w):
        seen = regressors.T @ change * period_s  # (4, 3): the output error receives p . change
        for i in range(len(array)):
            shift = gains[i] @ (seen @ array.p[i])
            covariances[kind][i] += np.outer(shift, shift)
    return [tuple(Contribution(kind, covariances[kind][i]) for kind in KINDS) for i in range(len(array))]


def _changes(readings: TableReadings, t_s: Floats, w: Floats) -> Iterator[tuple[str, Floats]]:
    """Yield (kind, change) of each imperfection of the table: the change (rows, 3) of the body rate ``w`` by one sigma.

    Kinds are rate, orthogonality, wobble and timing; nothing if the table states no uncertainty.
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
