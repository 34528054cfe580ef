"""Physics of an array of rate gyros: true input, deterministic errors, noise, temperature."""

import math
from dataclasses import dataclass

import numpy as np

from drivers.types import Floats
from sims.physics.body import Body
from sims.physics.geometry import Mounting
from sims.physics.hidden.chain import GyroChain
from sims.physics.hidden.effects import Hidden
from sims.physics.hidden.scene import World
from sims.physics.hidden.temperature import Temperature
from sims.physics.wander import Wander

_AHEAD_S = 0.1  # bias instability moves in steps of this, a tenth of its shortest time
_ROWS_AT_ONCE = 1 << 16


@dataclass(frozen=True, slots=True, eq=False)
class GyroTruth:
    """True errors of each gyro (m,), and the noise that all have."""

    k: Floats
    b_rps: Floats
    sigma_j_rad: Floats
    sigma_k_rad: Floats
    arw_rps_rthz: float
    bias_instability_rps: float
    temperature_c: float = 25.0
    warming_c: float = 2.0
    warming_time_s: float = 300.0
    rate_random_walk_rps_rts: float = 0.0


class GyroArray:
    """The outputs of the gyros of one device, before quantisation."""

    def __init__(
        self,
        *,
        mounting: Mounting,
        truth: GyroTruth,
        body: Body,
        rate_hz: float,
        seed: tuple[int, ...],
        hidden: Hidden | None = None,
        started_s: float = 0.0,
    ) -> None:
        """Prepare the gyros, m in number, which sample at ``rate_hz``; the same ``seed`` gives the same noise.

        ``mounting`` has their nominal axes, ``truth`` their errors, ``body`` the motion. The bench clock, which
        temperature and ``hidden`` effects follow, is at ``started_s`` at the instant 0. The temperature is that of
        ``hidden`` if it has one, else that of ``truth``. HiddenError for effects that do not fit m gyros.
        """
        self._truth = truth
        self._body = body
        tilt_j, tilt_k = truth.sigma_j_rad[:, None], truth.sigma_k_rad[:, None]
        tilted = mounting.p - tilt_k * mounting.j + tilt_j * mounting.k
        self._sensitivity = (1 - truth.k)[:, None] * tilted
        self._white_rps = truth.arw_rps_rthz * math.sqrt(rate_hz)
        self._random = np.random.default_rng(seed)
        m = len(mounting.p)
        self._period_s = 1 / rate_hz
        self._wander_rps = Wander(
            count=m,
            bias_instability=truth.bias_instability_rps,
            random_walk=truth.rate_random_walk_rps_rts,
            period_s=self._period_s,
            random=self._random,
        )
        self._started_s = started_s
        self.thermometer = True
        """Whether it has one that works."""
        self._temperature = (hidden and hidden.temperature) or Temperature(
            truth.temperature_c, truth.warming_c, truth.warming_time_s
        )
        self._chain: GyroChain | None = None
        if hidden is not None and hidden.of_gyros:
            world = World(body, mounting, tilted, self._temperature, started_s)
            self._chain = GyroChain(hidden.of_gyros, world, 1 - truth.k, self._period_s, seed)
        self._been_t = np.empty(0)
        self._per_call = 0
        self._revision = -1
        self._ahead_t, self._ahead, self._ahead_noise = np.empty(0), np.empty((0, m)), np.empty((0, m))

    def sample(self, t_s: Floats) -> Floats:
        """Return the outputs (n, m) in rad/s at n successive sampling instants, the first of which is now.

        Coming samples are computed ahead. If the table got a new command meanwhile, their true part is computed anew,
        while the noise of each instant stays. A call for another number of samples than the last discards those ahead,
        their noise included.
        """
        n = len(t_s)
        if n != self._per_call or not len(self._ahead):
            self._look_ahead(t_s)
        elif self._body.revision != self._revision:
            self._work_out(self._ahead_t)
        out = self._ahead[:n] - self._ahead_noise[:n]
        if self._chain is not None:
            self._been_t = np.concatenate([self._been_t, self._ahead_t[:n]])
            out = self._chain.put_out(self._ahead_t[:n], out)
        self._ahead, self._ahead_noise, self._ahead_t = self._ahead[n:], self._ahead_noise[n:], self._ahead_t[n:]
        return np.asarray(out)

    def sample_all(self, t_s: Floats) -> Floats:
        """Return the outputs (n, m) in rad/s at all instants (n,) of a run whose motion is known from the start.

        The bias moves in steps of 0.1 s. The noise is not that of ``sample`` with the same seed.
        """
        steps = max(round(_AHEAD_S / self._period_s), 1)
        wander = np.repeat(self._wander_rps.steps(steps, -(-len(t_s) // steps)), steps, axis=0)
        out = np.empty((len(t_s), len(self._truth.k)))
        for start in range(0, len(t_s), _ROWS_AT_ONCE):  # attitudes take many times the room of outputs
            stop = min(start + _ROWS_AT_ONCE, len(t_s))
            white = self._white_rps * self._random.standard_normal((stop - start, out.shape[1]))
            out[start:stop] = self._true_output(t_s[start:stop], keep=True) - wander[start:stop] - white
        return out if self._chain is None else self._chain.put_out(t_s, out)

    def _look_ahead(self, t_s: Floats) -> None:
        """Compute instants, noise and outputs of the calls of the next 0.1 s, each for n samples as ``t_s`` (n,)."""
        n = self._per_call = len(t_s)
        calls = max(round(_AHEAD_S / (n * self._period_s)), 1)
        self._ahead_t = (t_s + n * self._period_s * np.arange(calls)[:, None]).ravel()
        rows, m = len(self._ahead_t), len(self._truth.k)
        wander = self._wander_rps.step(rows)
        self._ahead_noise = wander + self._white_rps * self._random.standard_normal((rows, m))
        self._work_out(self._ahead_t)

    def _work_out(self, t_s: Floats) -> None:
        if self._chain is not None and self._chain.remembers and len(self._been_t):
            self._chain.output(self._been_t, keep=True)  # samples computed ahead may never have been used
        self._been_t = np.empty(0)
        self._ahead = self._true_output(t_s, keep=False)
        self._revision = self._body.revision

    def _true_output(self, t_s: Floats, *, keep: bool) -> Floats:
        if self._chain is not None:
            return self._chain.output(t_s, keep=keep) - self._truth.b_rps
        return np.asarray(self._body.rate_rps(t_s) @ self._sensitivity.T - self._truth.b_rps)

    @property
    def stated_c(self) -> float:
        """The temperature at which the errors are stated."""
        return self._truth.temperature_c

    def temperature_c(self, t_s: float) -> float:
        """Return the temperature of the gyros."""
        return float(self.temperatures_c(np.array([t_s]))[0])

    def temperatures_c(self, t_s: Floats) -> Floats:
        """Return the temperature of the gyros at instants (n,)."""
        return self._temperature.at(t_s + self._started_s) if self.thermometer else np.full(len(t_s), np.nan)
