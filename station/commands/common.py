"""The commands. Long work shows progress on stderr; results go to stdout."""

import argparse
import asyncio
import gc
import json
import signal
import sys
from collections.abc import Mapping
from contextlib import AsyncExitStack, nullcontext, suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from drivers.errors import DeviceError
from estimator.calibration.error_model import ErrorModel
from estimator.errors import MISSHAPEN, EstimatorError
from estimator.untrusted import harmless
from station.atomic_write import check_new_recording, new_recording
from station.bench.bench import Bench, load_bench
from station.computer.facilities import peer_note
from station.errors import UsageError, sentence
from station.opening import needs_only_memory, open_bench, serve_twins, with_links
from station.remote.after_run import tell_program
from station.remote.hosting import Host, introduction
from station.render.lines import tell
from station.render.printing import print_result, refuse, result_object
from station.render.progress import RunProgress
from station.render.terminal import print_rendered, stdout
from station.run.early_end import check_early_end
from station.run.event_loop.detached_output import lasting_streams, patient_streams
from station.run.event_loop.loops import PacedLoop, ScaledLoop, VirtualLoop, run_to_end
from station.run.event_loop.signals import ignore_hang_up
from station.run.outcome import Outcome
from station.run.session import Result, RunOptions, Session
from station.scripts.script import Script, check, load_script, paper_script


def command_run(arguments: argparse.Namespace) -> int:
    """Run a script on a bench, or its words; a hosted run continues if its terminal is closed."""
    arguments.host |= arguments.manual
    if arguments.host:
        ignore_hang_up()
    with lasting_streams() if arguments.host else nullcontext():
        return _run(arguments)


def _run(arguments: argparse.Namespace) -> int:
    """Run a script on a bench into a recording; return the exit code, also for wrong usage and unopened devices."""
    try:
        bench = chosen_bench(arguments)
        operator = bench.checked_operator(arguments.operator) if arguments.operator is not None else ""
        serial = bench.checked_serial(arguments.serial_number) if arguments.serial_number is not None else ""
        if arguments.manual and (arguments.script or arguments.end_early or arguments.model):
            raise UsageError(sentence("run.manual_alone"))
        script = Script("manual", ()) if arguments.manual else paper_script()
        script = load_script(Path(arguments.script), bench.plugin_files) if arguments.script else script
        script = check(script, bench.table.limits)
        if arguments.end_early:
            check_early_end(bench)
        model = _model_of(arguments, bench)
        path = Path(arguments.output) if arguments.output else new_recording(Path("recordings"))
        check_new_recording(path)
        scale = arguments.scale or (1.0 if arguments.host else None)  # virtual time has no sockets
        host = Host(scale or 1.0) if arguments.host else None
        if host is not None and (note := peer_note()):
            tell(f"note: {note}", sys.stderr)
        options = RunOptions(
            reset_fault=arguments.reset_fault,
            end_early=arguments.end_early,
            model=model,
            operator=operator,
            device_serial=serial,
            serial_reason=arguments.serial_reason or "",
            outlives_terminal=host is not None,
            time_scale=scale or 1.0,
            manual=arguments.manual,
        )
        with clock(bench, scale) as runner:
            result = run_to_end(runner, drive(bench, script, path, options, arguments.json, host, arguments.bench))
    except (UsageError, EstimatorError) as error:
        return refuse(str(error), arguments.json)
    except DeviceError as error:
        return refuse(str(error), arguments.json, Outcome.FAULT)
    for note in result.notes:
        tell(f"note: {harmless(note)}", sys.stderr)
    if arguments.json:
        print(json.dumps(_run_object(result)))
    else:
        if result.ended_early:
            print(f"ended early {result.ended_early}")
        found = result.verdict, result.calibration, result.recording
        print_result(*found, bench.units, details=arguments.details, sources=result.sources)
        if serial and host is None and result.calibration is not None:
            from station.screen.archive.archive import moved

            with suppress(*MISSHAPEN, KeyboardInterrupt):  # the run has ended, whatever fails here
                print_rendered(stdout(), "station.render", "moved.rich", {"moves": asyncio.run(moved(path))})
    if bench.after_run:
        sys.stdout.flush()  # the result is printed by then, however long the program takes
        context = {"bench": bench.station, "script": script.name, "operator": operator, "serial_number": serial}
        if sys.stderr.isatty():
            tell(f"after_run: {bench.after_run[0]} receives the result", sys.stderr)
        problem = tell_program(bench.after_run, {**_run_object(result), **context})
        if problem:
            tell(f"note: after_run: {problem}; the result is in {path}", sys.stderr)
    return result.verdict.outcome.exit_code


