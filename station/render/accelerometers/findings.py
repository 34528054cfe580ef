"""What an investigation found of accelerometers, as a person reads it."""

from collections.abc import Sequence

from rich.markup import escape
from rich.table import Table

from estimator.estimation.accelerometers.force_effects import BY_NAME
from estimator.geometry.kinematics import GRAVITY_MPS2
from estimator.tracing.accelerometers.trace_forces import ForceFinding
from station.render.terminal import Shown, print_all, rich_table, stdout
from station.views.accelerometers.result import rows_of_effect

_MICRO_G = 1e6 / GRAVITY_MPS2


def print_force_findings(findings: Sequence[ForceFinding]) -> None:
    """Print for each source which effects its accelerometers need, and what is left open.

    Tables of the effects and of the rms error before and after follow only where effects were added; then what
    ``_remarks`` says.
    """
    for finding in findings:
        shown: list[Shown] = [(_verdict(finding), {"highlight": False})]
        if finding.effects:
            shown.append((_effects_table(finding), {}))
            shown.append((_errors_table(finding), {}))
        shown += [(line, {"highlight": False}) for line in _remarks(finding)]
        print_all(stdout(), shown)


def _verdict(finding: ForceFinding) -> str:
    """Return, as markup, whether effects were added or are suspected, there is nothing to add, or it was not examined.

    Nothing to add is said to be in-sample without a verification run.
    """
    who = f"accelerometers of {escape(finding.source)}"
    if not finding.names:
        return f"[bold]{who}: not examined[/bold]"
    if finding.effects:
        names = ", ".join(effect.effect.words for effect in finding.effects)
        return f"[bold]{who}: added {escape(names)}[/bold]"
    if finding.suspects:
        return f"[bold]{who}: there is an effect, but no run decides which[/bold]"
    where = "" if finding.verified else " (in-sample: --verify judges by a run that was not used)"
    return f"[bold]{who}: nothing to add[/bold]{where}"


def _effects_table(finding: ForceFinding) -> Table:
    """Return a row for each parameter of the effects that were added, and how probable the effect is.

    It has the value with its standard deviation in each accelerometer, and their unit.
    """
    rows = []
    for effect in finding.effects:
        for row in rows_of_effect(effect.effect, effect.values, effect.sd):
            values = [row.figure.figure(value, sd) for value, sd in zip(row.values, row.sds, strict=True)]
            rows.append([row.name, *values, row.figure.unit, f"{effect.probability:.1%}"])
    heads = ["effect", *(escape(name) for name in finding.names), "unit", "probability"]
    return rich_table("Effects added to the model", heads, "l" + len(finding.names) * "r" + "lr", rows)


def _errors_table(finding: ForceFinding) -> Table:
    """Return a row for each accelerometer: rms error before and after in ug, and how many times smaller it is.

    The title says whether the errors are those of verification runs or of the fitted ones.
    """
    where = (
        "the verification runs" if finding.verified else "the fitted runs: give --verify for runs that were not used"
    )
    rows = [
        [escape(name), f"{before * _MICRO_G:.1f}", f"{after * _MICRO_G:.1f}", f"{before / after:.2f}"]
        for name, before, after in zip(finding.names, finding.before_mps2, finding.after_mps2, strict=True)
    ]
    heads = ["sensor", "before, ug", "after, ug", "times smaller"]
    return rich_table(f"Error of means over 2 s, noise included, on {where}", heads, "lrrr", rows)


def _remarks(finding: ForceFinding) -> list[str]:
    """Return sentences: what was left out and why, rivals, suspects and what would show them, effects not added.

    The latter fit the fitted runs but not those of verification. Rivals and suspects have their probabilities.
    """
    lines = [f"left out: {escape(reason)}" for reason in finding.left_out.values()]
    for effect in finding.effects:
        rivals = ", ".join(f"{BY_NAME[name].words} ({chance:.0%})" for name, chance in effect.rivals.items())
        if rivals:
            lines.append(f"{effect.effect.name.replace('_', ' ')} may also be: {escape(rivals)}")
    if finding.suspects:
        ordered = sorted(finding.suspects.items(), key=lambda pair: -pair[1])
        suspects = ", ".join(f"{BY_NAME[name].words} ({chance:.0%})" for name, chance in ordered)
        lines.append(f"suspects: {escape(suspects)}")
        shown_by = dict.fromkeys(BY_NAME[name].shown_by for name, _ in ordered if BY_NAME[name].shown_by)
        if shown_by:
            lines.append(f"next, record a run with: {escape('; '.join(shown_by))}")
    for name in finding.dropped:
        lines.append(f"{name.replace('_', ' ')} fits the fitted runs and makes the verification runs worse: not added")
    return lines
