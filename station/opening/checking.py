"""Whether everything on a bench answers: identities, limits, and two seconds of samples of each source."""

import asyncio
import math
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from drivers.errors import BadReply, DeviceError, LinkLost
from drivers.imus.kind import SPEC as IMU
from drivers.protocols import AppendsSeries, ImuSource, TellsOrders, Turntable
from drivers.tables.kind import SPEC as TABLE
from drivers.types import Floats, Identity, ImuBlock, LinkCounts, SourceCounts, Stamps
from station.bench.imu import ImuConfig
from station.errors import sentence
from station.opening import OpenBench, OpenDevice

LISTEN_S = 2.0
_OPEN_S = 5.0
_READINGS = 10
_OTHERS_S = 1.0  # in which another master that commands an enabled table is seen to do so
_LOOKS = (0.07, 0.11, 0.19, 0.23, 0.4)  # fractions of it between two readings of drives' commands
_RATE_OFF = 0.02
_LEAST_PERIOD_S = 1e-5
_LOOK_AT_TABLE = "Do protocol, link, baud rate, parity and axis addresses match the controller?"
_LOOK_AT_OTHER = "Do protocol, link, baud rate and parity match the device?"
_LOOK_AT_IMU = "Do protocol, link, baud rate or channel match the device?"


@dataclass(kw_only=True, frozen=True, slots=True)
class AxisCheck:
    """The state of one axis: ``text`` is its condition in words; limits are those of the bench file."""

    name: str
    angle_rad: float
    rate_rps: float
    text: str
    max_rate_rps: float
    max_acceleration_rps2: float
    travel_rad: tuple[float, float] | None
    round_trip_s: float


@dataclass(frozen=True, slots=True, eq=False)
class SourceCheck:
    """Two seconds of one source; ``jitter_s`` is the standard deviation of arrivals relative to sample times."""

    name: str
    rate_hz: float
    samples: int
    lost: int
    repeated: int
    late: int
    corrupt: int
    jitter_s: float
    temperature_c: float
    mean_rps: Floats


@dataclass(slots=True)
class DeviceCheck:
    """The answers of one device. ``wrong`` says what is wrong and what to do, empty if nothing is.

    ``experimental``: neither driver nor twin was tested with anything made by others.
    """

    device: str
    kind: str
    link: str
    identity: Identity = field(default_factory=Identity)
    axes: list[AxisCheck] = field(default_factory=list)
    sources: list[SourceCheck] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    experimental: bool = False
    counts: LinkCounts | None = None

    @property
    def measured(self) -> list[str]:
        """Further measured values in words, beside axes and sources."""
        return []


@dataclass(slots=True)
class OtherCheck(DeviceCheck):
    """The answers of a device of another kind: ``values`` of its series, by column, with their units."""

    values: dict[str, float] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)

    @property
    def measured(self) -> list[str]:
        """The values with their units."""
        return [f"{column}: {value:g} {self.units[column]}" for column, value in self.values.items()]


async def check_bench(
    opened: OpenBench, *, time_scale: float = 1.0, tell: Callable[[str], None] = lambda device: None
) -> list[DeviceCheck]:
    """Return the answers of each device of an open bench, the table first; nothing moves.

    ``tell`` gets the name of each device before it is asked. What is wrong with a device is noted in its answers, not
    raised. Every driver is closed at the end. Time limits are stretched by a ``time_scale`` above 1. The answers
    include the counts of its link. If several send nothing intelligible, swapped links are suggested.
    """
    found = []
    for device in opened.devices.values():
        tell(device.name)
        check_device = _OF_KIND.get(device.config.kind.name, _check_other)
        try:
            found.append(await check_device(opened, device, time_scale))
        finally:
            device.driver.close()
    for check in found:
        check.counts = opened.link_counts().get(check.device)
    not_even_refused = [check for check in found if not {_LOOK_AT_TABLE, _LOOK_AT_IMU}.isdisjoint(check.wrong)]
    dumb = [check for check in not_even_refused if not check.axes and not check.sources]
    for check in dumb if len(dumb) > 1 else ():
        others = " and ".join(other.device for other in dumb if other is not check)
        check.wrong.append(f"{others} sends unknown data, too. Are their links swapped?")
    return found


