"""Twin of any IMU on CAN that a DBC describes: nodes of one gyro each, or one device with several."""

import asyncio
import math
from dataclasses import dataclass
from typing import Any

import can
import numpy as np

from drivers.imus.can.imu import ChannelSignals, load_dbc
from drivers.imus.signals import SignalReader
from drivers.types import Floats
from sims.wires.frames import FrameSink, ImuTwinSetup

_BUILT = "can twin"
_RANGE_RPS = math.radians(2000)


class CanNodes:
    """Sends the messages of each channel regularly, and once a second those that carry only a temperature."""

    def __init__(self, setup: ImuTwinSetup, bus: FrameSink) -> None:
        """Prepare a node for each channel of ``setup.signals``, to which the gyros are given in their order.

        DeviceError for a DBC that cannot be read, or a signal that it lacks.
        """
        dbc, channels = setup.signals.dbc, setup.signals.channels
        database = setup.signals.database or load_dbc(_BUILT, dbc)
        self._setup, self._bus, self._rate_hz, self.faults = setup, bus, setup.rate_hz, setup.faults
        self._feels = any(channel.acceleration for channel in channels)
        self._nodes: list[_Node] = []
        first = 0
        for channel in channels:
            signals = ChannelSignals(_BUILT, database, dbc, channel)
            self._nodes.append(_Node(signals, slice(first, first + len(signals.rates))))
            first += len(signals.rates)
        # A temperature in a message of its own, or in none, is only computed when it is sent.
        self._rarely = all(node.tells_temperature_apart for node in self._nodes)

    async def serve(self) -> None:
        """Send the messages of all channels at the rate of ``setup`` until cancelled.

        Rates are limited to 2000 deg/s. Faults leave samples out, send them twice, change rates or the clock. A
        temperature in a message of its own is computed and sent once a second.
        """
        loop = asyncio.get_running_loop()
        device_s, start = 0.0, loop.time()
        sample = 0
        every = max(round(self._rate_hz), 1)
        while True:
            sample += 1
            # A fast clock takes a second of its own for less: its samples come early.
            step_s = 1 / self._rate_hz
            start += step_s / (1 + 1e-6 * self.faults.clock_ppm)
            device_s += step_s
            await asyncio.sleep(max(start - loop.time(), 0.0))
            at = np.array([start])
            rates = self.faults.rates(self._setup.gyros.sample(at)[0]).clip(-_RANGE_RPS, _RANGE_RPS)
            rates = self.faults.spoilt(rates[None])[0]
            force = self._setup.force_mps2(at)[0] if self._feels else np.zeros(3)
            with_temperature = sample % every == 0 or not self._rarely
            temperature_c = self._setup.gyros.temperature_c(start) if with_temperature else math.nan
            sent = _NodeState(sample, device_s, temperature_c, force)
            times = self.faults.times_to_send()
            for node in self._nodes:
                messages = node.messages(rates[node.gyros], sent, with_temperature=with_temperature)
                for message in messages * times:
                    self._bus.send(message)


class _NodeState:
    """The values of a device at one sampling instant, apart from the rates."""

    def __init__(self, sample: int, device_s: float, temperature_c: float, force_mps2: Floats) -> None:
        self.sample, self.device_s = sample, device_s
        self.temperature_c, self.force_mps2 = temperature_c, force_mps2


@dataclass(frozen=True, slots=True)
class _Field:
    """The values that a signal can hold: whole numbers only, and the ranges that limit them."""

    whole: bool
    ranges: tuple[tuple[float, float], ...]

    @classmethod
    def of(cls, signal: SignalReader) -> "_Field":
        """Return the ranges that limit a signal, in its unit in the DBC: of its raw number and that of the DBC.

        A float has no first range; the second is left out if the DBC gives none.
        """
        field = signal.message.get_signal_by_name(signal.name)
        ranges: list[tuple[float, float]] = []
        if not field.is_float:
            least, steps = -(2 ** (field.length - 1)) if field.is_signed else 0, 2**field.length - 1
            most = least + steps - (steps >> 50)  # the end of 64 bits is beyond the digits of a float
            low, high = sorted(raw * field.scale + field.offset for raw in (least, most))
            ranges.append((low, high))
        if field.minimum is not None and field.maximum is not None and field.minimum < field.maximum:
            ranges.append((field.minimum, field.maximum))
        return cls(not field.is_float, tuple(ranges))


class _Node:
    """One channel: its messages in the order of their priority on the bus."""

    def __init__(self, signals: ChannelSignals, gyros: slice) -> None:
        """Prepare the messages of ``signals``, all values at 0; ``gyros`` selects those of this channel."""
        self.gyros = gyros
        self._signals = signals
        by_key: dict[tuple[int, bool], Any] = {signal.key: signal.message for signal in signals.all}
        self._messages = [(key, by_key[key]) for key in sorted(by_key)]
        self._fields = {id(signal): _Field.of(signal) for signal in signals.all}
        of_a_sample = {signal.key for signal in signals.all if signal is not signals.temperature}
        self._rare = set(by_key) - of_a_sample
        self.tells_temperature_apart = signals.temperature is None or signals.temperature.key in self._rare
        self._values: dict[tuple[int, bool], dict[str, float]] = {
            key: {signal.name: 0.0 for signal in message.signals if not signal.is_multiplexer}
            for key, message in by_key.items()
        }

    def messages(self, rates_rps: Floats, state: _NodeState, *, with_temperature: bool) -> list[can.Message]:
        """Return the messages for one sample with the channel's rates (m,) and the rest of ``state``, by identifier.

        Counter and time of the sample wrap. Messages that carry only a temperature are left out unless
        ``with_temperature``; others repeat the last temperature.
        """
        signals = self._signals
        for signal, rate in zip(signals.rates, rates_rps.tolist(), strict=True):
            self._put(signal, rate)
        for signal, force in zip(signals.acceleration, state.force_mps2.tolist(), strict=False):
            self._put(signal, force)
        if signals.temperature is not None and with_temperature:
            self._put(signals.temperature, state.temperature_c)
        if signals.counter is not None:
            modulus = signals.wrap or 1 << signals.counter.bits
            self._values[signals.counter.key][signals.counter.name] = state.sample * signals.step % modulus
        if signals.time is not None:
            ticks = round(state.device_s / signals.time.scale) % (signals.wrap or 1 << signals.time.bits)
            self._values[signals.time.key][signals.time.name] = signals.time.unscaled(ticks * signals.time.scale)
        out = []
        for key, message in self._messages:
            if key not in self._rare or with_temperature:
                data = message.encode(self._values[key], strict=False)
                out.append(can.Message(arbitration_id=key[0], is_extended_id=key[1], data=data))
        return out

    def _put(self, signal: SignalReader, value: float) -> None:
        """Store a value in SI for sending, limited to the signal's ranges; NaN leaves an integer as it was."""
        field = self._fields[id(signal)]
        if field.whole and math.isnan(value):
            return  # it has no word for that
        scaled = signal.unscaled(value)
        for low, high in field.ranges:
            scaled = min(max(scaled, low), high)
        self._values[signal.key][signal.name] = scaled
