"""The chapter on what the run could not see."""

from collections.abc import Iterator, Sequence

import numpy as np

from drivers.arrays import Floats
from estimator.effects.effect import Effect
from estimator.planning import EffectForecast
from estimator.tracing.investigation import Value
from station.investigation_printed import human
from station.plan_printed import combination
from station.report.figures import CELSIUS, DEG_PER_S, ONE, STATES, Unit, figure, fixed, plain, significant, typographic
from station.report.html import Content, Markup, bullets, composed, joined, paragraph, table
from station.report.recorded import Recorded
from station.report.unseen import MARKED, Unseen, by_state

_ABSURD = 10.0  # times the largest plausible size: an effect that would have to be larger cannot be seen


@composed
def blind_spots(recorded: Recorded, unseen: Unseen | None) -> Iterator[Content]:
    """Return what the run could not see: a statement, and the effects that would have passed unnoticed."""
    yield _scope(recorded)
    if unseen is None:
        yield paragraph(
            "The steps that were driven are not known, so what this motion shows of further effects (scale factors "
            "that differ by direction, sensitivity to acceleration and the like) is not stated."
        )
        return
    found = unseen.forecast
    lacking = [gyro for gyro in found.gyros if len(gyro.unseen)]
    if lacking:
        yield paragraph(
            "Errors of the states in these proportions change nothing that this motion shows; only the data sheet "
            "limits them:"
        )
        yield bullets(f"{recorded.label(g.source, g.name)}: {'; '.join(map(combination, g.unseen))}" for g in lacking)
    else:
        yield paragraph("Every combination of the four states of each gyro is shown by this motion.")
    if found.saturated:
        yield paragraph(
            f"The motion is saturated: {found.steady_conditions} steady conditions (rests and rates that differ) "
            "for four states a gyro. Whatever is constant within each condition is taken up by the states and "
            "leaves no residual: the calibration could be wrong by it without a sign.",
            class_="caution",
        )
    yield _hidden(unseen)
    yield _visible(unseen)


def _scope(recorded: Recorded) -> Markup:
    """Return within which rates and temperatures the results were found."""
    sources = recorded.recording.sources.values()
    known = [
        data.temperature_c[np.isfinite(data.temperature_c)]
        for data in sources
        if data.temperature_c is not None and np.isfinite(data.temperature_c).any()
    ]
    rates = [data.rate_rps[np.isfinite(data.rate_rps)] for data in sources]
    warm: Content = " at temperatures that were not recorded"
    if known:
        low, high = min(float(t.min()) for t in known), max(float(t.max()) for t in known)
        warm = joined([" at ", fixed(low, CELSIUS, 1), " to ", fixed(high, CELSIUS, 1), " °C"])
    return paragraph(
        "The results hold for outputs up to ",
        plain(max(float(np.abs(r).max(initial=0.0)) for r in rates), DEG_PER_S, 3),
        " °/s",
        warm,
        ", for the mounting and the time of this run. Beyond them they are not verified.",
    )


def _hidden(unseen: Unseen) -> Content:
    """Return the effects that the motion does not show, and what they could have done to the states."""
    hidden = [effect for effect in unseen.forecast.effects if not effect.seen.all()]
    if not hidden:
        return None
    shifts = by_state(unseen.forecast)
    rows: list[Sequence[Content]] = []
    for effect in sorted(hidden, key=lambda e: -float(shifts[e.effect.name].max())):
        budgeted = effect.effect.name in unseen.budgeted
        rows.append(
            [
                unseen.words(effect.effect.name),
                _smallest(effect),
                _size(effect.effect, float(effect.largest.max())),
                "held by the budget" if budgeted else _shift(shifts[effect.effect.name]),
                effect.effect.shown_by,
            ]
        )
    notes = (
        "Smallest size shown: found on any gyro in 95 % of runs at 1 % false alarms; ∞: the states take up all. "
        "Shift: by how many standard uncertainties u the largest plausible size moves a state of some gyro unnoticed, "
        "where by one or more. Held by the budget: at the uncertainty that is stated of the table."
    )
    heads = ("effect", "smallest size shown", "largest plausible", "unnoticed shift, in u", "what would show it")
    return table("Effects that would have passed unnoticed", heads, rows, align="lrrll", notes=notes)


def _visible(unseen: Unseen) -> Content:
    seen = [effect for effect in unseen.forecast.effects if effect.seen.all()]
    if not seen:
        return None
    parts: list[Content] = ["At plausible sizes this motion shows (in brackets: from which size on): "]
    for number, effect in enumerate(seen):
        parts += [", " if number else None, f"{unseen.words(effect.effect.name)} (", _smallest(effect), ")"]
    return paragraph(*parts, ". Whether they were looked for is said in the chapter on the residual.")


def _shift(shifts: Floats) -> Content:
    moved = [(symbol, float(s)) for (symbol, _), s in zip(STATES, shifts, strict=True) if s >= MARKED]
    parts: list[Content] = []
    for symbol, size in moved:
        parts += [", " if parts else None, symbol, " ", plain(size, ONE, 2)]
    return joined(parts) if parts else "none"


def _smallest(effect: EffectForecast) -> Content:
    worst = float(effect.smallest.max())  # over its parameters and the gyros
    return "∞" if not worst < _ABSURD * float(effect.largest.max()) else _size(effect.effect, worst)


def _size(effect: Effect, value: float) -> Markup:
    unit = effect.parameters[0].unit
    number, _, name = human(Value(value, 0.0, unit)).partition(" ")
    return figure(value, Unit(unit, 1.0), typographic(f"{significant(float(number), 2)} {name}"))
