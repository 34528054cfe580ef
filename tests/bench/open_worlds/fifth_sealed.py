"""Twelve kinds kept for the end: while the program is worked on, nothing here is read or run beyond its oracle.

The docstring of a law names where its mechanism is described. Constants of a law are drawn once for a case from what
such devices have; the law, its constants and its units do not depend on a run. Every kind is a function of what the
recordings hold. All were written from their physics, without a look at how effects are sought. The kinds are fixed: the
program is fitted to none of them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import cont2discrete, lfilter

from open_worlds.effects import Kind, Registry, Scene, along_axis, column
from open_worlds.motion import DEG, GIMBALS

Floats = NDArray[np.float64]

KINDS: dict[str, Kind] = {}
_kind = Registry(KINDS)


@_kind("temperature direction time", thermal=True, shape="by run")
def path_length_reset(scene: Scene) -> Floats:
    """Bias by the piezo that holds a ring laser's path: it follows the cavity and at its end gives up one wave.

    F. Aronowitz, Fundamentals of the ring laser gyro, RTO AGARDograph 339 (1999), path length control. A perimeter of
    0.3 to 0.6 m of fused silica grows by a wave of 633 nm in 2 to 4 K. A stroke of more than a wave is a hysteresis.
    """
    wave_c = scene.fixed.uniform(2.0, 4.0)
    end = scene.fixed.uniform(0.6, 0.8)  # of the stroke on either side, in waves
    locked = scene.fixed.uniform(-0.5, 0.5)
    stroke = np.empty(len(scene.t_s))
    given_up = 0.0
    for row, grown in enumerate((locked + scene.warmth_c / wave_c).tolist()):
        if abs(grown - given_up) > end:
            given_up += np.sign(grown - given_up)
        stroke[row] = grown - given_up
    return column(0.05 * DEG * stroke)


# Far from its match the error of a gyro is in proportion to the temperature.
@_kind("temperature rate", thermal=True, shape="by run", parts="thermal_scale")
def mode_match_walk(scene: Scene) -> Floats:
    """Scale factor of a rebalanced gyro whose modes match at one temperature: its loop has less gain on either side.

    M. F. Zaman et al., A mode-matched silicon-yaw tuning-fork gyroscope, J. MEMS 17 (2008) 1526. Response goes as
    1 / sqrt(1 + x^2) with the split over the half width, here 1 to 2 K; a loop of gain 800 leaves sqrt(1 + x^2) / 800.
    """
    match_c = scene.fixed.uniform(1.5, 6.0, scene.gyros)
    half_width_c = scene.fixed.uniform(1.0, 2.0)
    split = (column(scene.warmth_c) - match_c) / half_width_c
    return np.asarray(-1.2e-3 * (np.sqrt(1 + split**2) - 1) * scene.u_rps)


@_kind("temperature gravity angle time", thermal=True, shape="by run")
def buoyant_plume(scene: Scene) -> Floats:
    """Bias by the gas that rises within a housing from what is warmer: a difference of temperatures times gravity.

    A. M. Leung et al., Micromachined accelerometer based on convection heat transfer, Proc. IEEE MEMS (1998) 627: in
    proportion to Grashof's number. The inside follows the housing behind a lag; in equilibrium there is no plume.
    """
    lag_s = scene.fixed.uniform(20, 60)
    towards = scene.fixed.uniform(0, 2 * np.pi)
    across = np.cos(towards) * scene.p + np.sin(towards) * scene.k
    difference_c = scene.warmth_c - scene.lagged(scene.warmth_c, lag_s)
    return np.asarray(0.03 * DEG * column(difference_c) * (scene.motion.up @ across.T))


# But for the time in which it melts or freezes it is a lagged temperature, whose leading terms these are.
@_kind("temperature time", thermal=True, shape="by run", parts="thermal_bias thermal_gradient")
def wax_buffer(scene: Scene) -> Floats:
    """Bias of a die on a heat sink of wax, which stays at the melting point until all of it has molten or frozen.

    V. Alexiades, A. D. Solomon, Mathematical Modeling of Melting and Freezing Processes (1993), enthalpy method.
    Latent heat of paraffin is that of 100 K; with the metal about it 5 to 12 K are left.
    """
    melting_c = scene.fixed.uniform(1.5, 3.5)
    latent_c = scene.fixed.uniform(5, 12)
    lag_s = scene.fixed.uniform(15, 40)
    share = float(scene.t_s[1] - scene.t_s[0]) / lag_s
    heat_c = 0.0
    die_c = np.empty(len(scene.t_s))
    for row, outside_c in enumerate(scene.warmth_c.tolist()):
        die_c[row] = min(heat_c, max(melting_c, heat_c - latent_c))
        heat_c += share * (outside_c - die_c[row])
    return column(0.012 * DEG * die_c)


@_kind("rate direction")
def stribeck_torque(scene: Scene) -> Floats:
    """Bias by the field of the motors' currents, which overcome friction: it falls with speed before it rises again.

    B. Armstrong-Helouvry, P. Dupont, C. Canudas de Wit, Automatica 30 (1994) 1083: Stribeck's curve. Mixed lubrication
    of greased, preloaded bearings ends at about 0.1 to 0.25 rad/s. Each gyro is near one motor and far from another.
    """
    breakaway = scene.fixed.uniform(1.5, 2.5)
    mixed_rps = scene.fixed.uniform(0.1, 0.25)
    viscous = scene.fixed.uniform(0.2, 0.5)  # at 20 deg/s, beside dry friction of 1
    nearness = scene.fixed.uniform(-1, 1, (len(GIMBALS), scene.gyros))
    rate = scene.motion.rate_rps
    dry = 1 + (breakaway - 1) * np.exp(-((rate / mixed_rps) ** 2))
    torque = np.tanh(rate / (0.05 * DEG)) * dry + viscous * rate / (20 * DEG)
    return np.asarray(0.03 * DEG * (torque @ nearness))


@_kind("rate angle time")
def wearing_film(scene: Scene) -> Floats:
    """Bias by the supply through a slip ring whose film of oxide wears off as it turns, and grows between sessions.

    R. Holm, Electric Contacts (1967), films and their wear: the drop of voltage falls with the path of the brush, which
    both directions and all turns since power-on add to. Rings run clean within some turns.
    """
    axis = scene.axis()
    wears_rad = scene.fixed.uniform(0.8, 2.5) * 2 * np.pi
    period_s = float(scene.t_s[1] - scene.t_s[0])
    path_rad = period_s * np.cumsum(np.abs(scene.rate(axis)))
    return column(0.06 * DEG * np.exp(-path_rad / wears_rad))


@_kind("rate acceleration time")
def braking_resistor(scene: Scene) -> Floats:
    """Bias by the heat of the resistor in which drives burn what a braking axis returns, and nothing else.

    W. Leonhard, Control of Electrical Drives (1985): braking choppers. Friction takes its part of the power before.
    """
    cools_s = scene.fixed.uniform(20, 60)
    friction = scene.fixed.uniform(0.03, 0.1)  # power at 20 deg/s beside that of a ramp at 20 deg/s2
    rate = scene.motion.rate_rps / (20 * DEG)
    push = scene.motion.acceleration_rps2 / (20 * DEG)
    returned = np.maximum(-rate * push - friction * np.abs(rate), 0.0).sum(axis=1)
    return column(0.6 * DEG * scene.lagged(returned, cools_s))


# The field of a distant magnet turns with the table's angles; a near one adds what is of higher order.
@_kind("angle", tilted=True, parts="table_harmonic")
def passing_magnet(scene: Scene) -> Floats:
    """Bias in the field of a magnet beside the table, which the gyros pass at a distance that goes with the pose.

    Field of a dipole: J. D. Jackson, Classical Electrodynamics (1975), 5.6. The gyros are a hand's breadth off the
    point where the axes meet; sensitivities differ in size and direction.
    """
    arm_m = scene.fixed.uniform(0.08, 0.15) * _direction(scene)
    magnet_m = scene.fixed.uniform(0.30, 0.40) * _direction(scene)
    moment = _direction(scene)
    pickup = np.stack([_direction(scene) for _ in range(scene.gyros)])
    apart_m = scene.motion.attitude @ arm_m - magnet_m
    distance_m = np.linalg.norm(apart_m, axis=1, keepdims=True)
    towards = apart_m / distance_m
    field = (3 * column(towards @ moment) * towards - moment) * (np.linalg.norm(magnet_m) / distance_m) ** 3
    in_body = np.einsum("nji,nj->ni", scene.motion.attitude, field)
    return np.asarray(0.02 * DEG * (in_body @ pickup.T))


@_kind("gravity rate time")
def trailing_bubble(scene: Scene) -> Floats:
    """Torque of a bubble in a float's fluid about the output axis: it trails behind the top, or slips round if left.

    R. Clift, J. R. Grace, M. E. Weber, Bubbles, Drops, and Particles (1978): it rises along the wall with the part of
    gravity that is along it. A bubble of 1 mm in 100 cSt, 20 mm from the middle, turns by 0.1 to 0.4 rad/s at most.
    """
    fastest_rps = scene.fixed.uniform(0.1, 0.4)
    share = fastest_rps * float(scene.t_s[1] - scene.t_s[0])
    up = scene.motion.up
    bubble = np.empty_like(up)
    x, y, z = up[0].tolist()
    for row, (to_x, to_y, to_z) in enumerate(up.tolist()):
        along = to_x * x + to_y * y + to_z * z
        x, y, z = (at + share * (to - along * at) for at, to in ((x, to_x), (y, to_y), (z, to_z)))
        length = (x * x + y * y + z * z) ** 0.5
        x, y, z = x / length, y / length, z / length
        bubble[row] = x, y, z
    return np.asarray(0.05 * DEG * (np.cross(bubble, up) @ scene.k.T))


@_kind("gravity angle rate", common=True, of_table=True, tilted=True)
def shaft_windup(scene: Scene) -> Floats:
    """Twist of the middle shaft by the unbalance of what it carries, beyond the encoder, which is at the motor's end.

    W. C. Young, Roark's Formulas for Stress and Strain (1989), torsion: 5 N m on 3 kN m/rad is 1.7 mrad. The twist
    turns the outer axis in the body, and its change is a rate about the shaft.
    """
    unbalance = _direction(scene)
    twists_rad = scene.fixed.uniform(1.2e-3, 2.2e-3)
    outer, middle = scene.motion.axes[:, 0], scene.motion.axes[:, 1]
    torque = np.einsum("ni,ni->n", middle, np.cross(scene.motion.up, unbalance))
    twist_rad = twists_rad * torque
    twisting_rps = np.gradient(twist_rad, float(scene.t_s[1] - scene.t_s[0]))
    tipped = np.cross(outer, middle) * column(twist_rad * scene.rate("z"))
    return np.asarray((tipped + column(twisting_rps) * middle) @ scene.p.T)


@_kind("angle rate time", common=True, of_table=True)
def set_point_ripple(scene: Scene) -> Floats:
    """Ripple of a table that reports its set points: an offset of a current sensor is a torque by electrical angle.

    D.-W. Chung, S.-K. Sul, IEEE Trans. Industry Applications 34 (1998) 340: once a pair of poles. A soft speed loop
    answers a torque as a resonance does, so the ripple's size and phase go with the rate; at rest none is left.
    """
    pairs = int(scene.fixed.integers(4, 9))
    natural_rps = 2 * np.pi * scene.fixed.uniform(0.4, 1.2)
    damping = scene.fixed.uniform(0.3, 0.7)
    phases = scene.fixed.uniform(0, 2 * np.pi, len(GIMBALS))
    period_s = float(scene.t_s[1] - scene.t_s[0])
    loop = ([2 * damping * natural_rps, 0.0], [1.0, 2 * damping * natural_rps, natural_rps**2])
    upper, lower, _ = cont2discrete(loop, period_s, method="zoh")
    out = np.zeros_like(scene.u_rps)
    for axis, phase in zip(GIMBALS, phases, strict=True):
        torque = np.cos(pairs * scene.angle(axis) - phase)
        ripple = lfilter(upper.ravel(), lower, torque - torque[0])
        out += 0.05 * DEG * column(ripple) * along_axis(scene, axis)
    return out


@_kind("rate time")
def drooping_peak(scene: Scene) -> Floats:
    """Offset that a gain control's voltage feeds through: the logarithm of a peak, up at once, down as it leaks off.

    P. Horowitz, W. Hill, The Art of Electronics (1989), peak detectors and their droop; THAT Corporation, data sheet of
    the 2180: gain is exponential in the control voltage, which feeds through to the output.
    """
    droop_s = scene.fixed.uniform(15, 60)
    floor_dps = scene.fixed.uniform(1.0, 4.0)
    kept = np.exp(-float(scene.t_s[1] - scene.t_s[0]) / droop_s)
    level_dps = np.zeros_like(scene.u_dps)
    held_dps = np.zeros(scene.gyros)
    for row, size_dps in enumerate(np.abs(scene.u_dps)):
        held_dps = np.maximum(size_dps, kept * held_dps)
        level_dps[row] = held_dps
    return np.asarray(0.02 * DEG * np.log1p(level_dps / floor_dps))


def _direction(scene: Scene) -> Floats:
    """Return a unit vector (3,), the same in every run of a case."""
    towards = scene.fixed.standard_normal(3)
    return np.asarray(towards / np.linalg.norm(towards))
