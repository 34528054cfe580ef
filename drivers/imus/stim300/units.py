"""STIM300 output units (TS1524 rev. 31, section 7.5.2): raw numbers of a cluster to rates of change."""

import math

import numpy as np

from drivers.packaged import packaged_codes
from drivers.types import Floats, Ints

UNITS = packaged_codes("drivers", "stim300", "unit")
"""Output units by their code in the configuration datagram; of accelerometers, the rate is the acceleration."""

GYRO_LSB_DPS = 2.0**-14
GYRO_LSB_DEG = 2.0**-21
ACCEL_LSB_G = {5: 2.0**-20, 10: 2.0**-19, 30: 2.0**-18, 80: 2.0**-16}
ACCEL_LSB_MPS = {5: 2.0**-23, 10: 2.0**-22, 30: 2.0**-21, 80: 2.0**-19}
STANDARD_GRAVITY_MPS2 = 9.80665

_INCREMENT, _INTEGRATED = 1, 3
_KIND = 0x03  # bit 3 says delayed
_WRAP = float(1 << 24)  # integrated values go round with their 24 bits: +-4 deg
_LONGEST_STEP_S = 0.1  # the counter wraps after 128 ms


class ClusterUnit:
    """Meaning of the raw numbers of one cluster: values, increments over a sample period, or wrapping integrals."""

    def __init__(self, code: int, value_lsb: float, integral_lsb: float, rate_hz: int) -> None:
        """Prepare for the unit ``code`` of the configuration datagram, at ``rate_hz`` datagrams a second.

        Only the lowest two bits of the code count, so that none is refused: 1 is an increment, 3 an integral, 0 and 2
        are values. ``value_lsb`` is the size of one digit where outputs are values, in the unit wanted;
        ``integral_lsb`` where they are increments or integrals, in that unit times s.
        """
        self._kind = code & _KIND
        integral = self._kind in (_INCREMENT, _INTEGRATED)
        self._scale = integral_lsb * rate_hz if integral else value_lsb
        self._rate_hz = rate_hz
        self._last: Floats | None = None
        self._last_counter, self._last_t_ns = 0, 0

    @property
    def centre_s(self) -> float:
        """How long before its sample's instant a value holds: half a period for what is a mean over one."""
        return 0.0 if self._kind == 0 else 0.5 / self._rate_hz

    def rates(self, raw: Floats, counter: Ints, t_ns: Ints, ticks: int) -> Floats:
        """Return values (n, 3) from raw numbers (n, 3), at least one row; NaN stays NaN.

        Values are only scaled. Increments are divided by the sample period. So is, for integrals, the change since the
        previous sample, also across calls. That is NaN for the first sample of all, and where the previous one is NaN
        or missing: ``counter`` (n,) has not moved by ``ticks``, or ``t_ns`` (n,) has by more than 0.1 s. Wraps over a
        gap cannot be counted.
        """
        if self._kind != _INTEGRATED:
            return np.asarray(raw * self._scale)
        if self._last is None:
            self._last, self._last_counter, self._last_t_ns = np.full(3, np.nan), 0, 0
        change = np.diff(np.vstack([self._last, raw]), axis=0)
        step = np.diff(np.concatenate([[self._last_counter], counter])) % 256
        step_s = np.diff(np.concatenate([[self._last_t_ns], t_ns])) * 1e-9
        change[(step != ticks % 256) | (step_s > _LONGEST_STEP_S)] = np.nan
        self._last, self._last_counter, self._last_t_ns = raw[-1], int(counter[-1]), int(t_ns[-1])
        return np.asarray(((change + _WRAP / 2) % _WRAP - _WRAP / 2) * self._scale)


def gyro_unit_rps(code: int, rate_hz: int) -> ClusterUnit:
    """Return how gyro outputs become rad/s."""
    return ClusterUnit(code, math.radians(GYRO_LSB_DPS), math.radians(GYRO_LSB_DEG), rate_hz)


def accel_unit_mps2(code: int, range_g: int, rate_hz: int) -> ClusterUnit:
    """Return how accelerometer outputs become m/s2; ``range_g`` is 5, 10, 30 or 80."""
    return ClusterUnit(code, ACCEL_LSB_G[range_g] * STANDARD_GRAVITY_MPS2, ACCEL_LSB_MPS[range_g], rate_hz)
