"""Physics of the accelerometers of a device: specific force where each one sits, errors, noise."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from drivers.types import Floats
from sims.physics.body import Body
from sims.physics.geometry import Mounting
from sims.physics.wander import Wander

_G_MPS2 = 9.80665


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class AccelerometerTruth:
    """True errors of each accelerometer (m,), the place (m, 3) of each, and the noise that all have.

    ``places_m`` are from the point in which the axes of the table meet, in body axes. ``delay_s`` is by how much an
    output is late. ``asymmetry`` is by how much the scale of positive forces exceeds that of negative ones, ``k2_pg``
    and ``k3_pg2`` (1/g, 1/g2) are the second and third order of the output, ``cross_pg`` (1/g) that of the product of
    the forces along the sense axis and the first tilt axis, ``square_rps2`` the output per square of the body rate
    ((m/s2)/(rad/s)2, vibration of the motor), and ``k_pk`` and ``b_mps2pk`` the slopes of scale factor error and bias
    over temperature.
    """

    k: Floats
    b_mps2: Floats
    sigma_j_rad: Floats
    sigma_k_rad: Floats
    places_m: Floats
    vrw_mps2_rthz: float = 0.0
    bias_instability_mps2: float = 0.0
    delay_s: float = 0.0
    step_mps2: float = 0.0
    asymmetry: Floats = field(default_factory=lambda: np.zeros(1))
    k2_pg: Floats = field(default_factory=lambda: np.zeros(1))
    k3_pg2: Floats = field(default_factory=lambda: np.zeros(1))
    cross_pg: Floats = field(default_factory=lambda: np.zeros(1))
    square_rps2: Floats = field(default_factory=lambda: np.zeros(1))
    k_pk: Floats = field(default_factory=lambda: np.zeros(1))
    b_mps2pk: Floats = field(default_factory=lambda: np.zeros(1))


class Accelerometers:
    """The outputs of the accelerometers of one device."""

    def __init__(
        self,
        *,
        mounting: Mounting,
        truth: AccelerometerTruth,
        body: Body,
        rate_hz: float,
        seed: tuple[int, ...],
        gravity_mps2: float = _G_MPS2,
        warmth_c: Callable[[Floats], Floats] | None = None,
    ) -> None:
        """Prepare the accelerometers, one for each row of ``mounting``; the same ``seed`` gives the same noise.

        ``warmth_c`` gives the excess (n,) over the temperature at which the errors are stated.
        """
        self._mounting = mounting
        self._truth = truth
        self._body = body
        self._gravity_mps2 = gravity_mps2
        self._warmth_c = warmth_c
        tilted = mounting.p - truth.sigma_k_rad[:, None] * mounting.j + truth.sigma_j_rad[:, None] * mounting.k
        self._sense = tilted
        self._random = np.random.default_rng(seed)
        self._white_mps2 = truth.vrw_mps2_rthz * math.sqrt(rate_hz)
        self._wander = Wander(
            count=len(mounting.p),
            bias_instability=truth.bias_instability_mps2,
            random_walk=0.0,
            period_s=1 / rate_hz,
            random=self._random,
        )
        self._true_in_turn = body.in_turn(self.true_output_mps2, 1 / rate_hz)

    def sample(self, t_s: Floats) -> Floats:
        """Return the outputs (n, m) in m/s2 at n successive sampling instants, the first of which is now."""
        return self._read(self._true_in_turn(t_s))

    def sample_all(self, t_s: Floats) -> Floats:
        """Return the outputs (n, m) in m/s2 at all instants of a run whose motion is known from the start."""
        rows = 1 << 14
        parts = [self._read(self.true_output_mps2(t_s[start : start + rows])) for start in range(0, len(t_s), rows)]
        return np.vstack(parts)

    def true_output_mps2(self, t_s: Floats) -> Floats:
        """Return the outputs (n, m) in m/s2 at instants (n,), without noise and quantisation.

        They are delayed and have all other errors of the truth; those that follow the temperature only if ``warmth_c``
        was given.
        """
        truth = self._truth
        felt_s = t_s - truth.delay_s
        force = self._body.specific_force_mps2(felt_s, truth.places_m, self._gravity_mps2)
        along = np.einsum("nmi,mi->nm", force, self._sense)
        across = np.einsum("nmi,mi->nm", force, self._mounting.j)
        scale = 1 - truth.k + 0.5 * truth.asymmetry * np.sign(along)
        bias = truth.b_mps2
        if self._warmth_c is not None:
            warmth = self._warmth_c(felt_s)[:, None]
            scale = scale - truth.k_pk * warmth
            bias = bias + truth.b_mps2pk * warmth
        out = scale * along - bias
        out += truth.k2_pg * along**2 / _G_MPS2 + truth.k3_pg2 * along**3 / _G_MPS2**2
        out += truth.cross_pg * along * across / _G_MPS2
        if np.any(truth.square_rps2):
            rate = self._body.rate_rps(felt_s)
            out += truth.square_rps2 * np.sum(rate**2, axis=1, keepdims=True)
        return np.asarray(out)

    def _read(self, true: Floats) -> Floats:
        """Return outputs (n, m) with noise, rounded to steps."""
        steps = self._wander_by_sample(len(true))
        out = true - steps - self._white_mps2 * self._random.standard_normal(true.shape)
        step = self._truth.step_mps2
        return np.asarray(np.round(out / step) * step if step else out)

    def _wander_by_sample(self, rows: int) -> Floats:
        """Return the wandering biases (rows, m), which move every 10 samples."""
        each = 10
        moved = self._wander.steps(each, rows // each)
        rest = [self._wander.step(rows % each)] if rows % each else []
        return np.concatenate([np.repeat(moved, each, axis=0), *(np.tile(row, (rows % each, 1)) for row in rest)])
