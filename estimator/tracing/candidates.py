"""The candidates: effects of the catalogue, and general dependences that stand for effects not in it."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import pairwise
from typing import Any, Self

import numpy as np

from estimator.effects.catalogue import records
from estimator.effects.conditions import Axes, Conditions, follow
from estimator.effects.constructed import CONSTRUCTED
from estimator.effects.disturbances import SAMPLE_HOLD
from estimator.effects.drift import BIAS_DRIFT, BIAS_STEP, WARM_UP
from estimator.effects.dynamics import BANDWIDTH, LAG_S, LATENCY, late
from estimator.effects.effect import Effect, Kind, Parameter, Record, Settings
from estimator.effects.law import VARIABLES, functions_of, last_sign, of_each_gyro, variables_of
from estimator.effects.site import EARTH_RATE, EARTH_RATE_UPWARD
from estimator.effects.table import TABLE_HARMONIC
from estimator.estimation.runs.run import Run, with_gyro
from estimator.observations.alignment import following
from estimator.types import Floats

_OTHER_ORDERS = (3, 5, 6)
_PICKED_UP, _AROUND = float(np.radians(0.5)), float(np.radians(0.05))  # largest sizes without a name, rad/s
_STEPS = 100  # instants in a run at which the search for a step begins
_LAGS_S = (15.0, 40.0, 120.0)
_MEMORIES = frozenset({"lag", "play", "last"})
_STEADY_K = 0.05  # a temperature that changes by less shows no effect
_NEAR_S = 5e-3  # a delay nearer than this to where a search begins is found from there


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """An effect or dependence to try in the search. ``name`` is unique, ``effect`` gives its name in results.

    ``depends_on`` is set for general dependences, which prove that there is an effect but not which. ``theta`` is the
    value of the nonlinear parameter, in ``unit``; ``of`` makes the effect for another value, ``start`` are the values
    at which the search for it begins, ``range_log`` is the logarithm of the range that it may have in nature. ``run``
    is the number of the recording in which a step lies. ``by_size``: the nonlinear parameter is the size of the effect,
    its first parameter. ``flexible``: a law that stands for any function of its variable, ``family`` is
    then the name of that with all terms. ``sensed`` are the directions
    (3,) that gyros really sense, with their scale, in place of the nominal ones. ``settings`` are those of the model
    that fix the nonlinear parameter. A law of one shape for all gyros is the sum of the terms of ``pieces``, each in
    its largest size, times the numbers ``along``. ``by_gyro``, if set, gives the columns in place of the effect, from a
    run and the number of a gyro in it. ``log_prior`` is the logarithm of the prior probability; if the effect
    ``beside`` is in the model, ``likelier`` is added to it. The log evidence loses ``log_tries`` because the nonlinear
    parameter was tuned, and ``log_choices`` because terms or a shape were chosen.
    """

    name: str
    effect: Effect
    log_prior: float = 0.0
    depends_on: str = ""
    theta: float | None = None
    of: Callable[[float], Effect] | None = None
    start: Floats | None = None
    run: int | None = None
    log_tries: float = 0.0
    log_choices: float = 0.0
    unit: str = "s"
    range_log: float = 0.0
    beside: str = ""
    likelier: float = 0.0
    by_size: bool = False
    flexible: bool = False
    family: str = ""
    sensed: Mapping[str, Floats] = field(default_factory=dict)
    settings: Settings = field(default_factory=dict)
    pieces: "Candidate | None" = None
    along: tuple[float, ...] = ()
    by_gyro: Callable[[Run, int], Floats] | None = None

    @classmethod
    def among(cls, name: str, of: Callable[[float], Effect], start: Floats, begin: int = 0, **more: Any) -> Self:
        """Return a candidate whose nonlinear parameter is searched from ``start`` values, of which number ``begin`` is
        set.
        """
        theta = float(start[begin])
        return cls(name, of(theta), theta=theta, of=of, start=start, **more)

    @property
    def called(self) -> str:
        """Name of the effect in results: that of its kind."""
        return self.effect.record.name

    @property
    def law(self) -> str:
        """The law of a constructed effect, empty for those of the catalogue."""
        return self.effect.law if self.effect.record is CONSTRUCTED else ""

    @property
    def label(self) -> str:
        """Name among rivals: laws of the same variables, all with a memory or all without, share one."""
        if not self.law:
            return self.called
        about = " and ".join(sorted(VARIABLES[name][2] for name in variables_of(self.law)))
        return f"a law of the {about}{', with memory' if functions_of(self.law) & _MEMORIES else ''}"

    @property
    def alike(self) -> bool:
        """Whether all gyros have the same columns."""
        if self.by_gyro is not None:
            return False
        return self.effect.record.alike or bool(self.effect.law and not of_each_gyro(self.effect.law))

    def columns(self, run: Run, gyro: int) -> Floats:
        """Return the columns (b, p) of gyro number ``gyro`` of a run, in rad/s at the largest size of the effect."""
        return self.regressors(run, gyro) * self.effect.largest

    def regressors(self, run: Run, gyro: int) -> Floats:
        """Return the columns (b, p) over b blocks of the effect's p parameters for gyro number ``gyro`` of a run.

        They are per unit of each parameter. For a step of another recording this is a constant: 1 in recordings after
        it, 0 in those before. A gyro in ``sensed`` has that direction in place of its nominal sense axis.
        """
        if self.by_gyro is not None:
            return self.by_gyro(run, gyro)
        if self.run is not None and run.order != self.run:
            return np.full((len(run.t_s), 1), float(run.order > self.run))
        p = self.sensed.get(run.array.names[gyro])
        array = run.array
        axes = Axes(array.p[gyro] if p is None else p, array.j[gyro], array.k[gyro])
        return run.fold(self.effect.at(run.grid, axes))


def candidates_of(runs: Sequence[Run]) -> tuple[list[Candidate], dict[str, str]]:
    """Return all candidates that can be tried on these runs, and the effects that cannot be, with the reason by name.

    An effect cannot be tried if the runs lack a quantity it needs, if it needs a temperature and that does not change,
    or if the reference may have the same effect itself or hides it: another instrument, external encoders, turns of
    which only the angle is known. General dependences come last; they are left out silently where the runs lack their
    quantity.
    """
    offers = frozenset.intersection(*(run.grid.offers for run in runs))
    gimbals = runs[0].grid.gimbals
    span_s = max(float(run.t_s[-1] - run.t_s[0]) for run in runs)
    left_out: dict[str, str] = {}
    if not gimbals:
        left_out[TABLE_HARMONIC.name] = "the recordings hold no gimbals"
    foreign = any(run.recording.reference.by_turns for run in runs)
    if foreign:
        why = "another instrument has its own lag, so a delay relative to it is the sum of all lags"
        left_out[BANDWIDTH.name] = why
    listed = _catalogue(runs, gimbals, span_s, foreign)
    if foreign and gimbals:
        why = "an external encoder may have the same effect itself"
        left_out |= {record.name: why for record in records() if record.of_encoders}
    if any(run.stated_rps for run in runs):
        why = "a turn from rest to rest has the same angle for any delay"
        left_out |= {record.name: why for record in records() if record.within_turns}
    warm = "temperature" in offers
    steady = warm and max(np.ptp(r.grid.temperature_c) for r in runs if r.grid.temperature_c is not None) < _STEADY_K
    chosen = []
    for candidate in (one for one in listed if one.called not in left_out):
        missing = candidate.effect.needs - offers
        if missing:
            left_out[candidate.called] = f"the recordings hold no {' and no '.join(sorted(missing))}"
        elif steady and "temperature" in candidate.effect.needs:
            left_out[candidate.called] = "the temperature does not change"
        else:
            chosen.append(candidate)
    of_kind = Counter(candidate.called for candidate in chosen)
    expected = [_expected(candidate, of_kind, warm) for candidate in chosen]
    return [*expected, *_general_dependences(offers, gimbals, len(of_kind))], left_out


def _expected(candidate: Candidate, of_kind: Mapping[str, int], warm: bool) -> Candidate:
    """Return a candidate with how much it is expected before the data; those of one kind share that of the kind."""
    odds = candidate.effect.record.odds
    log = odds.warm if warm and odds.warm is not None else odds.log
    beside, likelier = odds.beside or ("", log)
    share = log - np.log(len(of_kind)) - np.log(of_kind[candidate.called])
    return replace(candidate, log_prior=candidate.log_prior + share, beside=beside, likelier=likelier - log)


def _catalogue(runs: Sequence[Run], gimbals: tuple[str, ...], span_s: float, foreign: bool) -> list[Candidate]:
    """Return the candidates for the laws of the catalogue that are searched for, also those whose quantities runs lack.

    ``gimbals`` are the axes of the table, empty without one; ``span_s`` is the length of the longest run, which sets
    the grids of settings. ``foreign``: the reference is another instrument, so that delays may be large; no bandwidth
    is listed if they are. Sample hold is listed for held values only, laws that go on over runs for a common clock, a
    step for each recording that is long enough. Without gimbals, site and turns, the Earth rate is the upward one.
    Several candidates of one effect have names of their own (orders of a harmonic, drifts on one clock, steps).
    """
    known = [record for record in records() if record.kind is Kind.LAW and record.searched]
    plain = [record for record in known if record.grid is None]
    by_motion_s = _delay_by_motion(runs) if foreign else 0.0
    far_s = _far_delays(by_motion_s) if foreign else np.empty(0)
    if not gimbals and all(run.recording.site is None and not run.turns for run in runs):
        plain = [*(record for record in plain if record is not EARTH_RATE), EARTH_RATE_UPWARD]
    found = [
        Candidate(effect.name, effect)
        for effect in (record.effect(gimbals, **own) for record in plain for own in record.listed(span_s))
    ]
    by_size = partial(Candidate.among, by_size=True, sensed=_sensed(runs, by_motion_s))
    found.append(by_size(LATENCY.name, late, np.concatenate([[0.0], far_s])))
    if not len(far_s):
        found.append(Candidate(BANDWIDTH.name, BANDWIDTH.effect(tau_s=LAG_S)))
    if any(run.held > 1 for run in runs):
        found.append(by_size(SAMPLE_HOLD.name, lambda delay_s: SAMPLE_HOLD.effect(delay_s=delay_s), np.zeros(1)))
    of_grid = [record for record in known if record.grid is not None]
    found += [_scanned(record, gimbals, span_s) for record in of_grid if record is not WARM_UP]
    for order in (settings["order"] for settings in TABLE_HARMONIC.listed(span_s)):
        for axis in gimbals:
            effect = TABLE_HARMONIC.effect(gimbals, order=order, axis=axis)
            name = f"{TABLE_HARMONIC.name} {order} {axis}"
            found.append(Candidate(name, effect, settings={"axis": axis, "order": order}))
    one_clock = _one_clock(runs)
    if one_clock is not None:
        found.append(Candidate(f"{BIAS_DRIFT.name} on", _on_one_clock(BIAS_DRIFT.effect(), one_clock)))
    warm_up = _scanned(WARM_UP, gimbals, span_s)
    found.append(warm_up)
    if one_clock is not None and WARM_UP.grid is not None and WARM_UP.grid.grid is not None:
        going_on = partial(_going_on, began_s=one_clock)
        start = WARM_UP.grid.grid(float(runs[-1].t_s[-1] - one_clock), 12)
        name, effect = f"{WARM_UP.name} on", going_on(warm_up.theta or 0.0)
        found.append(replace(warm_up, name=name, effect=effect, of=going_on, start=start))

    def step(at_s: float) -> Effect:
        return BIAS_STEP.effect(at_s=at_s)

    for run in {run.order: run for run in runs}.values():
        times = np.arange(run.t_s[0] + 4.0, run.t_s[-1] - 4.0, max(3.0, np.ptp(run.t_s) / _STEPS))
        if len(times):
            tries = {"run": run.order, "log_tries": float(np.log(len(times)))}
            found.append(Candidate.among(f"{BIAS_STEP.name} {run.order}", step, times, len(times) // 2, **tries))
    return found


def _going_on(tau_s: float, began_s: float) -> Effect:
    return _on_one_clock(WARM_UP.effect(time_constant_s=tau_s), began_s)


def _scanned(record: Record, gimbals: tuple[str, ...], span_s: float) -> Candidate:
    """Return the candidate of an effect whose one setting is searched for, beginning at a grid of values.

    ``gimbals`` are the axes of the table; ``span_s``, the length of the longest run, sets the grid of ten values,
    unless the setting has a fixed one. The candidate has the value at place ``begin`` of the setting. AssertionError
    for a record without a setting that has a grid.
    """
    setting = record.grid
    assert setting is not None
    assert setting.grid is not None

    def of(value: float) -> Effect:
        return record.effect(gimbals, **{setting.key: value})

    more = {"range_log": setting.range_log, "unit": setting.unit}
    return Candidate.among(record.name, of, setting.grid(span_s, 10), setting.begin, **more)


def _far_delays(by_motion_s: float) -> Floats:
    """Return the delays in s (n,), besides 0, at which a search begins; that by motion unless it is near one of
    them.
    """
    far = [-0.1, -0.05, 0.02, 0.05, 0.1]
    known = min(abs(by_motion_s - other) for other in (0.0, *far)) < _NEAR_S
    return np.array(far if known else sorted([*far, by_motion_s]))


def _delay_by_motion(runs: Sequence[Run]) -> float:
    """Return the delay in s at which the outputs follow another instrument best, the median over the runs."""
    lines = [following(run.data, run.recording.reference, run.recording.site) for run in runs]
    known = [line.delay_s for line in lines if line is not None]
    return float(np.median(known)) if known else 0.0


def _sensed(runs: Sequence[Run], delay_s: float) -> dict[str, Floats]:
    """Return by gyro the direction (3,) that it senses, with its scale, from least squares over all its runs.

    The output error is fitted by a bias, the body rate, and the effect of a delay of about ``delay_s``. Directions
    about which the body never turns keep the nominal value.
    """
    found = {}
    for name in dict.fromkeys(name for run in runs for name in run.array.names):
        rows = []
        for _, run, i in with_gyro(runs, name):
            one = np.column_stack([np.ones(len(run.t_s)), run.w_rps, run.columns(late(delay_s), i), run.z_rps[:, i]])
            rows.append(one * run.weight[:, None])
        whole = np.vstack(rows)
        scale = np.sqrt(np.mean(whole[:, :-1] ** 2, axis=0))
        scale[scale < 1e-12] = 1.0  # about an axis that never turns nothing is known
        x = np.linalg.lstsq(whole[:, :-1] / scale, whole[:, -1], rcond=1e-3)[0] / scale
        found[name] = np.asarray(run.array.p[i] + x[1:4])
    return found


def _one_clock(runs: Sequence[Run]) -> float | None:
    """Return when the first run began if all are on one clock, one after the other; None if they are not."""
    ordered = [[run for run in runs if run.order == order] for order in dict.fromkeys(run.order for run in runs)]
    ends = [(min(r.t_s[0] for r in part), max(r.t_s[-1] for r in part)) for part in ordered]
    follow = all(later[0] > earlier[1] for earlier, later in pairwise(ends))
    return float(ends[0][0]) if len(ends) > 1 and follow else None


def _on_one_clock(effect: Effect, began_s: float) -> Effect:
    """Return an effect of the time since the run began as one of the time since ``began_s``, when the first run
    began.
    """

    def columns(conditions: Conditions, axes: Axes) -> Floats:
        since = replace(conditions, t_s=np.concatenate([[began_s], conditions.t_s]))
        return effect.regressors(since, axes)[1:]

    return replace(effect, regressors=columns)


def _general_dependences(offers: frozenset[str], gimbals: tuple[str, ...], count: int) -> list[Candidate]:
    """Return the candidates for general dependences, which are to prove that there is an effect, but not which.

    These are rate, direction, acceleration and time; temperature and gravity if ``offers`` has them; direction and
    angles of the axes ``gimbals``. Their prior probability is small: that of one of ``count`` named effects, shared
    among them.
    """
    kinds: list[tuple[str, Effect]] = [
        ("rate", _own("rate", _of_rate, 5)),
        ("direction", _own("direction", _of_direction, 2)),
        ("acceleration", _own("acceleration", _of_acceleration, 4)),
        ("time", _own("time", _of_time, 4)),
    ]
    if "temperature" in offers:
        kinds.append(("temperature", _own("temperature", _of_temperature, 4)))
    if "specific force" in offers:
        kinds.append(("gravity", _law("gravity", "gx*gy; gy*gz; gz*gx; gx*gx - gy*gy; gz*gz")))
    if gimbals:
        of_axes = "; ".join(f"last(rate_{axis})" for axis in gimbals)
        kinds.append(("direction", _law("direction of the axes", of_axes)))
    found = [
        Candidate(f"general: {effect.name}", effect, -np.log(count) - np.log(3 * len(kinds)), depends_on=kind)
        for kind, effect in kinds
    ]
    angles: list[tuple[str, Effect]] = []
    for axis in gimbals:
        for order in _OTHER_ORDERS:
            law = f"cos({order}*angle_{axis}); sin({order}*angle_{axis})"
            angles.append((f"angle {order} {axis}", _law("angle", law, _AROUND)))
        for order in range(1, 7):  # errors of the angle reading: the reported rate is wrong in proportion to the rate
            law = f"u_{axis}*cos({order}*angle_{axis}); u_{axis}*sin({order}*angle_{axis})"
            angles.append((f"encoder {order} {axis}", _law("angle", law, 0.01, shared=True)))
    prior = -np.log(count) - np.log(3 * max(len(angles), 1))
    return found + [Candidate(f"general: {name}", effect, prior, depends_on="angle") for name, effect in angles]


@lru_cache
def _own(name: str, columns: Callable[[Conditions, Axes], Floats], count: int) -> Effect:
    parameters = tuple(Parameter(str(n + 1), "rad/s", _PICKED_UP) for n in range(count))
    return Record(name=name, parameters=parameters, regressors=lambda settings, *where: columns(*where)).effect()


@lru_cache
def _law(name: str, law: str, largest: float = _PICKED_UP, *, shared: bool = False) -> Effect:
    parameters = tuple(Parameter(str(n + 1), "rad/s", largest) for n in range(law.count(";") + 1))
    return Record(name=name, parameters=parameters, law=law, shared=shared).effect()


def _rate(conditions: Conditions, axes: Axes) -> tuple[Floats, float]:
    u = conditions.w_rps @ axes.p
    return u, max(float(np.abs(conditions.w_rps).max()), 1e-9)


def _of_rate(conditions: Conditions, axes: Axes) -> Floats:
    u, top = _rate(conditions, axes)
    x = u / top
    still = np.exp(-0.5 * (x / 0.02) ** 2)
    return np.column_stack([np.abs(x), x**2, x**3, x**4, still])


def _of_direction(conditions: Conditions, axes: Axes) -> Floats:
    u, top = _rate(conditions, axes)
    last = last_sign(u)
    return np.column_stack([last, last * (np.abs(u) < 0.02 * top)])


def _of_acceleration(conditions: Conditions, axes: Axes) -> Floats:
    u, top = _rate(conditions, axes)
    slope = conditions.wdot_rps2 @ axes.p
    steep = max(float(np.abs(conditions.wdot_rps2).max()), 1e-9)
    size = np.abs(conditions.wdot_rps2).max(axis=1) / steep
    x, a = u / top, slope / steep
    return np.column_stack([np.abs(a), a * np.abs(x), x * size, size])


def _of_time(conditions: Conditions, axes: Axes) -> Floats:
    x = 2 * (conditions.t_s - conditions.t_s[0]) / max(float(np.ptp(conditions.t_s)), 1e-9) - 1
    return np.column_stack([np.polynomial.legendre.Legendre.basis(n)(x) for n in (1, 2, 3, 4)])


def _of_temperature(conditions: Conditions, axes: Axes) -> Floats:
    """Return the columns (N, 4) of a dependence on temperature at N instants: three lags behind it, and its cube.

    All are zero if the temperature is unknown; ``axes`` are not used.
    """
    if conditions.temperature_c is None:
        return np.zeros((len(conditions.t_s), 4))
    rise = conditions.temperature_c - 25.0
    lags = []
    for lag_s in _LAGS_S:
        keep = np.exp([-conditions.period_s / lag_s])
        lags.append((follow(rise, keep) - rise) / 10)
    return np.column_stack([*lags, (rise / 20) ** 3])
