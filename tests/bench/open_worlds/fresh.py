"""Ten more kinds of effects outside the catalogue, each from its physics, as different in form as could be found.

The docstring of a law names where its mechanism is described. Constants of a law are drawn once for a case from what
such devices have; the law, its constants and its units do not depend on a run. Every kind is a function of what the
recordings hold. The kinds are fixed: the program is fitted to none of them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from open_worlds.effects import Kind, Registry, Scene, along_axis, column, played
from open_worlds.motion import DEG

Floats = NDArray[np.float64]

KINDS: dict[str, Kind] = {}
_kind = Registry(KINDS)


# The gradient of the housing is what a lag leaves out: true where the temperature changes slowly.
@_kind("temperature time", thermal=True, shape="by run", parts="thermal_gradient")
def coil_transient(scene: Scene) -> Floats:
    """Rate of change of a fibre coil's temperature, which follows the housing, which follows the thermometer.

    A changing temperature makes the two ways through the coil differ: D. M. Shupe, Applied Optics 19 (1980) 654.
    Housing and coil are two heat capacities in a row.
    """
    housing_s = scene.fixed.uniform(15, 40)
    coil_s = scene.fixed.uniform(30, 90)
    housing_c = scene.lagged(scene.warmth_c, housing_s)
    slope_cps = (housing_c - scene.lagged(housing_c, coil_s)) / coil_s
    return column(0.5 * DEG * slope_cps)


@_kind("temperature", thermal=True, shape="by run")
def activity_dip(scene: Scene) -> Floats:
    """Bias near the temperature at which an unwanted mode of a quartz fork crosses the wanted one: a resonance curve.

    Activity dips are described for quartz resonators in J. R. Vig, Quartz Crystal Resonators and Oscillators, under
    "activity dips": a coupled mode with a steep temperature coefficient takes energy within a degree or so.
    """
    centre_c = scene.fixed.uniform(2.5, 5.5)
    half_width_c = scene.fixed.uniform(0.4, 1.0)
    return column(0.05 * DEG / (1 + ((scene.warmth_c - centre_c) / half_width_c) ** 2))


# A decay with one time constant and a slope are what one sees of a spectrum of them.
@_kind("time", parts="warm_up bias_drift")
def stretched_relaxation(scene: Scene) -> Floats:
    """Relaxation of the stress that a die's adhesive holds: exp(-(t / tau)^beta) of Kohlrausch.

    Drift of micromachined sensors by viscoelastic adhesive: Zhou et al., Materials 10 (2017) 1077. Exponents of
    glassy polymers lie between a third and two thirds.
    """
    beta = scene.fixed.uniform(0.35, 0.65)
    tau_s = scene.fixed.uniform(20, 120)
    return column(0.08 * DEG * np.exp(-((scene.t_s / tau_s) ** beta)))


@_kind("gravity angle", tilted=True)
def anisoelastic(scene: Scene) -> Floats:
    """Compliance of a suspension: the product of specific forces along two axes of the gyro, and of another two.

    The g-squared terms of the drift model in IEEE Std 517: the mass moves along one axis by a force along another, and
    a third pulls at it. Sense axis, spin axis (j) and output axis (k) are the gyro's own.
    """
    share = scene.fixed.uniform(-1, 1)
    sense, spin, output = (scene.motion.up @ axes.T for axes in (scene.p, scene.j, scene.k))
    return np.asarray(0.06 * DEG * (sense * spin + share * spin * output))


@_kind("rate", tilted=True)
def anisoinertia(scene: Scene) -> Floats:
    """Product of the rates about sense axis and spin axis: the float's moments of inertia about both differ.

    Euler's equations of the float; Wrigley, Hollister, Denhard, Gyroscopic Theory, Design, and Instrumentation (1969).
    Each spin axis lies across its sense axis, in a direction of its own.
    """
    direction = scene.fixed.uniform(0, 2 * np.pi, (scene.gyros, 1))
    spin = np.cos(direction) * scene.j + np.sin(direction) * scene.k
    spin_dps = scene.motion.w_rps @ spin.T / DEG
    return np.asarray(0.03 * DEG * scene.u_dps * spin_dps / 15**2)


# Within its threshold it is a dead band; beyond it is none.
@_kind("rate direction", sized=True, parts="dead_band")
def lock_in(scene: Scene) -> Floats:
    """Beat of a ring laser without dither: sign(u) sqrt(u^2 - L^2) beyond the threshold L, nothing within it.

    F. Aronowitz, The Laser Gyro, in Laser Applications 1 (1971). The error is L^2 / (2 u) far from the threshold, so it
    is L^2 that has the size.
    """
    threshold_dps = scene.fixed.uniform(0.4, 0.9, scene.gyros) * math.sqrt(scene.size)
    beyond = np.maximum(scene.u_dps**2 - threshold_dps**2, 0.0)
    return np.asarray(DEG * (np.sign(scene.u_dps) * np.sqrt(beyond) - scene.u_dps))


# Once it is settled, its heat is the square of the rate, and the product a cube.
@_kind("rate time", parts="scale_cubic")
def torquer_heat_scale(scene: Scene) -> Floats:
    """Scale factor of a rebalanced gyro: its torquer's magnet is warmed by the current, which goes with the rate.

    Power is the square of the current, a magnet loses strength with temperature, and its temperature lags: the scale
    factor's warm-up under torque that IEEE Std 813 asks to be tested.
    """
    lag_s = scene.fixed.uniform(20, 90)
    return 1.2e-3 * scene.u_rps * scene.lagged((scene.u_dps / 20) ** 2, lag_s)


@_kind("rate direction")
def torquer_hysteresis(scene: Scene) -> Floats:
    """Magnetic hysteresis of a torquer's iron: the field lags behind the current, which goes with the rate.

    A sum of plays of different widths, which contains Rayleigh's loops; review in Materials 16 (2023) 2422.
    """
    radius_dps = scene.fixed.uniform(1.0, 3.0)
    weights = scene.fixed.uniform(0.5, 1.5, 3)
    out = np.zeros_like(scene.u_dps)
    for gyro, rate_dps in enumerate(scene.u_dps.T):
        for number, weight in enumerate(weights, start=1):
            out[:, gyro] += weight * (played(rate_dps, number * radius_dps) - rate_dps)
    return 1.5e-3 * DEG * out


@_kind("rate time")
def convective_cooling(scene: Scene) -> Floats:
    """Cooling of a device warmer than the air: the root of the speed through it, behind the device's own lag.

    L. V. King, Phil. Trans. A 214 (1914) 373: heat taken off by a stream goes with the root of its speed.
    """
    speed_dps = np.linalg.norm(scene.motion.w_rps, axis=1) / DEG
    lag_s = scene.fixed.uniform(15, 60)
    return column(0.04 * DEG * scene.lagged(np.sqrt(speed_dps / 20), lag_s))


@_kind("angle rate direction", common=True, of_table=True)
def gear_flanks(scene: Scene) -> Floats:
    """Pitch error of a table's wheel, which is another on the flanks that drive it back: a harmonic by direction.

    ISO 1328-1 measures cumulative pitch deviations for right and left flanks apart. One to three waves a turn are
    those of a wheel that was clamped off its centre or in as many jaws.
    """
    axis = scene.axis()
    waves = int(scene.fixed.integers(1, 4))
    phases = scene.fixed.uniform(0, 2 * np.pi, 2)
    sizes = scene.fixed.uniform(0.5, 1.5, 2)
    forward, back = (
        size * np.cos(waves * scene.angle(axis) - phase) for size, phase in zip(sizes, phases, strict=True)
    )
    rate_rps = scene.rate(axis)
    return 1.5e-3 * column(rate_rps * np.where(rate_rps >= 0, forward, back)) * along_axis(scene, axis)
