"""What stands against a start, the limits of the bench, and the script with what it will show."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rich.text import Text

from station.screen.panes.lines import MARK_STYLES, TITLE, Mark, joined, line, marked, padded
from station.screen.sessions.answers import Reply
from station.screen.tabs.prospects import Prospect
from station.views.accelerometers.result import FORCE_FIGURES
from station.views.answers.plan import PlanView
from station.views.figures import StateUnit, clock_between, three_digits

if TYPE_CHECKING:
    from station.bench.bench import ForceLimits, Limits

_LIMITED = ("|k|", "|b|", "|sigma_j|, |sigma_k|")


@dataclass(kw_only=True, frozen=True, slots=True)
class Obstacle:
    """What stands against a start: something wrong, or something to wait for; ``text`` says what to do."""

    mark: Mark
    text: str


@dataclass(kw_only=True, frozen=True, slots=True)
class StartView:
    """What stands against a start.

    ``missed`` are the sensors whose required sigmas the script does not reach. ``mounted``: a device of the tray is
    mounted, whose run starts by itself.
    """

    obstacles: Sequence[Obstacle]
    missed: Sequence[str] = ()
    mounted: bool = False


def ready_text(view: StartView) -> Text:
    """Return a heading and what stands against a start, a line each, or that nothing is missing.

    A mounted device is announced above, as its run starts automatically. Sigmas that the script cannot reach are a note
    below and no obstacle, but it does not say then that nothing is missing.
    """
    lines = [line(("Before START", TITLE))]
    if view.mounted:
        waits = "the device is mounted: its run starts automatically once nothing is missing (F9 cancels)"
        lines.append(line(("TRAY  ", "bold"), waits))
    lines += [marked(obstacle.mark, obstacle.text) for obstacle in view.obstacles]
    if view.missed:
        missed = ", ".join(view.missed)
        text = f"this script does not reach the sigmas that the bench requires ({missed}): it will end FAIL"
        lines.append(marked(Mark.NOTE, text))
    elif not view.obstacles:
        lines.append(line(("nothing is missing", "green")))
    return joined(lines)


def summary_text(view: StartView) -> Text:
    """Return the line beside START: ready, or the first thing that stands against it."""
    if not view.obstacles:
        return line(("READY", "bold green"), "  the table will move")
    first = next((each for each in view.obstacles if each.mark is Mark.WRONG), view.obstacles[0])
    more = f"  (and {len(view.obstacles) - 1} more)" if len(view.obstacles) > 1 else ""
    return line(("NOT READY", MARK_STYLES[first.mark]), f"  {first.text}{more}")


def limits_text(limits: "Limits | None") -> Text:
    """Return the limits of a bench as its file states them; the heading alone if the bench is not known."""
    lines = [line(("Limits of the bench", TITLE))]
    if limits is not None:
        stated = _stated_limits(limits) or ["none: every completed run passes"]
        lines += [line(text) for text in stated]
    return joined(lines)


def _stated_limits(limits: "Limits") -> list[str]:
    """Return the limits that the bench states, in its words: of states, accelerometers, mean NIS and lost samples.

    Those that limit nothing are left out.
    """
    rows = zip(_LIMITED, limits.sizes, limits.written_sizes, limits.sds, limits.written_sds, strict=False)
    stated = _state_limits(rows)
    stated += _stated_force_limits(limits.forces)
    if limits.nis_low > 0 or math.isfinite(limits.nis_high):
        stated.append(f"mean NIS {limits.nis_low:g} to {limits.nis_high:g}")
    if limits.lost < 1:
        stated.append(f"samples lost up to {limits.written['lost']}")
    return stated


def _stated_force_limits(limits: "ForceLimits") -> list[str]:
    """Return the limits of accelerometers as their section states them."""
    stated = _state_limits((name, *limits.of_state(state)) for state, name in enumerate(_LIMITED))
    if math.isfinite(limits.sd_arm_m):
        stated.append(f"lever arm: sigma up to {limits.written['sd_arm_m']}")
    return [f"accelerometers: {text}" for text in stated]


def _state_limits(rows: Iterable[tuple[str, float, str, float, str]]) -> list[str]:
    """Return limits in words, one for each state that has any; infinite ones are left out.

    A row is the name of a state, its largest size, that as it is written, its largest sigma, that as it is written.
    """
    stated = []
    for name, size, written_size, sd, written_sd in rows:
        words = f"{name} up to {written_size}"
        sigma = f"sigma up to {written_sd}"
        if math.isfinite(size):
            stated.append(f"{words}, its {sigma}" if math.isfinite(sd) else words)
        elif math.isfinite(sd):
            stated.append(f"{name.replace('|', '')}: {sigma}")
    return stated


@dataclass(kw_only=True, frozen=True, slots=True)
class ScriptView:
    """A script and its plan, None while that is computed, in the units of ``figures``."""

    prospect: Prospect
    plan: Reply[PlanView] | None
    figures: Sequence[StateUnit]


def script_text(view: ScriptView) -> Text:
    """Return how long the script takes, and the sigmas that are predicted for it.

    In place of these: why the script cannot be read, and in place of the sigmas that their prediction is under way, or
    why it failed. Before the script is read there is only the heading.
    """
    prospect = view.prospect
    if prospect.motion is None:
        lines = [line(("Script", TITLE))]
        if prospect.script_wrong:
            lines.append(marked(Mark.WRONG, prospect.script_wrong))
        return joined(lines)
    lasting = clock_between(prospect.least_s, prospect.longer_s)
    lines = [line((f"Script {prospect.script}: {lasting} min", TITLE))]
    if view.plan is None:
        lines.append(marked(Mark.WAIT, "sigmas are being predicted"))
    elif view.plan.value is None:
        lines.append(marked(Mark.WRONG, view.plan.reason))
    else:
        lines += _predicted(view.plan.value, view.figures)
    return joined(lines)


def _predicted(plan: PlanView, figures: Sequence[StateUnit]) -> list[Text]:
    """Return lines on the predicted sigmas of each gyro and accelerometer, and axes that do not prove constancy.

    Each of these three parts begins with an empty line; only that of the gyros is always there. Gyros are in the units
    of ``figures``, followed by the required sigmas if any is stated; those that do not reach them are yellow.
    Accelerometers have units of their own and are not judged.
    """
    heads = ["predicted", *(f"{figure.name} {figure.unit}" for figure in figures)]
    rows = [heads, *([gyro.name, *_sigmas(gyro.sd.values(), figures)] for gyro in plan.gyros)]
    styles = ["bold", *("" if gyro.reached else "yellow" for gyro in plan.gyros)]
    required = plan.required.values()
    if any(sd is not None for sd in required):
        rows.append(["required", *_sigmas(required, figures)])
        styles.append("")
    lines = [Text(), *(line((" ".join(cells), style)) for cells, style in zip(padded(rows), styles, strict=True))]
    if plan.accelerometers:
        force_heads = ["predicted", *(f"{figure.name} {figure.unit}" for figure in FORCE_FIGURES)]
        force_rows = [[name, *_sigmas(sd.values(), FORCE_FIGURES)] for name, sd in plan.accelerometer_sds]
        head, *others = padded([force_heads, *force_rows])
        lines += [Text(), line((" ".join(head), "bold")), *(line(" ".join(cells)) for cells in others)]
    weak = [axis.axis for axis in plan.constancy if not axis.proved]
    if weak:
        unproved = f"constancy not proved: {', '.join(weak)}"
        lines += [Text(), line((unproved, "yellow"), " (station plan --early-late)")]
    return lines


def _sigmas(sds: Iterable[float | None], figures: Sequence[StateUnit]) -> list[str]:
    """Return sigmas in the units of the states, a dash for an unknown one."""
    shown = [None if sd is None else sd * figure.factor for sd, figure in zip(sds, figures, strict=False)]
    return [three_digits(sd) for sd in shown]
