"""Effects of gyros, table and surroundings that the catalogue does not hold, from their physics.

Each kind is a function of a scene that returns outputs in rad/s at size 1, as (n, 1) for gyros that all feel the same
shape or (n, m); each gyro then has a size and sign of its own, unless the kind is common. What is constant in a case is
drawn from ``scene.fixed``, what differs between runs from ``scene.anew``. The kinds are fixed: the program is fitted to
none of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from open_worlds.motion import DEG, GIMBALS, Motion

Floats = NDArray[np.float64]

_STILL_RPS = 0.05 * DEG  # several times Earth rate: below it an axis or a gyro is said not to turn
_BOLTZMANN_EV_K = 8.617333262e-5
_START_K = 298.15
_G_MPS2 = 9.80665


@dataclass(frozen=True, eq=False)
class Scene:
    """One run: its motion, warmth above that of its start (n,), what gyros put out (n, m).

    The gyros' sense axes ``p`` and tilt axes ``j``, ``k`` (m, 3) are in body axes. ``number`` counts the runs of a
    session, ``fixed`` gives the same numbers in each of them, ``anew`` others. ``size`` is for kinds that are not in
    proportion to it; ``white_rps`` is the noise of a sample, and ``quiet`` asks for what the effect is on the average
    over that noise.
    """

    motion: Motion
    p: Floats
    j: Floats
    k: Floats
    warmth_c: Floats
    output_rps: Floats
    number: int
    fixed: np.random.Generator
    anew: np.random.Generator
    size: float = 1.0
    white_rps: float = 0.0
    quiet: bool = False

    @property
    def t_s(self) -> Floats:
        """Instants (n,) since power-on."""
        return self.motion.t_s

    @property
    def gyros(self) -> int:
        """How many gyros there are."""
        return len(self.p)

    @cached_property
    def u_rps(self) -> Floats:
        """Rate about each sense axis (n, m)."""
        return self.motion.w_rps @ self.p.T

    @cached_property
    def udot_rps2(self) -> Floats:
        """Angular acceleration about each sense axis (n, m)."""
        return self.motion.wdot_rps2 @ self.p.T

    @cached_property
    def u_dps(self) -> Floats:
        """Rate about each sense axis (n, m), deg/s."""
        return self.u_rps / DEG

    def lagged(self, values: Floats, lag_s: float) -> Floats:
        """Return values (n,) or (n, m) behind a first-order lag that is settled when the run begins."""
        period_s = float(self.t_s[1] - self.t_s[0])
        kept = math.exp(-period_s / lag_s)
        start = kept * values[:1]
        return np.asarray(lfilter([1 - kept], [1.0, -kept], values, axis=0, zi=start)[0])

    def angle(self, axis: str) -> Floats:
        """Return the angle (n,) of an axis of the table."""
        return self.motion.angle_rad[:, GIMBALS.index(axis)]

    def rate(self, axis: str) -> Floats:
        """Return the rate (n,) of an axis of the table."""
        return self.motion.rate_rps[:, GIMBALS.index(axis)]

    def axis(self) -> str:
        """Return an axis of the table, the same in every run of a case."""
        return str(self.fixed.choice(list("xyz")))

    def one_gyro(self, values: Floats) -> Floats:
        """Return values (n,) at one gyro, the same in every run of a case, and nothing at the others (n, m)."""
        out = np.zeros((len(values), self.gyros))
        out[:, self.fixed.integers(self.gyros)] = values
        return out


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of effect and what may honestly be said of it.

    ``measured``: it is a function of rates, accelerations, angles, gravity, temperature, time since power-on.
    ``equivalents`` are effects of the catalogue that put out the same in these scripts, ``parts`` are leading terms of
    the law, true as far as they go. ``common``: all gyros have the same size. ``tilted``: it takes turns about an axis
    while another is tilted. ``thermal``: the temperature is in the recordings. ``noise``: nothing of it can be known.
    ``sized``: the law makes its size itself. ``shape`` is that of the temperature where the kind needs one.
    ``of_table``: the table's readings err, not the gyro.
    """

    name: str
    law: Callable[[Scene], Floats]
    depends_on: frozenset[str]
    measured: bool = True
    equivalents: frozenset[str] = frozenset()
    parts: frozenset[str] = frozenset()
    common: bool = False
    tilted: bool = False
    thermal: bool = False
    noise: bool = False
    sized: bool = False
    of_table: bool = False
    shape: str = ""
    arw_dps: float = 0.005


Law = Callable[[Scene], Floats]


