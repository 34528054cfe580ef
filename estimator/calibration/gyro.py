"""Calibration of one gyro: its states with their covariance, noise, and effects of the error model."""

from dataclasses import dataclass

import numpy as np

from estimator.calibration.budget import TYPE_A, UNMEASURED, UNSEEN, Contribution
from estimator.geometry.noise import NoiseFound
from estimator.observations.allan.sensor import SensorNoise
from estimator.types import Floats


@dataclass(kw_only=True, frozen=True, slots=True)
class EffectValue:
    """One parameter of an effect of the error model: its estimate for a gyro, and the model's expectation.

    In SI: value and standard deviation in ``unit``; ``expected_sd`` is that of the model. ``shared``: common to all
    gyros.
    """

    effect: str
    parameter: str
    value: float
    sd: float
    unit: str
    expected_sd: float
    shared: bool


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class GyroCalibration:
    """States of one gyro [k, b_rps, sigma_j_rad, sigma_k_rad], their covariance, the noise of one sample.

    ``covariance`` is complete; ``budget`` has its parts: type A, from the scatter of the data, and type B, from the
    table's stated uncertainty. ``noise`` is the estimated noise, if any, and ``rest`` that from rests of the table
    alone. ``effects`` are those of the error model, if one was given.
    """

    name: str
    source: str
    states: Floats
    covariance: Floats
    noise_rps: float
    p: Floats
    device: str
    budget: tuple[Contribution, ...] = ()
    noise: NoiseFound | None = None
    rest: SensorNoise | None = None
    effects: tuple[EffectValue, ...] = ()

    @property
    def sd(self) -> Floats:
        """Standard deviations of the states (4,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def sd_declared(self) -> Floats:
        """Standard deviations of the states (4,) if there were no undeclared effects."""
        others = [line.u**2 for line in self.budget if line.name in (UNSEEN, UNMEASURED)]
        return np.asarray(np.sqrt(np.maximum(self.sd**2 - np.sum([np.zeros(4), *others], axis=0), 0.0)))

    @property
    def type_a(self) -> Floats:
        """Covariance of the states (4, 4) from the data alone, without the reference; the whole one if not known
        apart.
        """
        own = [line.covariance for line in self.budget if line.name in TYPE_A]
        return np.asarray(np.sum(own, axis=0)) if own else self.covariance
