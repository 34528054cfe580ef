"""What the run could not see."""

from markupsafe import Markup

from estimator.effects.effect import Effect
from estimator.planning.planning import EffectForecast
from station.render.plan_printed import combination
from station.report.chapters.unseen import MARKED, Unseen, by_state
from station.report.figures import SYMBOLS, Unit, figure, significant, typographic
from station.report.recorded import Recorded
from station.views.seen import Seen, seen_by
from station.views.words import human

_ABSURD = 10.0  # times the largest plausible size: an effect that would have to be larger cannot be seen


def conditions(recorded: Recorded) -> Seen:
    """Return within which temperatures and rates the results were found."""
    return seen_by(recorded.recording.sources.values())


def lacking(recorded: Recorded, unseen: Unseen) -> list[str]:
    """Return by gyro the combinations of its states that the motion does not show."""
    gyros = [gyro for gyro in unseen.forecast.gyros if len(gyro.unseen)]
    return [f"{recorded.label(g.source, g.name)}: {'; '.join(map(combination, g.unseen))}" for g in gyros]


def hidden(unseen: Unseen) -> list[tuple[EffectForecast, list[tuple[Markup, float]]]]:
    """Return the effects that the motion does not show, the worst first, each with the states that it moves unnoticed.

    Those come with their shifts in sigmas.
    """
    shifts = by_state(unseen.forecast)
    effects = [effect for effect in unseen.forecast.effects if not effect.seen.all()]
    effects.sort(key=lambda effect: -float(shifts[effect.effect.name].max()))
    pairs = [list(zip(SYMBOLS, shifts[effect.effect.name].tolist(), strict=True)) for effect in effects]
    marked = ([(symbol, size) for symbol, size in moved if size >= MARKED] for moved in pairs)
    return list(zip(effects, marked, strict=True))


def visible(unseen: Unseen) -> list[EffectForecast]:
    """Return the effects that the motion shows."""
    return [effect for effect in unseen.forecast.effects if effect.seen.all()]


def smallest(effect: EffectForecast) -> str:
    """Return the smallest size of an effect that is shown, of its parameters and the gyros the worst."""
    worst = float(effect.smallest.max())
    return "∞" if not worst < _ABSURD * float(effect.largest.max()) else size(effect.effect, worst)


def size(effect: Effect, value: float) -> Markup:
    """Return a size of an effect to two digits."""
    unit = effect.parameters[0].unit
    number, _, name = human(value, 0.0, unit).partition(" ")
    return figure(value, Unit(unit, 1.0), typographic(f"{significant(float(number), 2)} {name}"))
