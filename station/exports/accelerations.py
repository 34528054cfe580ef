"""Accelerometers of an export: from their outputs to the specific force, and what a format lacks of them."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np

from drivers.types import Floats
from estimator.calibration.accelerometer import AccelerometerCalibration, ForceCalibration
from estimator.estimation.accelerometers.force_effects import BY_NAME
from estimator.geometry.array import TOLERANCE, SensorArray
from estimator.geometry.model import predicted_output
from station.errors import UsageError, sentence
from station.exports.exported import Exported


class Part(Enum):
    """What a calibration of accelerometers has beside the constants that correct a sample."""

    DELAY = auto()
    EFFECTS = auto()
    LEVER_ARM = auto()
    SIGMAS = auto()


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class ForceCorrection:
    """The constants that turn outputs y (a,) of the accelerometers of one source into the specific force f (3,).

    ``f = solution (y + bias_mps2)``, where ``solution`` (3, a) is the inverse of ``sensitivity`` (a, 3): outputs per
    specific force along body x, y, z, by least squares for more than three accelerometers. ``p`` (a, 3) are the
    nominal sense axes. Samples stamped t show the force at t less ``delay_s``. ``effects`` (a, e) are the parameters of
    those effects of the model that depend on the specific force alone, ``adds`` (e) what each adds to an output.
    """

    calibration: ForceCalibration
    p: Floats
    sensitivity: Floats
    bias_mps2: Floats
    solution: Floats
    effects: Floats
    adds: tuple[str, ...]

    @property
    def axes(self) -> Floats:
        """The nominal sense and tilt axes p, j, k of each accelerometer (a, 3, 3)."""
        return np.array([[one.p, one.j, one.k_axis] for one in self.accelerometers])

    @property
    def accelerometers(self) -> tuple[AccelerometerCalibration, ...]:
        """The accelerometers, in the order of the outputs."""
        return self.calibration.accelerometers

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the accelerometers."""
        return tuple(one.name for one in self.accelerometers)

    @property
    def delay_s(self) -> float:
        """By how much stamps are late; 0 if that is not known."""
        offset = self.calibration.offset
        return 0.0 if offset is None else offset.offset_s


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class HeldForces:
    """What a format holds of the accelerometers: ``correction``, None if nothing; ``lines`` say what it lacks."""

    correction: ForceCorrection | None = None
    lines: tuple[str, ...] = ()

    @property
    def held(self) -> ForceCorrection:
        """The correction; UsageError, with the reason, if there is none."""
        if self.correction is None:
            raise UsageError(". ".join(self.lines) or sentence("export.no_accelerometers"))
        return self.correction


def held_forces(exported: Exported, form: str = "", *, triad: bool, parts: Collection[Part] = ()) -> HeldForces:
    """Return what a format holds of the accelerometers of an export.

    ``form`` names it in messages. With ``triad`` it holds exactly three accelerometers. ``parts`` are those that it
    holds beside the constants; lines say which others the calibration has. Without accelerometers nothing is held, and
    no line says so. For those of several sources, or that do not span space or fit the format, one line says why.
    """
    if not exported.forces:
        return HeldForces()
    if len(exported.forces) > 1:
        devices = ", ".join(one.device or one.source for one in exported.forces)
        return HeldForces(lines=(sentence("export.several_places", devices=devices),))
    (calibration,) = exported.forces
    why = _why_refused(calibration, form, triad)
    if why:
        return HeldForces(lines=(f"accelerometers: {why}",))
    correction = _correction(calibration)
    return HeldForces(correction=correction, lines=tuple(_lacking(exported, correction, parts)))


def left_out(exported: Exported, why: str) -> HeldForces:
    """Return that a format of gyros alone holds no accelerometers, and ``why``; nothing if the export has none."""
    return HeldForces(lines=(f"accelerometers: {why}",)) if exported.forces else HeldForces()


