"""Sixteen kinds kept for the end: while the program is worked on, nothing here is read or run beyond its oracle.

All are of micromachined gyros and of the tables, drives, chambers and firmware that a laboratory has about them. The
docstring of a law names where its mechanism is described. Constants of a law are drawn once for a case from what such
devices have; the law, its constants and its units do not depend on a run. Every kind is a function of what the
recordings hold. All were written from their physics, without a look at how effects are sought. The kinds are fixed: the
program is fitted to none of them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from open_worlds.effects import Kind, Registry, Scene, along_axis, column
from open_worlds.motion import DEG, GIMBALS

Floats = NDArray[np.float64]

KINDS: dict[str, Kind] = {}
_kind = Registry(KINDS)

_STILL_RPS = 0.05 * DEG  # below it a drive says that its axis stands


@_kind("temperature time", thermal=True, shape="by run")
def time_proportioned_heater(scene: Scene) -> Floats:
    """Bias while a chamber's heater is on: its controller switches it within a fixed cycle, for a share that falls.

    Time-proportioning control: manual of the Partlow MIC 1400, section 4.5; cycles of relays are of 10 to 30 s. On-time
    goes with the deviation from the set point within a band. The cycle begins with power-on.
    """
    cycle_s = scene.fixed.uniform(12, 28)
    set_c = scene.fixed.uniform(8.0, 11.0)
    band_c = scene.fixed.uniform(7.0, 10.0)
    duty = np.clip((set_c - scene.warmth_c) / band_c, 0.0, 1.0)
    return column(0.03 * DEG * (np.mod(scene.t_s / cycle_s, 1.0) < duty))


@_kind("temperature", thermal=True, shape="by run")
def coarse_thermometer(scene: Scene) -> Floats:
    """Bias that firmware corrects by its own thermometer of whole digits: what the temperature is beyond the last one.

    STMicroelectronics, data sheets of the L3G4200D and L3GD20: 1 degC a digit, zero-rate level 0.03 deg/s/K. Digits are
    of that size within tolerances, and change at temperatures of their own.
    """
    digit_c = scene.fixed.uniform(0.8, 1.3)
    changes = scene.fixed.uniform(0.0, 1.0)
    digits = scene.warmth_c / digit_c + changes
    return column(0.03 * DEG * digit_c * (digits - np.round(digits)))


# At one temperature it is one more delay.
@_kind("temperature acceleration", thermal=True, shape="by run", parts="latency bandwidth")
def filter_capacitor(scene: Scene) -> Floats:
    """Lag of an anti-aliasing filter whose ceramic capacitor loses capacitance on either side of one temperature.

    EIA RS-198, code Y5V: up to -82 % between -30 and 85 degC, with a peak near room temperature; a bell half as high at
    20 to 28 K from it. Filters of 2 to 4 Hz; what the lag was at the start is known.
    """
    lag_s = scene.fixed.uniform(0.04, 0.08)
    peak_c = scene.fixed.uniform(-5.0, 2.0)
    half_width_c = scene.fixed.uniform(20, 28)
    share = 1 / (1 + ((scene.warmth_c - peak_c) / half_width_c) ** 2)
    at_start = 1 / (1 + (peak_c / half_width_c) ** 2)
    return np.asarray(-lag_s * column(share / at_start - 1) * scene.udot_rps2)


@_kind("rate time")
def holding_brake(scene: Scene) -> Floats:
    """Bias in the field of holding brakes, whose coils free an axis to turn and let it go a while after it stands.

    Power-off brakes and their timing: Yaskawa, Sigma-V user's manual, holding brakes; makers warn of the flux that
    leaks out while the coil is on. Each gyro is near one brake and far from another.
    """
    waits_s = scene.fixed.uniform(2, 8)
    nearness = scene.fixed.uniform(-1, 1, (len(GIMBALS), scene.gyros))
    period_s = float(scene.t_s[1] - scene.t_s[0])
    turns = np.abs(scene.motion.rate_rps) > _STILL_RPS
    rows = np.arange(len(turns))[:, None]
    last = np.maximum.accumulate(np.where(turns, rows, -len(turns)), axis=0)
    released = (rows - last) * period_s <= waits_s
    return np.asarray(0.03 * DEG * (released @ nearness))


@_kind("angle rate", common=True, of_table=True)
def bruised_encoder_ring(scene: Scene) -> Floats:
    """Reading of a magnetic ring that is bruised at one place: the angle is off about it, the rate before and after.

    Rings of many poles, read from beside them: ams, data sheet of the AS5311; on small rings an error of a few per cent
    of a pole is of a tenth of a degree. A blow or a chip of steel weakens some poles.
    """
    axis = scene.axis()
    middle = scene.fixed.uniform(-np.pi, np.pi)
    width = scene.fixed.uniform(15, 30) * DEG
    off = np.angle(np.exp(1j * (scene.angle(axis) - middle))) / width
    slope = -2 * off * np.exp(-(off**2)) / width
    return column(0.12 * DEG * slope * scene.rate(axis)) * along_axis(scene, axis)


# At a steady rate it is a share of the rate.
@_kind("acceleration rate", common=True, of_table=True)
def belt_creep(scene: Scene) -> Floats:
    """Creep of flat belts between motors with encoders and their axes: a share of the speed that goes with the torque.

    Elastic slip of belts: K.-H. Decker, Maschinenelemente, belt drives: 0.5 to 1 % at rated load, here that of a ramp
    at 20 deg/s2. It is behind when the belt drives and ahead when it brakes.
    """
    friction = scene.fixed.uniform(0.1, 0.2)
    rate = scene.motion.rate_rps
    torque = scene.motion.acceleration_rps2 / (20 * DEG) + friction * np.tanh(rate / _STILL_RPS)
    out = np.zeros_like(scene.u_rps)
    for gimbal, axis in enumerate(GIMBALS):
        share = -8e-3 * torque[:, gimbal]
        out += column(share * np.abs(rate[:, gimbal])) * along_axis(scene, axis)
    return out


# Turns about an outer axis in several poses tell it from a tilt or a scale factor that goes with the temperature.
@_kind("temperature rate", thermal=True, shape="by run", tilted=True)
def cold_grease(scene: Scene) -> Floats:
    """Bias by the field of the currents that turn greased bearings: viscous drag, which falls as the table warms.

    ASTM D341, viscosity and temperature of oils: 4 to 7 % a kelvin near room temperature. Brushed torque motors, whose
    current has the sign of the torque. Each gyro is near one motor and far from another.
    """
    thins_per_c = scene.fixed.uniform(0.04, 0.07)
    nearness = scene.fixed.uniform(-1, 1, (len(GIMBALS), scene.gyros))
    drag = scene.motion.rate_rps / (20 * DEG) * column(np.exp(-thins_per_c * scene.warmth_c))
    return np.asarray(0.08 * DEG * (drag @ nearness))


@_kind("acceleration angle direction rate")
def six_step_field(scene: Scene) -> Floats:
    """Bias in the stray field of brushless motors that are switched in six steps: it jumps on by 60 deg with the rotor.

    J. R. Hendershot, T. J. E. Miller, Design of Brushless Permanent-Magnet Motors (1994), six-step commutation. The
    field goes with the current, which ramps and friction take; motors have four to eight poles.
    """
    pairs = int(scene.fixed.integers(2, 5))
    friction = scene.fixed.uniform(0.3, 0.5)  # torque beside that of a ramp at 20 deg/s2
    towards = scene.fixed.uniform(0, 2 * np.pi, (len(GIMBALS), scene.gyros))
    starts = scene.fixed.uniform(0, 1, len(GIMBALS))
    torque = scene.motion.acceleration_rps2 / (20 * DEG)
    torque = torque + friction * np.tanh(scene.motion.rate_rps / _STILL_RPS)
    steps = np.floor(6 * pairs * scene.motion.angle_rad / (2 * np.pi) + starts)
    out = np.zeros_like(scene.u_rps)
    for gimbal in range(len(GIMBALS)):
        field = np.cos(np.pi / 3 * column(steps[:, gimbal]) - towards[gimbal])
        out += 0.06 * DEG * column(torque[:, gimbal]) * field
    return out


# While one axis turns, each term of its expansion by the angle is a harmonic of the table.
@_kind("angle", tilted=True, parts="table_harmonic")
def acoustic_standing_wave(scene: Scene) -> Floats:
    """Bias by the sound of an inverter: between walls it stands as a wave, through which the gyros are carried.

    R. N. Dean et al., IEEE Trans. Industrial Electronics 58 (2011) 2591: sound of high power near the frequencies of
    micromachined gyros. Inverters whine at 3 to 5 kHz; what is rectified goes with the square of the pressure.
    """
    wave_m = 343 / scene.fixed.uniform(3000, 5000)
    arm_m = scene.fixed.uniform(0.025, 0.045) * _direction(scene) + 0.008 * scene.p
    phase = scene.fixed.uniform(0, np.pi)
    path_m = scene.motion.into_body(_direction(scene)) @ arm_m.T
    return np.asarray(0.04 * DEG * np.cos(2 * np.pi * path_m / wave_m - phase) ** 2)


@_kind("angle", tilted=True)
def lamp_through_vent(scene: Scene) -> Floats:
    """Bias by photocurrents in a bare die, while a lamp of the laboratory shines through an opening of the housing.

    Silicon Laboratories, application note AN0878: light on dies in chip-scale packages makes them leak. The opening is
    on a side, as deep as it is wide and less, and lets light in that comes within a cone; lamps hang overhead.
    """
    side = np.zeros(3)
    side[scene.fixed.integers(2)] = scene.fixed.choice([-1.0, 1.0])
    opening = side + 0.2 * _direction(scene)
    opening /= np.linalg.norm(opening)
    slant, heading = scene.fixed.uniform(10, 35) * DEG, scene.fixed.uniform(0, 2 * np.pi)
    lamp = np.array([np.sin(slant) * np.cos(heading), np.sin(slant) * np.sin(heading), np.cos(slant)])
    edge = np.tan(scene.fixed.uniform(50, 65) * DEG)
    facing = np.clip(scene.motion.into_body(lamp) @ opening, 1e-9, 1.0)
    open_share = np.maximum(1 - np.sqrt(1 / facing**2 - 1) / edge, 0.0)
    return column(0.08 * DEG * facing * open_share)


@_kind("gravity rate time")
def attitude_filter_bias(scene: Scene) -> Floats:
    """Bias that the attitude filter of a unit takes off its rates: it takes their scale errors across gravity for one.

    R. Mahony, T. Hamel, J.-M. Pflimlin, IEEE Trans. Automatic Control 53 (2008) 1203: the integral term follows what
    the gyros turn too far against gravity, behind a lag of the ratio of both gains; about the vertical it sees nothing.
    """
    lag_s = scene.fixed.uniform(10, 40)
    up, rate_rps = scene.motion.up, scene.motion.w_rps
    across_rps = rate_rps - column(np.einsum("ni,ni->n", up, rate_rps)) * up
    return np.asarray(-4e-3 * (scene.lagged(across_rps, lag_s) @ scene.p.T))


# Within the transition it is the temperature times its slope.
@_kind("temperature", thermal=True, shape="by run", parts="thermal_bias")
def softening_die_attach(scene: Scene) -> Floats:
    """Bias by the stress of an adhesive under the die, which passes from glass to rubber: a step as wide as that.

    Stress of die attachments in micromachined gyros: Z. Hou et al., Microsystem Technologies 18 (2012) 507. Flexible
    epoxies soften near room temperature; L. H. Sperling, Introduction to Physical Polymer Science (1992), modulus.
    """
    softens_c = scene.fixed.uniform(2.0, 5.5)
    width_c = scene.fixed.uniform(0.5, 1.2)
    return column(0.05 * DEG / (1 + np.exp((scene.warmth_c - softens_c) / width_c)))


@_kind("temperature rate", thermal=True, shape="by run", common=True)
def leaning_bracket(scene: Scene) -> Floats:
    """Bracket of plastic on legs of unequal length, which leans as it warms: all sense axes turn with it.

    X. Niu et al., Fast thermal calibration of low-grade inertial sensors, Sensors 13 (2013) 12192, measures angles
    between axes by temperature. Plastics grow by 60 to 100 ppm/K: legs of 20 and 40 mm, 8 mm apart, lean by 0.2 mrad/K.
    """
    hinge = _direction(scene)
    leans_rad = 2e-4 * scene.warmth_c
    return np.asarray(column(leans_rad) * (scene.motion.w_rps @ np.cross(hinge, scene.p).T))


@_kind("angle gravity rate", common=True, of_table=True)
def unbalanced_speed(scene: Scene) -> Floats:
    """Speed of axes that report their set points: it sags where a motor lifts an unbalanced load, and overshoots after.

    A. E. Fitzgerald, C. Kingsley, S. D. Umans, Electric Machinery (1990), speed regulation of a motor at a voltage: in
    proportion to the torque. An axis that stands is held, and does not err.
    """
    arm = _direction(scene)
    weight = np.cross(scene.motion.up, arm)
    turning = np.tanh(np.abs(scene.motion.rate_rps) / DEG)
    out = np.zeros_like(scene.u_rps)
    for gimbal, axis in enumerate(GIMBALS):
        torque = np.einsum("ni,ni->n", scene.motion.axes[:, gimbal], weight)
        out += 0.06 * DEG * column(torque * turning[:, gimbal]) * along_axis(scene, axis)
    return out


@_kind("angle gravity rate", common=True, of_table=True, tilted=True)
def soft_isolators(scene: Scene) -> Floats:
    """Tilt of a table on soft isolators as its load's centre of mass goes round: base and gyros turn, no encoder does.

    E. I. Rivin, Passive Vibration Isolation (2003): isolators of 1 to 2 Hz leave a tilt stiffness of some kN m/rad. A
    load of 20 kg, 20 mm off the axes, tilts it by 1 to 2 mrad; slow turns are followed at once.
    """
    tilts_rad = scene.fixed.uniform(1.2e-3, 2.0e-3)
    arm = _direction(scene)
    up, rate_rps = scene.motion.up, scene.motion.w_rps
    tilting_rps = column(up @ arm) * rate_rps - column(np.einsum("ni,ni->n", up, rate_rps)) * arm
    return np.asarray(-tilts_rad * (tilting_rps @ scene.p.T))


@_kind("rate")
def linearised_by_table(scene: Scene) -> Floats:
    """Rest of a nonlinear scale factor that a unit corrects by straight lines between the rates of its calibration.

    Table look-up with interpolation: J. Fraden, Handbook of Modern Sensors (2010), piecewise approximation. Open-loop
    gyros err by a cube, some per cent at 100 deg/s, which is known at steps of 16 to 28 deg/s.
    """
    step_dps = scene.fixed.uniform(16, 28)
    known_dps = step_dps * np.arange(-6, 7)
    line = np.interp(scene.u_dps, known_dps, (known_dps / 100) ** 3)
    return np.asarray(3.0 * DEG * ((scene.u_dps / 100) ** 3 - line))


def _direction(scene: Scene) -> Floats:
    """Return a unit vector (3,), the same in every run of a case."""
    towards = scene.fixed.standard_normal(3)
    return np.asarray(towards / np.linalg.norm(towards))
