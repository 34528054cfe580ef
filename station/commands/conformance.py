"""station conformance: tests a device and its twin by the rules that the station's own devices fulfil."""

import argparse
import asyncio
import json
import math
import signal
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import DeviceError, LinkLost
from drivers.imus.described.imu import SPEC as DESCRIBED
from drivers.imus.kind import SPEC as IMU
from drivers.imus.registry import IMUS
from drivers.kind import DeviceKind
from drivers.kinds import KINDS
from drivers.plugins import PluginError, load_file, records_of
from drivers.protocols import AppendsSeries, Device, ImuSource, Turntable
from drivers.specs import DeviceSpec, ImuSpec, TableSpec
from drivers.tables.kind import SPEC as TABLE
from drivers.tables.registry import TABLES, USUAL_TABLE
from drivers.types import AxisState, Floats, ImuBlock, SourceCounts
from estimator.strict_toml import not_one_of
from station.bench.bench import Bench, read_bench
from station.bench.descriptions import load_description
from station.bench.imu import ImuConfig
from station.errors import UsageError
from station.init.gyros import GYROS, built_in_channels
from station.opening import OpenBench, open_bench
from station.render.lines import tell
from station.render.template import rendered
from station.run.event_loop.loops import VirtualLoop
from station.run.outcome import Outcome

_RATE_RPS, _RAMP_RPS2, _LITTLE_RPS = math.radians(20.0), math.radians(20.0), math.radians(0.3)
USUAL_DESCRIPTION = "hipnuc_hi91"
_REST_S, _LOOKS, _LOOK_S = 4.0, 50, 0.1
_ROWS = 3  # of a series


@dataclass(slots=True)
class ImuSamples:
    """Samples of an IMU by source, at rest and turning about z; table readings ``angles`` (s, rad); last ``error``."""

    imu: ImuConfig
    blocks: dict[str, list[ImuBlock]] = field(default_factory=dict)
    counts: dict[str, SourceCounts] = field(default_factory=dict)
    angles: list[tuple[float, float]] = field(default_factory=list)
    error: Exception | None = None

    def sources(self) -> Iterator[tuple[SourceCounts, Floats, Floats, Floats]]:
        """Yield of each source: counts, times (n,) in s, rates (n, m) in rad/s, and how its gyros (m,) lie along z."""
        for name, gyros in self.imu.gyros_of(list(self.blocks)).items():
            t_s = np.concatenate([block.t_ns for block in self.blocks[name]]) * 1e-9
            rate_rps = np.vstack([block.rate_rps for block in self.blocks[name]])
            yield self.counts[name], t_s, rate_rps, self.imu.array.p[gyros, 2]


async def samples_on(opened: OpenBench) -> ImuSamples:
    """Return nine seconds of the IMU's samples, at rest, then turning, and the table's angles; stores its errors."""
    table, source = opened.table, opened.imus[0].source
    heard = ImuSamples(opened.imus[0].config)

    async def listen() -> None:
        """Open the source and collect its blocks; any exception is kept in ``heard.error``."""
        try:
            await source.open()
            await source.identify()
            async for name, block in source.blocks():
                heard.blocks.setdefault(name, []).append(block)
        except Exception as error:  # its own mistakes, too
            heard.error = error

    listening = asyncio.get_running_loop().create_task(listen())
    await asyncio.sleep(_REST_S)
    await table.jog("z", _RATE_RPS, _RAMP_RPS2)
    for _ in range(_LOOKS):
        await asyncio.sleep(_LOOK_S)
        state = await table.read("z")
        heard.angles.append((state.angle_t_ns * 1e-9, state.angle_rad))
    listening.cancel()
    await asyncio.wait({listening})
    for name, block in source.flush():
        heard.blocks.setdefault(name, []).append(block)
    heard.counts = {name: replace(source.counts(name)) for name in heard.blocks}
    source.close()
    source.close()  # as a run does that cannot know whether it is closed
    return heard