@dataclass(frozen=True, slots=True)
class Registry:
    """Collects kinds by name: an instance decorates laws, each of which is registered under its function's name."""

    kinds: dict[str, Kind]

    def __call__(
        self, depends_on: str, *, equivalents: str = "", parts: str = "", **flags: Any
    ) -> Callable[[Law], Law]:
        """Return the decorator for one law; sets are given as words, ``flags`` are fields of ``Kind``."""

        def register(law: Law) -> Law:
            self.kinds[law.__name__] = Kind(
                name=law.__name__,
                law=law,
                depends_on=frozenset(depends_on.split()),
                equivalents=frozenset(equivalents.split()),
                parts=frozenset(parts.split()),
                **flags,
            )
            return law

        return register


KINDS: dict[str, Kind] = {}
_kind = Registry(KINDS)


def column(values: NDArray[Any]) -> Floats:
    """Return values (n,) as what every gyro feels (n, 1)."""
    return np.asarray(values[:, None], dtype=np.float64)


def along_axis(scene: Scene, axis: str) -> Floats:
    """Return the cosine (n, m) between an axis of the table and each sense axis."""
    return np.asarray(scene.motion.axes[:, GIMBALS.index(axis)] @ scene.p.T)


def played(values: Floats, half_width: float) -> Floats:
    """Return values (n,) behind a play: what follows is moved only when the gap of twice the half width is used up."""
    out = np.empty_like(values)
    at = float(values[0])
    for i, value in enumerate(values.tolist()):
        at = min(max(at, value - half_width), value + half_width)
        out[i] = at
    return out


def last_sign(rates_rps: Floats) -> Floats:
    """Return the direction of the last turn (n, m): +1, -1, 0 before the first."""
    turning = np.abs(rates_rps) > _STILL_RPS
    rows = np.where(turning, np.arange(len(rates_rps))[:, None], -1)
    last = np.maximum.accumulate(rows, axis=0)
    signs = np.take_along_axis(np.sign(rates_rps), np.maximum(last, 0), axis=0)
    return np.asarray(np.where(last >= 0, signs, 0.0))


# --- temperature


# In every shape of temperature a lagged one is the temperature, its slope and a decay with the lag, exactly.
@_kind("temperature time", thermal=True, equivalents="thermal_bias thermal_gradient warm_up")
def lagged_temperature(scene: Scene) -> Floats:
    return column(0.006 * DEG * scene.lagged(scene.warmth_c, scene.fixed.uniform(20, 90)))


# A play is the temperature less a sign of its slope: thermal_bias says the first, nothing the second.
@_kind("temperature direction time", thermal=True, shape="cycle", parts="thermal_bias")
def temperature_play(scene: Scene) -> Floats:
    return column(0.006 * DEG * played(scene.warmth_c, scene.fixed.uniform(0.5, 1.0)))


# A cube about the middle of the range, as of a quartz: a line and a parabola leave a quarter of it.
@_kind("temperature", thermal=True, parts="thermal_bias thermal_bias_quadratic")
def temperature_cube(scene: Scene) -> Floats:
    middle_c = scene.fixed.uniform(3, 5)
    return column(0.02 * DEG * ((scene.warmth_c - middle_c) / 4) ** 3)


# Over 8 degC an activation of 1 eV differs from its expansion to second order by 0.3 % of its span.
@_kind("temperature", thermal=True, equivalents="thermal_bias thermal_bias_quadratic")
def temperature_activated(scene: Scene) -> Floats:
    inverse_k = 1 / _START_K - 1 / (_START_K + scene.warmth_c)
    return column(0.025 * DEG * np.expm1(inverse_k / _BOLTZMANN_EV_K))


# Averages over the turns are a g-sensitivity and, where gravity rests, a thermal bias; the product is in neither.
@_kind("temperature gravity", thermal=True, parts="g_sensitivity thermal_bias")
def temperature_times_gravity(scene: Scene) -> Floats:
    return 0.04 * DEG * column(scene.warmth_c / 8) * (scene.motion.up @ scene.p.T)


# What the scale factor follows is the temperature less its lag.
@_kind("temperature rate time", thermal=True, parts="thermal_scale")
def scale_of_lagged_temperature(scene: Scene) -> Floats:
    lag_s = scene.fixed.uniform(20, 90)
    return 3e-4 * column(scene.lagged(scene.warmth_c, lag_s)) * scene.u_rps


# --- gravity


@_kind("gravity angle", tilted=True)
def gravity_product_xy(scene: Scene) -> Floats:
    up = scene.motion.up
    return column(0.05 * DEG * up[:, 0] * up[:, 1])


