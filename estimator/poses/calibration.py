"""What an accelerometer calibration by hand gives: parameters with sigmas, every rest, and what cannot be said."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimator.geometry.kinematics import Gravity
from estimator.poses.intrinsic import NAMES, Intrinsic
from estimator.types import Flags, Floats


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class PoseRest:
    """One rest: ``number`` from 1, its file, when it begins and how long it lasts, and its mean output (3,).

    Times are None for given means. ``before_mps2`` and ``after_mps2`` are the lengths of the specific force before and
    after calibration, ``sd_mps2`` is the standard deviation expected of the latter, None if the rest was not used.
    ``refused`` is the reason for that, empty if it was used.
    """

    number: int
    file: str
    start_s: float | None
    duration_s: float | None
    mean: Floats
    before_mps2: float
    after_mps2: float
    sd_mps2: float | None
    refused: str = ""


@dataclass(kw_only=True, frozen=True, slots=True)
class Parameter:
    """One parameter of ``intrinsic.NAMES`` with its standard uncertainty and the half width of its 95 % interval.

    Scales are relative, or in counts per m/s2; biases are in m/s2, or in counts; angles between sense axes are less
    90 deg, in rad. The numbers are None if the rests do not show it.
    """

    name: str
    value: float | None
    sd: float | None
    u95: float | None

    @property
    def shown(self) -> bool:
        """Whether the rests determine it."""
        return self.value is not None


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class PoseCalibration:
    """Nine parameters (in the order of ``intrinsic.NAMES``) from rests, with gravity as reference.

    ``covariance`` (9, 9) includes that of gravity; ``shown`` (9,). ``before_mps2`` and ``after_mps2`` are the standard
    deviations of the lengths over the rests that were used. ``between_mps2`` is the scatter of rests beyond the noise
    within them; ``freedom`` counts rests less parameters, 0 if nothing is left over to test the model by. ``unit`` is
    that of the outputs, m/s2 or counts. ``factor`` is that of a 95 % interval.
    """

    intrinsic: Intrinsic
    covariance: Floats
    shown: Flags
    factor: float
    freedom: int
    gravity: Gravity
    unit: str
    before_mps2: float
    after_mps2: float
    between_mps2: float
    rests: tuple[PoseRest, ...]
    notes: tuple[str, ...]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The nine parameters with their uncertainties."""
        return parameters_of(NAMES, self.intrinsic.vector, self.covariance, self.shown, self.factor)

    @property
    def used(self) -> tuple[PoseRest, ...]:
        """The rests that were used."""
        return tuple(rest for rest in self.rests if not rest.refused)

    @property
    def refused(self) -> tuple[PoseRest, ...]:
        """The rests that were left out, each with its reason."""
        return tuple(rest for rest in self.rests if rest.refused)


