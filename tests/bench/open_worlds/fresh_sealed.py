"""Ten more kinds, kept for the end: while the program is worked on, nothing here is run beyond its oracle.

The docstring of a law names where its mechanism is described. Constants of a law are drawn once for a case from what
such devices have; the law, its constants and its units do not depend on a run. Every kind is a function of what the
recordings hold. The kinds are fixed: the program is fitted to none of them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from open_worlds.effects import Kind, Registry, Scene, column
from open_worlds.motion import DEG

Floats = NDArray[np.float64]

KINDS: dict[str, Kind] = {}
_kind = Registry(KINDS)

_MODES = 12  # of a plate, the fastest with a time constant of 1 / 529 of the slowest
_HARMONICS = 60  # of a saw tooth, whose edges noise rounds


# The temperature less a lag times its slope is what diffusion is while it is slow.
@_kind("temperature time", thermal=True, shape="by run", parts="thermal_bias thermal_gradient")
def diffused_temperature(scene: Scene) -> Floats:
    """Temperature on the insulated face of a plate whose other face has the thermometer's: 1 / cosh(sqrt(s d^2 / a)).

    Carslaw, Jaeger, Conduction of Heat in Solids, 3.4: a sum of lags with time constants as 1, 1/9, 1/25 and
    weights of alternating sign. Boards of 6 to 9 mm (a = 3e-7 m2/s) have d^2 / a of 120 to 270 s.
    """
    diffusion_s = scene.fixed.uniform(120, 270)
    far_c = np.zeros_like(scene.warmth_c)
    at_once = 1.0  # the weight of all faster modes, which are at their ends by then
    for number in range(_MODES):
        odd = 2 * number + 1
        weight = (-1) ** number * 4 / (math.pi * odd)
        at_once -= weight
        far_c += weight * scene.lagged(scene.warmth_c, diffusion_s * (2 / (math.pi * odd)) ** 2)
    return column(0.008 * DEG * (far_c + at_once * scene.warmth_c))


# A step of the bias is what one sees of a relay in one run.
@_kind("temperature direction time", thermal=True, shape="by run", parts="bias_step")
def thermostat_relay(scene: Scene) -> Floats:
    """Heater that a thermostat turns off at one temperature and on again at a lower one; the die follows it.

    The relay with hysteresis of any two-point controller, for example of a sensor's oven.
    """
    on_c = scene.fixed.uniform(1.5, 3.0)
    off_c = scene.fixed.uniform(4.5, 6.5)
    die_s = scene.fixed.uniform(3, 8)
    return column(0.04 * DEG * scene.lagged(relayed(scene.warmth_c, on_c, off_c), die_s))


@_kind("time rate")
def scale_power_relaxation(scene: Scene) -> Floats:
    """Scale factor that relaxes as a power of time: charge that creeps into the dielectric of an electrode.

    The law of Curie and von Schweidler, t^-n with n up to 1; A. K. Jonscher, Dielectric Relaxation in Solids (1983).
    """
    start_s = scene.fixed.uniform(10, 40)
    power = scene.fixed.uniform(0.5, 1.0)
    return 5e-3 * column((1 + scene.t_s / start_s) ** -power) * scene.u_rps


@_kind("gravity rate angle", tilted=True)
def sagging_mount(scene: Scene) -> Floats:
    """Soft mount that lets the sense axis tip towards the side that gravity pulls to: its tilt is a function of pose.

    Tilt about each of two axes is a compliance times gravity across it, and what the gyro feels is that tilt times the
    rate across. Isolators differ by direction: C. E. Crede, Vibration and Shock Isolation (1951).
    """
    out = np.zeros_like(scene.u_rps)
    for axes, compliance in zip((scene.j, scene.k), scene.fixed.uniform(1e-3, 3e-3, 2), strict=True):
        out += compliance * (scene.motion.up @ axes.T) * (scene.motion.w_rps @ axes.T)
    return out


# The part of gravity that is not late, and the harmonic at right angles to it, which is the late one at one rate.
@_kind("gravity time angle", parts="g_sensitivity table_harmonic")
def floated_unbalance(scene: Scene) -> Floats:
    """Mass unbalance of a float that creeps through its fluid: gravity in one direction of the gyro, behind a lag.

    Mass unbalance along spin and input axis: IEEE Std 517; a float's slow motion in its fluid after a turn: Wrigley,
    Hollister, Denhard, Gyroscopic Theory, Design, and Instrumentation (1969).
    """
    lag_s = scene.fixed.uniform(4, 15)
    towards = scene.fixed.uniform(0, 2 * np.pi)
    unbalance = math.cos(towards) * scene.p + math.sin(towards) * scene.j
    return 0.06 * DEG * scene.lagged(scene.motion.up @ unbalance.T, lag_s)


@_kind("rate direction")
def drive_at_its_rail(scene: Scene) -> Floats:
    """Scale beyond a rate at which the loop that holds a vibrating gyro's amplitude has no more voltage to give.

    Amplitude control of the drive mode: Acar, Shkel, MEMS Vibratory Gyroscopes (2009). Below the corner the loop holds,
    beyond it the amplitude falls with the rate.
    """
    corner_dps = scene.fixed.uniform(8, 14, scene.gyros)
    beyond_rps = np.maximum(np.abs(scene.u_dps) - corner_dps, 0.0) * DEG
    return 4e-3 * np.sign(scene.u_rps) * beyond_rps


@_kind("rate")
def subranging_converter(scene: Scene) -> Floats:
    """Error of a converter's stages: a saw tooth over the rate, as many teeth as the first stage has ranges.

    Gain error between the stages of a subranging converter: W. Kester, The Data Conversion Handbook (2005), 3.2. It
    converts far more often than samples leave the device, and the noise of a conversion rounds the edges; none of them
    is at rest.
    """
    period_dps = scene.fixed.uniform(4, 12)
    noise_dps = scene.fixed.uniform(0.1, 0.4)
    at_zero = scene.fixed.uniform(0.2, 0.8, scene.gyros)
    turns = 2 * np.pi * (scene.u_dps / period_dps + at_zero)
    teeth = np.zeros_like(turns)
    for order in range(1, _HARMONICS + 1):
        rounded = math.exp(-2 * (math.pi * order * noise_dps / period_dps) ** 2)
        teeth -= rounded * np.sin(order * turns) / (math.pi * order)
    return 0.08 * DEG * teeth


@_kind("angle")
def cable_windup(scene: Scene) -> Floats:
    """Torque of a cable that a turning axis winds up, as a spring: it strains the plate by all turns since home.

    The angle counts on beyond a turn. Service loops are specified by their torque a turn.
    """
    axis = scene.axis()
    return column(0.04 * DEG * scene.angle(axis) / (4 * np.pi))


@_kind("rate time")
def ratiometric_scale(scene: Scene) -> Floats:
    """Scale of a gyro whose converter is referred to the supply, which sags with what the table's motors take.

    Analog Devices, application note AN-767: an absolute output read against the supply changes by as much as it does.
    Motors take current in proportion to their rates, and the regulator settles behind a lag.
    """
    lag_s = scene.fixed.uniform(3, 15)
    load = np.abs(scene.motion.rate_rps).sum(axis=1) / (20 * DEG)
    return 1.5e-3 * column(scene.lagged(load, lag_s)) * scene.u_rps


@_kind("angle rate", common=True, of_table=True)
def axis_wobble(scene: Scene) -> Floats:
    """Tilt of the outer axis that goes round with its angle, two or three times a turn: what its bearing does.

    Tilt error motion of an axis of rotation: ISO 230-7. Its derivative is a rate across the axis, fixed to the base.
    """
    waves = int(scene.fixed.integers(2, 4))
    phases = scene.fixed.uniform(0, 2 * np.pi, 2)
    tilts_rad = scene.fixed.uniform(0.6e-3, 1.4e-3, 2)
    angle, rate_rps = scene.angle("z"), scene.rate("z")
    across_rps = np.zeros((len(angle), 3))
    for direction, (phase, tilt_rad) in enumerate(zip(phases, tilts_rad, strict=True)):
        across_rps[:, direction] = -tilt_rad * waves * rate_rps * np.sin(waves * angle - phase)
    in_body = np.einsum("nji,nj->ni", scene.motion.attitude, across_rps)
    return np.asarray(in_body @ scene.p.T)


def relayed(values: Floats, on_below: float, off_above: float) -> Floats:
    """Return the state (n,) of a relay, 1 or 0: on below one limit, off above the other, at first on."""
    switched = (values < on_below) | (values > off_above)
    last = np.maximum.accumulate(np.where(switched, np.arange(len(values)), -1))
    return np.where(last >= 0, values[np.maximum(last, 0)] < on_below, True).astype(np.float64)
