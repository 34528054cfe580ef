"""Effects of the table: its axes, its rates, what goes round with it."""

from collections.abc import Sequence

import numpy as np

from estimator.effects.conditions import Conditions
from estimator.effects.effect import Axes, Effect, Parameter
from estimator.geometry.kinematics import AXES, into_body
from estimator.types import Floats


def table_harmonic(gimbals: Sequence[str], order: int, of: Sequence[str] | None = None) -> Effect:
    """Return wobble or magnetic pick-up: cosine and sine of ``order`` times the angle of axes, a gyro its own.

    ``of`` names the axes, by default all ``gimbals``.

    Up to 0.05 deg/s: 0.5 gauss at 0.1 deg/s/gauss.
    """

    def columns(conditions: Conditions, axes: Axes) -> Floats:
        turned = order * conditions.angle_rad[:, chosen]
        return np.stack([np.cos(turned), np.sin(turned)], axis=2)  # (N, g, 2), in the order of the parameters

    largest = float(np.radians(0.05))
    names = list(gimbals if of is None else of)
    chosen = [list(gimbals).index(axis) for axis in names]
    return Effect(
        f"table_harmonic_{order}",
        tuple(Parameter(f"{part} of {axis}", "rad/s", largest) for axis in names for part in ("cosine", "sine")),
        shared=False,
        shown_by="full turns about each axis",
        confused_with=("g_sensitivity", "earth_rate") if order == 1 else (),
        regressors=columns,
        needs=frozenset({"gimbals"}),
    )


def table_axes(gimbals: Sequence[str]) -> Effect:
    """Return axes that are not at right angles: each inner axis tilted towards the two others, up to 1 mrad.

    The outermost axis defines the base. With a small rotation d that takes an axis to where it is, R' becomes
    (1 + d x) R' (1 - d x), and the error of the body rate w becomes R' error + d x w - R' (d x (w before)).
    """

    def columns(conditions: Conditions, axes: Axes) -> Floats:
        tilts = [
            _tilted(conditions, inner, d) @ axes.p for inner in range(1, len(gimbals)) for d in _tilts(gimbals[inner])
        ]
        return np.stack(tilts, axis=1) if tilts else np.empty((len(conditions.t_s), 0))

    parameters = [Parameter(f"{axis} towards {other}", "rad", 1e-3) for axis in gimbals[1:] for other in _others(axis)]
    return Effect(
        "table_axes",
        tuple(parameters),
        shared=True,
        shown_by="turns about an axis with the axes within it at different angles; another mounting",
        confused_with=(),
        regressors=columns,
        needs=frozenset({"gimbals"}),
    )


def table_rate(gimbals: Sequence[str]) -> Effect:
    """Return rates of the table that are larger than reported, by a share for each axis, up to 1000 ppm."""
    return Effect(
        "table_rate",
        tuple(Parameter(f"of {axis}", "1", 1e-3) for axis in gimbals),
        shared=True,
        shown_by="another table, counted turns",
        confused_with=(),
        regressors=lambda conditions, axes: np.stack(
            [_rate_of(conditions, column) @ axes.p for column in range(len(gimbals))], axis=1
        ),
        needs=frozenset({"gimbals"}),
    )


def _others(axis: str) -> tuple[str, str]:
    a = AXES.index(axis)
    return AXES[(a + 1) % 3], AXES[(a + 2) % 3]


def _tilts(axis: str) -> tuple[Floats, Floats]:
    """Return the rotations (3,) that tilt an axis a towards the next b and the one after c: c x a = b, -b x a = c."""
    unit = np.eye(3)
    a = AXES.index(axis)
    return unit[(a + 2) % 3], -unit[(a + 1) % 3]


def _tilted(conditions: Conditions, inner: int, d: Floats) -> Floats:
    """Return the error of the body rate (N, 3) per radian by which gimbal ``inner`` is rotated by d (3,)."""
    v = np.zeros_like(conditions.w_rps)
    if conditions.site is not None:
        v = v + conditions.site.earth_rate_rps()
    error = np.zeros_like(v)
    for column, axis in enumerate(conditions.gimbals):
        angle = conditions.angle_rad[:, [column]]
        before = np.cross(d, v)
        v, error = into_body(v, angle, axis), into_body(error, angle, axis)
        v[:, AXES.index(axis)] += conditions.rate_rps[:, column]
        if column == inner:
            error = np.cross(d, v) - into_body(before, angle, axis)
    return error


def _rate_of(conditions: Conditions, column: int) -> Floats:
    """Return the part of the body rate (N, 3) that one gimbal makes."""
    part = np.zeros_like(conditions.w_rps)
    part[:, AXES.index(conditions.gimbals[column])] = conditions.rate_rps[:, column]
    return into_body(part, conditions.angle_rad[:, column + 1 :], conditions.gimbals[column + 1 :])