def _units(heard: ImuSamples) -> str:
    """Return what is wrong with rates while turning: unit, scale, sign or order of axes; "" if they are right."""
    for _, t_s, rate_rps, along in heard.sources():
        off_rps = np.nanmean(rate_rps[t_s > t_s[-1] - 2.0], axis=0) - along * _RATE_RPS
        worst = int(np.argmax(np.abs(off_rps)))
        if not abs(off_rps[worst]) < _LITTLE_RPS:
            true_dps, off_dps = math.degrees(along[worst] * _RATE_RPS), math.degrees(off_rps[worst])
            wrong = f"gyro {worst + 1} says {true_dps + off_dps:.2f} deg/s while it turns at {true_dps:.2f} deg/s"
            return f"{wrong}: check unit, scale and sign, and the order of axes"
    return ""


def _clock(heard: ImuSamples) -> str:
    """Return what is wrong with sample times: order, rate, or more than 20 ms off the motion; "" if right."""
    for _, t_s, rate_rps, along in heard.sources():
        step_s = np.diff(t_s)
        if not (step_s > 0).all():
            return "sample times do not always increase"
        if abs(np.median(step_s) * heard.imu.rate_hz - 1) > 0.01:
            return f"samples are {np.median(step_s) * 1e3:.3f} ms apart, at {heard.imu.rate_hz:g} Hz"
        best = int(np.argmax(np.abs(along)))
        way = np.concatenate([[0.0], np.cumsum(step_s * (rate_rps[1:, best] + rate_rps[:-1, best]) / 2)]) / along[best]
        seen_s, seen_rad = np.array(heard.angles[-20:]).T
        late_s = float(np.mean(seen_rad - np.interp(seen_s, t_s, way))) / _RATE_RPS
        if abs(late_s) > 0.02:
            return f"sample times are {abs(late_s) * 1e3:.0f} ms too {'late' if late_s > 0 else 'early'}"
    return ""


def _complete(heard: ImuSamples) -> str:
    for counts, t_s, *_ in heard.sources():
        if counts.lost or counts.corrupt or abs(len(t_s) / ((t_s[-1] - t_s[0]) * heard.imu.rate_hz) - 1) > 0.01:
            wrong = f"byte by byte {len(t_s)} samples came, {counts.lost} were lost, {counts.corrupt} corrupt"
            return f"{wrong}: keep incomplete frames until the rest arrives"
    return ""


def _counted(heard: ImuSamples) -> str:
    for counts, t_s, *_ in heard.sources():
        sent = (t_s[-1] - t_s[0]) * heard.imu.rate_hz + 1
        if abs(len(t_s) + counts.lost - sent) > 0.01 * sent:
            return f"of {sent:.0f} samples {len(t_s)} came, and {counts.lost} were counted as lost"
    return ""


def _undamaged(heard: ImuSamples) -> str:
    """Return what is wrong on a wire that damages bytes: damaged samples accepted, or too few; "" if nothing."""
    for counts, t_s, rate_rps, along in heard.sources():
        middle_rps = along * _RATE_RPS / 2  # of the table's motion
        wild = int((np.abs(rate_rps - middle_rps) > np.abs(middle_rps) + 5 * _LITTLE_RPS).any(axis=1).sum())
        if wild > 1 + 0.01 * (counts.lost + counts.corrupt):
            most_dps = math.degrees(np.nanmax(np.abs(rate_rps)))
            return f"{wild} damaged samples of up to {most_dps:.0f} deg/s were accepted: check the checksum"
        if len(t_s) < _REST_S * heard.imu.rate_hz:
            return f"only {len(t_s)} samples came where three bytes in a thousand are damaged"
    return ""


def _unplugged(heard: ImuSamples) -> str:
    ended, heard.error = heard.error, None
    ending = "without an error" if ended is None else f"with {_error_text(ended)}"
    return "" if isinstance(ended, LinkLost) else f"it ended {ending}: do not catch LinkLost of its link"