# While one axis turns alone, -sin(y) cos(y) is the second harmonic of y and nothing else.
@_kind("gravity angle", equivalents="table_harmonic")
def gravity_product_zx(scene: Scene) -> Floats:
    up = scene.motion.up
    return column(0.04 * DEG * up[:, 2] * up[:, 0])


# The same of x: sin(x) cos(x).
@_kind("gravity angle", equivalents="table_harmonic")
def gravity_product_yz(scene: Scene) -> Floats:
    up = scene.motion.up
    return column(0.04 * DEG * up[:, 1] * up[:, 2])


# While one axis turns alone, cos(x)^2 and cos(y)^2 are second harmonics.
@_kind("gravity angle", equivalents="table_harmonic")
def gravity_square(scene: Scene) -> Floats:
    return column(0.03 * DEG * scene.motion.up[:, 2] ** 2)


@_kind("gravity angle", tilted=True)
def gravity_square_tilted(scene: Scene) -> Floats:
    return column(0.04 * DEG * scene.motion.up[:, 2] ** 2)


# The square of a sine of one angle is its second harmonic, for any sense axis.
@_kind("gravity angle", equivalents="table_harmonic")
def gravity_square_of_sense_axis(scene: Scene) -> Floats:
    return np.asarray(0.03 * DEG * (scene.motion.up @ scene.p.T) ** 2)


# The magnitude of a sine of one angle is its harmonics 2 and 4 but for 4 %.
@_kind("gravity angle", equivalents="table_harmonic")
def gravity_magnitude(scene: Scene) -> Floats:
    return np.asarray(0.03 * DEG * np.abs(scene.motion.up @ scene.p.T))


@_kind("gravity angle", tilted=True)
def gravity_magnitude_tilted(scene: Scene) -> Floats:
    return column(0.04 * DEG * np.abs(scene.motion.up[:, 1]))


# --- rate


@_kind("rate direction")
def rate_sign(scene: Scene) -> Floats:
    u = scene.u_rps
    return np.where(np.abs(u) > _STILL_RPS, 0.015 * DEG * np.sign(u), 0.0)


@_kind("rate direction")
def rate_logarithm(scene: Scene) -> Floats:
    width_dps = scene.fixed.uniform(0.5, 2.0)
    return np.asarray(0.006 * DEG * np.sign(scene.u_rps) * np.log1p(np.abs(scene.u_dps) / width_dps))


@_kind("rate")
def rate_root(scene: Scene) -> Floats:
    return np.asarray(0.005 * DEG * np.sqrt(np.abs(scene.u_dps)))


@_kind("rate")
def rate_fourth(scene: Scene) -> Floats:
    return np.asarray(0.03 * DEG * (scene.u_dps / 30) ** 4)


# A curve that saturates is a cube of the rate to leading order: a compressed scale in either's words.
@_kind("rate", equivalents="scale_cubic")
def rate_saturating(scene: Scene) -> Floats:
    x = scene.u_dps / scene.fixed.uniform(40, 60)
    return np.asarray(0.3 * DEG * (np.tanh(x) - x))


@_kind("rate", tilted=True)
def rate_product(scene: Scene) -> Floats:
    w_dps = scene.motion.w_rps / DEG
    return column(0.02 * DEG * w_dps[:, 1] * w_dps[:, 2] / 15**2)


@_kind("direction rate")
def last_turn(scene: Scene) -> Floats:
    return 0.02 * DEG * last_sign(scene.u_rps)


@_kind("direction rate angle")
def last_turn_of_axis(scene: Scene) -> Floats:
    return 0.02 * DEG * last_sign(column(scene.rate(scene.axis())))


@_kind("angle direction rate")
def axis_play(scene: Scene) -> Floats:
    angle = scene.angle(scene.axis())
    half_rad = scene.fixed.uniform(10, 30) * DEG
    return column(0.025 * DEG * (angle - played(angle, half_rad)) / half_rad)


@_kind("rate time")
def self_heating(scene: Scene) -> Floats:
    return 0.03 * DEG * scene.lagged(np.abs(scene.u_dps) / 20, scene.fixed.uniform(10, 60))


@_kind("rate time")
def self_heating_square(scene: Scene) -> Floats:
    return 0.03 * DEG * scene.lagged((scene.u_dps / 20) ** 2, scene.fixed.uniform(10, 60))


@_kind("rate time")
def supply_of_table(scene: Scene) -> Floats:
    total = np.abs(scene.motion.rate_rps).sum(axis=1) / (20 * DEG)
    return column(0.03 * DEG * scene.lagged(total, scene.fixed.uniform(5, 20)))


