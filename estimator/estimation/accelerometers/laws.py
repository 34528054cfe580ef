"""Laws of the output of accelerometers on a table, beside the four states.

Columns are in m/s2 per unit of a parameter, for the sense axis p of one accelerometer.
"""

from collections.abc import Callable, Sequence

import numpy as np

from estimator.effects.conditions import Axes, Conditions
from estimator.effects.effect import Effect, Parameter, Record, Regressors
from estimator.estimation.noise_evidence import Law
from estimator.geometry.kinematics import AXES, GRAVITY_MPS2, Gravity, into_body
from estimator.geometry.model import ForcePrior
from estimator.recordings.reference import TableReadings, TableUncertainty
from estimator.types import Floats, least_steps

ARM, APART, DELAY = "lever arm", "size effect", "delay"
LEVEL, ORTHOGONALITY, GRAVITY, RESOLUTION = "level", "orthogonality", "gravity", "resolution"
UNSTATED_LEVEL_RAD = float(np.radians(0.05))
"""Tilt of the base from level that is expected where none is stated: the data show it."""


def arm_columns(conditions: Conditions, axes: Axes) -> Floats:
    """Return the columns (N, 3) of the components of a lever arm: p . (a x r + w x (w x r)) for unit r.

    ``a`` is the angular acceleration. (Nieminen, Kangas, Kettunen, Meas. Sci. Technol. 2010.)
    """
    along = conditions.w_rps @ axes.p
    square = np.sum(conditions.w_rps**2, axis=1)
    tangential = np.cross(axes.p, conditions.wdot_rps2)
    return np.asarray(tangential + along[:, None] * conditions.w_rps - square[:, None] * axes.p)


def arm_law(expected: Floats, arm_m: Floats) -> Law:
    """Return the law of what is left of the lever arm, common to all accelerometers.

    ``expected`` (3,) is the standard deviation of its components about zero; ``arm_m`` (3,) was subtracted.
    """
    return _law(ARM, arm_columns, expected, mean=-arm_m, names="xyz", shared=True)


def apart_law(expected: Floats) -> Law:
    """Return the law of where each accelerometer sits about the common lever arm, of standard deviation (3,)."""
    return _law(APART, arm_columns, expected, names="xyz", shared=False)


def delay_law(expected_s: float, taken_off_s: float, arm_m: Floats) -> Law:
    """Return the law of the delay of the outputs, of which ``taken_off_s`` was subtracted from the stamps.

    ``arm_m`` (3,) is the lever arm, whose centripetal force changes on ramps; ``expected_s`` is the standard deviation.
    The parameter, common to all accelerometers, is the delay that is left in s: its mean is ``-taken_off_s``.
    """

    def columns(conditions: Conditions, axes: Axes) -> Floats:
        """Return the change of the output per second of delay; gravity is at rest in the base, the arm in the body."""
        w, wdot = conditions.w_rps, conditions.wdot_rps2
        gravity = into_body(np.array([0.0, 0.0, GRAVITY_MPS2]), conditions.angle_rad, conditions.gimbals)
        centripetal_change = np.cross(wdot, np.cross(w, arm_m)) + np.cross(w, np.cross(wdot, arm_m))
        return np.asarray((np.cross(w, gravity) - centripetal_change) @ axes.p)[:, None]

    return _law(DELAY, columns, np.array([expected_s]), mean=np.array([-taken_off_s]), names=("delay",), shared=True)


def gravity_law(relative: float) -> Law:
    """Return the law of an error of the assumed gravity, which no run on a table tells from the scale factors.

    ``relative`` is its expected standard deviation, as a share of gravity; it is common to all accelerometers.
    """

    def columns(conditions: Conditions, axes: Axes) -> Floats:
        """Return the output itself."""
        return np.asarray(conditions.specific_force_mps2 @ axes.p)[:, None]

    return _law(GRAVITY, columns, np.array([relative]), names=("gravity",), shared=True, line=GRAVITY)


def level_law(expected_rad: float) -> Law:
    """Return the law of a base that is not level: rotations about its x and y axes, common to all accelerometers.

    ``expected_rad`` is the standard deviation of each.
    """

    def columns(conditions: Conditions, axes: Axes) -> Floats:
        """Return the components along p of gravity turned with the base."""
        tilts = (np.array([0.0, -GRAVITY_MPS2, 0.0]), np.array([GRAVITY_MPS2, 0.0, 0.0]))
        turned = [into_body(tilt, conditions.angle_rad, conditions.gimbals) @ axes.p for tilt in tilts]
        return np.column_stack(turned)

    return _law(LEVEL, columns, np.full(2, expected_rad), names=("about x", "about y"), shared=True, line=LEVEL)


def orthogonality_law(gimbals: Sequence[str], expected_rad: float) -> Law:
    """Return the law of small rotations between each axis of a table and the next: of its directions and its zero.

    It has three for each axis but the outermost, each with the standard deviation ``expected_rad``.
    """
    names = [f"{about} before {axis}" for axis in gimbals[1:] for about in AXES]

    def columns(conditions: Conditions, axes: Axes) -> Floats:
        """Return the components along p of gravity turned before each axis but the outermost, (N, 3 for each)."""
        up = np.array([0.0, 0.0, GRAVITY_MPS2])
        found = []
        for place in range(1, len(conditions.gimbals)):
            outer, inner = conditions.gimbals[:place], conditions.gimbals[place:]
            before = into_body(up, conditions.angle_rad[:, :place], outer)
            for about in range(3):
                moved = -np.cross(np.eye(3)[about], before)
                found.append(_into_each(moved, conditions.angle_rad[:, place:], inner) @ axes.p)
        return np.column_stack(found)

    return _law(ORTHOGONALITY, columns, np.full(len(names), expected_rad), names=names, shared=True, line=ORTHOGONALITY)


