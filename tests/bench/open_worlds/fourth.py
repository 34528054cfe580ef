"""Ten more kinds from the physics of gyros, electronics, fixtures and tables, which are looked at during work.

The docstring of a law names where its mechanism is described. Constants of a law are drawn once for a case from what
such devices have; the law, its constants and its units do not depend on a run. Every kind is a function of what the
recordings hold. Twenty kinds were written from their physics, and the order of a hash of their names took these ten:
neither half is the harder one by design. The kinds are fixed: the program is fitted to none of them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from open_worlds.effects import Kind, Registry, Scene, column
from open_worlds.motion import DEG

Floats = NDArray[np.float64]

KINDS: dict[str, Kind] = {}
_kind = Registry(KINDS)

_LONGEST_S = 360.0
"""Beyond the end of every script, s."""


@_kind("temperature", thermal=True, shape="by run")
def injection_pulling(scene: Scene) -> Floats:
    """Bias of two drives that pull each other: in lock it goes with the detuning, beyond it the beat averages it.

    R. Adler, A study of locking phenomena in oscillators, Proc. IRE 34 (1946) 351. Silicon drives at 10 to 20 kHz
    detune by 0.1 to 0.5 Hz a kelvin.
    """
    alike_c = scene.fixed.uniform(2.0, 5.0)
    locked_c = scene.fixed.uniform(0.8, 2.0)
    detuning = (scene.warmth_c - alike_c) / locked_c
    beat = np.sqrt(np.maximum(detuning**2 - 1, 0))
    return column(0.03 * DEG * (detuning - np.sign(detuning) * beat))


@_kind("angle rate", tilted=True)
def lorentz_drive_scale(scene: Scene) -> Floats:
    """Scale factor of a ring that is driven and sensed in a magnet's field, to which a field of the laboratory adds.

    Inductive rings: Silicon Sensing Systems, data sheet of the CRS03; both drive and pickoff go with the field along
    the sense axis. A steel pier or a magnet nearby is some millitesla beside the ring's few hundred.
    """
    dip = scene.fixed.uniform(40, 70) * DEG
    heading = scene.fixed.uniform(0, 2 * np.pi)
    field = np.array([np.cos(dip) * np.cos(heading), np.cos(dip) * np.sin(heading), -np.sin(dip)])
    along = scene.motion.into_body(field) @ scene.p.T
    return np.asarray(4e-3 * along * scene.u_rps)


@_kind("angle")
def worn_slip_ring(scene: Scene) -> Floats:
    """Bias by the supply where the brushes of a slip ring cross a worn sector, whose contact drops more voltage.

    R. Holm, Electric Contacts (1967): sliding contacts. Tens of millivolts over a sector of some tens of degrees.
    """
    angle = scene.angle(scene.axis())
    middle = scene.fixed.uniform(-np.pi, np.pi)
    half = scene.fixed.uniform(20, 40) * DEG
    edge = scene.fixed.uniform(2, 6) * DEG
    off = np.abs(np.angle(np.exp(1j * (angle - middle))))
    return column(0.04 * DEG / (1 + np.exp(np.clip((off - half) / edge, -50, 50))))


@_kind("temperature time", thermal=True, shape="by run")
def ratcheting_solder(scene: Scene) -> Floats:
    """Bias by the stress of a solder joint that yields as it warms and keeps its strain: the warmest it has been.

    Elastic, ideally plastic joint: J. H. Lau, Solder Joint Reliability (1991). It relaxes at rest between two sessions.
    """
    yields_c = scene.fixed.uniform(0.5, 2.0)
    warmest_c = np.maximum.accumulate(scene.warmth_c)
    return column(0.012 * DEG * np.maximum(warmest_c - yields_c, 0.0))


@_kind("acceleration time", common=True, sized=True)
def sliding_sample_clock(scene: Scene) -> Floats:
    """Age of samples that a host polls from a gyro with a clock of its own: it slides up to a period and slips back.

    Bosch BMI088, InvenSense MPU-6000: output rates are within some per cent or per mille of nominal. Clocks start at
    power-on together.
    """
    period_s = scene.size * scene.fixed.uniform(0.010, 0.020)
    slips_s = scene.fixed.uniform(7, 25)
    age_s = period_s * np.mod(scene.t_s / slips_s, 1.0)
    late = [np.interp(scene.t_s - age_s, scene.t_s, u) for u in scene.u_rps.T]
    return np.column_stack(late) - scene.u_rps


@_kind("rate direction time")
def overload_tail(scene: Scene) -> Floats:
    """Tail of an amplifier that a rate has overdriven: what went beyond its range decays by its thermal time constant.

    Overdrive recovery with thermal tails: J. Williams, Linear Technology application note 10 (1985). A post-amplifier
    for low rates is in overload during turns.
    """
    range_dps = scene.fixed.uniform(4, 9)
    recovery_s = scene.fixed.uniform(3, 10)
    beyond = np.sign(scene.u_dps) * np.maximum(np.abs(scene.u_dps) - range_dps, 0.0)
    return np.asarray(0.05 * DEG * scene.lagged(beyond / 10, recovery_s))


@_kind("rate")
def pwm_interference(scene: Scene) -> Floats:
    """Bias by a harmonic of the motors' bridges that falls on the drive frequency: it goes with the sine of the duty.

    Amplitude |sin(n pi d)| of the n-th harmonic of a pulse train: N. Mohan, T. Undeland, W. Robbins, Power Electronics
    (1995). The duty is that of the back-emf, in proportion to an axis' speed.
    """
    order = int(scene.fixed.integers(2, 5))
    full_dps = scene.fixed.uniform(80, 140)
    duty = np.abs(scene.motion.rate_rps) / (full_dps * DEG)
    return column(0.04 * DEG * np.abs(np.sin(order * np.pi * duty)).sum(axis=1))


@_kind("angle rate time")
def standing_wave_drift(scene: Scene) -> Floats:
    """Drift of a whole-angle gyro by its damping's anisotropy: a harmonic of the pattern's angle, which its rate turns.

    D. D. Lynch, Vibratory gyro analysis by the method of averaging (1995): sin 4 (theta - theta_tau) for n = 2. The
    pattern starts at an electrode and turns by the angular gain, 0.27 to 0.4 of silicon rings.
    """
    gain = scene.fixed.uniform(0.27, 0.40)
    axes_rad = scene.fixed.uniform(0, np.pi / 2, (1, scene.gyros))
    period_s = float(scene.t_s[1] - scene.t_s[0])
    pattern_rad = gain * period_s * np.cumsum(scene.u_rps, axis=0)
    return np.asarray(0.03 * DEG * np.sin(4 * (pattern_rad - axes_rad)))


@_kind("temperature", thermal=True, shape="by run")
def parasitic_interferometer(scene: Scene) -> Floats:
    """Bias of a fibre gyro by light that crosses over between polarisations: its phase goes with the temperature.

    H. C. Lefevre, The Fiber-Optic Gyroscope (1993), polarisation nonreciprocities: the birefringence of a metre of
    fibre turns by a wave in one or a few kelvins.
    """
    wave_c = scene.fixed.uniform(2.0, 4.0)
    phase = scene.fixed.uniform(0, 2 * np.pi, (1, scene.gyros))
    return np.asarray(0.02 * DEG * np.cos(2 * np.pi * column(scene.warmth_c) / wave_c - phase))


@_kind("time")
def draining_battery(scene: Scene) -> Floats:
    """Bias by a battery's voltage, which falls as a hyperbola of the charge that is left, at a steady load.

    C. M. Shepherd, Design of primary and secondary cells, J. Electrochem. Soc. 112 (1965) 657. Each run starts full.
    """
    empty_s = scene.fixed.uniform(1.1, 1.4) * _LONGEST_S
    return column(0.03 * DEG * (1 / (1 - scene.t_s / empty_s) - 1))
