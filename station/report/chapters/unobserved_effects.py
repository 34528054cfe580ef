"""Effects that a run could not show: its real motion, what such a motion shows, and the text in the report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from drivers.types import Floats
from estimator.calibration.values import Calibration
from estimator.effects.catalogue import catalogue, records
from estimator.effects.constructed import readable as words
from estimator.effects.effect import Effect
from estimator.effects.site import EARTH_RATE
from estimator.geometry.noise import NoiseModel
from estimator.planning.planning import EffectForecast, Forecast, PlannedDevice, forecast
from estimator.recordings.recording import ImuData
from estimator.recordings.reference import REST_RPS, TableReadings
from station.report.figures import (
    CELSIUS,
    DEG_PER_S,
    ONE,
    SYMBOLS,
    Unit,
    figure,
    fixed,
    plain,
    significant,
    typographic,
)
from station.report.recorded import Recorded, Step
from station.report.tables import Content, Table, table_of
from station.scripts.planned import planned_motion
from station.scripts.script import Script
from station.scripts.steps.kind import Step as ScriptStep
from station.scripts.steps.rest import Rest
from station.scripts.steps.rotate import Rotate
from station.views.figures import human
from station.views.plan import MARKED, combination, unnoticed
from station.views.seen import seen_by

_PERIOD_S = 0.1
_MOST_ROWS = 36_000  # an hour of them; longer runs use coarser steps
_PLATEAU = 0.9  # of the largest rate: above it an axis is taken to be at its steady rate
_FINEST_DEG = 0.01  # resolution to which rates and turns of a script are derived from the table's readings
_SHORTEST_RAMP_S = 0.05
_NEVER_SEEN = 10.0  # times the largest plausible size


@dataclass(frozen=True, slots=True, eq=False)
class Unseen:
    """What the motion of a run shows of the gyros and of the effects of the catalogue.

    ``budgeted`` are effects of the table that the uncertainty budget covers, at the size stated for the table.
    ``site_known``: Earth rate is in the model, so that only an error of it can be hidden.
    """

    forecast: Forecast
    budgeted: frozenset[str]
    site_known: bool

    @property
    def unnoticed(self) -> list[str]:
        """Effects that could move a state by more than its sigma without being seen or budgeted, the worst first."""
        largest = {name: float(shift.max()) for name, shift in by_state(self.forecast).items()}
        found = [name for name, size in largest.items() if size >= MARKED and name not in self.budgeted]
        return [self.words(name) for name in sorted(found, key=lambda name: -largest[name])]

    def words(self, effect: str) -> str:
        """Return the readable name of an effect."""
        return "wrong Earth rate" if effect == EARTH_RATE.name and self.site_known else words(effect)


def unseen_of(recorded: Recorded) -> Unseen | None:
    """Return which effects of the catalogue a run on a table shows and which not.

    Effects that its calibration estimated are left out. Those of the table count as budgeted if it states its
    uncertainty. None without table readings, steps, a calibration, or any turn.
    """
    table, found = recorded.recording.table, recorded.calibration
    if table is None or not recorded.steps or found is None:
        return None
    driven = [driven_step(table, step) for step in recorded.steps]
    if not any(step.turn for step in driven):
        return None
    script = Script(recorded.text("script") or "script", tuple(part for step in driven for part in step.parts))
    period_s = max(_PERIOD_S, script.least_s / _MOST_ROWS)
    motion = planned_motion(script, table.gimbals, period_s)
    conditions = motion.conditions(_temperature(recorded, motion.t_s), recorded.recording.site)
    devices = [
        PlannedDevice(source, data.array, _noise(found, source, data), data.prior)
        for source, data in recorded.recording.sources.items()
    ]
    known = {value.effect.split()[0] for gyro in found.gyros for value in gyro.effects}
    effects = [e for e in catalogue(motion.gimbals, script.least_s) if e.name not in known]
    of_table = frozenset(record.name for record in records() if record.of_table)
    budgeted = of_table if table.uncertainty is not None else frozenset[str]()
    return Unseen(forecast(conditions, devices, effects), budgeted, recorded.recording.site is not None)


@dataclass(frozen=True, slots=True)
class Driven:
    """The motion in one step of a run: a turn, a rest after it, or both."""

    turn: Rotate | None = None
    rest: Rest | None = None

    @property
    def parts(self) -> tuple[ScriptStep, ...]:
        """The turn and the rest, as far as there are both, in order."""
        return tuple(part for part in (self.turn, self.rest) if part is not None)


def driven_step(table: TableReadings, step: Step) -> Driven:
    """Return the motion in one step, reconstructed from the readings; neither turn nor rest if it took no time.

    The turn is that of the fastest axis, about no other axis, by a trapezoid of the rate. Rates (per second) and turns
    are rounded to 0.01 deg. A motion that the readings do not resolve, or that ends where it began, counts as rest.
    After a turn up to 0.1 s of rest are left out.
    """
    duration_s = (step.end_ns - step.start_ns) * 1e-9
    inside = (table.t_ns >= step.start_ns) & (table.t_ns <= step.end_ns)
    if duration_s <= 0:
        return Driven()
    t_s, rate, angle = table.t_ns[inside] * 1e-9, table.rate_rps[inside], table.angle_rad[inside]
    column = int(np.argmax(np.abs(rate).max(axis=0, initial=0.0)))
    largest = float(np.abs(rate[:, column]).max(initial=0.0))
    if len(t_s) < 4 or largest < 10 * REST_RPS:
        return Driven(rest=Rest(duration_s, step.label))
    steady = np.abs(rate[:, column]) > _PLATEAU * largest
    peak = abs(_rounded(float(np.median(rate[steady, column]))))
    turn = _rounded(float(angle[-1, column] - angle[0, column]))
    # For a trapezoid, the integrals of the rate and of its square give the length of a ramp.
    square = float(np.trapezoid(rate[:, column] ** 2, t_s))
    if not peak or not turn:
        return Driven(rest=Rest(duration_s, step.label))  # there and back, or read too seldom to decide
    way_s = abs(turn) / peak
    ramp_s = min(max(3 * (way_s - square / peak**2), _SHORTEST_RAMP_S), 0.999 * way_s)
    moving_s = way_s + ramp_s
    rotated = Rotate(table.gimbals[column], float(np.copysign(peak, turn)), moving_s, peak / ramp_s, step.label)
    if way_s <= _SHORTEST_RAMP_S:
        return Driven(rest=Rest(duration_s, step.label))
    rest_s = duration_s - moving_s
    return Driven(rotated, Rest(rest_s, step.label) if rest_s > _PERIOD_S else None)


def _rounded(angle_rad: float) -> float:
    return float(np.radians(round(np.degrees(angle_rad) / _FINEST_DEG) * _FINEST_DEG))


def _temperature(recorded: Recorded, t_s: Floats) -> Floats | None:
    """Return the mean temperature of the sources (n,), degC, at ``t_s`` (n,) since the start; None if one has none.

    Between and beyond the readings of a source it is interpolated, or held.
    """
    courses = []
    for data in recorded.recording.sources.values():
        if data.temperature_c is None or not np.isfinite(data.temperature_c).any():
            return None
        known = np.isfinite(data.temperature_c)
        since_s = (data.t_ns[known] - recorded.start_ns) * 1e-9
        courses.append(np.interp(t_s, since_s, data.temperature_c[known]))
    return np.asarray(np.mean(courses, axis=0))


def _noise(calibration: Calibration, source: str, data: ImuData) -> NoiseModel:
    """Return the noise of a source: the mean of its gyros' estimated noise, else that of the data sheet.

    Without either, white noise is derived from the noise of a sample; without gyros it is 1e-4 rad/s/rtHz.
    """
    own = [gyro for gyro in calibration.gyros if gyro.source == source]
    models = [gyro.noise.mean for gyro in own if gyro.noise is not None]
    if models:
        means = (float(np.mean([getattr(m, key) for m in models])) for key in ("arw", "instability", "walk"))
        return NoiseModel(*means)
    if data.noise is not None or not own:
        return data.noise or NoiseModel(1e-4)
    period_s = float(np.median(np.diff(data.t_ns))) * 1e-9
    return NoiseModel(float(np.mean([gyro.noise_rps for gyro in own])) * float(np.sqrt(period_s)))


def by_state(forecast: Forecast) -> Mapping[str, Floats]:
    """Return by effect the largest shift of each state (4,), in sigmas, that stays unseen."""
    return {effect.effect.name: unnoticed(effect).max(axis=(0, 1), initial=0.0) for effect in forecast.effects}


def hidden(unseen: Unseen) -> list[tuple[EffectForecast, Floats]]:
    """Return the effects that the motion does not show, the worst first, each with ``by_state`` of it."""
    shifts = by_state(unseen.forecast)
    effects = [(effect, shifts[effect.effect.name]) for effect in unseen.forecast.effects if not effect.seen.all()]
    return sorted(effects, key=lambda pair: -float(pair[1].max()))


def size(effect: Effect, value: float) -> Markup:
    """Return a size of an effect, ``value`` in SI, to two digits in a readable unit."""
    unit = effect.parameters[0].unit
    number, _, name = human(value, 0.0, unit).partition(" ")
    return figure(value, Unit(unit, 1.0), typographic(f"{significant(float(number), 2)} {name}"))


@dataclass(kw_only=True, frozen=True, slots=True)
class SteadyMotion:
    """What a known motion shows.

    ``no_effect``: for each gyro the proportions of errors without an effect in the motion. ``saturated``: as many
    steady ``conditions`` as the states can absorb. ``hidden`` are effects that would have passed unnoticed, ``shown``
    those that this motion shows.
    """

    no_effect: Sequence[str]
    saturated: bool
    conditions: int
    hidden: Table | None
    shown: Markup


@dataclass(kw_only=True, frozen=True, slots=True)
class UnseenView:
    """The chapter on what a run could not see; outputs in deg/s, temperatures in degC, empty if not recorded.

    ``motion`` is None if the steps of the script are not known.
    """

    largest_dps: Markup
    low_c: Markup
    high_c: Markup
    motion: SteadyMotion | None


def unseen_view(recorded: Recorded, unseen: Unseen | None) -> UnseenView:
    """Return what a run could not see, and the rates and temperatures for which its results hold.

    Temperatures are empty if they were not recorded; ``unseen`` is None if nothing is known of the motion.
    """
    seen = seen_by(recorded.recording.sources.values())
    low_c, mean_c, high_c = seen.temperature_c
    known = mean_c == mean_c
    return UnseenView(
        largest_dps=plain(seen.largest_rps, DEG_PER_S, 3),
        low_c=fixed(low_c, CELSIUS, 1) if known else Markup(),
        high_c=fixed(high_c, CELSIUS, 1) if known else Markup(),
        motion=None if unseen is None else _steady_motion(recorded, unseen),
    )


def _steady_motion(recorded: Recorded, unseen: Unseen) -> SteadyMotion:
    """Return what the motion of a run cannot show: combinations of states by gyro, and effects, hidden or shown.

    ``hidden`` is None if every effect is shown in each gyro.
    """
    found = unseen.forecast
    effects = hidden(unseen)
    seen = [effect for effect in found.effects if effect.seen.all()]
    return SteadyMotion(
        no_effect=[
            f"{recorded.label(gyro.source, gyro.name)}: {'; '.join(map(combination, gyro.unseen))}"
            for gyro in found.gyros
            if len(gyro.unseen)
        ],
        saturated=found.saturated,
        conditions=found.steady_conditions,
        hidden=_hidden_table(unseen, effects) if effects else None,
        shown=Markup(", ").join(_shown(unseen, effect) for effect in seen),
    )


def _shown(unseen: Unseen, effect: EffectForecast) -> Markup:
    return Markup("{} ({})").format(unseen.words(effect.effect.name), _smallest(effect))


def _hidden_table(unseen: Unseen, effects: Sequence[tuple[EffectForecast, Floats]]) -> Table:
    heads = ["effect", "smallest size shown", "largest plausible", "unnoticed shift, in u", "what would show it"]
    return table_of(heads, "lrrll", [_hidden_row(unseen, effect, shifts) for effect, shifts in effects])


def _hidden_row(unseen: Unseen, effect: EffectForecast, shifts: Floats) -> list[Content]:
    """Return the five cells of an effect: name, smallest size detected, largest plausible, shift, what shows it.

    ``shifts`` (4,) are those of the states in sigmas. ``held by the budget`` stands in place of the shift if
    the uncertainty budget includes the effect.
    """
    budgeted = effect.effect.name in unseen.budgeted
    return [
        unseen.words(effect.effect.name),
        _smallest(effect),
        size(effect.effect, effect.largest.max()),
        "held by the budget" if budgeted else _shift(shifts),
        effect.effect.record.shown_by,
    ]


def _smallest(effect: EffectForecast) -> Content:
    """Return the smallest size that is seen, of the parameters and the gyros the worst.

    What would have to be ten times as large as is plausible cannot be seen.
    """
    worst = effect.smallest.max()
    return size(effect.effect, worst) if worst < _NEVER_SEEN * effect.largest.max() else "∞"


def _shift(shifts: Floats) -> Content:
    """Return the shifts of the states that are worth a word."""
    marked = [(symbol, shift) for symbol, shift in zip(SYMBOLS, shifts, strict=True) if shift >= MARKED]
    if not marked:
        return "none"
    return Markup(", ").join(Markup("{} {}").format(symbol, plain(shift, ONE, 2)) for symbol, shift in marked)