async def _motion(opened: OpenBench) -> str:
    """Return what is wrong with jogs and moves of each axis: rate, angle, or arrival; "" if they are right."""
    table, loop = opened.table, asyncio.get_running_loop()
    for axis in opened.bench.table.gimbals:
        await table.jog(axis, _RATE_RPS, _RAMP_RPS2)
        await asyncio.sleep(3.0)
        first = await table.read(axis)
        await asyncio.sleep(1.0)
        then = await table.read(axis)
        turned_rps = (then.angle_rad - first.angle_rad) / (then.angle_t_ns - first.angle_t_ns) * 1e9
        for quantity, rate_rps in (("rate", then.rate_rps), ("angle", turned_rps)):
            if abs(rate_rps - _RATE_RPS) > 0.01 * _RATE_RPS:
                return f"axis {axis}, told to turn at 20 deg/s, turns at {math.degrees(rate_rps):.2f} by its {quantity}"
        await table.move(axis, -0.5, _RATE_RPS, _RAMP_RPS2)
        until_s = loop.time() + 60.0
        while not (await table.status(axis)).target_reached and loop.time() < until_s:
            await asyncio.sleep(_LOOK_S)
        off_rad = (await table.read(axis)).angle_rad + 0.5
        if abs(off_rad) > 1e-3 or loop.time() >= until_s:
            return (
                f"axis {axis}: a move is {math.degrees(off_rad):.3f} deg off when it reports that "
                "it has arrived, or after a minute"
            )
    return ""


async def _late(opened: OpenBench) -> str:
    """Return what is wrong on a wire that delays: angles of another time, a stop that returns early; "" if nothing.

    Errors of jogs and readings are ignored, as answers may be lost; without any reading it is wrong.
    """
    axis, seen = opened.bench.table.gimbals[-1], list[AxisState]()
    for _ in range(3):
        with suppress(DeviceError):  # which a command may meet with where much is lost
            await opened.table.jog(axis, _RATE_RPS, _RAMP_RPS2)
    await asyncio.sleep(2.0)
    for _ in range(300):
        with suppress(DeviceError):
            seen.append(await opened.table.read(axis))
    ahead = np.array([state.angle_rad - state.angle_t_ns * 1e-9 * _RATE_RPS for state in seen])
    known = np.array([state.half_width_ns for state in seen]) * 1e-9 * _RATE_RPS + _LITTLE_RPS
    usual = np.median(ahead) if seen else 0.0
    if (wrong := int((np.abs(ahead - usual) > known).sum())) or not seen:
        return f"{wrong} of {len(seen)} angles belong to another time: a late answer was taken for the next one"
    await opened.table.stop()
    await asyncio.sleep(_LOOK_S)
    return "" if opened.at_rest() else "stop returned while an axis still turned"


async def _stopped(opened: OpenBench, how: str, at_s: float = 0.0) -> str:
    """Turn all axes, cancel a reading at ``at_s`` (loop time) or later, stop by ``how``; return if one turns, or ""."""
    table, loop = opened.table, asyncio.get_running_loop()
    for axis in opened.bench.table.gimbals:
        await table.jog(axis, _RATE_RPS, _RAMP_RPS2)
    await asyncio.sleep(max(at_s - loop.time(), 2.0))
    reading = loop.create_task(table.read(opened.bench.table.gimbals[0]))
    await asyncio.sleep(0)
    reading.cancel()  # as Ctrl-C does
    await asyncio.wait({reading})
    await getattr(table, how)()
    await asyncio.sleep(_LOOK_S)
    return "" if opened.at_rest() else f"{how} returned while an axis still turned"