GYRO_NAMES = (
    *(f"gyro scale {axis}" for axis in "xyz"),
    *(f"gyro bias {axis}" for axis in "xyz"),
    *(f"gyro {axis} towards {other}" for axis in "xyz" for other in "xyz" if axis != other),
)
"""Names of what turns show of gyros: scales, biases in rad/s, tilts of the sense axes in rad."""


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class RefusedTurn:
    """A turn from one rest to the next, by their numbers, that was left out, and why."""

    before: int
    after: int
    reason: str


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class GyroTurnCalibration:
    """Gyros by the turns between rests: output = G w + bias, w in the frame of the accelerometers' matrix.

    ``matrix`` (3, 3) is G, ``bias_rps`` (3,). ``covariance`` (12, 12) and ``shown`` (12,) are of ``parameters``, in the
    order of ``GYRO_NAMES``. ``before_rad`` and ``after_rad`` are the rms angles by which a turn misses gravity.
    """

    matrix: Floats
    bias_rps: Floats
    covariance: Floats
    shown: Flags
    factor: float
    turns: int
    before_rad: float
    after_rad: float
    refused: tuple[RefusedTurn, ...]
    notes: tuple[str, ...]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Scales, biases and tilts with their uncertainties; a tilt is the part of a sense axis along another axis."""
        values = gyro_vector(self.matrix, self.bias_rps)
        return parameters_of(GYRO_NAMES, values, self.covariance, self.shown, self.factor)


def gyro_vector(matrix: Floats, bias_rps: Floats) -> Floats:
    """Return the values (12,) of ``GYRO_NAMES`` of a matrix G (3, 3) and biases (3,)."""
    scale = np.linalg.norm(matrix, axis=1)
    tilts = [matrix[i, j] / scale[i] for i in range(3) for j in range(3) if i != j]
    return np.concatenate([scale, bias_rps, tilts])


def parameters_of(
    names: Sequence[str], values: Floats, covariance: Floats, shown: Flags, factor: float
) -> tuple[Parameter, ...]:
    """Return n parameters with standard deviations and 95 % half widths, in the order of the n ``names``.

    ``values`` (n,) and ``covariance`` (n, n) are theirs; a half width is ``factor`` standard deviations. Value,
    standard deviation and half width are None, all three, where a parameter is not ``shown`` (n,).
    """
    found = []
    for at, name in enumerate(names):
        if not shown[at]:
            found.append(Parameter(name=name, value=None, sd=None, u95=None))
            continue
        sd = float(covariance[at, at]) ** 0.5
        found.append(Parameter(name=name, value=float(values[at]), sd=sd, u95=factor * sd))
    return tuple(found)


ACCELEROMETER, GYRO = "accelerometer", "gyro"
TRIAD_NAMES = tuple(name.removeprefix("gyro ") for name in GYRO_NAMES)
"""Names of the twelve states of a triad whose frame is stated."""


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Triad:
    """Twelve states in a stated frame: output = matrix (3, 3) times input, plus bias (3,).

    ``kind`` is ACCELEROMETER, with biases in m/s2, or GYRO, with biases in rad/s. ``covariance`` (12, 12) and ``shown``
    (12,) are of ``parameters``, in the order of ``TRIAD_NAMES``.
    """

    kind: str
    matrix: Floats
    bias: Floats
    covariance: Floats
    shown: Flags
    factor: float

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Scales, biases and tilts with their uncertainties; a tilt is the part of a sense axis along another axis."""
        return parameters_of(TRIAD_NAMES, gyro_vector(self.matrix, self.bias), self.covariance, self.shown, self.factor)


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class BoardImu:
    """One IMU on a board, against the first: ``rotation`` (3, 3) turns vectors of its frame into that of the first.

    ``rotation_sd_rad`` is the standard uncertainty of it about any axis. ``arm_m`` (3,) leads from the accelerometers
    of the first to its own, ``covariance_m2`` (3, 3) is that of it; ``distance_m`` is its length with the half width of
    its 95 % interval.
    """

    name: str
    accelerometer: PoseCalibration
    gyro: GyroTurnCalibration
    rotation: Floats
    rotation_sd_rad: float
    arm_m: Floats
    covariance_m2: Floats
    distance_m: float
    distance_u95_m: float


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Board:
    """IMUs on a board, the first one first; ``saturated`` samples were left out, ``used`` ones give the arms.

    ``misfit_mps2`` is the rms of what arms and motion leave of the accelerometers.
    """

    imus: tuple[BoardImu, ...]
    used: int
    saturated: int
    misfit_mps2: float


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class PoseSession:
    """A calibration by hand as it is kept: device, licence and source of the data, the mapping's text, the files.

    ``gyro`` is None unless gyros are calibrated by gravity; ``triads`` are there if poses are stated.
    ``board`` has all IMUs of a board, the first of which is ``accelerometer`` and ``gyro``. ``notes``
    are of the files; ``refused_files`` are those left out, with reasons.
    """

    device: str
    licence: str
    source: str
    mapping: str
    files: tuple[str, ...]
    notes: tuple[str, ...]
    refused_files: tuple[str, ...]
    accelerometer: PoseCalibration
    gyro: GyroTurnCalibration | None = None
    triads: tuple[Triad, ...] = ()
    board: Board | None = None
