"""Six kinds kept for the end: while the program is worked on, nothing here is read or run beyond its oracle.

The docstring of a law names where its mechanism is described. Constants of a law are drawn once for a case from what
such devices have; the law, its constants and its units do not depend on a run. Every kind is a function of what the
recordings hold. Twelve kinds were written from their physics and a shuffle took these six of them: neither half is
the harder one by design. The kinds are fixed: the program is fitted to none of them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from open_worlds.effects import Kind, Registry, Scene, along_axis, column, played
from open_worlds.motion import DEG

Floats = NDArray[np.float64]

KINDS: dict[str, Kind] = {}
_kind = Registry(KINDS)


# A scale factor that goes with the temperature is the slope of the cosine away from its crest.
@_kind("temperature rate", thermal=True, shape="by run", parts="thermal_scale")
def demodulation_phase(scene: Scene) -> Floats:
    """Scale factor that falls as the cosine of the demodulator's phase error, which goes with the temperature.

    A. M. Shkel, C. Acar, MEMS Vibratory Gyroscopes (2009): the rate signal is demodulated against the drive. The phase
    was adjusted at one temperature, and the filters before the demodulator turn it by about a degree a kelvin.
    """
    adjusted_c = scene.fixed.uniform(1.5, 5.0)
    slope_rad_per_c = scene.fixed.uniform(0.012, 0.02)
    phase_rad = slope_rad_per_c * (scene.warmth_c - adjusted_c)
    return column(np.cos(phase_rad) - 1) * scene.u_rps


@_kind("rate")
def critical_speed(scene: Scene) -> Floats:
    """Rectified vibration of a fixture that a turning axis drives through its resonance: a peak over the axis' rate.

    The motor's ripple has a frequency in proportion to the rate. Amplitude of what an unbalance drives: J. P. Den
    Hartog, Mechanical Vibrations (1956), chapter 2. A gyro rectifies its square: IEEE Std 528, vibration rectification.
    """
    critical_dps = scene.fixed.uniform(10, 24)
    damping = scene.fixed.uniform(0.15, 0.3)
    ratio = (scene.motion.rate_rps / (critical_dps * DEG)) ** 2
    square = ratio**2 / ((1 - ratio) ** 2 + 4 * damping**2 * ratio)
    return column(0.01 * DEG * square.sum(axis=1))


@_kind("rate time")
def thixotropic_grease(scene: Scene) -> Floats:
    """Drag of a bearing whose grease thins as it is sheared and thickens again at rest: more current as a turn begins.

    Moore's equation for the structure s of the grease, ds/dt = (1 - s) / tau - k |rate| s; H. A. Barnes, Thixotropy -
    a review, J. Non-Newtonian Fluid Mech. 70 (1997) 1. Drag goes with s times the rate, and a coil's field with it.
    """
    recovery_s = scene.fixed.uniform(20, 60)
    shear_rad = scene.fixed.uniform(100, 250) * DEG
    period_s = float(scene.t_s[1] - scene.t_s[0])
    drag = np.zeros(len(scene.t_s))
    for speed_rps in np.abs(scene.motion.rate_rps).T:
        rates_of_change = 1 / recovery_s + speed_rps / shear_rad
        settled = 1 / (recovery_s * rates_of_change)
        drag += speed_rps * _approached(settled, np.exp(-rates_of_change * period_s))
    return column(0.06 * DEG * drag / (20 * DEG))


@_kind("rate time")
def dielectric_soakage(scene: Scene) -> Floats:
    """Charge that an integrator's capacitor gives back after a rate: several lags of the signed rate, each by five.

    Dielectric absorption as a ladder of RC branches: R. A. Pease, Understand capacitor soakage to optimize analog
    systems, EDN, 13 October 1982.
    """
    shortest_s = scene.fixed.uniform(1.5, 4)
    weights = scene.fixed.uniform(0.5, 1.5, 3)
    out = np.zeros_like(scene.u_rps)
    for number, weight in enumerate(weights):
        out += weight * scene.lagged(scene.u_rps, shortest_s * 5.0**number)
    return 1.2e-3 * out


@_kind("acceleration direction rate")
def slipping_joint(scene: Scene) -> Floats:
    """Mount that turns a little in its bolts by the torque of a ramp, and sticks there until a torque takes it back.

    Jenkins element of a bolted joint, spring and dry friction: L. Gaul, R. Nitsche, Applied Mechanics Reviews 54 (2001)
    93. All sense axes turn about the joint's axis by what has slipped.
    """
    joint = scene.fixed.standard_normal(3)
    joint /= np.linalg.norm(joint)
    sticking_rps2 = scene.fixed.uniform(1.5, 3.0) * DEG
    torque = scene.motion.wdot_rps2 @ joint
    slip_rad = 5e-3 * played(torque, sticking_rps2) / (20 * DEG)
    return column(slip_rad) * (scene.motion.w_rps @ np.cross(joint, scene.p).T)


@_kind("angle direction rate", common=True, sized=True, of_table=True)
def gear_backlash(scene: Scene) -> Floats:
    """Backlash between a motor with an encoder and its table: after a reversal the table stands until the gap is shut.

    Backlash of gears: DIN 3967. Values are those of a worm drive that wants adjustment.
    """
    axis = scene.axis()
    half_rad = scene.size * scene.fixed.uniform(0.01, 0.03) * DEG
    period_s = float(scene.t_s[1] - scene.t_s[0])
    behind_rad = played(scene.angle(axis), half_rad) - scene.angle(axis)
    error_rps = np.diff(behind_rad, prepend=behind_rad[:1]) / period_s
    return column(error_rps) * along_axis(scene, axis)


def _approached(settled: Floats, kept: Floats) -> Floats:
    """Return the state (n,) that keeps a share of its distance from each settled value; it is 1 at first."""
    out = np.empty_like(settled)
    state = 1.0
    for row, (goal, share) in enumerate(zip(settled.tolist(), kept.tolist(), strict=True)):
        out[row] = state
        state = goal + (state - goal) * share
    return out
