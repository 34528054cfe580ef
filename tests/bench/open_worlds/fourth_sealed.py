"""Ten kinds kept for the end: while the program is worked on, nothing here is read or run beyond its oracle.

The docstring of a law names where its mechanism is described. Constants of a law are drawn once for a case from what
such devices have; the law, its constants and its units do not depend on a run. Every kind is a function of what the
recordings hold. Twenty kinds were written from their physics, and the order of a hash of their names took these ten:
neither half is the harder one by design. The kinds are fixed: the program is fitted to none of them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from open_worlds.effects import Kind, Registry, Scene, column, played
from open_worlds.motion import DEG

Floats = NDArray[np.float64]

KINDS: dict[str, Kind] = {}
_kind = Registry(KINDS)


@_kind("angle time", tilted=True)
def draught_on_face(scene: Scene) -> Floats:
    """Bias by the cooling of that face of a housing which looks into the draught of a laboratory, behind its heat.

    Heat transfer is large before the stagnation point and small in the wake: F. P. Incropera, D. P. DeWitt,
    Fundamentals of Heat and Mass Transfer, "cylinder in cross flow". Time constants are those of small housings.
    """
    settling_s = scene.fixed.uniform(15, 60)
    heading = scene.fixed.uniform(0, 2 * np.pi)
    face = scene.fixed.standard_normal(3)
    face /= np.linalg.norm(face)
    draught = np.array([np.cos(heading), np.sin(heading), 0.0])
    facing = np.maximum(scene.motion.into_body(draught) @ face, 0.0)
    return column(0.08 * DEG * scene.lagged(facing, settling_s))


@_kind("gravity direction rate", tilted=True)
def loose_trunnion(scene: Scene) -> Floats:
    """Trunnion with clearance, which falls to its other side when the weight across it changes sign.

    Clearances of loose running fits: ISO 286, H9/d9: 0.1 mm on 50 mm of length is 2 mrad. All sense axes turn by it.
    """
    hinge = scene.fixed.standard_normal(3)
    hinge /= np.linalg.norm(hinge)
    across = np.cross(hinge, scene.fixed.standard_normal(3))
    across /= np.linalg.norm(across)
    friction = scene.fixed.uniform(0.1, 0.35)
    weight = scene.motion.up @ across
    falls = np.abs(weight) > friction
    rows = np.maximum.accumulate(np.where(falls, np.arange(len(weight)), 0))
    return 2e-3 * column(np.sign(weight[rows])) * (scene.motion.w_rps @ np.cross(hinge, scene.p).T)


@_kind("temperature", thermal=True, shape="by run")
def oven_out_of_reach(scene: Scene) -> Floats:
    """Bias of a gyro in an oven that can heat and not cool: steady up to its set point, then with the temperature.

    A heater's duty ends at zero: J. R. Vig, Quartz Crystal Resonators and Oscillators, "oven controlled oscillators".
    """
    set_c = scene.fixed.uniform(2.5, 5.0)
    return column(0.02 * DEG * np.maximum(scene.warmth_c - set_c, 0.0))


@_kind("temperature rate time", thermal=True, shape="by run", tilted=True)
def warping_board(scene: Scene) -> Floats:
    """Board that bows while its two sides differ in temperature, which tilts the sense axes: none of it lasts.

    S. Timoshenko, Analysis of bi-metal thermostats, J. Opt. Soc. Am. 11 (1925) 233. The inner side follows the outer
    one behind a lag; the bow of FR-4 is of a milliradian a kelvin.
    """
    lag_s = scene.fixed.uniform(15, 50)
    towards = scene.fixed.uniform(0, 2 * np.pi)
    across = np.cos(towards) * scene.j + np.sin(towards) * scene.k
    difference_c = scene.warmth_c - scene.lagged(scene.warmth_c, lag_s)
    return 2e-3 * column(difference_c) * (scene.motion.w_rps @ across.T)


@_kind("rate direction", tilted=True)
def shared_reference_droop(scene: Scene) -> Floats:
    """Scale factor of all channels by one reference, which droops under the load of all their outputs together.

    Load regulation of a reference: data sheet of the Analog Devices ADR03, some 100 ppm a milliampere; a channel's load
    goes with the magnitude of its rate. A gyro errs by the rates of the others.
    """
    weights = scene.fixed.uniform(0.3, 1.7, scene.gyros)
    load = np.abs(scene.u_dps) @ weights / 40
    return 2e-3 * column(load) * scene.u_rps


@_kind("gravity rate", tilted=True)
def gap_closing_scale(scene: Scene) -> Floats:
    """Scale factor by the gap of the sense electrodes, which gravity opens and closes as the proof mass sags.

    M. S. Weinberg, A. Kourepenis, Error sources in in-plane silicon tuning-fork MEMS gyroscopes, J. MEMS 15 (2006) 479.
    A mode of 3 kHz sags by 28 nm; to a gap of some micrometres that is a few thousandths a g.
    """
    towards = scene.fixed.uniform(0, 2 * np.pi)
    sagging = np.cos(towards) * scene.j + np.sin(towards) * scene.k
    return np.asarray(4e-3 * (scene.motion.up @ sagging.T) * scene.u_rps)


@_kind("acceleration rate time")
def winding_heat(scene: Scene) -> Floats:
    """Bias by the heat of a motor's windings: the square of its current, which ramps and friction take, behind a lag.

    Copper loss and thermal time constants of frameless torque motors: Kollmorgen, KBM series, selection guide.
    """
    settling_s = scene.fixed.uniform(20, 60)
    friction = scene.fixed.uniform(0.1, 0.2)  # torque beside that of a ramp at 20 deg/s2
    push = scene.motion.acceleration_rps2 / (20 * DEG)
    drag = friction * np.tanh(scene.motion.rate_rps / (0.1 * DEG))
    loss = ((push + drag) ** 2).sum(axis=1)
    return column(0.4 * DEG * scene.lagged(loss, settling_s))


@_kind("angle rate")
def gear_rattle(scene: Scene) -> Floats:
    """Bias by the vibration of teeth that rattle where the load's unbalance leaves them without contact force.

    R. Singh, H. Xie, R. J. Comparin, Analysis of automotive neutral gear rattle, J. Sound Vib. 131 (1989) 177. The
    vibration goes with the axis' speed and is rectified: IEEE Std 528.
    """
    axis = scene.axis()
    balanced_rad = scene.fixed.uniform(0, np.pi)
    width = scene.fixed.uniform(0.2, 0.4)
    free = np.exp(-((np.sin(scene.angle(axis) - balanced_rad) / width) ** 2))
    return column(0.08 * DEG * free * np.abs(scene.rate(axis)) / (20 * DEG))


@_kind("gravity direction")
def endplay_shift(scene: Scene) -> Floats:
    """Unbalance of a rotor that shifts in its bearings' play only when gravity has turned far enough to move it.

    Mass unbalance, hysteresis and shift of a spin bearing: IEEE Std 517; Wrigley, Hollister, Denhard (1969).
    """
    half_g = scene.fixed.uniform(0.3, 0.6)
    along = scene.fixed.standard_normal(3)
    along /= np.linalg.norm(along)
    return column(0.04 * DEG * played(scene.motion.up @ along, half_g))


@_kind("temperature time", thermal=True, shape="by run")
def timed_autozero(scene: Scene) -> Floats:
    """Bias of a channel that nulls its amplifier by a timer: what the temperature has changed since the last nulling.

    Auto-zeroing by interrupting the signal: C. C. Enz, G. C. Temes, Proc. IEEE 84 (1996) 1584. Once or twice a minute.
    """
    every_s = scene.fixed.uniform(40, 80)
    since_s = np.mod(scene.t_s, every_s)
    nulled_c = np.interp(scene.t_s - since_s, scene.t_s, scene.warmth_c)
    return column(0.03 * DEG * (scene.warmth_c - nulled_c))