@contextmanager
def _errors_noted(check: DeviceCheck, look_at: str) -> Iterator[None]:
    """Turn any exception within this context, time-outs included, into entries of ``check.wrong``.

    ``look_at`` is what to check for one that does not answer or whose answers make no sense.
    """
    try:
        yield
    except TimeoutError:
        check.wrong += [f"no answer within {_OPEN_S:g} s. Is it powered?", look_at]
    except (LinkLost, BadReply) as error:
        check.wrong += [error.message, look_at]
    except DeviceError as error:
        check.wrong.append(error.message)
    except Exception as error:  # a driver from outside
        check.wrong.append(f"its driver failed ({type(error).__name__}: {error}); `station conformance` tests drivers")


async def _check_table(opened: OpenBench, device: OpenDevice, time_scale: float) -> DeviceCheck:
    """Ask the table for identity, status and readings of each axis, and whether another master commands it.

    Returns the answers, with the limits of each axis and how long a reading takes. Noted as wrong are faults, open
    interlocks and cautions, axes that turn, commands of others, errors, and axes that together take longer to read than
    the poll rate allows. Commands of others are looked for if an axis is enabled and the protocol tells them. Time
    limits are stretched by ``time_scale``.
    """
    bench, table = opened.bench, opened.table
    check = DeviceCheck(device.name, bench.table.protocol, ", ".join(bench.table.links))
    check.experimental = not bench.table.spec.checked_against
    loop = asyncio.get_running_loop()
    with _errors_noted(check, _LOOK_AT_TABLE):
        async with asyncio.timeout(_OPEN_S * max(time_scale, 1.0)):
            await table.open()
            check.identity = await table.identify()
        orders = await _orders(table, bench.table.gimbals)
        enabled = []
        for axis in bench.table.gimbals:
            status = await table.status(axis)
            enabled += [axis] if status.enabled else []
            if status.trouble:
                check.wrong.append(f"{status.trouble}; clear the cause, then run with --reset-fault")
            elif status.caution:
                check.wrong.append(status.caution)
            trips = []
            for _ in range(_READINGS):
                began = loop.time()
                state = await table.read(axis)
                trips.append(loop.time() - began)
            limits = table.limits[axis]
            trip = float(np.median(trips)) / time_scale
            check.axes.append(
                AxisCheck(
                    name=axis,
                    angle_rad=state.angle_rad,
                    rate_rps=state.rate_rps,
                    text=status.text,
                    max_rate_rps=limits.rate_rps,
                    max_acceleration_rps2=limits.acceleration_rps2,
                    travel_rad=limits.travel_rad,
                    round_trip_s=trip,
                )
            )
            dps = math.degrees(state.rate_rps)
            if abs(dps) > 0.05:
                elsewhere = sentence("check.driven_elsewhere", axis=axis, dps=dps)
                check.wrong.append(
                    elsewhere if status.enabled else f"axis {axis} turns at {dps:.2f} deg/s. Stop it first"
                )
        if orders and enabled:
            check.wrong += await _commands_of_others(table, bench.table.gimbals, orders, time_scale)
        slow = sum(axis.round_trip_s for axis in check.axes)
        if slow * bench.table.poll_rate_hz > 1:
            check.wrong.append(sentence("check.too_slow", slow_ms=slow * 1e3, poll_rate_hz=bench.table.poll_rate_hz))
    return check


async def _check_other(opened: OpenBench, device: OpenDevice, time_scale: float) -> DeviceCheck:
    """Ask a device for its identity, one row of its series, and whether it would accept its set point.

    Returns the answers; a refusal and errors are noted as wrong. The device is not commanded.
    """
    config, driver = device.config, device.driver
    check = OtherCheck(device.name, config.spec.name, ", ".join(config.links))
    check.experimental = not config.spec.checked_against
    with _errors_noted(check, _LOOK_AT_OTHER):
        async with asyncio.timeout(_OPEN_S * max(time_scale, 1.0)):
            await driver.open()
            check.identity = await driver.identify()
            if isinstance(driver, AppendsSeries):
                check.units = dict(driver.columns)
                async for _, row in driver.rows():
                    check.values = dict(zip(check.units, row, strict=True))
                    break
            refused = await config.kind.refusal(driver, config.settings)
            check.wrong += [refused] if refused else []
    return check


