"""An effect: something that the four states of a gyro lack, as linear terms of its output error.

The output of gyro i gains ``+ sum of parameter * phi`` (rad/s), phi being the columns of ``Effect.columns``. What an
effect depends on in a non-linear way (a time constant, an instant, a frequency) is an argument of the function that
makes it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from estimator.effects.conditions import Conditions
from estimator.geometry.array import SensorArray
from estimator.types import Floats


class Axes(NamedTuple):
    """Sense axis and tilt axes of one gyro, (3,) each, in body axes."""

    p: Floats
    j: Floats
    k: Floats


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of an effect: its SI unit, and the largest size that real gyros and tables plausibly have."""

    name: str
    unit: str
    largest: float


@dataclass(frozen=True, slots=True)
class Effect:
    """An entry of the catalogue.

    ``shared``: one set of parameters for all gyros (a cause in the table, the site or the clock), not one a gyro.
    ``shown_by`` says what excites it, ``confused_with`` names effects that look alike in many runs.
    ``regressors`` gives the columns of one gyro, (N, parameters). ``needs`` names what a recording must hold for them
    beside rates: "temperature", "gimbals" (angles of the table's axes), "specific force".
    """

    name: str
    parameters: tuple[Parameter, ...]
    shared: bool
    shown_by: str
    confused_with: tuple[str, ...]
    regressors: Callable[[Conditions, Axes], Floats]
    needs: frozenset[str] = frozenset()

    def columns(self, conditions: Conditions, array: SensorArray, gyro: int) -> Floats:
        """Return the regressors (N, parameters) of gyro number ``gyro``: rad/s per unit of each parameter."""
        return self.at(conditions, Axes(array.p[gyro], array.j[gyro], array.k[gyro]))

    def at(self, conditions: Conditions, axes: Axes) -> Floats:
        """Return the regressors (N, parameters) of a gyro with these axes."""
        return self.regressors(conditions, axes).reshape(len(conditions.t_s), len(self.parameters))
