"""What a recording says of its gyros: values, without the way they were found."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from estimator.calibration.budget import TYPE_A, Contribution
from estimator.geometry.model import STATES, Prior
from estimator.geometry.noise import NoiseFound
from estimator.observations.coverage import AxisCoverage
from estimator.observations.health import Excluded
from estimator.observations.rests import RestNoise
from estimator.observations.timing import TimeOffset
from estimator.types import Floats

_UNSEEN = 0.5  # a posterior sigma above this share of the prior's: the run did not show the state


@dataclass(frozen=True, slots=True)
class GyroParity:
    """Fault that the parity sees in one gyro: rms and worst block over their sigma; ``suspect`` if not by chance.

    ``told_apart``: whether the parity can tell this gyro from the others of its device.
    """

    name: str
    rms_sigma: float
    worst_sigma: float
    worst_t_s: float
    suspect: bool
    told_apart: bool


@dataclass(frozen=True, slots=True)
class EffectValue:
    """One parameter of an effect of the error model: what was found on a gyro, and what the model expected.

    SI: value and standard deviation in ``unit``; ``expected_sd`` is that of the model. ``shared``: of all gyros.
    """

    effect: str
    parameter: str
    value: float
    sd: float
    unit: str
    expected_sd: float
    shared: bool


@dataclass(frozen=True, slots=True, eq=False)
class GyroCalibration:
    """States of one gyro [k, b_rps, sigma_j_rad, sigma_k_rad], their covariance, the noise of one sample.

    ``covariance`` holds everything; ``budget`` is what it is the sum of: type A, from the scatter of the data, and
    type B, from the table's stated uncertainty. ``noise`` is what the data say of the noise, where they do, and
    ``rest`` what the rests of the table alone say of it. ``effects`` are those of the error model, if one was given.
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
    rest: RestNoise | None = None
    effects: tuple[EffectValue, ...] = ()

    @property
    def sd(self) -> Floats:
        """Standard deviations of the states (4,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def type_a(self) -> Floats:
        """What the data leave open of the states (4, 4), whatever may be wrong with the reference; all if not known."""
        own = [line.covariance for line in self.budget if line.name in TYPE_A]
        return np.asarray(np.sum(own, axis=0)) if own else self.covariance


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """What one recording says of its gyros. ``samples`` counts gyro samples used, ``lost`` those missing.

    ``excluded`` are gyros that could not be estimated; ``parity`` is what the gyros of redundant devices say of
    each other. ``model`` is the text of the error model that the estimate began with, if one was given. ``doubts`` are
    those of the notes that speak against the sigmas, ``spoilt`` those of them that no sigma can hold: what was measured
    changed in mid-run, or the table's readings contradict each other. ``holds_for`` are the conditions that the states
    are of, ``offsets`` those between the reference and the samples of each source, where they were estimated.
    ``constancy`` says of each axis that turned over which time a change of what was estimated would have been found.
    """

    gyros: tuple[GyroCalibration, ...]
    nis_mean: float
    samples: int
    lost: int
    notes: tuple[str, ...]
    excluded: tuple[Excluded, ...] = ()
    parity: tuple[GyroParity, ...] = ()
    model: str = ""
    doubts: tuple[str, ...] = ()
    holds_for: str = ""
    offsets: Mapping[str, TimeOffset] = field(default_factory=dict)
    spoilt: tuple[str, ...] = ()
    constancy: tuple[AxisCoverage, ...] = ()

    def to_frame(self) -> Any:
        """Return a pandas.DataFrame with a row a gyro: its device, states and sigmas, in SI. Needs pandas."""
        from pandas import DataFrame

        columns = [*STATES, *(f"sd_{state}" for state in STATES)]
        frame = DataFrame([[*g.states, *g.sd] for g in self.gyros], [g.name for g in self.gyros], columns)
        frame.insert(0, "device", [gyro.device for gyro in self.gyros])
        return frame


def unseen_notes(name: str, covariance: Floats, prior: Prior) -> list[str]:
    """Return which states of a gyro its covariance (4, 4) says were not seen, in words."""
    ratio = np.sqrt(np.diag(covariance) / prior.variances())
    labels = ("scale factor error k", "bias b", "misalignment sigma_j", "misalignment sigma_k")
    return [
        f"{name}: {label} is not seen by this run (its sigma is {r:.0%} of what the data sheet says)"
        for label, r in zip(labels, ratio, strict=True)
        if r > _UNSEEN
    ]