async def _ready(opened: OpenBench) -> str:
    """Open, identify twice and ready a device of another kind, and read its rows; return what is wrong or ""."""
    (device,) = opened.others
    config, driver = device.config, device.driver
    await driver.open()
    first, second = await driver.identify(), await driver.identify()
    if first != second:
        return f"asked twice who it is, it says {first} and {second}"
    if refused := await config.kind.refusal(driver, config.settings):
        return refused
    await config.kind.ready(driver, config.settings)
    if not isinstance(driver, AppendsSeries):
        return ""
    before_ns, rows = 0, 0
    async for t_ns, row in driver.rows():
        if len(row) != len(driver.columns) or not all(map(math.isfinite, row)):
            return f"a row of its series is {row}: it needs a number for each of {', '.join(driver.columns)}"
        if t_ns <= before_ns:
            return "instants of its series do not always go up"
        before_ns, rows = t_ns, rows + 1
        if rows == _ROWS:
            break
    return ""


async def _left_safe(opened: OpenBench, at_s: float = 2.0) -> str:
    """Cancel the readying of the other device at ``at_s``, make it safe; return what is wrong, "" if nothing."""
    (device,) = opened.others
    config = device.config
    await device.driver.open()
    way = asyncio.ensure_future(config.kind.ready(device.driver, config.settings))
    await asyncio.sleep(at_s - asyncio.get_running_loop().time())
    way.cancel()  # as Ctrl-C does
    await asyncio.wait({way})
    return (await config.kind.make_safe(device.driver, time_scale=1.0, unconfirmed=lambda trouble: None)).trouble


_Suites = dict[str, tuple[Mapping[str, Any], Callable[[Any], Any]]]
_FRAMES: _Suites = {"units": ({}, _units), "clock": ({}, _clock), "loss": ({"loss": "3 %"}, _counted)}
_BYTES: _Suites = {
    "framing cut anywhere": ({"one_byte": True}, _complete),
    "garbage": ({"bit_flips": "0.3 %"}, _undamaged),
    "unplugged": ({"unplug": "8 s"}, _unplugged),
}
_TABLE: _Suites = {
    "units": ({}, _motion),
    "framing cut anywhere": ({"one_byte": True}, _motion),
    "loss": ({"loss": "1 %", "late": "2 %", "late_by": "0.3 s"}, _late),
    "stop": ({}, lambda opened: _stopped(opened, "stop")),
    "abort": ({}, lambda opened: _stopped(opened, "abort")),
    "stop, unplugged": ({"unplug": "30 s", "replug": "30.5 s"}, lambda opened: _stopped(opened, "stop", 30.2)),
}
_OTHER: _Suites = {
    "ready": ({}, _ready),
    "framing cut anywhere": ({"one_byte": True}, _ready),
    "made safe": ({}, _left_safe),
    "made safe, unplugged": ({"unplug": "30 s", "replug": "30.5 s"}, lambda opened: _left_safe(opened, 30.2)),
}


def suites_of(spec: DeviceSpec) -> _Suites:
    """Return the suites that a device has to pass: by name the faults of its wire, and the judging function."""
    suites = {TABLE.name: _TABLE, IMU.name: _FRAMES if spec.on_can else _FRAMES | _BYTES}  # a bus hands over frames
    return suites.get(spec.kind, _OTHER)


def _bench_of(spec: DeviceSpec, faults: Mapping[str, Any], plugins: Sequence[Path], description: Path | None) -> Bench:
    """Return a bench with the device's twin, whose wire has ``faults``, and usual twins of the other kinds it needs."""
    table = spec if isinstance(spec, TableSpec) else TABLES[USUAL_TABLE]
    imu, rate = (spec, spec.proposed.rate) if isinstance(spec, ImuSpec) else _slowest_imu()
    axes = "zyx"[: spec.most_axes if isinstance(spec, TableSpec) else 1]
    keys = "\n".join(f"{key} = {json.dumps(value)}" for key, value in faults.items())
    values = {"table": table, "imu": imu, "axes": axes, "channels": built_in_channels(GYROS.get(imu.proposed.array, 0))}
    values |= {"description": str(description or USUAL_DESCRIPTION), "p": _axes_of(description), "rate": rate}
    values |= {"table_faults": keys if table is spec else "", "imu_faults": keys if imu is spec else ""}
    values["other"] = "" if spec in (table, imu) else _other_section(spec, keys, plugins)
    return read_bench(rendered("station.commands", "conformance.toml", values), "conformance", plugins=plugins)


