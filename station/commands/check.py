"""station check: does everything on the bench answer, and what is to be done where it does not."""

import argparse
import json
import sys

from station.bench.bench import Bench
from station.commands.common import chosen_bench, clock
from station.opening import open_bench
from station.opening.checking import DeviceCheck, check_bench
from station.render.terminal import print_rendered, stdout
from station.run.outcome import Outcome
from station.views.json_values import json_object


def command_check(arguments: argparse.Namespace) -> int:
    """Look at every device of a bench; 0 if all is well, 4 if not."""

    def tell(device: str) -> None:
        if not arguments.json:
            print(f"checking {device} ...", file=sys.stderr, flush=True)

    async def look(bench: Bench, scale: float) -> list[DeviceCheck]:
        async with open_bench(bench, time_scale=scale) as opened:
            return await check_bench(opened, time_scale=scale, tell=tell)

    bench = chosen_bench(arguments)
    with clock(bench, arguments.scale) as runner:
        found = runner.run(look(bench, arguments.scale or 1.0))
    well = not any(device.wrong for device in found)
    if arguments.json:
        print(json.dumps({"ok": well, "devices": json_object(found)}))
    else:
        print_rendered(stdout(), "station.render", "check.rich", {"bench": bench, "found": found})
    return (Outcome.PASS if well else Outcome.FAULT).exit_code
