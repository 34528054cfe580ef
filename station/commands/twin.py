"""station twin: the twins of a bench on real ports."""

import argparse
import asyncio
import signal
from contextlib import suppress
from functools import partial
from pathlib import Path

from station.bench.bench import load_bench
from station.commands.common import seeded
from station.opening import serve_twins
from station.render.printing import refuse
from station.run.event_loop.loops import ScaledLoop
from station.run.outcome import Outcome


def command_twin(arguments: argparse.Namespace) -> int:
    """Serve the twins of a bench until SIGINT or SIGTERM; return 0, or 4 for an OSError.

    The ports are announced on stdout, a line of JSON each. DeviceError if a port is taken.
    """
    bench = seeded(load_bench(Path(arguments.bench) if arguments.bench else None), arguments.seed)

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