def laws_of_table(gimbals: Sequence[str], *, level_rad: float, orthogonality_rad: float) -> list[Law]:
    """Return the laws of the errors of a table that tilt gravity, of these expected sizes: level, then orthogonality.

    That of orthogonality is left out for a table of one axis, and if its size is 0.
    """
    laws = [level_law(level_rad)]
    if orthogonality_rad > 0 and len(gimbals) > 1:
        laws.append(orthogonality_law(gimbals, orthogonality_rad))
    return laws


def laws_beside(
    prior: ForcePrior,
    gimbals: Sequence[str],
    stated: TableUncertainty | None,
    gravity: Gravity,
    *,
    delay_sd_s: float,
    arm_m: Floats,
    delay_s: float,
) -> list[Law]:
    """Return all laws beside the states, about the lever arm (3,) and the delay that were subtracted.

    They are lever arm, places apart from it, delay, those of the table, gravity. ``prior`` is the data sheet,
    ``stated`` the uncertainty of the table, ``delay_sd_s`` what is expected of the delay. Where no level is stated, or
    0, ``UNSTATED_LEVEL_RAD`` is expected; an orthogonality that is not stated counts as perfect. A stated gravity (of
    uncertainty 0) has no law.
    """
    level_rad = stated.level_rad if stated is not None and stated.level_rad else UNSTATED_LEVEL_RAD
    return [
        arm_law(np.full(3, prior.arm_m), arm_m),
        apart_law(np.full(3, prior.apart_m)),
        delay_law(delay_sd_s, delay_s, arm_m),
        *laws_of_table(
            gimbals,
            level_rad=level_rad,
            orthogonality_rad=stated.orthogonality_rad if stated is not None else 0.0,
        ),
        *([gravity_law(gravity.sd)] if gravity.sd else []),
    ]


def rest_angle_law(table: TableReadings) -> Law | None:
    """Return the law of the angles of axes that stand: each is off its reading by up to half a count of its encoder.

    A count of 2 pi / 65536 is 1 mm/s2 of gravity. It is the same error until the axis moves again, whatever the other
    axes do meanwhile, so that no averaging reduces it. None if no axis stands, or with readings that are not rounded.
    """
    return counted_angles_law(table, least_steps(np.abs(np.diff(table.angle_rad, axis=0))))


def counted_angles_law(table: TableReadings, counts_rad: Floats) -> Law | None:
    """Return the law of the angles of axes that stand, for counts (g,) of their encoders in rad, infinite if unknown.

    Axes are in the order of the table's gimbals. The law has one parameter for each span in which an axis of a known
    count stands, axis by axis, common to all accelerometers; its standard deviation is the count over the root of 12.
    None if there is no such span.
    """
    rounded = [place for place, count in enumerate(counts_rad.tolist()) if np.isfinite(count)]
    stands_ns = table.stands_ns
    spans_s = [(place, first * 1e-9, last * 1e-9) for place in rounded for first, last in stands_ns[place]]
    if not spans_s:
        return None
    names = [f"{table.gimbals[place]} from {first_s:.1f} s" for place, first_s, _ in spans_s]

    def columns(conditions: Conditions, axes: Axes) -> Floats:
        """Return the changes (N, spans) of the output, in m/s2 per rad, by the angle of each axis that stands.

        They are 0 outside of the span.
        """
        changes = {}
        for place in rounded:
            unit = np.eye(3)[AXES.index(conditions.gimbals[place])]
            about = into_body(unit, conditions.angle_rad[:, place + 1 :], conditions.gimbals[place + 1 :])
            changes[place] = np.cross(conditions.specific_force_mps2, about) @ axes.p
        t_s = conditions.t_s
        return np.column_stack([changes[place] * ((t_s >= first) & (t_s <= last)) for place, first, last in spans_s])

    expected = counts_rad[[place for place, _, _ in spans_s]] / np.sqrt(12)
    return _law(RESOLUTION, columns, expected, names=names, shared=True, line=RESOLUTION)


def _into_each(vectors: Floats, angles_rad: Floats, gimbals: Sequence[str]) -> Floats:
    """Return vectors (N, 3), each turned by the angles (N, g) of its own row."""
    columns = [into_body(unit, angles_rad, gimbals) for unit in np.eye(3)]
    return np.asarray(sum(column * vectors[:, [place]] for place, column in enumerate(columns)))


def _law(
    called: str,
    columns: Callable[[Conditions, Axes], Floats],
    expected: Floats,
    *,
    names: Sequence[str],
    shared: bool,
    mean: Floats | None = None,
    line: str = "",
) -> Law:
    """Return a law with ``columns``, its parameters called ``names``, with their ``expected`` standard deviations (k,).

    ``shared`` says that all accelerometers have the same parameters, ``mean`` (k,) where these are expected, by default
    at zero. ``line`` is the line of the budget that the law fills, "" for none.
    """
    parameters = tuple(Parameter(name, "", float(sd)) for name, sd in zip(names, expected, strict=True))
    record = Record(name=called.replace(" ", "_"), parameters=parameters, shared=shared)
    regressors: Regressors = columns
    effect = Effect(
        name=called, parameters=parameters, regressors=regressors, needs=frozenset({"gimbals"}), record=record
    )
    return Law(
        called=called, effect=effect, mean=np.zeros(len(expected)) if mean is None else mean, sd=expected, line=line
    )
