"""The nine intrinsic parameters of an accelerometer triad, and the specific force that it shows under them.

Output y = A f + o. The rows of A are the sense axes times their sensitivities. A rotation of the triad leaves the
length of f unchanged, so only lengths of the rows, offsets and angles between the rows are seen without known poses
(Geist et al., J. Res. NIST 122.032, 2017).
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from estimator.types import Floats

PAIRS = ((0, 1), (0, 2), (1, 2))
"""Sense axes of each of the three angles."""
NAMES = (
    *(f"scale {axis}" for axis in "xyz"),
    *(f"bias {axis}" for axis in "xyz"),
    *(f"angle {'xyz'[i]}{'xyz'[j]}" for i, j in PAIRS),
)
"""Names of the nine parameters, in the order of a vector of them."""


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Intrinsic:
    """Sensitivities (3,), offsets (3,) and angles between sense axes less 90 deg (3,), in rad.

    Angles are of x and y, x and z, y and z. Sensitivities are in units of the output per m/s2, 1 for an ideal device
    that puts out m/s2; offsets are in units of the output.
    """

    scale: Floats
    offset: Floats
    angle_rad: Floats

    @classmethod
    def ideal(cls) -> Self:
        """Return the parameters of a device without errors."""
        return cls(scale=np.ones(3), offset=np.zeros(3), angle_rad=np.zeros(3))

    @classmethod
    def of_vector(cls, x: Floats) -> Self:
        """Return the parameters in a vector (9,) in the order of ``NAMES``."""
        return cls(scale=x[:3], offset=x[3:6], angle_rad=x[6:])

    @classmethod
    def of_matrix(cls, matrix: Floats, offset: Floats) -> Self:
        """Return the parameters of a matrix (3, 3) whose rows are sense axes times sensitivities."""
        scale = np.linalg.norm(matrix, axis=1)
        rows = matrix / scale[:, None]
        return cls(scale=scale, offset=offset, angle_rad=np.array([-np.arcsin(rows[i] @ rows[j]) for i, j in PAIRS]))

    @property
    def vector(self) -> Floats:
        """The parameters (9,) in the order of ``NAMES``."""
        return np.concatenate([self.scale, self.offset, self.angle_rad])

    @property
    def cosines(self) -> Floats:
        """Cosines of the angles between the sense axes (3, 3)."""
        cosines = np.eye(3)
        for (i, j), angle in zip(PAIRS, self.angle_rad, strict=True):
            cosines[i, j] = cosines[j, i] = -np.sin(angle)
        return cosines

    @property
    def matrix(self) -> Floats:
        """The matrix A (3, 3) for the body frame with x along the sense axis x and y in the plane of x and y.

        LinAlgError if no three directions have such angles.
        """
        return np.asarray(self.scale[:, None] * np.linalg.cholesky(self.cosines))

    def force_mps2(self, outputs: Floats) -> Floats:
        """Return specific forces (n, 3) in the frame of ``matrix`` for outputs (n, 3)."""
        return np.asarray(np.linalg.solve(self.matrix, (outputs - self.offset).T).T)


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Lengths:
    """Lengths (n,) of specific forces in m/s2, their derivatives by parameters (n, 9) and by outputs (n, 3).

    ``inverse`` (3, 3) is the inverse of A A'.
    """

    length_mps2: Floats
    by_parameter: Floats
    by_output: Floats
    inverse: Floats

    @classmethod
    def of(cls, parameters: Intrinsic, outputs: Floats) -> Self:
        """Return the lengths that outputs (n, 3) show under these parameters, with their derivatives."""
        inverse_cosines = np.linalg.inv(parameters.cosines)
        scaled = (outputs - parameters.offset) / parameters.scale
        dual = scaled @ inverse_cosines
        length = np.sqrt(np.maximum(np.sum(scaled * dual, axis=1), np.finfo(float).tiny))
        unit = dual / length[:, None]
        by_output = unit / parameters.scale
        by_angle = [
            unit[:, i] * dual[:, j] * np.cos(angle) for (i, j), angle in zip(PAIRS, parameters.angle_rad, strict=True)
        ]
        return cls(
            length_mps2=length,
            by_parameter=np.column_stack([-by_output * scaled, -by_output, *by_angle]),
            by_output=by_output,
            inverse=inverse_cosines / np.outer(parameters.scale, parameters.scale),
        )
