"""The error of the compensated rate before and after an investigation, and its models one after the other."""

from collections.abc import Iterator

from rich.markup import escape
from rich.table import Table

from estimator.effects.constructed import readable
from station.render.terminal import Shown, line, rich_table
from station.views.figures import dph, number, percent
from station.views.investigation import ErrorsView, GyroView, ImprovementView, InvestigationView, ModelView

_IN_SAMPLE = (
    "[yellow]in-sample:[/] without a verification run (--verify) these figures are cross-validated by step of the "
    "same recordings, which proves less than a separate run"
)
_HEADS = (
    "gyro",
    "rms\ndeg/h",
    "\nafter",
    "largest\ndeg/h",
    "\nafter",
    "in 95 %\nbefore",
    "\nafter",
    "states moved, in old sigmas\nk / b / sigma_j / sigma_k",
)
_MODEL_HEADS = ("model", "log evidence", "rms deg/h", "largest deg/h", "in 95 %")


def errors_shown(view: InvestigationView) -> Iterator[Shown]:
    """Yield the errors by gyro before and after, how much smaller they became or that no effect was added.

    Then that they are in-sample, if so, and the chain of models if it has several.
    """
    yield _errors_table(view), {}
    if view.improvement is None:
        yield line(f"rms error {dph(view.before.rms_rps)} deg/h; unchanged, since no effect was added")
    else:
        yield line(_improved(view, view.improvement))
    if view.in_sample:
        yield line(_IN_SAMPLE)
    if len(view.models) > 1:
        yield _chain(view.models), {}


def _errors_table(view: InvestigationView) -> Table:
    """Return a row for each gyro, and one for all if there are several: errors before and after, and moved states."""
    where = "cross-validated by step, in-sample" if view.in_sample else "verification run"
    errors = rich_table(f"Error of the compensated rate, before and after ({where})", _HEADS, "lr")
    for name, gyro in view.gyros.items():
        errors.add_row(escape(name), *_errors(gyro.before, gyro.after), _moved(gyro))
    if len(view.gyros) > 1:
        errors.add_section()
        errors.add_row("all", *_errors(view.before, view.after), "")
    return errors


def _errors(before: ErrorsView, after: ErrorsView) -> list[str]:
    """Return six texts: rms and largest error in deg/h, and coverage of the 95 % intervals, each before, then after."""
    return [
        dph(before.rms_rps),
        dph(after.rms_rps),
        dph(before.max_rps),
        dph(after.max_rps),
        percent(before.coverage95),
        percent(after.coverage95),
    ]


def _moved(gyro: GyroView) -> str:
    return " / ".join(number(sigmas, 1, signed=True) for sigmas in gyro.moved_sigmas.values())


def _improved(view: InvestigationView, gain: ImprovementView) -> str:
    return (
        f"rms error {dph(view.before.rms_rps)} -> {dph(view.after.rms_rps)} deg/h: {_ratio(gain.ratio)} times smaller "
        f"(95 %: {_ratio(gain.low)} to {_ratio(gain.high)}), over the entire run, noise removed"
    )


def _ratio(value: float | None) -> str:
    """Return a ratio; JSON has None for an infinite one."""
    return "inf" if value is None else f"{value:.3g}"


def _chain(models: tuple[ModelView, ...]) -> Table:
    """Return a row for each model: its effects, log evidence relative to the first one, errors and coverage."""
    chain = rich_table("Chain of models", _MODEL_HEADS, "lr", fold=True)
    for model in models:
        names = ["four states", *map(readable, model.effects)]
        evidence = "0" if model is models[0] else number(model.log_evidence, 1, signed=True)
        chain.add_row(
            escape(" + ".join(names)), evidence, dph(model.rms_rps), dph(model.max_rps), percent(model.coverage95)
        )
    return chain
