"""station check: whether everything on the bench answers, and advice where it does not."""

import argparse
import json
import sys
from collections.abc import Sequence

from rich.markup import escape

from station.bench.bench import Bench
from station.commands.common import chosen_bench, clock
from station.computer.finding import Finding
from station.computer.look import look_at_computer
from station.computer.timekeeping import ClockWatch
from station.opening import open_bench
from station.opening.checking import DeviceCheck, check_bench
from station.render.check_printed import print_check
from station.render.terminal import print_all, stdout
from station.run.outcome import Outcome
from station.views.answers.check import BenchCheck
from station.views.json_values import json_object


def print_computer(findings: Sequence[Finding]) -> None:
    """Print the findings on the computer, each with the command that helps below it."""
    for finding in findings:
        mark = "[red]" if finding.wrong else "[yellow]"
        line = f"{mark}{escape(finding.about)}[/] {escape(finding.text)}"
        print_all(stdout(), [(line, {"highlight": False})])
        if finding.command:
            stdout().print(f"    {escape(finding.command)}", highlight=False, soft_wrap=True)


def command_check(arguments: argparse.Namespace) -> int:
    """Check every used device of a bench, and this computer; print the answers.

    Return 0 if nothing is wrong, else 4. Raises as ``chosen_bench``.
    """

    def tell(device: str) -> None:
        if not arguments.json:
            print(f"checking {device} ...", file=sys.stderr, flush=True)

    async def look(bench: Bench, scale: float) -> list[DeviceCheck]:
        async with open_bench(bench, time_scale=scale) as opened:
            return await check_bench(opened, time_scale=scale, tell=tell)

    bench = chosen_bench(arguments)
    computer = look_at_computer([link for device in bench.used for link in device.links])
    watch = ClockWatch()
    with clock(bench, arguments.scale) as runner:
        found = runner.run(look(bench, arguments.scale or 1.0))
    computer += watch.findings()
    well = not any(device.wrong for device in found) and not any(finding.wrong for finding in computer)
    if arguments.json:
        answer = BenchCheck(ok=well, devices=tuple(found), computer=tuple(computer))
        print(json.dumps(json_object(answer)))
    else:
        print_check(bench.name, found)
        print_computer(computer)
    return (Outcome.PASS if well else Outcome.FAULT).exit_code
