"""Gyros on CAN, described by a DBC: one message a gyro for its rate, one for its temperature."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import DeviceError
from drivers.sampling import RegularClock
from drivers.seams import Frame, FrameLink, ImuBlock, SourceCounts

BUILT_IN_DBC = Path(__file__).with_name("gyro_nodes.dbc")

_GATHER_S = 0.03
_TO_RPS = {"deg/s": np.pi / 180, "rad/s": 1.0}


@dataclass(frozen=True, slots=True)
class CanChannel:
    """Which signals carry one gyro, as ``MESSAGE.Signal`` names of the DBC."""

    name: str
    rate_signal: str
    temperature_signal: str | None = None


@dataclass(slots=True)
class _Node:
    clock: RegularClock
    counts: SourceCounts
    temperature_c: float = float("nan")


class CanImu:
    """Each channel is a source of its own with one gyro: nodes on a bus share no clock."""

    def __init__(
        self, device: str, link: FrameLink, dbc: Path, channels: tuple[CanChannel, ...], rate_hz: float
    ) -> None:
        """Read the DBC; DeviceError if it cannot be read or lacks a message or signal that is asked for."""
        import cantools

        self._device, self._link = device, link
        try:
            database: Any = cantools.database.load_file(dbc)
        except Exception as error:  # cantools has no common base for what a file can have wrong
            raise DeviceError(device, f"DBC file {dbc.name} cannot be read: {error}") from None
        self._nodes: dict[str, _Node] = {}
        self._rates: dict[tuple[int, bool], tuple[str, Any, str, float]] = {}
        self._temperatures: dict[tuple[int, bool], tuple[str, Any, str]] = {}
        for channel in channels:
            counts = SourceCounts()
            self._nodes[channel.name] = _Node(RegularClock(1 / rate_hz, counts), counts)
            message, signal = _lookup(device, database, dbc, channel.rate_signal)
            unit = str(message.get_signal_by_name(signal).unit)
            if unit not in _TO_RPS:
                raise DeviceError(device, f"{channel.rate_signal} in {dbc.name} has unit {unit!r}, not deg/s or rad/s")
            self._rates[_key(message)] = (channel.name, message, signal, _TO_RPS[unit])
            if channel.temperature_signal is not None:
                message, signal = _lookup(device, database, dbc, channel.temperature_signal)
                self._temperatures[_key(message)] = (channel.name, message, signal)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the channels."""
        return tuple(self._nodes)

    def counts(self, name: str) -> SourceCounts:
        """Get the counts of one channel."""
        return self._nodes[name].counts

    async def open(self) -> None:
        """Open the bus."""
        await self._link.open()

    async def blocks(self) -> AsyncIterator[tuple[str, ImuBlock]]:
        """Yield blocks of each channel; LinkLost when the bus is gone."""
        while True:
            for frame in await self._link.receive():
                self._take(frame)
            for name, node in self._nodes.items():
                if node.clock.due and (block := self._block(name)) is not None:
                    yield name, block
            # Frames are stamped by the link; to take them in handfuls spares the loop most of its turns.
            await asyncio.sleep(_GATHER_S)

    def flush(self) -> list[tuple[str, ImuBlock]]:
        """Return what is still held back for its timing."""
        last = [(name, self._block(name, everything=True)) for name in self._nodes]
        return [(name, block) for name, block in last if block is not None]

    def close(self) -> None:
        """Leave the bus."""
        self._link.close()

    def _take(self, frame: Frame) -> None:
        if (rate := self._rates.get((frame.identifier, frame.extended))) is not None:
            name, message, signal, to_rps = rate
            node = self._nodes[name]
            if (value := _decoded(message, signal, frame, node)) is not None:
                node.clock.add(frame.t_ns, value * to_rps, frame.data)
        elif (temperature := self._temperatures.get((frame.identifier, frame.extended))) is not None:
            name, message, signal = temperature
            if (value := _decoded(message, signal, frame, self._nodes[name])) is not None:
                self._nodes[name].temperature_c = value

    def _block(self, name: str, *, everything: bool = False) -> ImuBlock | None:
        node = self._nodes[name]
        ready = node.clock.ready(everything=everything)
        if ready is None:
            return None
        t_ns, arrival_ns, rate = ready
        return ImuBlock(t_ns, arrival_ns, rate[:, None], np.full(len(rate), node.temperature_c))


def _key(message: Any) -> tuple[int, bool]:
    """Return what tells a message: an 11-bit and a 29-bit id of the same number are two."""
    return int(message.frame_id), bool(message.is_extended_frame)


def _decoded(message: Any, signal: str, frame: Frame, node: _Node) -> float | None:
    if len(frame.data) != message.length:
        node.counts.corrupt += 1
        return None
    values: Mapping[str, Any] = message.decode(frame.data, decode_choices=False)
    return float(values[signal])


def _lookup(device: str, database: Any, dbc: Path, name: str) -> tuple[Any, str]:
    message_name, _, signal = name.partition(".")
    try:
        message = database.get_message_by_name(message_name)
        message.get_signal_by_name(signal)
    except KeyError:
        raise DeviceError(device, f"{dbc.name} has no signal {name}: write it as MESSAGE.Signal") from None
    return message, signal