# The force on a lever that turns is w x (w x r): squares and products of two rates, not the gyro's own square alone.
@_kind("rate gravity acceleration")
def centripetal(scene: Scene) -> Floats:
    arm_m = scene.fixed.uniform(0.3, 0.6, 3) * scene.fixed.choice([-1.0, 1.0], 3)
    w = scene.motion.w_rps
    force_g = np.cross(w, np.cross(w, arm_m)) / _G_MPS2
    return 2.0 * DEG * (force_g @ scene.p.T)


# A leak of another gyro's rate is a misalignment, its lag an angular acceleration across: true to first order.
@_kind("rate acceleration time", parts="acceleration_sensitivity")
def crosstalk(scene: Scene) -> Floats:
    source, sink = scene.fixed.permutation(scene.gyros)[:2]
    leak = scene.lagged(scene.u_rps[:, source], scene.fixed.uniform(1.0, 3.0))
    out = np.zeros_like(scene.u_rps)
    out[:, sink] = 2e-3 * leak
    return out


# --- acceleration


@_kind("acceleration")
def acceleration_square(scene: Scene) -> Floats:
    return np.asarray(0.06 * DEG * (scene.udot_rps2 / (20 * DEG)) ** 2)


@_kind("acceleration")
def acceleration_magnitude(scene: Scene) -> Floats:
    return np.asarray(0.05 * DEG * np.abs(scene.udot_rps2) / (20 * DEG))


# A delay it is, but one that grows with the rate.
@_kind("acceleration rate", common=True, parts="latency")
def rate_dependent_delay(scene: Scene) -> Floats:
    delay_s = 100e-6 * np.abs(scene.u_dps)
    late = [np.interp(scene.t_s - d, scene.t_s, u) for d, u in zip(delay_s.T, scene.u_rps.T, strict=True)]
    return np.column_stack(late) - scene.u_rps


@_kind("acceleration direction rate")
def motor_current(scene: Scene) -> Floats:
    rate, push = scene.motion.rate_rps, scene.motion.acceleration_rps2 / (20 * DEG)
    friction = np.where(np.abs(rate) > _STILL_RPS, 0.3 * np.sign(rate), 0.0)
    return column(0.04 * DEG * np.abs(push + friction).sum(axis=1))


# --- time since power-on


# A decay with one time constant and a slope come close to a logarithm, and both are true of a settling bias in part.
@_kind("time", parts="warm_up bias_drift")
def time_logarithm(scene: Scene) -> Floats:
    return column(0.008 * DEG * np.log1p(scene.t_s / scene.fixed.uniform(3, 15)))


@_kind("time", parts="warm_up bias_drift")
def time_root(scene: Scene) -> Floats:
    return column(0.04 * DEG * np.sqrt(scene.t_s / 340))


@_kind("time rate")
def scale_drift(scene: Scene) -> Floats:
    return 2e-3 * column(scene.t_s / 340) * scene.u_rps


# --- angle


@_kind("angle")
def third_harmonic(scene: Scene) -> Floats:
    return np.cos(3 * column(scene.angle(scene.axis())) - _phases(scene)) * 0.02 * DEG


@_kind("angle")
def fifth_harmonic(scene: Scene) -> Floats:
    return np.cos(5 * column(scene.angle(scene.axis())) - _phases(scene)) * 0.02 * DEG


@_kind("angle", tilted=True)
def angle_difference(scene: Scene) -> Floats:
    return column(0.03 * DEG * np.cos(scene.angle("x") - scene.angle("z")))


# A gear of two turns to one: half harmonics are not in the catalogue.
@_kind("angle")
def half_angle_difference(scene: Scene) -> Floats:
    return column(0.03 * DEG * np.cos(0.5 * (scene.angle("x") - scene.angle("z"))))


@_kind("angle rate", common=True, of_table=True)
def encoder_eccentricity(scene: Scene) -> Floats:
    return _eccentric(scene, 1)


@_kind("angle rate", common=True, of_table=True)
def encoder_third(scene: Scene) -> Floats:
    return _eccentric(scene, 3)


# The vertical field goes with gravity; the horizontal one takes two angles.
@_kind("angle gravity", tilted=True, parts="g_sensitivity table_harmonic")
def magnetic_heading(scene: Scene) -> Floats:
    dip = 62 * DEG
    heading = scene.fixed.uniform(0, 2 * np.pi)
    field = np.array([math.cos(dip) * math.cos(heading), math.cos(dip) * math.sin(heading), -math.sin(dip)])
    pickup = scene.fixed.standard_normal((scene.gyros, 3))
    pickup /= np.linalg.norm(pickup, axis=1, keepdims=True)
    return 0.03 * DEG * (scene.motion.into_body(field) @ pickup.T)


