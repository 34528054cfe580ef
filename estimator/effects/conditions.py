"""Conditions of gyros on a table: everything on which the regressor of an effect may depend."""

from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from estimator.geometry.kinematics import Site, Turn, body_rate, check_gimbals, specific_force, turn_frame, turns_of
from estimator.types import Floats

SLOPE_S = 10.0
"""Time constant over which a causal slope of the temperature is taken: readings are too coarse for differences."""
REFERENCE_C = 25.0
"""Temperature at which data sheets state bias and scale factor."""


class Axes(NamedTuple):
    """Sense axis and tilt axes of one gyro, (3,) each, in body axes."""

    p: Floats
    j: Floats
    k: Floats


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Conditions:
    """Conditions on an even grid of instants ``t_s`` (N,).

    ``w_rps`` and ``wdot_rps2`` (N, 3): inertial rate of the body in body axes, and its derivative there. ``angle_rad``,
    ``rate_rps``, ``acceleration_rps2`` (N, g): those of the ``gimbals``, outermost first; there are none without a
    table. ``specific_force_mps2`` (N, 3) in body axes, NaN if unknown; ``temperature_c`` (N,), None if unknown.
    ``w_rps`` includes Earth rate only if there is a ``site``. ``delayed_rps(delay_s)`` gives the body rate (N, 3) that
    long before, averaged over the same samples as the output errors; None for planned conditions. ``causal``: nothing
    later than an instant is known there. ``reference_c``: temperature at which thermal effects are zero. ``cache``
    holds the results of ``once``.
    """

    t_s: Floats
    w_rps: Floats
    wdot_rps2: Floats
    angle_rad: Floats
    rate_rps: Floats
    acceleration_rps2: Floats
    gimbals: tuple[str, ...]
    specific_force_mps2: Floats
    temperature_c: Floats | None = None
    site: Site | None = None
    delayed_rps: Callable[[float], Floats] | None = None
    causal: bool = False
    reference_c: float = REFERENCE_C
    cache: dict[Hashable, Any] = field(default_factory=dict, init=False, repr=False)

    @property
    def warming_kps(self) -> Floats:
        """Slope (N,) of the temperature in K/s, smoothed over ``SLOPE_S`` if causal; zero if it is not known."""
        if self.temperature_c is None:
            return np.zeros(len(self.t_s))
        if self.causal:
            return smoothed_slope(self.t_s, self.temperature_c)
        return np.asarray(np.gradient(self.temperature_c, self.t_s))

    @property
    def offers(self) -> frozenset[str]:
        """Data that effects can use: "gimbals", "specific force" (finite at all instants), "temperature" (if given)."""
        held = {
            "gimbals": bool(self.gimbals),
            "specific force": bool(np.isfinite(self.specific_force_mps2).all()),
            "temperature": self.temperature_c is not None,
        }
        return frozenset(name for name, there in held.items() if there)

    @property
    def period_s(self) -> float:
        """Spacing of the grid."""
        return float(self.t_s[1] - self.t_s[0])

    def once(self, key: Hashable, work: Callable[[], Floats]) -> Floats:
        """Return the array ``work()``, computed at the first call with ``key`` and kept; it is read-only.

        The key must contain everything besides the conditions on which the values depend.
        """
        if key not in self.cache:
            values = work()
            values.flags.writeable = False
            self.cache[key] = values
        found: Floats = self.cache[key]
        return found

    @property
    def memories(self) -> dict[str, Floats] | None:
        """By text the functions with memory that are the same for all gyros; None while they are not shared."""
        found: dict[str, Floats] | None = self.cache.get("memories")
        return found

    @contextmanager
    def sharing_memories(self) -> Iterator[None]:
        """Share ``memories`` among the laws and gyros that are evaluated inside, and drop them in the end."""
        self.cache["memories"] = {}
        try:
            yield
        finally:
            del self.cache["memories"]

    def thinned(self, first: int, stride: int) -> "Conditions":
        """Return the rows ``first``, ``first + stride``, ...: always the same object, so that it keeps its values."""
        key = "thinned", first, stride
        if key not in self.cache:
            self.cache[key] = self.rows(slice(first, None, stride))
        found: Conditions = self.cache[key]
        return found

    def rows(self, chosen: slice | NDArray[np.intp]) -> Self:
        """Return the conditions at some instants, without the earlier rates that a delay needs."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        cut: dict[str, Any] = {name: v[chosen] for name, v in values.items() if isinstance(v, np.ndarray)}
        return replace(self, **cut, delayed_rps=None)

    @classmethod
    def on_table(
        cls,
        t_s: Floats,
        angle_rad: Floats,
        rate_rps: Floats,
        acceleration_rps2: Floats,
        gimbals: Sequence[str],
        *,
        temperature_c: Floats | None = None,
        site: Site | None = None,
    ) -> Self:
        """Return the conditions of a body that g gimbals move: at instants (N,) in s, angles, rates, accelerations (N,
        g).

        ``gimbals`` are named outermost first. The specific force is standard gravity, without accelerations. Without a
        ``site`` Earth rate is left out; ``temperature_c`` is (N,). RecordingError for unknown gimbals.
        """
        names = check_gimbals(gimbals)
        turns = turns_of(angle_rad, names)
        return cls(
            t_s=t_s,
            w_rps=body_rate(angle_rad, rate_rps, names, site, turns),
            wdot_rps2=body_acceleration(angle_rad, rate_rps, acceleration_rps2, names, site, turns=turns),
            angle_rad=angle_rad,
            rate_rps=rate_rps,
            acceleration_rps2=acceleration_rps2,
            gimbals=names,
            specific_force_mps2=specific_force(angle_rad, names, turns),
            temperature_c=temperature_c,
            site=site,
        )


def smoothed_slope(t_s: Floats, temperature_c: Floats) -> Floats:
    """Return the slope (N,) in K/s of a temperature that is smoothed by a first-order lag of ``SLOPE_S``.

    A reading that is no number makes its own slope NaN, and those after it only go by the others.
    """
    step_s = np.maximum(np.diff(t_s, prepend=t_s[:1]), 0.0)
    return (temperature_c - follow(temperature_c, SLOPE_S / (SLOPE_S + step_s))) / SLOPE_S


def follow(values: Floats, shares: Floats) -> Floats:
    """Return values (N,) smoothed recursively: each output keeps ``shares`` of the last output's distance to the input.

    ``shares`` are (N,), or (1,) for all. It starts at the first finite value. Values that are not finite are skipped,
    and returned unchanged.
    """
    out = np.array(values, dtype=np.float64)
    finite = np.isfinite(out)
    shares = np.broadcast_to(shares, out.shape)
    if finite.all():
        return _follow_finite(out, shares)
    out[finite] = _follow_finite(out[finite], shares[finite])
    return out


def _follow_finite(x: Floats, share: Floats) -> Floats:
    """Return finite values (N,) smoothed recursively: y[n] = share[n] y[n-1] + (1 - share[n]) x[n], with y[0] = x[0].

    This is a lower triangular system with one band below its diagonal.
    """
    from scipy.linalg.blas import dtbsv  # solves such systems; scipy.signal takes half a second to import

    if not len(x):
        return x
    bands = np.ones((2, len(x)), order="F")
    bands[1, :-1] = -share[1:]
    right = (1 - share) * (x - x[0])
    return np.asarray(x[0] + dtbsv(1, bands, right, lower=1, diag=1, overwrite_x=1))


def body_acceleration(
    angle_rad: Floats,
    rate_rps: Floats,
    acceleration_rps2: Floats,
    gimbals: Sequence[str],
    site: Site | None = None,
    *,
    turns: Sequence[Turn] | None = None,
) -> Floats:
    """Return the derivative (N, 3) of the body rate in body axes, rad/s2.

    Angles, rates and accelerations are (N, g), for g ``gimbals``, outermost first; Earth rate is that of the ``site``,
    none without. ``turns`` are those of the angles, if they are at hand. Through each gimbal with axis e, v becomes
    R' v + e rate, so its derivative becomes R' vdot - rate e x (R' v) + e acceleration.
    """
    base = np.zeros(3) if site is None else site.earth_rate_rps()
    v = np.tile(base, (len(angle_rad), 1))
    vdot = np.zeros_like(v)
    for column, turn in enumerate(turns_of(angle_rad, gimbals) if turns is None else turns):
        e = np.eye(3)[turn[0]]
        v, vdot = turn_frame(v, turn), turn_frame(vdot, turn)
        vdot = vdot - rate_rps[:, [column]] * np.cross(e, v) + acceleration_rps2[:, [column]] * e
        v = v + rate_rps[:, [column]] * e
    return vdot
