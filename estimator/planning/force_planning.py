"""The prediction for accelerometers: standard deviations of states and places that a motion will show.

The columns are those of the calibration (``estimator.estimation.accelerometers``): the states, the place of each
accelerometer, and the laws that all of a device share. They are weighed as the estimate weighs them under the noise of
the data sheet.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from estimator.effects.conditions import Conditions
from estimator.estimation.accelerometers.laws import APART, ARM, laws_beside
from estimator.estimation.accelerometers.resolution import SCALES
from estimator.estimation.noise_evidence import Law
from estimator.geometry.array import SensorArray
from estimator.geometry.kinematics import gravity_at, into_body
from estimator.geometry.model import ForcePrior, regressor_maps
from estimator.observations.timing import expected_sd_s
from estimator.recordings.reference import TableUncertainty
from estimator.types import Floats

PARAMETERS = 7
"""Of an accelerometer: its four states and the three components of its place."""
_DRAWS = 64  # of the noise of a calibration


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlannedAccelerometers:
    """The accelerometers of a device on a table: nominal axes, data sheet, and the stated errors of the table."""

    array: SensorArray
    prior: ForcePrior
    table: TableUncertainty | None


def force_covariances(
    conditions: Conditions,
    device: PlannedAccelerometers,
    products: Callable[[Floats], Floats],
    rest_angles: Law | None = None,
) -> Floats:
    """Return the covariances (a, 7, 7) of [k, b, sigma_j, sigma_k, x, y, z] of each accelerometer, in SI units.

    ``conditions`` are those of the motion at N even instants; ``products`` weighs columns (N, c) under the noise of the
    accelerometers (``estimator.planning.planning.weighing``). ``rest_angles`` is the law of the angles at rest: what a
    calibration adds for encoders of this resolution if the table stands on whole counts.
    """
    gravity = gravity_at(conditions.site)
    up = np.array([0.0, 0.0, gravity.value_mps2])
    force = into_body(up, conditions.angle_rad, conditions.gimbals)
    felt = replace(conditions, specific_force_mps2=force)
    laws = laws_beside(
        device.prior,
        conditions.gimbals,
        device.table,
        gravity,
        delay_sd_s=expected_sd_s(device.table.timing_s if device.table is not None else 0.0),
        arm_m=np.zeros(3),
        delay_s=0.0,
    )
    shared = [law for law in laws if law.effect.shared]
    arm = [law.called for law in shared].index(ARM)
    first_of_arm = sum(len(law.sd) for law in shared[:arm])
    (apart,) = [law for law in laws if law.called == APART]
    prior_sd = np.concatenate([np.sqrt(device.prior.variances()), apart.sd])
    regressors = np.column_stack([np.ones(len(force)), force])
    columns = []
    for number, own_map in enumerate(regressor_maps(device.array)):
        own = np.hstack([regressors @ own_map.T, apart.effect.columns(felt, device.array, number)]) * prior_sd
        further = [*shared, rest_angles] if rest_angles is not None else shared
        common = [law.effect.columns(felt, device.array, number) * law.sd for law in further]
        columns.append(np.hstack([own, *common]))
    information = _by_accelerometer(products(np.hstack(columns)), len(columns))
    if rest_angles is not None:
        known = PARAMETERS + sum(len(law.sd) for law in shared)
        sizes = np.ones(information.shape[1])
        sizes[known:] = np.sqrt(_mean_square(information, known))
        information *= np.outer(sizes, sizes)
    return _places(_joined(information), prior_sd, device.prior.arm_m, first_of_arm)


def _mean_square(information: Floats, known: int) -> float:
    """Return the mean square of the size of the angles that a calibration finds where there are none.

    ``information`` (a, c, c) is that of a accelerometers about their ``PARAMETERS``, then the shared ones up to
    ``known``, then the angles. The mean is over the noise of a calibration, which weighs the sizes ``SCALES`` by their
    evidence.
    """
    own = slice(0, PARAMETERS)
    further = slice(PARAMETERS, information.shape[1])
    alone = np.linalg.inv(information[:, own, own] + np.eye(PARAMETERS))
    across = information[:, own, further]
    left = (information[:, further, further] - across.transpose(0, 2, 1) @ alone @ across).sum(axis=0)
    shared = known - PARAMETERS
    response = np.linalg.solve(left[:shared, :shared] + np.eye(shared), left[:shared, shared:])
    shown = np.maximum(np.linalg.eigvalsh(left[shared:, shared:] - left[shared:, :shared] @ response), 0.0)
    squares = np.random.default_rng(0).standard_normal((_DRAWS, len(shown))) ** 2
    share = SCALES[:, None] ** 2 * shown
    logs = 0.5 * (squares @ (share / (1 + share)).T - np.log1p(share).sum(axis=1))
    weights = np.exp(logs - logs.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    return float(np.mean(weights @ SCALES**2))


def _by_accelerometer(information: Floats, count: int) -> Floats:
    """Return the blocks (a, c, c) on the diagonal of the products of all columns."""
    size = len(information) // count
    return np.array([information[i : i + size, i : i + size] for i in range(0, count * size, size)])


def _joined(information: Floats) -> Floats:
    """Return the scaled covariance (a, c, c) of each accelerometer's own and the shared parameters.

    ``information`` (a, c, c) is that of each alone, without what is expected, which is 1 in these units.
    """
    own = slice(0, PARAMETERS)
    shared = slice(PARAMETERS, information.shape[1])
    alone = np.linalg.inv(information[:, own, own] + np.eye(PARAMETERS))
    across = information[:, own, shared]
    response = alone @ across
    left = (information[:, shared, shared] - across.transpose(0, 2, 1) @ response).sum(axis=0)
    common = np.linalg.inv(left + np.eye(len(left)))
    joined = np.empty_like(information)
    joined[:, own, own] = alone + response @ common @ response.transpose(0, 2, 1)
    joined[:, own, shared] = -response @ common
    joined[:, shared, own] = joined[:, own, shared].transpose(0, 2, 1)
    joined[:, shared, shared] = common
    return joined


def _places(covariances: Floats, prior_sd: Floats, arm_sd_m: float, first_of_arm: int) -> Floats:
    """Return the covariances (a, 7, 7) of states and places, from those of own and shared parameters (a, c, c).

    ``first_of_arm`` is where the lever arm is among the shared ones. ``prior_sd`` (7,) and ``arm_sd_m`` are the units
    of own parameters and lever arm. The place of an accelerometer is the common lever arm plus its own part.
    """
    weights = np.zeros((PARAMETERS, covariances.shape[1]))
    weights[:, :PARAMETERS] = np.diag(prior_sd)
    for component in range(3):
        weights[PARAMETERS - 3 + component, PARAMETERS + first_of_arm + component] = arm_sd_m
    return np.asarray(weights @ covariances @ weights.T)