def lower_and_rotation(sensitivity: Floats) -> tuple[Floats, Floats] | None:
    """Return a lower triangular matrix (3, 3), its diagonal positive, and a rotation (3, 3).

    The matrix times the rotation is ``sensitivity`` (3, 3).
    None if the rows of ``sensitivity`` are a left-handed triad.
    """
    q, r = np.linalg.qr(sensitivity.T)
    signs = np.sign(np.diag(r))
    rotation = (q * signs).T
    if np.linalg.det(rotation) < 0:
        return None
    return r.T * signs + 0.0, rotation  # no minus zeros


def sensitivity_of(accelerometers: Sequence[AccelerometerCalibration]) -> Floats:
    """Return outputs per specific force along body x, y, z (a, 3), by the states and nominal axes of accelerometers.

    Effects beside the states are not in it. There must be one accelerometer or more.
    """
    array = SensorArray(
        tuple(one.name for one in accelerometers),
        np.array([one.p for one in accelerometers]),
        np.array([one.j for one in accelerometers]),
        np.array([one.k_axis for one in accelerometers]),
    )
    states = np.array([one.states for one in accelerometers])
    return np.asarray((predicted_output(array, states, np.eye(3)) + states[:, 1]).T)


def spans_space(sensitivity: Floats) -> bool:
    """Return whether outputs (a,) with this sensitivity (a, 3) determine a vector."""
    return len(sensitivity) >= 3 and bool(np.linalg.svd(sensitivity, compute_uv=False)[2] >= TOLERANCE)


def _why_refused(calibration: ForceCalibration, form: str, triad: bool) -> str:
    """Return why the format ``form`` cannot hold accelerometers; "" if it can.

    They have to span space, and with ``triad`` there have to be three.
    """
    count = len(calibration.accelerometers)
    excluded = "".join(f"; {one.name}: {one.reason}" for one in calibration.excluded)
    if count < 3 or not spans_space(sensitivity_of(calibration.accelerometers)):
        return sentence("export.no_force", count=count, excluded=excluded)
    if triad and count != 3:
        return sentence("export.three_accelerometers", form=form, count=count)
    return ""


def _correction(calibration: ForceCalibration) -> ForceCorrection:
    """Return the constants of accelerometers that span space: sensitivity, its pseudo-inverse, biases, effects.

    Of these it has those that depend on the specific force alone.
    """
    sensitivity = sensitivity_of(calibration.accelerometers)
    of_force = [effect for effect in calibration.effects if BY_NAME[effect.name].of_force]
    return ForceCorrection(
        calibration=calibration,
        p=np.array([one.p for one in calibration.accelerometers]),
        sensitivity=sensitivity,
        bias_mps2=np.array([one.states[1] for one in calibration.accelerometers]),
        solution=np.asarray(np.linalg.pinv(sensitivity)),
        effects=np.hstack([np.empty((len(sensitivity), 0)), *(effect.values for effect in of_force)]),
        adds=tuple(text for effect in of_force for text in BY_NAME[effect.name].adds),
    )


def _lacking(exported: Exported, correction: ForceCorrection, parts: Collection[Part]) -> Iterator[str]:
    """Yield a line for each thing that is known of the accelerometers and is not among ``parts``, those of the format.

    Effects that do not depend on the specific force alone are lacking in any format. Two lines do not depend on
    ``parts``: that the places are unknown, if they are, and at which temperature it was calibrated, or that this is
    unknown.
    """
    if Part.DELAY not in parts and correction.delay_s:
        yield sentence("export.force_delay", delay_s=correction.delay_s)
    if not correction.calibration.placed:
        yield sentence("export.no_places")
    elif Part.LEVER_ARM not in parts:
        arm = ", ".join(f"{value:.6g}" for value in correction.calibration.arm_m)
        yield sentence("export.lever_arm", arm=arm)
    lacking = [
        effect.name.replace("_", " ")
        for effect in correction.calibration.effects
        if Part.EFFECTS not in parts or not BY_NAME[effect.name].of_force
    ]
    if lacking:
        yield sentence("export.force_effects", names=", ".join(lacking))
    if Part.SIGMAS not in parts:
        yield sentence("export.force_sigmas")
    mean_c = exported.seen.temperature_c[1]
    if np.isfinite(mean_c):
        yield sentence("export.force_temperature", mean_c=mean_c)
    else:
        yield sentence("export.force_temperature_unknown")
