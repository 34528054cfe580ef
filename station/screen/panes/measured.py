"""The present figures of a run: axes of the table, sources, innovations, states, events."""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

from rich.text import Text

from station.run.snapshot import ArmSnapshot, AxisSnapshot, Snapshot, SourceSnapshot
from station.screen.panes.lines import joined, line, padded
from station.screen.panes.states import StatesView, state_lines
from station.views.accelerometers.result import LIVE_FORCE_FIGURES, PLACE
from station.views.figures import StateUnit, number

_NIS_OFF = 0.25
_WHITE_OFF = 0.2
_MANY_SIGMAS = 4.0  # by which both must be off to be reported
_LEAST_EVENT_WIDTH = 30
_OK = "ok"
_BOLD, _DIM, _ALARM = "bold", "dim", "bold red"


@dataclass(kw_only=True, frozen=True, slots=True)
class MeasuredView:
    """The last state of a run, in the units of ``figures``.

    ``old``: it is not of now. ``moving``: the table may turn; else its last rates are from before it came to rest.
    ``large``: the sources have a place of their own.
    """

    snapshot: Snapshot
    figures: Sequence[StateUnit]
    old: bool
    moving: bool
    large: bool


def measured_text(view: MeasuredView) -> Text:
    """Return the axes, the sources unless they have a place of their own, and the states."""
    states = StatesView(figures=view.figures, gyros=view.snapshot.gyros, with_nis=True)
    between = [Text()] if view.large else [*_troubled_sources(view.snapshot), _sources_in_a_line(view.snapshot)]
    return joined([*_axis_lines(view), *between, *state_lines(states), *_accelerometer_lines(view.snapshot)])


def _accelerometer_lines(snapshot: Snapshot) -> list[Text]:
    """Return the states of the accelerometers, lever arm, delay and NIS of each source, and which are left out and why.

    Empty without accelerometers.
    """
    if not snapshot.accelerometers:
        return []
    accelerometers = snapshot.accelerometers
    states = StatesView(figures=LIVE_FORCE_FIGURES, gyros=accelerometers, kind="accelerometer", with_nis=True)
    lines = [*state_lines(states)]
    for arm in snapshot.arms:
        of_source = f" of {arm.source}" if len(snapshot.arms) > 1 else ""
        places = [PLACE.figure(*of_axis) for of_axis in zip(arm.arm_m, arm.arm_sd_m, strict=True)]
        lines.append(line(f"lever arm{of_source} {'  '.join(places)} {PLACE.unit}"))
        delay = f"{number(arm.delay_s * 1e3, 2)} ± {number(arm.delay_sd_s * 1e3, 2)} ms"
        lines.append(line(f"delay {delay}   NIS {number(arm.nis_recent, 2)}  ", _judgement_of_forces(arm)))
    for one in accelerometers:
        if one.left_out:
            lines.append(line((f"{snapshot.called(one)} left out: {one.left_out}", _ALARM)))
    return lines


def _judgement_of_forces(arm: ArmSnapshot) -> tuple[str, str]:
    """Return a text on the innovations of the accelerometers of a source, and its style."""
    if not math.isfinite(arm.nis_recent):
        return "not known yet", _DIM
    if abs(arm.nis_recent - 1) > max(_NIS_OFF, _MANY_SIGMAS * math.sqrt(2 / max(arm.recent, 1))):
        return "NIS OFF 1: the noise or the model differs from what was assumed", _ALARM
    return "good: near 1", "green"


def _axis_lines(view: MeasuredView) -> list[Text]:
    """Return a line of headings, and one for each axis in order of the names: angle, rate, setpoint of the rate, state.

    Units are deg and deg/s. Once nothing moves, rates and setpoints are 0, and an axis that turned last is at rest. The
    heading says if the figures are old.
    """
    axes = sorted(view.snapshot.axes, key=lambda axis: axis.name)
    heads = ["axis", "     angle deg", "    rate deg/s", "setpoint deg/s"]
    head, *rows = padded([heads, *(_axis_row(axis, view.moving) for axis in axes)])
    lines = [line(("  ".join(head) + f"   {'last state' if view.old else 'state'}", _BOLD))]
    for axis, cells in zip(axes, rows, strict=True):
        came_to_rest = axis.state == "turning" and not view.moving
        state = "at rest" if came_to_rest else axis.state
        lines.append(line(f"{'  '.join(cells)}   {state}"))
    return lines


def _axis_row(axis: AxisSnapshot, moving: bool) -> list[str]:
    rate_dps = math.degrees(axis.rate_rps) * moving
    setpoint_dps = math.degrees(axis.setpoint_rps) * moving
    return [axis.name, number(math.degrees(axis.angle_rad), 3), number(rate_dps, 3), number(setpoint_dps, 3)]


