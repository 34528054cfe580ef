"""The gyros of one device with their faults: from the motion to the outputs."""

from collections.abc import Iterable
from copy import copy
from typing import TypeVar

import numpy as np

from drivers.types import Floats
from sims.physics.hidden.converter import Converter, DeadBand, SampleHold, Saturation, Stuck
from sims.physics.hidden.fields import HiddenError, for_gyros
from sims.physics.hidden.outputs import Added, BiasWalk, Sensed
from sims.physics.hidden.scene import Scene, World
from sims.physics.hidden.timing import Bandwidth, Hysteresis, LastTurn, Latency, LowPass, RateDependentDelay

T = TypeVar("T")


class GyroChain:
    """Signal chain: motion, delay, rate and further sensed effects, dead band, low pass, biases.

    Noise and converter follow.
    """

    def __init__(
        self, effects: Iterable[object], world: World, gain: Floats, period_s: float, seed: tuple[int, ...]
    ) -> None:
        """Prepare the chain of ``effects`` on m gyros, sampled every ``period_s``; ``seed`` is of biases that walk.

        ``gain`` (m,) is the sensitivity left by the constant scale factor errors, ``world`` what effects depend on.
        HiddenError if an effect names a gyro that does not exist, or has neither one value nor m.
        """
        m = len(gain)
        self._world, self._gain = world, gain
        fitted = [for_gyros(e.for_run(m, seed) if isinstance(e, BiasWalk) else e, m) for e in effects]
        self._sensed = [e for e in fitted if isinstance(e, Sensed)]
        self._added = [e for e in fitted if isinstance(e, Added)]
        self._late_s = sum(latency.delay_s for latency in _of(fitted, Latency))
        self._delays = _of(fitted, RateDependentDelay)
        self._bands = _of(fitted, DeadBand)
        self._hysteresis = _of(fitted, Hysteresis)
        self._low_passes = [LowPass(b.lag_s(), period_s) for b in _of(fitted, Bandwidth)]
        self._turns = [LastTurn(h.threshold_rps, np.zeros(m)) for h in self._hysteresis]
        stuck = _of(fitted, Stuck)
        if any(s.gyro > m for s in stuck):
            raise HiddenError(f"stuck.gyro: there are {m} gyros, counted from 1")
        holds = [hold.samples for hold in _of(fitted, SampleHold)]
        self._converter = Converter(tuple(_of(fitted, Saturation)), max(holds, default=1), tuple(stuck))

    @property
    def remembers(self) -> bool:
        """Return whether outputs depend on earlier samples."""
        return bool(self._low_passes or self._turns)

    def output(self, t_s: Floats, *, keep: bool) -> Floats:
        """Return outputs (n, m) in rad/s at successive instants (n,), without noise and before the converter.

        Low passes and hysteresis go on from the last call with ``keep``; other calls leave their state as it is.
        """
        low_passes = self._low_passes if keep else [copy(p) for p in self._low_passes]
        turns = self._turns if keep else [copy(t) for t in self._turns]
        now = Scene(self._world, t_s)
        late = Scene(self._world, t_s - self._late_s) if self._late_s else now
        out = self._sense_late(now, late)
        for low_pass in low_passes:
            out = low_pass(out)
        for effect in self._added:
            out = out + effect.output(now)
        for hysteresis, turn in zip(self._hysteresis, turns, strict=True):
            out = out + hysteresis.size_rps * turn(late.u)
        return out

    def put_out(self, t_s: Floats, out: Floats) -> Floats:
        """Return successive outputs (n, m) with their noise after the converter."""
        return self._converter(t_s + self._world.started_s, out)

    def _sense_late(self, now: Scene, late: Scene) -> Floats:
        if not self._delays:
            return self._sense(late)
        instants = late.t_s[:, None] - sum(delay.delay_s(now.u) for delay in self._delays)
        scenes = [Scene(self._world, instants[:, i]) for i in range(len(self._gain))]
        return np.column_stack([self._sense(scene)[:, i] for i, scene in enumerate(scenes)])

    def _sense(self, scene: Scene) -> Floats:
        """Return the sensed rate (n, m): gain times rate plus the sensed effects.

        A dead band removes gain times rate alone.
        """
        out = self._gain * scene.u
        for effect in self._sensed:
            out = out + effect.output(scene)
        for band in self._bands:
            within = np.abs(scene.u) <= band.size_rps
            out = np.where(within, out - self._gain * scene.u, out)
        return np.asarray(out)


def _of(effects: Iterable[object], kind: type[T]) -> list[T]:
    return [effect for effect in effects if isinstance(effect, kind)]