async def _orders(table: Turntable, axes: Sequence[str]) -> dict[str, Mapping[str, float]]:
    """Return by axis the last commands in the drives, nothing if the protocol cannot tell."""
    return {axis: await table.orders(axis) for axis in axes} if isinstance(table, TellsOrders) else {}


async def _commands_of_others(
    table: Turntable, axes: Sequence[str], first_commands: Mapping[str, Mapping[str, float]], time_scale: float
) -> list[str]:
    """Return sentences about commands that drives of ``axes`` got from another master; empty if there were none.

    ``first_commands`` are the commands by axis at the beginning. The drives are looked at several times within a
    second, stretched by a ``time_scale`` above 1, at uneven intervals: a master that moves to and fro may repeat a
    command.
    """
    for part in _LOOKS:
        await asyncio.sleep(part * _OTHERS_S * max(time_scale, 1.0))
        if found := _commanded_by_others(first_commands, await _orders(table, axes)):
            return found
    return []


def _commanded_by_others(
    before: Mapping[str, Mapping[str, float]], now: Mapping[str, Mapping[str, float]]
) -> list[str]:
    """Return a sentence for each axis whose last commands changed between ``before`` and ``now``."""
    found = []
    for axis, orders in now.items():
        changed = [name for name, value in orders.items() if value != before[axis].get(name, value)]
        if changed:
            found.append(sentence("check.told_elsewhere", axis=axis, what=", ".join(changed).replace("_", " ")))
    return found


async def _check_imu(opened: OpenBench, device: OpenDevice, time_scale: float) -> DeviceCheck:
    """Listen to a device for two seconds; return its identity, its sources, and what is wrong with them.

    There are no sources if opening it, its identity or its samples raise an error. A source that sends nothing is noted
    as wrong and left out. Time is stretched by a ``time_scale`` above 1.
    """
    imu = next(imu for imu in opened.imus if imu.config.name == device.name)
    config, source = imu.config, imu.source
    check = DeviceCheck(config.name, config.protocol, config.link, experimental=not config.spec.checked_against)
    blocks: dict[str, list[ImuBlock]] = {}
    with _errors_noted(check, _LOOK_AT_IMU):
        async with asyncio.timeout(_OPEN_S * max(time_scale, 1.0)):
            await source.open()
            check.identity = await source.identify()
        blocks = await _blocks_received(source, LISTEN_S * max(time_scale, 1.0))
    if check.wrong:
        return check
    silent = [name for name in source.names if not sum(len(block.t_ns) for block in blocks.get(name, []))]
    if silent:
        corrupt = sum(source.counts(name).corrupt for name in silent)
        heard = f", but {corrupt} unknown or damaged frames" if corrupt else ""
        complaint = f"no samples from {', '.join(silent)} in {LISTEN_S:g} s{heard}. Is it powered and sending?"
        check.wrong += [complaint, _LOOK_AT_IMU]
    for name in source.names:
        if name not in silent:
            source_check = _source_check(source, name, blocks[name], time_scale)
            check.sources.append(source_check)
            check.wrong += _complaints(config, source_check, _counted(blocks[name]))
    return check


_OF_KIND: Mapping[str, Callable[[OpenBench, OpenDevice, float], Awaitable[DeviceCheck]]] = {
    TABLE.name: _check_table,
    IMU.name: _check_imu,
}
"""What looks at the devices of a kind, where a kind has more to show than who it is and what it appends."""


async def _blocks_received(source: ImuSource, duration_s: float) -> dict[str, list[ImuBlock]]:
    """Return by source the blocks received within ``duration_s``, held ones included; silent ones are left out.

    Errors of the driver pass through.
    """
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


