"""What the devices of a bench answered, as a person reads it."""

import math
from collections.abc import Iterator, Sequence

from rich.markup import escape
from rich.table import Table

from drivers.types import Identity
from station.opening.checking import AxisCheck, DeviceCheck, SourceCheck
from station.render.terminal import Shown, line, print_all, rich_table, stdout

_ALL_ANSWER = "[bold green]every device answers[/]"
_EXPERIMENTAL = (
    "is EXPERIMENTAL: it was tested with its twin only, never with hardware or third-party software. "
    "Compare its readings with the display of the device"
)


def print_check(bench: str, devices: Sequence[DeviceCheck]) -> None:
    """Print a table of what each device of a bench answered, and below it what is wrong."""
    print_all(stdout(), _shown(bench, devices))


def _shown(bench: str, checks: Sequence[DeviceCheck]) -> Iterator[Shown]:
    """Yield the table of devices, what is wrong with each, which drivers are experimental, and that all devices answer.

    The last line is left out if anything is wrong.
    """
    yield _devices(bench, checks), {}
    for device in checks:
        for reason in device.wrong:
            yield line(f"[red]{escape(device.device)}:[/] {escape(reason)}")
    for device in checks:
        if device.experimental:
            yield line(f"[yellow]{escape(device.device)}:[/] {escape(device.kind)} {_EXPERIMENTAL}")
    if not any(device.wrong for device in checks):
        yield line(_ALL_ANSWER)


def _devices(bench: str, checks: Sequence[DeviceCheck]) -> Table:
    """Return a row for each device of a bench: link, identity, answers, and whether anything is wrong."""
    heads = ["device", "link", "identity", "found", ""]
    devices = rich_table(f"Bench {escape(bench)}", heads, fold=True)
    for device in checks:
        devices.add_row(
            _device(device),
            escape(device.link),
            escape(_identity(device.identity)),
            escape("\n".join(_answers(device)) or "nothing"),
            "[bold red]WRONG[/]" if device.wrong else "[bold green]OK[/]",
            end_section=True,
        )
    return devices


def _device(device: DeviceCheck) -> str:
    """Return name and protocol of a device, with a mark if the driver is experimental."""
    text = f"{escape(device.device)}\n[dim]{escape(device.kind)}[/]"
    return f"{text}\n[yellow]EXPERIMENTAL[/]" if device.experimental else text


def _identity(identity: Identity) -> str:
    serial = f"serial {identity.serial}" if identity.serial else ""
    return "\n".join(filter(None, (identity.model, serial, identity.firmware))) or "unknown"


def _answers(device: DeviceCheck) -> list[str]:
    """Return a line on each axis and source, further values, and the traffic of the link."""
    answers = [*map(_axis, device.axes), *map(_source, device.sources), *device.measured]
    if device.counts is not None:
        answers.append(f"link: {device.counts.text}")
    return answers


def _axis(axis: AxisCheck) -> str:
    rate = f"{math.degrees(axis.max_rate_rps):g} deg/s"
    acceleration = f"{math.degrees(axis.max_acceleration_rps2):g} deg/s2"
    limits = f"up to {rate}, {acceleration}{_travel(axis)}"
    angle = f"{math.degrees(axis.angle_rad):.3f} deg"
    return f"{axis.name}: {axis.text}, at {angle}; {limits}; read in {axis.round_trip_s * 1e3:.1f} ms"


def _travel(axis: AxisCheck) -> str:
    if not axis.travel_rad:
        return ""
    least, most = axis.travel_rad
    return f", from {math.degrees(least):g} to {math.degrees(most):g} deg"


def _source(source: SourceCheck) -> str:
    counts = f"{source.lost} lost, {source.repeated} repeated, {source.late} late, {source.corrupt} corrupt"
    temperature = f", {source.temperature_c:.1f} degC" if math.isfinite(source.temperature_c) else ""
    jitter = f"jitter {source.jitter_s * 1e3:.2f} ms"
    return f"{source.name}: {source.rate_hz:.1f} Hz, {counts}, {jitter}{temperature}"
