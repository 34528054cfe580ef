"""What is tried: the effects of the catalogue, and general dependences that stand for what is not in it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise

import numpy as np

from estimator.effects.catalogue import HARMONICS, catalogue
from estimator.effects.conditions import Conditions
from estimator.effects.constructed import NAME, last_sign
from estimator.effects.drift import bias_drift, bias_step, warm_up
from estimator.effects.dynamics import bandwidth, latency
from estimator.effects.effect import Axes, Effect, Parameter
from estimator.effects.scale import dead_band
from estimator.effects.site import earth_rate_upward
from estimator.effects.table import table_harmonic
from estimator.estimation.runs.run import Run
from estimator.estimation.undeclared import WITHIN_TURNS
from estimator.geometry.kinematics import AXES, GRAVITY_MPS2, into_body
from estimator.observations.turned import by_turns
from estimator.types import Floats

_BY_ITSELF = frozenset({"warm_up", "bias_step", "tone", "table_rate", "latency", "bandwidth"})
"""Effects of the catalogue that are looked for in a way of their own, and one that passes for scale factor errors."""
OF_TIME = frozenset({"warm_up", "bias_step", "bias_drift"})
"""Effects of which all gyros have the same columns."""
_OF_ENCODERS = ("table_harmonic", "dead_band")
_OTHER_ORDERS = (3, 5, 6)
# Log odds of an effect against the others before the data. What refines a simpler effect is rarer than that effect.
# A bias over temperature is in every data sheet; its gradient without it one part in a hundred may have, while beside
# it a gradient is no more than a lag between gyro and thermometer. Where a temperature is measured, a law of time with
# a free time constant stands behind it.
_EXPECTED = {
    "thermal_gradient": float(np.log(0.01)),
    "thermal_bias_quadratic": -1.5,
    "bandwidth": -1.5,
    "dead_band": -1.5,
    "bias_step": -1.5,
}
_EXPECTED_WITH_TEMPERATURE = {"warm_up": -1.5}
_EXPECTED_BESIDE = {"thermal_gradient": ("thermal_bias", -1.5)}
_WARM_UPS = float(np.log(3600.0 / 5.0))  # time constants of warm-up from a chip's to a housing's

_HELD = 6.0  # log odds of the delay of held samples against another delay: that they are held is seen in them
_PICKED_UP = float(np.radians(0.5))
_STEPS = 100  # instants in a run at which a step is looked for first
_LAG_S = 0.004  # where the time constant of a gyro's own low pass is looked for first
_LAGS_S = (15.0, 40.0, 120.0)


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """Something to try. ``name`` is unique, ``effect`` what it is called in results.

    ``depends_on`` is set for general dependences: they prove that something is there, not what. ``theta`` holds the
    value of what is not linear, in ``unit``; ``of`` makes the effect anew for another, ``start`` lists where to begin
    looking, ``range_log`` is the logarithm of the range it may have in nature. ``run`` is the recording of a step.
    ``by_size``: what is not linear is the effect's own size, its first parameter. ``sensed`` are the directions (3,)
    that gyros really sense, with their scale, in place of the nominal ones. ``log_prior`` is the logarithm of its
    share of the expectation; if the effect ``beside`` is in the model, it is so much ``likelier``.
    """

    name: str
    effect: Effect
    log_prior: float
    depends_on: str = ""
    theta: float | None = None
    of: Callable[[float], Effect] | None = None
    start: Floats | None = None
    run: int | None = None
    log_tries: float = 0.0
    unit: str = "s"
    range_log: float = 0.0
    beside: str = ""
    likelier: float = 0.0
    by_size: bool = False
    sensed: Mapping[str, Floats] = field(default_factory=dict)

    @property
    def evenly(self) -> bool:
        """Whether any value of what is not linear is as probable as any other, rather than any ratio."""
        return self.run is not None

    @property
    def called(self) -> str:
        """Name of the effect in results: that of its kind."""
        return self.effect.name.split(":")[0]

    @property
    def law(self) -> str:
        """The law of a constructed effect, empty for those of the catalogue."""
        return self.effect.name.partition(": ")[2] if self.called == NAME else ""

    @property
    def largest(self) -> Floats:
        """Largest plausible size of each parameter (p,)."""
        return np.array([p.largest for p in self.effect.parameters])

    def columns(self, run: Run, gyro: int) -> Floats:
        """Return the scaled columns (b, p) of gyro number ``gyro`` of a run. A step stays for all later recordings."""
        if self.run is not None and run.order != self.run:
            return np.full((len(run.t_s), 1), float(run.order > self.run)) * self.largest
        p = self.sensed.get(run.array.names[gyro])
        array = run.array
        axes = Axes(array.p[gyro] if p is None else p, array.j[gyro], array.k[gyro])
        return run.fold(self.effect.at(run.grid, axes)) * self.largest


def candidates_of(runs: Sequence[Run]) -> tuple[list[Candidate], dict[str, str]]:
    """Return all that can be tried on these runs, and what cannot, with the reason."""
    offers = frozenset.intersection(*(run.grid.offers for run in runs))
    gimbals = runs[0].grid.gimbals
    span_s = max(float(run.t_s[-1] - run.t_s[0]) for run in runs)
    left_out: dict[str, str] = {}
    if not gimbals:
        left_out["table_harmonic"] = "the recordings hold no gimbals"
    foreign = any(by_turns(run.recording.reference) for run in runs)
    if foreign:
        left_out["bandwidth"] = "another instrument has a lag of its own: a delay against it is the sum of all lags"
    listed = _catalogue(runs, gimbals, span_s)
    if foreign and gimbals:
        listed = [candidate for candidate in listed if candidate.called not in _OF_ENCODERS]
        left_out |= dict.fromkeys(_OF_ENCODERS, "an encoder that is read from outside may have the same by itself")
    if any(run.stated_rps for run in runs):
        listed = [candidate for candidate in listed if candidate.called not in WITHIN_TURNS]
        why = "a turn from rest to rest comes to the same angle however late it is felt"
        left_out |= dict.fromkeys(WITHIN_TURNS, why)
    chosen = []
    for candidate in listed:
        missing = candidate.effect.needs - offers
        if missing:
            left_out[candidate.called] = f"the recordings hold no {' and no '.join(sorted(missing))}"
        else:
            chosen.append(candidate)
    if "temperature" in offers:
        spread = max(float(np.ptp(run.grid.temperature_c)) for run in runs if run.grid.temperature_c is not None)
        if spread < 0.05:
            for candidate in [c for c in chosen if "temperature" in c.effect.needs]:
                chosen.remove(candidate)
                left_out[candidate.called] = "the temperature does not change"
    count = len({c.called for c in chosen})
    of_kind = {c.called: sum(o.called == c.called for o in chosen) for c in chosen}
    expected = {**_EXPECTED, **(_EXPECTED_WITH_TEMPERATURE if "temperature" in offers else {})}
    chosen = [
        replace(c, log_prior=c.log_prior + expected.get(c.called, 0.0) - np.log(count) - np.log(of_kind[c.called]))
        for c in chosen
    ]
    for n, candidate in enumerate(chosen):
        if candidate.called in _EXPECTED_BESIDE:
            beside, then = _EXPECTED_BESIDE[candidate.called]
            chosen[n] = replace(candidate, beside=beside, likelier=then - expected[candidate.called])
    return [*chosen, *_general(offers, gimbals, count)], left_out


def _catalogue(runs: Sequence[Run], gimbals: tuple[str, ...], span_s: float) -> list[Candidate]:
    listed = [effect for effect in catalogue(gimbals, span_s) if effect.name not in _BY_ITSELF]
    found = [Candidate(effect.name, effect, 0.0) for effect in listed if not effect.name.startswith("table_harmonic")]
    far_s = (
        np.array([-0.1, -0.05, 0.02, 0.05, 0.1]) if any(by_turns(r.recording.reference) for r in runs) else np.empty(0)
    )
    if not gimbals and all(run.recording.site is None and not run.turns for run in runs):
        found = [c for c in found if c.called != "earth_rate"]
        found.append(Candidate("earth_rate", earth_rate_upward(), 0.0))
    late = partial(_by_size, sensed=_sensed(runs))
    found.append(late("latency", latency, np.concatenate([[0.0], far_s])))
    if not len(far_s):
        found.append(Candidate("bandwidth", bandwidth(_LAG_S), 0.0))
    if any(run.held > 1 for run in runs):

        def hold(delay_s: float) -> Effect:
            return replace(latency(delay_s), name="sample_hold")

        found.append(replace(late("sample_hold", hold, np.zeros(1)), log_prior=_HELD))
    bands = np.radians(np.geomspace(0.01, 3.0, 12))
    found.append(
        Candidate(
            "dead_band",
            dead_band(float(bands[6])),
            0.0,
            theta=float(bands[6]),
            of=dead_band,
            start=bands,
            range_log=5.0,
            unit="rad/s",
        )
    )
    for order in HARMONICS:
        for axis in gimbals:
            effect = replace(table_harmonic(gimbals, order, (axis,)), name="table_harmonic")
            parameters = tuple(
                Parameter(f"{part} of {order} {axis}", "rad/s", p.largest)
                for part, p in zip(("cosine", "sine"), effect.parameters, strict=True)
            )
            found.append(Candidate(f"table_harmonic {order} {axis}", replace(effect, parameters=parameters), 0.0))
    one_clock = _one_clock(runs)
    if one_clock is not None:
        found.append(Candidate("bias_drift on", _on_one_clock(bias_drift(), one_clock), 0.0))
    taus = np.geomspace(8.0, max(span_s / 1.5, 20.0), 10)
    found.append(
        Candidate(
            "warm_up",
            warm_up(float(taus[4])),
            0.0,
            theta=float(taus[4]),
            of=warm_up,
            start=taus,
            range_log=_WARM_UPS,
        )
    )
    if one_clock is not None:
        began = one_clock

        def going_on(tau_s: float) -> Effect:
            return _on_one_clock(warm_up(tau_s), began)

        found.append(
            Candidate(
                "warm_up on",
                going_on(float(taus[4])),
                0.0,
                theta=float(taus[4]),
                of=going_on,
                start=np.geomspace(8.0, max((runs[-1].t_s[-1] - began) / 1.5, 20.0), 12),
                range_log=_WARM_UPS,
            )
        )
    for run in {run.order: run for run in runs}.values():
        times = np.arange(run.t_s[0] + 4.0, run.t_s[-1] - 4.0, max(3.0, np.ptp(run.t_s) / _STEPS))
        if len(times):
            found.append(
                Candidate(
                    f"bias_step {run.order}",
                    bias_step(float(times[len(times) // 2])),
                    0.0,
                    theta=float(times[len(times) // 2]),
                    of=bias_step,
                    start=times,
                    run=run.order,
                    log_tries=float(np.log(len(times))),
                )
            )
    return found


def _by_size(name: str, of: Callable[[float], Effect], start: Floats, *, sensed: Mapping[str, Floats]) -> Candidate:
    first = float(start[0])
    return Candidate(name, of(first), 0.0, theta=first, of=of, start=start, by_size=True, sensed=sensed)


def _sensed(runs: Sequence[Run]) -> dict[str, Floats]:
    """Return the direction (3,) that each gyro senses, with its scale: what it puts out late is all of that.

    Least squares of the output error on bias, body rate, and a delay of the nominal output.
    """
    found = {}
    for name in dict.fromkeys(name for run in runs for name in run.array.names):
        rows = []
        for run in (run for run in runs if name in run.array.names):
            i = run.array.names.index(name)
            one = np.column_stack([np.ones(len(run.t_s)), run.w_rps, run.columns(latency(), i), run.z_rps[:, i]])
            rows.append(one * run.weight[:, None])
        whole = np.vstack(rows)
        scale = np.maximum(np.sqrt(np.mean(whole[:, :-1] ** 2, axis=0)), 1e-12)
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
    """Return an effect of the time since a run began as one of the time since the first of them."""

    def columns(conditions: Conditions, axes: Axes) -> Floats:
        since = replace(conditions, t_s=np.concatenate([[began_s], conditions.t_s]))
        return effect.regressors(since, axes)[1:]

    return replace(effect, regressors=columns)


def _general(offers: frozenset[str], gimbals: tuple[str, ...], count: int) -> list[Candidate]:
    kinds: list[tuple[str, Effect]] = [
        ("rate", _own("rate", _of_rate, 5)),
        ("direction", _own("direction", _of_direction, 2)),
        ("acceleration", _own("acceleration", _of_acceleration, 4)),
        ("time", _own("time", _of_time, 4)),
    ]
    if "temperature" in offers:
        kinds.append(("temperature", _own("temperature", _of_temperature, 4)))
    if "specific force" in offers:
        kinds.append(("gravity", _own("gravity", _of_gravity, 5)))
    if gimbals:
        kinds.append(("direction", _own("direction of the axes", _of_axis_direction, len(gimbals))))
    found = [
        Candidate(f"general: {effect.name}", effect, -np.log(count) - np.log(3 * len(kinds)), depends_on=kind)
        for kind, effect in kinds
    ]
    angles: list[tuple[str, Effect]] = []
    for axis_number, axis in enumerate(gimbals):
        for order in _OTHER_ORDERS:
            angles.append((f"angle {order} {axis}", replace(table_harmonic(gimbals, order, (axis,)), name="angle")))
        for order in range(1, 7):
            angles.append((f"encoder {order} {axis}", _encoder(gimbals, axis_number, order)))
    prior = -np.log(count) - np.log(3 * max(len(angles), 1))
    return found + [Candidate(f"general: {name}", effect, prior, depends_on="angle") for name, effect in angles]


def _own(name: str, columns: Callable[[Conditions, Axes], Floats], count: int) -> Effect:
    parameters = tuple(Parameter(str(n + 1), "rad/s", _PICKED_UP) for n in range(count))
    return Effect(name, parameters, shared=False, shown_by="", confused_with=(), regressors=columns)


def _encoder(gimbals: tuple[str, ...], column: int, order: int) -> Effect:
    """Return an error of the table's angle reading: it makes the reported rate wrong in proportion to the rate."""

    def columns(conditions: Conditions, axes: Axes) -> Floats:
        unit = np.zeros((len(conditions.t_s), 3))
        unit[:, AXES.index(gimbals[column])] = conditions.rate_rps[:, column]
        part = into_body(unit, conditions.angle_rad[:, column + 1 :], gimbals[column + 1 :]) @ axes.p
        turned = order * conditions.angle_rad[:, column]
        return np.column_stack([part * np.cos(turned), part * np.sin(turned)])

    parameters = tuple(Parameter(part, "1", 0.01) for part in ("cosine", "sine"))
    return Effect("angle", parameters, shared=True, shown_by="", confused_with=(), regressors=columns)


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


def _of_axis_direction(conditions: Conditions, axes: Axes) -> Floats:
    return np.column_stack([last_sign(column) for column in conditions.rate_rps.T])


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
    if conditions.temperature_c is None:
        return np.zeros((len(conditions.t_s), 4))
    rise = conditions.temperature_c - 25.0
    from scipy.signal import lfilter

    lags = []
    for lag_s in _LAGS_S:
        keep = np.exp(-conditions.period_s / lag_s)
        slow, _ = lfilter([1 - keep], [1, -keep], rise - rise[0], zi=[0.0])
        lags.append((slow - (rise - rise[0])) / 10)
    return np.column_stack([*lags, (rise / 20) ** 3])


def _of_gravity(conditions: Conditions, axes: Axes) -> Floats:
    f = conditions.specific_force_mps2 / GRAVITY_MPS2
    x, y, z = f.T
    return np.column_stack([x * y, y * z, z * x, x * x - y * y, z * z])