def _source_check(source: ImuSource, name: str, blocks: Sequence[ImuBlock], time_scale: float) -> SourceCheck:
    """Return rate, counts, jitter, temperature and mean rates of one source; NaN for a gyro without a valid rate.

    There must be at least one sample. The temperature is the last one, NaN without any. ``time_scale`` is how fast the
    loop's clock runs: the jitter is in real time.
    """
    t_ns = np.concatenate([block.t_ns for block in blocks])
    arrival_ns = np.concatenate([block.arrival_ns for block in blocks])
    temperature = np.concatenate([block.temperature_c for block in blocks])
    rate = np.vstack([block.rate_rps for block in blocks])
    counts = source.counts(name)
    known = temperature[np.isfinite(temperature)]
    valid = np.isfinite(rate).any(axis=0)
    mean = np.full(rate.shape[1], np.nan)
    mean[valid] = np.nanmean(rate[:, valid], axis=0)
    return SourceCheck(
        name,
        _sent_hz(t_ns, arrival_ns, counts, _counted(blocks)),
        **asdict(replace(counts, samples=len(t_ns))),
        jitter_s=float(np.std((arrival_ns - t_ns).astype(np.float64))) * 1e-9 / time_scale,
        temperature_c=float(known[-1]) if len(known) else math.nan,
        mean_rps=mean,
    )


def _counted(blocks: Sequence[ImuBlock]) -> bool:
    """Return whether the device sends a count or clock of its own."""
    return blocks[0].counter is not None


def _sent_hz(t_ns: Stamps, arrival_ns: Stamps, counts: SourceCounts, counted: bool) -> float:
    """Return the number of samples per second that a device sends, lost ones included; 0 for fewer than two.

    ``counted``: the times are from the device's own count or clock. They show it once they have settled, in their
    second half. Without a count, times follow the rate of the bench file: only arrivals can contradict it, and losses
    follow from it, so that only repeated samples are added.
    """
    n = len(t_ns)
    if n < 2:
        return 0.0
    if counted:
        settled_ns = t_ns[(n - 1) // 2 :]
        period_s = float(settled_ns[-1] - settled_ns[0]) * 1e-9 / (len(settled_ns) - 1)
    else:
        period_s = float(np.polyfit(np.arange(n), (arrival_ns - arrival_ns[0]) * 1e-9, 1)[0])
    unseen = counts.lost if counted else counts.repeated
    return (1 + unseen / n) / max(period_s, _LEAST_PERIOD_S)


def _complaints(config: ImuConfig, check: SourceCheck, counted: bool) -> Iterator[str]:
    """Yield what is wrong with a source that sends: its rate, or else lost and corrupt samples; then its gyros.

    A rate is wrong by more than 2 %. A gyro is wrong if it sends no valid rate, or more than 20 deg/s at rest.
    ``counted``: its samples carry a count or clock; without, losses may explain a wrong rate.
    """
    who, prefix = ("it", "") if check.name == config.name else (check.name, f"{check.name}: ")
    whole = check.samples + check.lost
    lost = f"{check.lost} of {whole} samples"
    cables = "check cable, baud rate and load of this computer"
    if abs(check.rate_hz / config.rate_hz - 1) > _RATE_OFF:
        complaint = f"{who} sends at {check.rate_hz:.1f} Hz, but the bench file says {config.rate_hz:g} Hz. Correct one"
        whole_hz = check.rate_hz * whole / check.samples
        if not counted and abs(whole_hz / config.rate_hz - 1) < 2 * _RATE_OFF:
            complaint += f", or, if {lost} were lost, {cables}"
        yield complaint
    elif check.lost or check.corrupt:
        yield f"{prefix}{lost} lost, {check.corrupt} corrupt: {cables}"
    for i, mean in enumerate(check.mean_rps):
        if math.isnan(mean):
            yield f"{prefix}gyro {i + 1} sends no valid rate. Is the device starting up, or defective?"
        elif abs(mean) > math.radians(20.0):
            complaint = f"{prefix}gyro {i + 1} reads {math.degrees(mean):.1f} deg/s at rest"
            yield f"{complaint}. Do unit and scale match the bench file?"
