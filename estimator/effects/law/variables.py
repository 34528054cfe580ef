"""The variables of laws under given conditions, each computed when first used."""

from collections.abc import Callable
from typing import Any

import numpy as np

from estimator.effects.conditions import Axes, Conditions
from estimator.effects.law.grammar import OF_GYROS
from estimator.effects.law.memory import steps_of
from estimator.geometry.kinematics import AXES, GRAVITY_MPS2, into_body
from estimator.types import Floats

Compiled = Callable[[Any], Floats]
"""A term of a law: its value (N,), or (), from what gives the value of each variable by name (``Variables``)."""


class Variables:
    """The variables of laws for one gyro under given conditions, each computed when first used.

    The same holds for functions with memory, which take long: those of a law are computed once for all of its terms,
    and for all gyros while the conditions share them.
    """

    def __init__(self, conditions: Conditions, axes: Axes) -> None:
        self.causal = conditions.causal
        self._conditions, self._axes = conditions, axes
        self._own_memories: dict[str, Floats] = {}

    def __getitem__(self, name: str) -> Floats:
        axis = OF_GYROS.get(name)
        key = name if axis is None else (name, getattr(self._axes, axis).tobytes())
        return self._conditions.once(key, lambda: np.array(_variable(name, self._conditions, self._axes)))

    def remembered(self, text: str, work: Compiled, *, of_gyro: bool) -> Floats:
        """Return what a function with memory gives, by its text; ``of_gyro``: it differs from gyro to gyro."""
        shared = None if of_gyro else self._conditions.memories
        known = self._own_memories if shared is None else shared
        if text not in known:
            known[text] = work(self)
        return known[text]

    @property
    def steps_s(self) -> Floats:
        """Time (N,) since the instant before, or (1,) if it is always the same."""
        return self._conditions.once("steps", lambda: steps_of(self._conditions.t_s))


def _variable(name: str, c: Conditions, axes: Axes) -> Floats:
    """Return the variable ``name`` (N,) of laws under conditions ``c``, for a gyro with these axes.

    The temperature counts from the reference, and is 0 if it is unknown; time counts from the first instant; forces are
    in units of standard gravity. ValueError for an axis that the table does not have.
    """
    match name:
        case "u" | "uj" | "uk":
            return np.asarray(c.w_rps @ getattr(axes, OF_GYROS[name]))
        case "wx" | "wy" | "wz":
            return c.w_rps[:, AXES.index(name[1])]
        case "a" | "aj" | "ak":
            return np.asarray(c.wdot_rps2 @ getattr(axes, OF_GYROS[name]))
        case "jolt":
            return np.asarray(np.linalg.norm(c.wdot_rps2, axis=1))
        case "speed":
            return np.asarray(np.linalg.norm(c.w_rps, axis=1))
        case "T":
            return np.zeros(len(c.t_s)) if c.temperature_c is None else c.temperature_c - c.reference_c
        case "Tdot":
            return c.warming_kps
        case "t":
            return np.asarray(c.t_s - c.t_s[0])
        case "gs" | "gj" | "gk":
            return np.asarray(c.specific_force_mps2 / GRAVITY_MPS2 @ getattr(axes, OF_GYROS[name]))
        case "ms" | "mj" | "mk" | "ns" | "nj" | "nk":
            return np.asarray(_of_the_base("mn".index(name[0]), c) @ getattr(axes, OF_GYROS[name]))
        case "gx" | "gy" | "gz":
            return c.specific_force_mps2[:, AXES.index(name[1])] / GRAVITY_MPS2
    what, axis = name.split("_")
    column = c.gimbals.index(axis)
    match what:
        case "angle":
            return c.angle_rad[:, column]
        case "rate":
            return c.rate_rps[:, column]
    return np.asarray(c.once(f"turning about {axis}", lambda: _turning_about(axis, c)) @ axes.p)


def _of_the_base(axis: int, c: Conditions) -> Floats:
    """Return a horizontal direction (N, 3) of the base of the table in body axes: x, 0, or y, 1."""
    return c.once(("base", axis), lambda: into_body(np.eye(3)[axis], c.angle_rad, c.gimbals))


def _turning_about(axis: str, c: Conditions) -> Floats:
    """Return the part of the body rate (N, 3), in body axes, that an axis of the table makes."""
    column = c.gimbals.index(axis)
    part = np.zeros((len(c.t_s), 3))
    part[:, AXES.index(axis)] = c.rate_rps[:, column]
    return into_body(part, c.angle_rad[:, column + 1 :], c.gimbals[column + 1 :])