def _phases(scene: Scene) -> Floats:
    return np.asarray(scene.fixed.uniform(0, 2 * np.pi, (1, scene.gyros)))


def _eccentric(scene: Scene, order: int) -> Floats:
    """Return the rate that an encoder with a harmonic error of the angle hides: all gyros feel it by their axes."""
    axis = scene.axis()
    share = np.cos(order * scene.angle(axis) - scene.fixed.uniform(0, 2 * np.pi))
    return 1.5e-3 * column(scene.rate(axis) * share) * along_axis(scene, axis)


# --- what was not measured


@_kind("time", measured=False)
def decaying_jump(scene: Scene) -> Floats:
    tau_s = scene.fixed.uniform(10, 60)
    after_s = scene.t_s - scene.anew.uniform(40, 250)
    return scene.one_gyro(np.where(after_s >= 0, 0.06 * DEG * np.exp(-np.maximum(after_s, 0) / tau_s), 0.0))


@_kind("time", measured=False)
def popcorn(scene: Scene) -> Floats:
    period_s = float(scene.t_s[1] - scene.t_s[0])
    flips = scene.anew.random(scene.output_rps.shape) < period_s / scene.fixed.uniform(8, 40)
    start = scene.anew.choice([-1.0, 1.0], (1, scene.gyros))
    return np.asarray(0.015 * DEG * start * (-1.0) ** np.cumsum(flips, axis=0))


@_kind("time rate", measured=False)
def scale_jump(scene: Scene) -> Floats:
    run, at_s = scene.fixed.integers(2), scene.fixed.uniform(100, 250)
    after = scene.t_s >= at_s if run == scene.number else np.full(len(scene.t_s), scene.number > run)
    return 1.5e-3 * column(after) * scene.u_rps


@_kind("time", measured=False)
def chirp(scene: Scene) -> Floats:
    start_hz, grown = scene.fixed.uniform(0.3, 5.0), scene.fixed.uniform(0.1, 0.5)
    cycles = start_hz * scene.t_s * (1 + 0.5 * grown * scene.t_s / scene.t_s[-1])
    return column(0.03 * DEG * np.sin(2 * np.pi * cycles + scene.anew.uniform(0, 2 * np.pi)))


# A tone is a line that stays; this one stops with the motor.
@_kind("rate time", measured=False, parts="tone")
def tone_while_turning(scene: Scene) -> Floats:
    phase = 2 * np.pi * scene.fixed.uniform(0.5, 20) * scene.t_s + scene.anew.uniform(0, 2 * np.pi)
    return column(np.where(np.abs(scene.rate("z")) > _STILL_RPS, 0.04 * DEG * np.sin(phase), 0.0))


@_kind("rate", measured=False, common=True, sized=True, arw_dps=0.0005)
def coarse_steps(scene: Scene) -> Floats:
    step = 0.02 * DEG * scene.size
    if not scene.quiet:
        return np.asarray(np.round(scene.output_rps / step) * step - scene.output_rps)
    # The saw tooth that rounding adds, as a Fourier series of which the noise has blurred each term.
    out = np.zeros_like(scene.output_rps)
    for order in range(1, 9):
        blurred = math.exp(-2 * (np.pi * order * scene.white_rps / step) ** 2)
        out += step * (-1) ** order / (np.pi * order) * blurred * np.sin(2 * np.pi * order / step * scene.output_rps)
    return out


# A value held for three samples is late by one on the average: to first order a lag of this gyro.
@_kind("acceleration", measured=False, equivalents="sample_hold bandwidth", common=True, sized=True)
def held_samples(scene: Scene) -> Floats:
    gyro = int(scene.fixed.integers(scene.gyros))
    out = np.zeros_like(scene.output_rps)
    rows, count = np.arange(len(out)), 3 if scene.size >= 1 else 2
    out[:, gyro] = scene.output_rps[rows - rows % count, gyro] - scene.output_rps[:, gyro]
    return out


@_kind("rate", measured=False, noise=True)
def noise_of_rate(scene: Scene) -> Floats:
    return np.asarray(0.05 * DEG * scene.u_dps / 20 * scene.anew.standard_normal(scene.u_rps.shape))


# A walk is what the catalogue's walk says.
@_kind("time", measured=False, equivalents="bias_walk")
def walk_of_one(scene: Scene) -> Floats:
    period_s = float(scene.t_s[1] - scene.t_s[0])
    steps = scene.anew.standard_normal(len(scene.t_s)) * math.sqrt(period_s)
    return scene.one_gyro(2e-3 * DEG * np.cumsum(steps))
