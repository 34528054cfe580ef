"""The results of a calibration: values, without the way they were found."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from estimator.calibration.accelerometer import ForceCalibration
from estimator.calibration.applied import applied
from estimator.calibration.compensation import Compensation, CompensationError
from estimator.calibration.gyro import GyroCalibration
from estimator.geometry.array import SensorArray
from estimator.geometry.model import STATES, StatePrior
from estimator.observations.coverage import AxisCoverage
from estimator.observations.health import Excluded
from estimator.observations.timing import TimeOffset
from estimator.sensors.gyros import GYRO
from estimator.sensors.kind import State
from estimator.types import Floats

_UNSEEN = 0.5  # a posterior sigma above this share of the prior's: the run did not show the state


@dataclass(kw_only=True, frozen=True, slots=True)
class GyroParity:
    """Residual of one gyro in the parity: rms and worst block over their sigma; ``suspect`` if that is not chance.

    ``told_apart``: whether the parity can separate this gyro from the others of its device.
    """

    name: str
    rms_sigma: float
    worst_sigma: float
    worst_t_s: float
    suspect: bool
    told_apart: bool
    source: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class UndeclaredEffect:
    """An effect that nobody has declared: its ``share`` of the variance of a state, and what would show it."""

    state: str
    effect: str
    share: float
    shown_by: str


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Calibration:
    """The calibration of one recording. ``samples`` counts gyro samples used, ``lost`` missing ones.

    ``excluded`` are gyros that could not be estimated; ``parity`` compares the gyros of redundant devices. ``model`` is
    the text of the error model given to the estimate, if any. ``doubts`` are the notes that question the sigmas,
    ``spoilt`` those that no sigma can cover: changes during the run, or contradictory readings of the table.
    ``holds_for`` are the conditions for which the states are valid, ``offsets`` the time offsets between reference and
    samples of each source, where estimated. ``constancy`` says, for each axis that turned, over which time a change
    would have been detected.
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
    arrays: Mapping[str, SensorArray] = field(default_factory=dict)
    """Nominal axes of the gyros by source."""
    forces: tuple[ForceCalibration, ...] = ()
    """The accelerometers of each source that states a data sheet for them."""
    undeclared: tuple[UndeclaredEffect, ...] = ()
    """Effects of the catalogue that make most of the sigmas, by state, the largest first."""

    def apply(
        self,
        outputs_rps: Any,
        *,
        device: str | None = None,
        t_s: Floats | None = None,
        temperature_c: Floats | None = None,
        accel_mps2: Floats | None = None,
    ) -> Any:
        """Return the body rate for samples of the calibrated gyros, in rad/s about the body axes x, y, z.

        ``outputs_rps`` (N, n) in rad/s has a column for each gyro, in the order of ``gyros``. In a pandas.DataFrame
        columns are found by name; the result is then a DataFrame (x_rps, y_rps, z_rps) with its index, else an array
        (N, 3). ``device`` selects the gyros of one device under test, None all.

        Effects of the error model are corrected, too. Effects of temperature need ``temperature_c`` (N,), those of
        acceleration ``accel_mps2`` (N, 3), the specific force in body axes, and those with memory the instants ``t_s``
        (N,). Rates are NaN where an effect of the rate cannot be undone.

        CompensationError for an unknown device, gyros that do not span space, or missing columns, temperatures and so
        on.
        """
        gyros = tuple(gyro for gyro in self.gyros if device in (None, gyro.device))
        if not gyros:
            devices = ", ".join(dict.fromkeys(gyro.device for gyro in self.gyros)) or "none"
            raise CompensationError(f"no calibrated device is called {device!r}; there are {devices}")
        compensation = Compensation.of(gyros, self.arrays, self.model)
        return applied(compensation, outputs_rps, t_s=t_s, temperature_c=temperature_c, accel_mps2=accel_mps2)

    def to_xarray(self) -> Any:
        """Return an xarray.Dataset over gyro and state, in SI units. Needs xarray.

        ``value`` and ``sd`` (gyro, state), ``covariance`` (gyro, state, other_state), ``noise_rps`` (gyro). ``device``
        and ``unit`` are further coordinates; attributes are nis_mean, samples, lost and holds_for.
        """
        from xarray import Dataset

        dimensions = ("gyro", "state")
        return Dataset(
            {
                "value": (dimensions, np.array([gyro.states for gyro in self.gyros])),
                "sd": (dimensions, np.array([gyro.sd for gyro in self.gyros])),
                "covariance": ((*dimensions, "other_state"), np.array([gyro.covariance for gyro in self.gyros])),
                "noise_rps": (("gyro",), np.array([gyro.noise_rps for gyro in self.gyros])),
            },
            {
                "gyro": [gyro.name for gyro in self.gyros],
                "device": ("gyro", [gyro.device for gyro in self.gyros]),
                "state": list(STATES),
                "other_state": list(STATES),
                "unit": ("state", list(GYRO.units)),
            },
            {"nis_mean": self.nis_mean, "samples": self.samples, "lost": self.lost, "holds_for": self.holds_for},
        )

    def to_frame(self) -> Any:
        """Return a pandas.DataFrame with a row a gyro, by its name: device, states, and sigmas as "sd_STATE", in SI.
        Needs pandas.
        """
        from pandas import DataFrame

        columns = [*STATES, *(f"sd_{state}" for state in STATES)]
        frame = DataFrame([[*g.states, *g.sd] for g in self.gyros], [g.name for g in self.gyros], columns)
        frame.insert(0, "device", [gyro.device for gyro in self.gyros])
        return frame


def unseen_notes(
    name: str, covariance: Floats, prior: StatePrior, states: tuple[State, ...] = GYRO.states
) -> list[str]:
    """Return a sentence for each state of a sensor whose sigma is more than half of that of the prior.

    ``covariance`` (4, 4) is that of its ``states``, by default those of a gyro; ``name`` is that of the sensor.
    """
    ratio = np.sqrt(np.diag(covariance) / prior.variances())
    return [
        f"{name}: {state.text} is not determined by this run (its sigma is {r:.0%} of the data sheet value)"
        for state, r in zip(states, ratio, strict=True)
        if r > _UNSEEN
    ]
