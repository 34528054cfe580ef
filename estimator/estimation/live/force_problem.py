"""The accelerometers of a source as a linear problem at single samples: all parameters, their columns, their prior."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.effects.conditions import Axes
from estimator.estimation.accelerometers.force_runs import force_conditions
from estimator.estimation.accelerometers.laws import APART, ARM, DELAY, laws_beside
from estimator.geometry.array import SensorArray
from estimator.geometry.kinematics import Gravity
from estimator.geometry.model import ForcePrior, regressor_maps
from estimator.observations.timing import expected_sd_s
from estimator.recordings.motion.body_rates import BodyRates
from estimator.recordings.reference import TableUncertainty
from estimator.types import Floats, Stamps


@dataclass(kw_only=True, frozen=True, slots=True)
class About:
    """The delay and the lever arm (3,) about which outputs are linearised."""

    delay_s: float = 0.0
    arm_m: tuple[float, ...] = (0.0, 0.0, 0.0)


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class ForceColumns:
    """Columns (n, a, c) of the parameters of each of a accelerometers, and the outputs (n, a) without any error.

    The latter are NaN where the motion is not known.
    """

    columns: Floats
    expected_mps2: Floats


class ForceProblem:
    """Parameters of the accelerometers of a source: four states each, and the laws beside them.

    The laws are those of the batch estimate, each parameter in units of its expected standard deviation: lever arm and
    place of each accelerometer about it, delay, level and orthogonality of the table, gravity. ``places`` tells by
    accelerometer where its c parameters are among all; ``variances`` are those of all before any sample.
    """

    def __init__(
        self,
        array: SensorArray,
        prior: ForcePrior,
        gimbals: Sequence[str],
        uncertainty: TableUncertainty | None,
        gravity: Gravity,
    ) -> None:
        """Take the accelerometers, their data sheet, and what is known of table and gravity.

        ``gimbals`` are outermost first; ``uncertainty`` is that of the table, None if not stated.
        """
        self.array, self.gravity_mps2 = array, gravity.value_mps2
        self._gimbals, self._maps = tuple(gimbals), regressor_maps(array)
        timing_s = uncertainty.timing_s if uncertainty is not None else 0.0
        self._laws = laws_beside(
            prior,
            gimbals,
            uncertainty,
            gravity,
            delay_sd_s=expected_sd_s(timing_s),
            arm_m=np.zeros(3),
            delay_s=0.0,
        )
        count = len(array)
        own: list[list[int]] = [list(range(4 * i, 4 * i + 4)) for i in range(count)]
        size = 4 * count
        self._slices: dict[str, slice] = {}  # of the columns of an accelerometer
        for law in self._laws:
            width = len(law.sd)
            self._slices[law.called] = slice(len(own[0]), len(own[0]) + width)
            for i in range(count):
                start = size if law.effect.shared else size + i * width
                own[i] += range(start, start + width)
            size += width if law.effect.shared else width * count
        self.places: list[NDArray[np.intp]] = [np.array(places) for places in own]
        self.variances = np.concatenate([np.tile(prior.variances(), count), np.ones(size - 4 * count)])
        self._sds = {law.called: law.sd for law in self._laws}

    def at(self, rates: BodyRates, t_ns: Stamps, about: About) -> ForceColumns:
        """Return the columns at the instants (n,) of samples, in order, linearised ``about`` a delay and an arm.

        The outputs without any error are extrapolated to a delay and an arm of 0, of which the parameters tell. They
        are NaN where the motion is not known. Columns are for parameters in units of their expected standard
        deviations.
        """
        arm_m, count = np.array(about.arm_m), len(self.array)
        earlier_ns = rates.earlier(t_ns, about.delay_s)
        conditions = force_conditions(rates, self._gimbals, earlier_ns, arm_m, self.gravity_mps2)
        force = conditions.specific_force_mps2
        one = np.column_stack([np.ones(len(t_ns)), force])
        columns = np.empty((len(t_ns), count, len(self.places[0])))
        for i in range(count):
            axes = Axes(self.array.p[i], self.array.j[i], self.array.k[i])
            beside = [law.effect.at(conditions, axes) * law.sd for law in self._laws]
            columns[:, i] = np.hstack([one @ self._maps[i].T, *beside])
        taken = columns[:, :, self._slices[ARM]] @ (arm_m / self._sds[ARM])
        taken += columns[:, :, self._slices[DELAY]] @ (about.delay_s / self._sds[DELAY])
        expected = force @ self.array.p.T - taken
        expected[~rates.felt_known(earlier_ns)] = np.nan
        return ForceColumns(columns=columns, expected_mps2=expected)

    def plausible_mps2(self, columns: Floats) -> Floats:
        """Return the standard deviations (n, a) of outputs about the expected ones, before any sample."""
        variances = np.array([self.variances[places] for places in self.places])
        return np.asarray(np.sqrt(np.einsum("nac,ac->na", columns**2, variances)))

    def delay(self, x: Floats, covariance: Floats) -> tuple[float, float]:
        """Return the delay in s and its standard deviation, from all parameters (size,) and their covariance."""
        place = int(self.places[0][self._slices[DELAY]][0])
        sd = float(self._sds[DELAY][0])
        return float(x[place]) * sd, float(np.sqrt(covariance[place, place])) * sd

    def arm(self, x: Floats, covariance: Floats, counted: Sequence[int]) -> tuple[Floats, Floats]:
        """Return the mean place (3,) in m of the accelerometers with the numbers ``counted``, and its sigmas (3,).

        They follow from all parameters x (size,) and their covariance. Without any ``counted`` both are 0.
        """
        weights = np.zeros((3, len(x)))
        for i in counted:
            for law in (ARM, APART):
                at = self.places[i][self._slices[law]]
                weights[np.arange(3), at] += self._sds[law] / len(counted)
        return weights @ x, np.sqrt(np.diag(weights @ covariance @ weights.T))
