"""The answers of the devices of a bench, and what was found of this computer."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from rich.text import Text

from station.computer.finding import Finding
from station.opening.checking import AxisCheck, DeviceCheck, SourceCheck
from station.screen.panes.lines import TITLE, Mark, joined, line, marked
from station.screen.sessions.answers import Reply
from station.views.answers.check import BenchCheck
from station.views.figures import number

_INDENT = " " * 6
_DIM = "dim"


@dataclass(kw_only=True, frozen=True, slots=True)
class DevicesView:
    """The check of a bench, None before its answer; ``checking`` is how far it is, or why there is none."""

    bench: str
    check: Reply[BenchCheck] | None
    checking: str


def devices_text(view: DevicesView) -> Text:
    """Return what each device answered, and what was found of this computer."""
    title = f"Devices of {view.bench}" if view.bench else "Devices"
    return joined([line((title, TITLE)), *_answer_lines(view)])


def _answer_lines(view: DevicesView) -> list[Text]:
    """Return the lines on the devices and this computer; one that says why there are none, or that the check waits."""
    if view.check is None:
        return [marked(Mark.WAIT, view.checking or "not asked yet")]
    if view.check.value is None:
        return [marked(Mark.WRONG, view.check.reason)]
    lines = []
    for device in view.check.value.devices:
        lines += _device_lines(device)
    for finding in view.check.value.computer:
        lines += _finding_lines(finding)
    return lines


def _device_lines(device: DeviceCheck) -> list[Text]:
    """Return the lines of a device: OK or WRONG with who it is, its axes or sources, and each thing that is wrong."""
    mark = Mark.WRONG if device.wrong else Mark.OK
    lines = [marked(mark, (device.device, "bold"), f"  {'  '.join(_identity(device))}")]
    lines += [line((f"{_INDENT}{_axis(axis)}", _DIM)) for axis in device.axes]
    lines += [line((f"{_INDENT}{_source(source)}", _DIM)) for source in device.sources]
    lines += [line((f"{_INDENT}{wrong}", "red")) for wrong in device.wrong]
    return lines


def _identity(device: DeviceCheck) -> Sequence[str]:
    known = device.identity
    serial = f"serial {known.serial}" if known.serial else ""
    return [text for text in (device.kind, device.link, known.model, serial, known.firmware) if text]


def _axis(axis: AxisCheck) -> str:
    return f"{axis.name}: {axis.text}, at {number(math.degrees(axis.angle_rad), 3)} deg"


def _source(source: SourceCheck) -> str:
    text = f"{source.name}: {source.rate_hz:.1f} Hz, {source.lost} lost"
    return f"{text}, {source.temperature_c:.1f} degC" if math.isfinite(source.temperature_c) else text


def _finding_lines(finding: Finding) -> list[Text]:
    mark = Mark.WRONG if finding.wrong else Mark.NOTE
    lines = [marked(mark, (finding.about, "bold"), f" {finding.text}")]
    if finding.command:
        lines.append(line((f"{_INDENT}{finding.command}", _DIM)))
    return lines