def _slowest_imu() -> tuple[ImuSpec, str]:
    """Return the IMU with the lowest rate, and that rate: beside a device under test its samples only cost time."""
    rates_hz = {name: spec.rates_hz for name, spec in IMUS.items()}
    lowest_hz = {name: min(rates) for name, rates in rates_hz.items() if isinstance(rates, Sequence) and rates}
    slowest = min(lowest_hz, key=lambda name: lowest_hz[name])
    return IMUS[slowest], f"{lowest_hz[slowest]:g} Hz"


def _other_section(spec: DeviceSpec, faults: str, plugins: Sequence[Path]) -> str:
    """Return the sections of a bench file about a device of another kind; keys that it must have as their example."""
    kind = KINDS.beside(map(load_file, plugins))[spec.kind]
    keys = [key for key in (*kind.keys, *spec.keys) if key.required]
    lines = [f"{key.name} = {json.dumps(key.example)}" for key in keys]
    section = f"[{kind.name}]" if kind.single else f"[[{kind.name}]]"
    return "\n".join([section, f'protocol = "{spec.name}"', *lines, f"[twin.{kind.name}.fault]", faults])


def complaint(
    spec: DeviceSpec,
    suite: str,
    plugins: Sequence[Path] = (),
    description: Path | None = None,
    within_s: float = 60.0,
) -> str:
    """Run one conformance suite on a device's twin in virtual time; return what is wrong in words, "" if it passes.

    ``plugins`` have its record, ``description`` is a described IMU's file, else one of the package. Failures include
    ``within_s`` of real time, exceptions of the driver, missing methods, tasks left. In the main thread only (SIGALRM).
    """
    faults, judge = suites_of(spec)[suite]
    bench = _bench_of(spec, faults, plugins, description)

    async def tried() -> str:
        """Open the bench and the table, judge the device under test, and return what is wrong, "" if nothing."""
        before = asyncio.all_tasks()
        async with open_bench(bench) as opened:
            driver, protocol = _driver_of(spec, opened)
            if lacks := [name for name in dir(protocol) if name[0] != "_" and not hasattr(driver, name)]:
                return f"the driver has no {', '.join(lacks)}: see {protocol.__name__} in drivers/protocols.py"
            await opened.table.open()
            await opened.table.identify()
            await opened.table.enable()
            await opened.table.home()
            if spec.kind != IMU.name:
                wrong = str(await judge(opened))
            else:
                heard = await samples_on(opened)
                failed = None if isinstance(heard.error, DeviceError) else heard.error  # all else follows from it
                wrong = judge(heard) if heard.blocks and not failed else ""
                ended = [f"it ended with {_error_text(heard.error)}"] if heard.error and not wrong else []
                wrong = wrong or "; ".join([*["no samples came"] * (not heard.blocks), *ended])
            for device in opened.devices.values():
                device.driver.close()
        left = asyncio.all_tasks() - before
        return wrong or ("a task still runs after it was closed" if any(not task.done() for task in left) else "")

    late: list[str] = []

    def overdue(_: int, frame: Any) -> None:
        place = f"({Path(frame.f_code.co_filename).name}, line {frame.f_lineno})"
        late.append(f"it does not return within {within_s:g} s {place}: it must await what it waits for")
        runner.get_loop().set_exception_handler(lambda *_: None)  # it is reported below
        raise KeyboardInterrupt  # nothing less comes through a driver and the event loop

    before = signal.signal(signal.SIGALRM, overdue)
    signal.setitimer(signal.ITIMER_REAL, within_s)
    try:
        with asyncio.Runner(loop_factory=VirtualLoop) as runner:
            return runner.run(tried())
    except (Exception, KeyboardInterrupt) as error:  # the driver may raise anything
        if isinstance(error, KeyboardInterrupt) and not late:
            raise
        return late[0] if late else f"it ended with {_error_text(error)}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def _driver_of(spec: DeviceSpec, opened: OpenBench) -> tuple[Any, type]:
    """Return the driver under test, and the protocol that it must fulfil."""
    if spec.kind == TABLE.name:
        return opened.table, Turntable
    if spec.kind == IMU.name:
        return opened.imus[0].source, ImuSource
    return opened.others[0].driver, Device


