"""What commands that open a bench share: which bench, the clock of its event loop, a run with its progress."""

import argparse
import asyncio
import gc
from collections.abc import Mapping
from contextlib import AsyncExitStack, suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from station.bench.bench import Bench, load_bench
from station.errors import UsageError
from station.opening import needs_only_memory, open_bench, with_links
from station.remote.hosting import Host, introduction
from station.render.printing import result_object
from station.render.progress import RunProgress
from station.run.event_loop.detached_output import patient_streams
from station.run.event_loop.loops import PacedLoop, ScaledLoop, VirtualLoop
from station.run.session import Result, RunOptions, Session
from station.scripts.script import Script


def clock(bench: Bench, scale: float | None) -> asyncio.Runner:
    """Return the runner for loops of one clock, ``scale`` times as fast as the wall's, None for the default.

    That is virtual time if every link leads to a twin in memory, else 1. With other links all objects so far are
    exempted from garbage collection.
    """
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
    """Run a script on a bench into the recording ``path``; return the result.

    Progress goes to stderr unless ``quiet``, and to the clients of ``host``, who are told ``bench_file`` as well.
    Errors before the run are raised: BenchError, DeviceRefused for a link in use, RecordingError. Those of the run are
    in its verdict.
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
        with suppress(asyncio.CancelledError):  # what was seen of the table is told whatever comes now
            await host.end(run_object(result))
        return result


def chosen_bench(arguments: argparse.Namespace) -> Bench:
    """Return the bench of the options --bench, --link, --device and --seed, the built-in one without --bench.

    UsageError for a link without "=", BenchError for an invalid file or a device that it does not have.
    """
    bench = load_bench(Path(arguments.bench) if arguments.bench else None)
    links = {}
    for text in arguments.link:
        device, equals, url = text.partition("=")
        if not equals:
            raise UsageError(f"--link {text}: write DEVICE=URL, for instance table=tcp://127.0.0.1:5020")
        links[device] = url
    return seeded(with_links(bench, links, arguments.device), arguments.seed)


def seeded(bench: Bench, seed: int | None) -> Bench:
    """Return the bench with this seed of its twins' noise; None keeps that of the bench file."""
    return bench if seed is None else replace(bench, twin=replace(bench.twin, seed=seed))


def run_object(result: Result) -> Mapping[str, Any]:
    """Return the object of a run, for --json and for the clients of a host."""
    found = result_object(result.verdict, str(result.recording), result.calibration)
    sources = {report.name: report.as_object() for report in result.sources}
    links = {device: asdict(counts) for device, counts in result.links.items()}
    return {**found, "ended_early": result.ended_early or None, "sources": sources, "links": links}
