"""Six more kinds of micromachined gyros, their electronics, mounts and tables, which are looked at during work.

The docstring of a law names where its mechanism is described. Constants of a law are drawn once for a case from what
such devices have; the law, its constants and its units do not depend on a run. Every kind is a function of what the
recordings hold. Twelve kinds were written from their physics and a shuffle took these six of them: neither half is
the harder one by design. The kinds are fixed: the program is fitted to none of them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import cont2discrete, lfilter

from open_worlds.effects import Kind, Registry, Scene, column
from open_worlds.motion import DEG

Floats = NDArray[np.float64]

KINDS: dict[str, Kind] = {}
_kind = Registry(KINDS)


@_kind("time")
def oven_overshoot(scene: Scene) -> Floats:
    """Bias of a gyro in an oven whose controller overshoots after power-on: a damped oscillation about the set point.

    Step response of an underdamped second-order loop: K. Ogata, Modern Control Engineering, "transient response".
    """
    damping = scene.fixed.uniform(0.15, 0.35)
    period_s = scene.fixed.uniform(60, 140)
    root = np.sqrt(1 - damping**2)
    phase = 2 * np.pi * scene.t_s / period_s
    error = np.exp(-damping / root * phase) * (np.cos(phase) + damping / root * np.sin(phase))
    return column(0.06 * DEG * error)


@_kind("rate acceleration")
def drive_power(scene: Scene) -> Floats:
    """Bias by the supply, which sags with the power that the table's drives take and rises when they brake.

    Mechanical power of a mass is its rate times its acceleration; a regenerative drive feeds it back. The sum of axes.
    """
    drag = scene.fixed.uniform(0.02, 0.1)  # power of friction at 20 deg/s, beside that of a ramp at 20 deg/s2
    rate = scene.motion.rate_rps / (20 * DEG)
    push = scene.motion.acceleration_rps2 / (20 * DEG)
    return column(0.05 * DEG * (rate * push + drag * rate**2).sum(axis=1))


# At one time it is a g-sensitivity.
@_kind("gravity time", parts="g_sensitivity")
def settling_unbalance(scene: Scene) -> Floats:
    """Mass unbalance of a float that goes as the fluid's density evens out after power-on: gravity times a decay.

    Mass unbalance along spin and input axis: IEEE Std 517; stabilisation after turn-on: Wrigley, Hollister, Denhard,
    Gyroscopic Theory, Design, and Instrumentation (1969).
    """
    settling_s = scene.fixed.uniform(60, 150)
    towards = scene.fixed.uniform(0, 2 * np.pi)
    unbalance = np.cos(towards) * scene.p + np.sin(towards) * scene.j
    return 0.06 * DEG * column(np.exp(-scene.t_s / settling_s)) * (scene.motion.up @ unbalance.T)


@_kind("rate direction")
def shared_auto_range(scene: Scene) -> Floats:
    """Amplifier that changes all channels to a wide range when one of them is large, and back when all are small.

    Ranges differ in offset and gain, and the change has a hysteresis: an auto-ranging instrument, P. Horowitz, W. Hill,
    The Art of Electronics (1989). A gyro errs by the rates of the others.
    """
    up_dps = scene.fixed.uniform(5.0, 9.0)
    down_dps = up_dps * scene.fixed.uniform(0.3, 0.7)
    offset_rps = scene.fixed.uniform(0.01, 0.03, scene.gyros) * scene.fixed.choice([-1.0, 1.0], scene.gyros) * DEG
    largest_dps = np.abs(scene.u_dps).max(axis=1)
    changes = (largest_dps > up_dps) | (largest_dps < down_dps)
    rows = np.maximum.accumulate(np.where(changes, np.arange(len(largest_dps)), 0))
    wide = largest_dps[rows] > up_dps
    return column(wide) * (offset_rps + 1e-3 * scene.u_rps)


# Between two standstills of a gyro it is what the temperature has changed since the last one.
@_kind("temperature rate time", thermal=True, shape="by run", parts="thermal_bias")
def zero_rate_update(scene: Scene) -> Floats:
    """Firmware of each gyro that takes its output for its bias while it feels no rate, and keeps that through turns.

    The zero-rate update of consumer devices: a standstill is one that has lasted for a time, then the estimate follows
    the bias, which goes with the temperature. A gyro stands still, too, while the table turns across it.
    """
    wait_s = scene.fixed.uniform(0.3, 1.5)
    follow_s = scene.fixed.uniform(2, 6)
    still_dps = scene.fixed.uniform(0.2, 0.6)
    period_s = float(scene.t_s[1] - scene.t_s[0])
    share = 1 - np.exp(-period_s / follow_s)
    still_s = period_s * _rows_since(np.abs(scene.u_dps) >= still_dps)
    updates = still_s > wait_s
    out_c = np.empty_like(scene.u_dps)
    for gyro in range(scene.gyros):
        estimate_c = float(scene.warmth_c[0])
        for row, (now_c, update) in enumerate(zip(scene.warmth_c.tolist(), updates[:, gyro].tolist(), strict=True)):
            if update:
                estimate_c += share * (now_c - estimate_c)
            out_c[row, gyro] = now_c - estimate_c
    return 0.01 * DEG * out_c


@_kind("acceleration rate time", common=True)
def ringing_fixture(scene: Scene) -> Floats:
    """Arm of a fixture that rings when a ramp begins or ends: its twist is the gyros' own rate, which no encoder sees.

    Response of one mode to the acceleration of its base; the share of it that is at the gyros is small. Modes of tall
    fixtures with a load are at a few hertz: W. T. Thomson, Theory of Vibration with Applications (1981).
    """
    natural_rps = 2 * np.pi * scene.fixed.uniform(1.5, 4.0)
    damping = scene.fixed.uniform(0.04, 0.12)
    period_s = float(scene.t_s[1] - scene.t_s[0])
    mode = ([-1.0, 0.0], [1.0, 2 * damping * natural_rps, natural_rps**2])
    upper, lower, _ = cont2discrete(mode, period_s, method="zoh")
    return np.asarray(0.1 * lfilter(upper.ravel(), lower, scene.udot_rps2, axis=0))


def _rows_since(events: NDArray[np.bool_]) -> Floats:
    """Return how many rows (n, m) ago the last event of each column was; before the first, since ever."""
    rows = np.arange(len(events))[:, None]
    last = np.maximum.accumulate(np.where(events, rows, -len(events)), axis=0)
    return np.asarray(rows - last, dtype=np.float64)