def _axes_of(description: Path | None) -> list[list[float]]:
    """Return sense axes along z, y and x in turn for the gyros of a description; empty for none, or a triad."""
    if description is None:
        return []
    gyros = len(load_description(str(description)).channels[0].rates)
    if gyros == 3:
        return []
    return [[1.0 if axis == gyro % 3 else 0.0 for axis in (2, 1, 0)] for gyro in range(gyros)]


def _error_text(error: BaseException) -> str:
    if isinstance(error, (DeviceError, PluginError)):
        return str(error)
    frame = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({Path(frame.filename).name}, line {frame.lineno})"


def command_conformance(arguments: argparse.Namespace) -> int:
    """Test the devices of a Python file, a described IMU, or those of a protocol; return 0 if all pass, else 1.

    UsageError if the argument is none of these, or describes fewer than three gyros. Suites that need correct rates are
    skipped if those are wrong.
    """
    name, plugins = arguments.module, [Path(arguments.module)] if arguments.module.endswith(".py") else []
    described = Path(name).absolute() if name.endswith(".toml") else None
    modules = [load_file(path) for path in plugins]
    kinds = [kind for kind in KINDS.beside(modules).tried().values() if isinstance(kind, DeviceKind)]
    brought = [spec for module in modules for spec in records_of(module, DeviceSpec)]
    found: list[DeviceSpec] = [spec for kind in kinds for spec in brought if spec.kind == kind.name]
    found += [kind.protocols[name] for kind in kinds if name in kind.protocols]
    if described is not None:
        gyros = len(load_description(str(described)).channels[0].rates)  # gives errors with file, line and key
        if gyros < 3:
            raise UsageError(f"{described} describes {gyros} gyros: a bench needs three or more, in all directions")
        found.append(DESCRIBED)
    if not found:
        if modules:
            raise UsageError(f"{name} has no ImuSpec and no TableSpec: give the record a name, as SPEC = ImuSpec(...)")
        known = [protocol for kind in kinds for protocol in kind.protocols]
        raise UsageError(
            f"{not_one_of(name, known)}; or give a .py with an ImuSpec or a TableSpec, or a .toml that describes an IMU"
        )
    rows, off = [], set[str]()
    for spec, suite in [(one, suite) for one in found for suite in suites_of(one)]:
        skipped = suite in ("clock", "garbage") and spec.name in off
        wrong = "it needs correct rates, and units fails" if skipped else complaint(spec, suite, plugins, described)
        rows.append({"device": spec.name, "suite": suite, "wrong": wrong})
        off |= {spec.name} if wrong and suite == "units" else set()
        if not arguments.json:
            word = "skip" if skipped else "FAIL" if wrong else "pass"
            tell(f"{word}  {spec.name}, {suite}{': ' if wrong else ''}{wrong}")
    well, unmet = not any(finding["wrong"] for finding in rows), [one.name for one in found if not one.checked_against]
    if arguments.json:
        print(json.dumps({"ok": well, "findings": rows, "experimental": unmet}))
    elif unmet:
        tell(
            f"EXPERIMENTAL: {', '.join(unmet)}; checked_against of the spec lists the external devices "
            "and programs it was tested with"
        )
    return (Outcome.PASS if well else Outcome.FAIL).exit_code
