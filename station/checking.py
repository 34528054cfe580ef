"""Whether everything on a bench answers: identities, limits, and two seconds of samples of each source."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceError
from drivers.seams import Identity, ImuBlock, ImuSource
from station.bench_imu import ImuConfig
from station.open_bench import OpenBench, OpenImu

Floats = NDArray[np.float64]

LISTEN_S = 2.0
_OPEN_S = 5.0
_READINGS = 10
_RATE_OFF = 0.02
_SLOW_READING_S = 0.025  # half a period of the usual 20 Hz


@dataclass(frozen=True, slots=True)
class AxisCheck:
    """One axis as it answered: ``text`` is its condition in words, limits are the bench file's."""

    name: str
    angle_rad: float
    rate_rps: float
    text: str
    max_rate_rps: float
    max_acceleration_rps2: float
    round_trip_s: float


@dataclass(frozen=True, slots=True, eq=False)
class SourceCheck:
    """Two seconds of one source; ``jitter_s`` is the standard deviation of arrivals against sample times."""

    name: str
    rate_hz: float
    lost: int
    repeated: int
    late: int
    corrupt: int
    jitter_s: float
    temperature_c: float
    mean_rps: Floats


@dataclass(slots=True)
class DeviceCheck:
    """What one device answered. ``wrong`` says what is wrong and what to do, empty if nothing is."""

    device: str
    kind: str
    link: str
    identity: Identity = field(default_factory=Identity)
    axes: list[AxisCheck] = field(default_factory=list)
    sources: list[SourceCheck] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)


async def check_bench(
    opened: OpenBench, *, time_scale: float = 1.0, tell: Callable[[str], None] = lambda device: None
) -> list[DeviceCheck]:
    """Return what each device of an open bench answers, the table first. Nothing moves; every link is closed."""
    found = []
    tell("table")
    try:
        found.append(await _check_table(opened, time_scale))
    finally:
        opened.table.close()
    for imu in opened.imus:
        tell(imu.config.name)
        try:
            found.append(await _check_imu(imu, time_scale))
        finally:
            imu.source.close()
    return found


async def _check_table(opened: OpenBench, time_scale: float) -> DeviceCheck:
    bench, table = opened.bench, opened.table
    check = DeviceCheck("table", bench.table.protocol, bench.table.link)
    loop = asyncio.get_running_loop()
    try:
        async with asyncio.timeout(_OPEN_S * time_scale):
            await table.open()
            check.identity = await table.identify()
        for axis in bench.table.gimbals:
            status = await table.status(axis)
            if status.fault:
                check.wrong.append(f"{status.fault}; clear its cause, then run with --reset-fault")
            trips = []
            for _ in range(_READINGS):
                began = loop.time()
                state = await table.read(axis)
                trips.append(loop.time() - began)
            limits = table.limits[axis]
            trip = float(np.median(trips)) / time_scale
            check.axes.append(
                AxisCheck(
                    axis, state.angle_rad, state.rate_rps, status.text, limits.rate_rps, limits.acceleration_rps2, trip
                )
            )
            if abs(state.rate_rps) > math.radians(0.05):
                check.wrong.append(f"axis {axis} turns at {math.degrees(state.rate_rps):.2f} deg/s: stop it first")
        slow = sum(axis.round_trip_s for axis in check.axes)
        if slow * bench.table.poll_rate_hz > 1:
            check.wrong.append(
                f"a reading of all axes takes {slow * 1e3:.0f} ms, too slow for poll_rate = "
                f"{bench.table.poll_rate_hz:g} Hz: lower it, or use a faster link"
            )
    except TimeoutError:
        check.wrong.append(f"no answer within {_OPEN_S:g} s: is it powered, is the link right?")
    except DeviceError as error:
        check.wrong.append(_what(error))
    return check


async def _check_imu(imu: OpenImu, time_scale: float) -> DeviceCheck:
    config, source = imu.config, imu.source
    check = DeviceCheck(config.name, config.protocol, config.link)
    try:
        async with asyncio.timeout(_OPEN_S * time_scale):
            await source.open()
            check.identity = await source.identify()
        blocks = await _listen(source, LISTEN_S * time_scale)
    except TimeoutError:
        check.wrong.append(f"no answer within {_OPEN_S:g} s: is it powered, is the link right?")
        return check
    except DeviceError as error:
        check.wrong.append(_what(error))
        return check
    for name in source.names:
        got = blocks.get(name, [])
        if not sum(len(block.t_ns) for block in got):
            check.wrong.append(
                f"no samples from {name} in {LISTEN_S:g} s: is it powered and sending, are link, baud rate or channel "
                "as on the device?"
            )
            continue
        source_check = _source(source, name, got, time_scale)
        check.sources.append(source_check)
        check.wrong += _complaints(config, source_check)
    return check


async def _listen(source: ImuSource, duration_s: float) -> dict[str, list[ImuBlock]]:
    blocks: dict[str, list[ImuBlock]] = {}
    try:
        async with asyncio.timeout(duration_s):
            async for name, block in source.blocks():
                blocks.setdefault(name, []).append(block)
    except TimeoutError:
        pass
    for name, block in source.flush():
        blocks.setdefault(name, []).append(block)
    return blocks


def _source(source: ImuSource, name: str, blocks: Sequence[ImuBlock], time_scale: float) -> SourceCheck:
    t_ns = np.concatenate([block.t_ns for block in blocks])
    arrival_ns = np.concatenate([block.arrival_ns for block in blocks])
    temperature = np.concatenate([block.temperature_c for block in blocks])
    rate = np.vstack([block.rate_rps for block in blocks])
    counts = source.counts(name)
    span_s = float(t_ns[-1] - t_ns[0]) * 1e-9
    known = temperature[np.isfinite(temperature)]
    valid = np.isfinite(rate).any(axis=0)
    mean = np.full(rate.shape[1], np.nan)
    mean[valid] = np.nanmean(rate[:, valid], axis=0)
    return SourceCheck(
        name,
        (len(t_ns) - 1) / span_s if span_s > 0 else 0.0,
        counts.lost,
        counts.repeated,
        counts.late,
        counts.corrupt,
        float(np.std((arrival_ns - t_ns).astype(np.float64))) * 1e-9 / time_scale,
        float(known[-1]) if len(known) else math.nan,
        mean,
    )


def _complaints(config: ImuConfig, check: SourceCheck) -> list[str]:
    """Return what is wrong with a source that does send."""
    wrong = []
    sent_hz = check.rate_hz
    if abs(sent_hz / config.rate_hz - 1) > _RATE_OFF:
        wrong.append(
            f"{check.name} sends at {sent_hz:.1f} Hz, the bench file says {config.rate_hz:g} Hz: set one to the other"
        )
    if check.lost or check.corrupt:
        wrong.append(
            f"{check.name}: {check.lost} samples lost and {check.corrupt} corrupt in {LISTEN_S:g} s: look at cable, "
            "baud rate and load of the host"
        )
    for i, mean in enumerate(check.mean_rps):
        if math.isnan(mean):
            wrong.append(f"{check.name}: gyro {i + 1} gives no valid rate: is the device starting up, or broken?")
        elif abs(mean) > math.radians(20.0):
            wrong.append(
                f"{check.name}: gyro {i + 1} says {math.degrees(mean):.1f} deg/s at rest: is its unit or scale as in "
                "the bench file?"
            )
    return wrong


def _what(error: DeviceError) -> str:
    """Return an error without the device's name, which stands beside it."""
    return str(error).removeprefix(f"{error.device}: ")
