"""Effects of the table: its axes, its rates, and errors that repeat with each turn."""

from collections.abc import Sequence

import numpy as np

from estimator.effects.conditions import Axes, Conditions
from estimator.effects.effect import Parameter, Setting, Settings, family
from estimator.effects.law import columns_of
from estimator.geometry.kinematics import AXES, into_body
from estimator.types import Floats


def _turning(settings: Settings, conditions: Conditions, axes: Axes) -> Floats:
    """Return the columns of cosine and sine of ``order`` times the angle of an ``axis``, by default of all.

    The two of an axis stand side by side, those of the outermost axis first.
    """
    names = [settings["axis"]] if "axis" in settings else conditions.gimbals
    waves = (f"{part}({settings['order']}*angle_{name})" for name in names for part in ("cos", "sin"))
    return columns_of("; ".join(waves), conditions, axes)


def _waves_of(gimbals: Sequence[str], settings: Settings) -> tuple[Parameter, ...]:
    names = [f"{settings['order']} {settings['axis']}"] if "axis" in settings else gimbals
    largest = float(np.radians(0.05))  # 0.5 gauss at 0.1 deg/s/gauss
    return tuple(Parameter(f"{part} of {name}", "rad/s", largest) for name in names for part in ("cosine", "sine"))


def _tilt_columns(settings: Settings, conditions: Conditions, axes: Axes) -> Floats:
    """Return the columns (N, 2 for each inner axis) of axes tilted towards the two others; (N, 0) for a single axis.

    Inner axes come outermost first, and each is tilted first towards the next of x, y, z, x, y, then towards the one
    after it. The outermost axis defines the base. With a small rotation d that tilts an axis, R' becomes (1 + d x) R'
    (1 - d x), and the error of the body rate w becomes R' error + d x w - R' (d x (w before)).
    """
    if len(conditions.gimbals) < 2:
        return np.empty((len(conditions.t_s), 0))
    return conditions.once("errors of tilted axes", lambda: _all_tilted(conditions)) @ axes.p


def _all_tilted(conditions: Conditions) -> Floats:
    """Return the errors of the body rate (N, tilts, 3) per radian of each tilt of each inner axis.

    Their order is that of ``_tilt_columns``; there must be two axes or more.
    """
    gimbals = conditions.gimbals
    tilts = [_error_of_tilt(conditions, inner, d) for inner in range(1, len(gimbals)) for d in _tilts(gimbals[inner])]
    return np.stack(tilts, axis=1)


def _tilts_of(gimbals: Sequence[str], settings: Settings) -> tuple[Parameter, ...]:
    return tuple(Parameter(f"{axis} towards {other}", "rad", 1e-3) for axis in gimbals[1:] for other in _others(axis))


def _faster(settings: Settings, conditions: Conditions, axes: Axes) -> Floats:
    """Return the part of the rate about the sense axis that each axis of the table makes: (N, g), outermost first."""
    return columns_of("; ".join(f"u_{axis}" for axis in conditions.gimbals), conditions, axes)


def _others(axis: str) -> tuple[str, str]:
    a = AXES.index(axis)
    return AXES[(a + 1) % 3], AXES[(a + 2) % 3]


def _tilts(axis: str) -> tuple[Floats, Floats]:
    """Return the rotations (3,) that tilt an axis a towards the next b and the one after c: c x a = b, -b x a = c."""
    unit = np.eye(3)
    a = AXES.index(axis)
    return unit[(a + 2) % 3], -unit[(a + 1) % 3]


def _error_of_tilt(conditions: Conditions, inner: int, d: Floats) -> Floats:
    """Return the error (N, 3) of the body rate per radian of a rotation that tilts gimbal number ``inner``.

    ``d`` (3,) is the axis of that rotation, in the frame within which the gimbal turns.
    """
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


RECORDS = TABLE_HARMONIC, TABLE_AXES, TABLE_RATE = family(
    "table",
    table_harmonic={
        "parameters": _waves_of,
        "regressors": _turning,
        "settings": (
            Setting("order", "", "1", read=lambda key, n: int(n)),
            Setting("axis", "", "", read=lambda key, axis: str(axis)),
        ),
        "confused_with": lambda settings: ("g_sensitivity", "earth_rate") if settings["order"] == 1 else (),
    },
    table_axes={"parameters": _tilts_of, "regressors": _tilt_columns},
    table_rate={
        "parameters": lambda axes, _: tuple(Parameter(f"of {name}", "1", 1e-3) for name in axes),
        "regressors": _faster,
    },
)
