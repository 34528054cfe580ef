"""Regressors of an error model's effects at single samples, for the live filter and its comparison."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from estimator.calibration.error_model import ErrorModel
from estimator.effects.conditions import Conditions
from estimator.effects.constructed import readable
from estimator.effects.effect import Acts
from estimator.estimation.gram import Solution
from estimator.geometry.array import SensorArray
from estimator.geometry.kinematics import Site
from estimator.geometry.model import Prior, regressor_maps
from estimator.recordings.motion.body_rates import BodyRates
from estimator.recordings.recording import ImuData, Recording
from estimator.types import Floats, Stamps

_ON_A_TABLE = frozenset({"gimbals", "specific force", "temperature"})
_CHUNK_ROWS = 8192


class SampleColumns:
    """The effects of a model as columns at single samples, for the live filter.

    Columns are scaled by the expected sigma of each parameter, so that their prior is one. Each gyro has all effects to
    itself, also those that are shared, under the same prior. Effects that cannot be estimated live are left out, which
    ``notes`` say.
    """

    def __init__(self, model: ErrorModel, gimbals: Sequence[str], site: Site | None, array: SensorArray) -> None:
        """Take the effects of a model that can be estimated live; ``notes`` name the others, which are left out.

        Raises ModelError if the table does not fit the model.
        """
        made = zip(model.effects, model.made(gimbals, _ON_A_TABLE), strict=True)
        self._parts = [(known, effect) for known, effect in made if not known.record.not_live]
        self._gimbals, self._site, self._array = tuple(gimbals), site, array
        self._needs_temperature = any("temperature" in effect.needs for _, effect in self._parts)
        self._scale = np.concatenate([np.empty(0), *(known.sd for known, _ in self._parts)])
        self._expected = np.concatenate([np.empty(0), *(known.mean for known, _ in self._parts)])
        self.notes = tuple(
            f"{readable(known.called)} {known.record.not_live}: it is missing in the live estimate, but "
            "included in the calibration"
            for known in model.effects
            if known.record.not_live
        )

    @property
    def holds_delay(self) -> bool:
        """Whether one of them is a delay of the samples."""
        return any(effect.acts is Acts.STAMPS for _, effect in self._parts)

    @property
    def count(self) -> int:
        """Parameters of each gyro."""
        return len(self._scale)

    def at(self, rates: BodyRates, t_ns: Stamps, temperature_c: Floats) -> tuple[Floats, Floats]:
        """Return the columns (rows, m, p) at instants, and the outputs (rows, m) that the expected effects give.

        Columns are times the expected standard deviations of their parameters. Values are NaN where an effect needs the
        temperature and it is not known. Instants are in order, as for ``BodyRates.at``.
        """
        # Effects of time count from the first instant of the conditions: the first reading of the table.
        t_s = np.concatenate([[rates.starts_ns * 1e-9], t_ns * 1e-9])
        angle, rate = rates.gimbals_at(t_ns)
        angle, rate, slope = (np.vstack([part[:1], part]) for part in (angle, rate, rates.accelerations_at(t_ns)))
        temperature = np.concatenate([temperature_c[:1], temperature_c]) if self._needs_temperature else None
        conditions = Conditions.on_table(
            t_s, angle, rate, slope, self._gimbals, temperature_c=temperature, site=self._site
        )
        columns = np.empty((len(t_ns), len(self._array), self.count))
        for gyro in range(len(self._array)):
            own = [effect.columns(conditions, self._array, gyro)[1:] for _, effect in self._parts]
            columns[:, gyro] = np.hstack([np.empty((len(t_ns), 0)), *own])
        return columns * self._scale, np.asarray(columns @ self._expected)


def white_solution(
    recording: Recording,
    data: ImuData,
    columns: SampleColumns | None,
    prior: Prior,
    noise_rps: Floats,
    offset_sd_s: float = 0.0,
    taken_off: tuple[Sequence[int], Sequence[float]] = ((), ()),
) -> Solution:
    """Return the states of a source on a table, estimated with effects under white noise from all samples at once.

    ``columns`` are the effects, None for none; their estimates are not returned. ``noise_rps`` (m,) is that of one
    sample, ``offset_sd_s`` the expected sigma of their time offset, 0 for none. ``taken_off`` are instants in ns and
    the offset in s subtracted up to each, as ``LiveFilter`` used them: the problem is linear about these. Samples with
    NaN, outside the readings, or without a known rate or needed temperature are left out.
    """
    table = recording.table
    assert table is not None, "samples are compared with the readings of a table"
    rates = BodyRates.of(table, recording.site)
    m, count = len(data.array), columns.count if columns is not None else 0
    width = 4 + count
    maps = regressor_maps(data.array)
    information, right = np.zeros((m, width + 1, width + 1)), np.zeros((m, width + 1))
    rows = np.flatnonzero(np.isfinite(data.rate_rps).all(axis=1))
    rows = rows[np.argsort(data.t_ns[rows], kind="stable")]
    rows = rows[(data.t_ns[rows] >= rates.starts_ns) & (data.t_ns[rows] <= rates.final_until_ns)]
    warm = data.temperature_c if data.temperature_c is not None else np.full(len(data.t_ns), np.nan)
    ends_ns, offsets_s = np.array(taken_off[0], dtype=np.int64), np.append(np.array(taken_off[1]), 0.0)
    of_row = offsets_s[np.minimum(np.searchsorted(ends_ns, data.t_ns[rows]), max(len(ends_ns) - 1, 0))]
    edges = {0, len(rows), *range(0, len(rows), _CHUNK_ROWS), *(np.flatnonzero(np.diff(of_row)) + 1).tolist()}
    for start, stop in pairwise(sorted(edges)):
        part, offset_s = rows[start:stop], float(of_row[start])
        t_ns, y = rates.earlier(data.t_ns[part], offset_s), data.rate_rps[part]
        w, wdot = rates.at(t_ns), rates.angular_acceleration_at(t_ns)
        wdot = np.zeros_like(w) if wdot is None else wdot
        extra = np.empty((len(t_ns), m, 0))
        if columns is not None:
            extra, expected = columns.at(rates, t_ns, warm[part])
            y = y - expected
        known = np.isfinite(w).all(axis=1) & np.isfinite(wdot).all(axis=1) & np.isfinite(y).all(axis=1)
        w, extra, late = w[known], extra[known], -(wdot @ data.array.p.T)[known]
        z = y[known] - w @ data.array.p.T + offset_s * late
        one = np.column_stack([np.ones(len(w)), w])
        for i in range(m):
            regressors = np.hstack([one @ maps[i].T, extra[:, i], late[:, i : i + 1]])
            information[i] += regressors.T @ regressors
            right[i] += regressors.T @ z[:, i]
    information /= noise_rps[:, None, None] ** 2
    right /= noise_rps[:, None] ** 2
    precision = np.diag(np.concatenate([1 / prior.variances(), np.ones(count)]))
    own, across = information[:, :width, :width] + precision, information[:, :width, width]
    gain = np.linalg.solve(own, np.stack([right[:, :width], across], axis=2))
    # The offset is one of all gyros.
    left = np.sum(information[:, width, width] - np.einsum("mi,mi->m", across, gain[:, :, 1]))
    variance = 1 / (left + 1 / offset_sd_s**2) if offset_sd_s else 0.0
    offset = variance * float(np.sum(right[:, width] - np.einsum("mi,mi->m", across, gain[:, :, 0])))
    x = gain[:, :, 0] - gain[:, :, 1] * offset
    covariance = np.linalg.inv(own) + variance * np.einsum("mi,mj->mij", gain[:, :, 1], gain[:, :, 1])
    covariance = np.asarray(covariance[:, :4, :4], dtype=np.float64)
    return Solution(np.asarray(x[:, :4], dtype=np.float64), covariance, noise_rps)
