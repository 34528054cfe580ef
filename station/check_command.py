"""station check: does everything on the bench answer, and what is to be done where it does not."""

import argparse
import json
import math
import sys

from rich.console import Console
from rich.markup import escape

from drivers.errors import DeviceError
from drivers.seams import Identity
from station.bench import Bench
from station.checking import AxisCheck, DeviceCheck, SourceCheck, check_bench
from station.commands import chosen_bench, clock
from station.errors import UsageError
from station.open_bench import open_bench
from station.outcome import Outcome
from station.printing import refuse
from station.rich_table import rich_table
from station.snapshot import json_object
from station.terminal import stdout


def command_check(arguments: argparse.Namespace) -> int:
    """Look at every device of a bench; 0 if all is well, 4 if not."""

    def tell(device: str) -> None:
        if not arguments.json:
            print(f"checking {device} ...", file=sys.stderr, flush=True)

    async def look(bench: Bench, scale: float) -> list[DeviceCheck]:
        async with open_bench(bench, time_scale=scale) as opened:
            return await check_bench(opened, time_scale=scale, tell=tell)

    try:
        bench = chosen_bench(arguments)
        with clock(bench, arguments.scale) as runner:
            found = runner.run(look(bench, arguments.scale or 1.0))
    except UsageError as error:
        return refuse(str(error), arguments.json)
    except DeviceError as error:
        return refuse(str(error), arguments.json, Outcome.FAULT)
    well = not any(device.wrong for device in found)
    if arguments.json:
        print(json.dumps({"ok": well, "devices": json_object(found)}))
    else:
        print_check(bench, found, stdout())
    return (Outcome.PASS if well else Outcome.FAULT).exit_code


def print_check(bench: Bench, found: list[DeviceCheck], console: Console) -> None:
    """Print what answered and how well, then what is wrong and what to do."""
    devices = rich_table(f"Bench {escape(bench.name)}", ("device", "link", "identity", "found", ""), fold=True)
    for device in found:
        answered = [_axis(axis) for axis in device.axes] + [_source(source) for source in device.sources]
        devices.add_row(
            f"{escape(device.device)}\n[dim]{device.kind}[/]",
            escape(device.link),
            escape(_identity(device.identity)),
            escape("\n".join(answered) or "nothing"),
            "[bold red]WRONG[/]" if device.wrong else "[bold green]OK[/]",
        )
        devices.add_section()
    console.print(devices)
    for device in found:
        for line in device.wrong:
            console.print(f"[red]{escape(device.device)}:[/] {escape(line)}", highlight=False)
    if not any(device.wrong for device in found):
        console.print("[bold green]everything answers[/]")


def _identity(identity: Identity) -> str:
    named = (identity.model, identity.serial and f"serial {identity.serial}", identity.firmware)
    return "\n".join(part for part in named if part) or "not said"


def _axis(axis: AxisCheck) -> str:
    travel = ""
    if axis.travel_rad is not None:
        low, high = map(math.degrees, axis.travel_rad)
        travel = f", from {low:g} to {high:g} deg"
    return (
        f"{axis.name}: {axis.text}, at {math.degrees(axis.angle_rad):.3f} deg; up to "
        f"{math.degrees(axis.max_rate_rps):g} deg/s, {math.degrees(axis.max_acceleration_rps2):g} deg/s2{travel}; "
        f"read in {axis.round_trip_s * 1e3:.1f} ms"
    )


def _source(source: SourceCheck) -> str:
    temperature = f", {source.temperature_c:.1f} degC" if math.isfinite(source.temperature_c) else ""
    return (
        f"{source.name}: {source.rate_hz:.1f} Hz, {source.lost} lost, {source.repeated} repeated, {source.late} late, "
        f"{source.corrupt} corrupt, jitter {source.jitter_s * 1e3:.2f} ms{temperature}"
    )