def _run_object(result: Result) -> Mapping[str, Any]:
    """Return the object of a run for --json."""
    found = result_object(result.verdict, str(result.recording), result.calibration)
    sources = {report.name: report.as_object() for report in result.sources}
    links = {device: asdict(counts) for device, counts in result.links.items()}
    return {**found, "ended_early": result.ended_early or None, "sources": sources, "links": links}


def _model_of(arguments: argparse.Namespace, bench: Bench) -> ErrorModel | None:
    """Return the error model of --model, checked against the bench before anything moves; None without it.

    UsageError if it needs a temperature that a device does not have, or with --end-early.
    """
    if arguments.model is None:
        return None
    model = ErrorModel.read(Path(arguments.model))
    if arguments.end_early:
        raise UsageError(sentence("run.end_early_model"))
    model.made(bench.table.gimbals, frozenset({"gimbals", "specific force", "temperature"}))
    if model.needs_temperature:
        for imu in bench.imus:
            if imu.used and not imu.knows_temperature:
                raise UsageError(sentence("run.no_temperature", model=arguments.model, imu=imu.name))
    return model


def command_twin(arguments: argparse.Namespace) -> int:
    """Serve the twins of a bench until SIGINT or SIGTERM; return 0, or 4 if a port cannot be had."""
    bench = _seeded(load_bench(Path(arguments.bench) if arguments.bench else None), arguments.seed)

    async def serve() -> None:
        """Serve the bench's twins until SIGINT or SIGTERM, which end it without an error."""
        task = asyncio.current_task()
        assert task is not None
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, task.cancel)
        with suppress(asyncio.CancelledError):
            await serve_twins(
                bench,
                time_scale=arguments.scale,
                host=arguments.host,
                port=arguments.port,
                announce=partial(print, flush=True),
            )

    try:
        with asyncio.Runner(loop_factory=partial(ScaledLoop, arguments.scale)) as runner:
            runner.run(serve())
    except OSError as error:
        return refuse(str(error), False, Outcome.FAULT)
    return 0


def clock(bench: Bench, scale: float | None) -> asyncio.Runner:
    """Return the runner for loops of one clock; virtual or paced time if every link leads to a twin in memory."""
    if not needs_only_memory(bench):
        gc.freeze()  # present objects stay: examining them again would delay the loop by 0.2 s
        return asyncio.Runner(loop_factory=partial(ScaledLoop, scale or 1.0))
    return asyncio.Runner(loop_factory=VirtualLoop if scale is None else partial(PacedLoop, scale))


async def drive(
    bench: Bench,
    script: Script,
    path: Path,
    options: RunOptions,
    quiet: bool,
    host: Host | None = None,
    bench_file: str | None = None,
) -> Result:
    """Run a script on a bench into a recording; return the result. Progress goes to stderr, and to the clients of
    ``host``.
    """
    async with AsyncExitStack() as stack:
        stack.enter_context(patient_streams())
        if host is not None:
            await stack.enter_async_context(host)
        opened = await stack.enter_async_context(open_bench(bench, time_scale=options.time_scale))
        progress = stack.enter_context(RunProgress(quiet))
        on_event = host.tell if host is not None else None
        session = Session(opened, script, path, options, on_progress=progress.show, on_event=on_event)
        if host is None:
            return await session.run()
        shown_options = {key: getattr(options, key) for key in ("time_scale", "operator", "device_serial", "manual")}
        await host.begin(session, {**introduction(bench, bench_file, script, path, session.gyros), **shown_options})
        result = await session.run()
        with suppress(asyncio.CancelledError):  # the table's last state is reported whatever comes now
            await host.end(_run_object(result))
        return result


def chosen_bench(arguments: argparse.Namespace) -> Bench:
    """Return the bench of the options --bench, --link, --device and --seed; UsageError for a malformed link."""
    bench = load_bench(Path(arguments.bench) if arguments.bench else None)
    links = {}
    for text in arguments.link:
        device, equals, url = text.partition("=")
        if not equals:
            raise UsageError(f"--link {text}: write DEVICE=URL, for instance table=tcp://127.0.0.1:5020")
        links[device] = url
    return _seeded(with_links(bench, links, arguments.device), arguments.seed)


def _seeded(bench: Bench, seed: int | None) -> Bench:
    return bench if seed is None else replace(bench, twin=replace(bench.twin, seed=seed))