def _sources_in_a_line(snapshot: Snapshot) -> Text:
    """Return number, rate and losses of the sources, and whether the filter is right."""
    count = len(snapshot.sources)
    rate_hz = max((s.rate_hz for s in snapshot.sources if math.isfinite(s.rate_hz)), default=math.nan)
    lost = sum(source.lost for source in snapshot.sources)
    sources = f"{count} {'source' if count == 1 else 'sources'} at {number(rate_hz, 0)} Hz, {lost} lost"
    return line(f"{sources}   NIS {number(snapshot.nis_recent, 2)}  ", _judgement(snapshot))


def sources_text(snapshot: Snapshot) -> Text:
    """Return all sources, the traffic of the links, and NIS and whiteness of the filter's innovations, judged."""
    lines = [text for text, _ in _source_table(snapshot)]
    lines += [line((traffic, _DIM)) for traffic in snapshot.links]
    mean, recent = number(snapshot.nis_mean, 3), number(snapshot.nis_recent, 3)
    correlation = number(snapshot.whiteness, 3, signed=True)
    nis = f"NIS {mean} over the run, {recent} of the last 30 s;  lag-one correlation {correlation}"
    return joined([*lines, Text(), line(("innovations", _BOLD)), line(nis), line(_judgement(snapshot))])


def _troubled_sources(snapshot: Snapshot) -> list[Text]:
    """Return the headings and the sources that are not as they should be; nothing if all are."""
    head, *sources = _source_table(snapshot)
    troubled = [text for text, ok in sources if not ok]
    return [head[0], *troubled] if troubled else []


def _source_table(snapshot: Snapshot) -> list[tuple[Text, bool]]:
    """Return the headings and a line for each source, each with whether it is as it should be.

    It is if its link is well and no sample was lost or corrupt; else its line is red. The headings count as well.
    """
    heads = ["source", "     Hz", " samples", "lost", "late", "corrupt", "latency ms", "jitter ms", "degC", "     link"]
    head, *rows = padded([heads, *map(_source_row, snapshot.sources)])
    table = [(line((" ".join(head), _BOLD)), True)]
    for source, cells in zip(snapshot.sources, rows, strict=True):
        ok = _link_state(source) == _OK
        table.append((line((" ".join(cells), "" if ok else _ALARM)), ok))
    return table


def _source_row(source: SourceSnapshot) -> list[str]:
    """Return the ten cells of a source: name, rate, samples, lost, late, corrupt, latency, jitter, temperature, link.

    Units are Hz, ms and deg C; an unknown number is a dash.
    """
    return [
        source.name,
        number(source.rate_hz, 1),
        str(source.samples),
        str(source.lost),
        str(source.late),
        str(source.corrupt),
        number(source.latency_s * 1e3, 2),
        number(source.jitter_s * 1e3, 2),
        number(source.temperature_c, 1),
        _link_state(source),
    ]


def _link_state(source: SourceSnapshot) -> str:
    losses = source.lost or source.corrupt
    return "losses" if source.link == _OK and losses else source.link


def _judgement(snapshot: Snapshot) -> tuple[str, str]:
    """Return a text on the innovations of the live filter, and its style.

    It says that their NIS is off 1, else that they are not white, each if by more than chance, else that both are good;
    "not known yet" with too few blocks.
    """
    if not (math.isfinite(snapshot.nis_recent) and math.isfinite(snapshot.whiteness)):  # too few blocks for either
        return "not known yet", _DIM
    by_chance = _MANY_SIGMAS / math.sqrt(max(snapshot.recent, 1))
    if abs(snapshot.nis_recent - 1) > max(_NIS_OFF, math.sqrt(2) * by_chance):
        return "NIS OFF 1: the noise or the model differs from what was assumed", _ALARM
    if abs(snapshot.whiteness) > max(_WHITE_OFF, by_chance):
        return "NOT WHITE: the model misses something", _ALARM
    return "good: near 1, and white", "green"


def events_text(events: Sequence[tuple[float, str]], width: int) -> Text:
    """Return a heading and below it the events (instant in s, text), each broken into lines that fit the width.

    ``width`` is in characters; below 30 it counts as 30. Further lines of an event are indented as its text. Without
    events only the heading is returned; an event with an empty text has its instant alone.
    """
    lines = [line(("events", _BOLD))]
    for t_s, text in events:
        at = f"{t_s:8.1f} s  "
        first, *others = textwrap.wrap(text, max(width, _LEAST_EVENT_WIDTH) - len(at)) or [""]
        lines.append(line((at, _DIM), first))
        lines += [line(" " * len(at) + rest) for rest in others]
    return joined(lines)
