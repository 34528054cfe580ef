"""The effect: an error that the four states of a gyro do not cover, as one record of all knowledge about it.

The output of gyro i gains ``+ sum of parameter * phi`` (rad/s), phi being the columns of ``Effect.columns``. A
``Record`` says what holds on any table: the law, what it may depend on in a non-linear way (a time constant, an
instant, a frequency), how it is looked for, kept and undone. An ``Effect`` is one of these on some table, its settings
at some values. A file of a family holds its records; ``catalogue`` names them all.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from typing import Any

import numpy as np

from estimator.effects.conditions import Axes, Conditions
from estimator.effects.law import VARIABLES, LawError, columns_of, functions_of, needs_of, parsed, variables_of
from estimator.errors import EstimatorError
from estimator.geometry.array import SensorArray
from estimator.packaged import packaged_toml, sentence
from estimator.types import Floats

Value = float | int | str
Settings = Mapping[str, Value]
Regressors = Callable[[Conditions, Axes], Floats]
_UNSTEADY = frozenset({"lag", "play", "last", "sign", "sqrt", "/"})
"""Functions of the rate that no iteration undoes: with memory, or of a slope without limit."""
_IMPLAUSIBLE = 2.0  # of the largest plausible size: larger, it is something else


def _none(conditions: Conditions, axes: Axes) -> Floats:
    return np.empty((len(conditions.t_s), 0))


class EffectError(EstimatorError):
    """An invalid record of an effect; the message says what it lacks."""


class Kind(StrEnum):
    """How an effect is handled."""

    LAW = "law"
    NOISE = "noise"
    SAMPLES = "fault of the data"


class Acts(StrEnum):
    """Where in the output an effect acts that is corrected."""

    ADDED = "whatever the rate"
    RATE = "by the rate, undone by iteration"
    MOTION = "by the rate as it is without this effect, its past and its change"
    LAG = "as a lag of the output"
    STAMPS = "as a delay of the stamps"


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of an effect: its SI unit, and the largest size plausible for real gyros and tables.

    The name may contain settings in braces.
    """

    name: str
    unit: str
    largest: float


def positive(key: str, value: object) -> float:
    """Return a value as a positive number; ValueError with its key if it is none."""
    number = float(value)  # type: ignore[arg-type]
    if not math.isfinite(number) or number <= 0:
        raise ValueError(f"{key} is {value}")
    return number


@dataclass(frozen=True, slots=True)
class Setting:
    """A non-linear setting of an effect: ``key`` in models ("" if not stored), name ("" if it is stated), unit.

    ``text`` formats a value, ``read`` checks one of a file. ``grid(span_s, count)`` returns the values to search from,
    starting with number ``begin``; ``range_log`` is the logarithm of its range in nature.
    """

    key: str
    name: str
    unit: str
    text: Callable[[Any], str] = str
    read: Callable[[str, Any], Value] = positive
    grid: Callable[[float, int], Floats] | None = None
    begin: int = 4
    range_log: float = 0.0


@dataclass(frozen=True, slots=True)
class Odds:
    """Log odds of an effect relative to the others before the data.

    ``warm`` applies where a temperature was measured; ``beside`` names an effect and the odds if that one is in the
    model.
    """

    log: float = 0.0
    warm: float | None = None
    beside: tuple[str, float] | None = None


def of_plausible_size(sizes: Floats) -> bool:
    """Return whether sizes (gyros, parameters) are plausible together, in shares of the largest plausible ones."""
    return bool(np.sqrt(np.mean(np.square(sizes))) < _IMPLAUSIBLE)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Record:
    """All that is known about an effect.

    - ``parameters`` in order, or a function of the table's axes and the settings that returns them. ``law`` (see
      ``law``) has a term for each, settings in braces; an effect without a law has ``regressors``, which return the
      columns of one gyro (N, parameters) from settings, conditions and axes, and a ``formula`` for people. ``settings``
      are its non-linear ones.
    - ``shared``: one set of parameters for all gyros (a cause in table, site or clock) instead of one per gyro.
      ``shown_by`` says what excites it, ``confused_with`` names effects that often look alike.
    - ``depends_on`` is the quantity on which a residual with this effect depends; ``suspected_of`` lists quantities
      whose residuals may contain it. ``needs`` names data beyond rates and those of the law: "temperature", "gimbals"
      (angles of the table's axes), "specific force". ``odds`` are its prior odds. It is ``searched`` for as it stands
      unless ``tracing`` has another way; ``plausible`` says whether sizes can be real.
    - ``planned``: a plan states its smallest visible size. ``listed(span_s)`` gives the settings that stand for it;
      ``assumed`` those that share its variance if it is undeclared, for the first to the last instant. ``power`` is
      that of the rate with which it grows.
    - ``acts`` says how it is corrected, if the law does not; ``left_out`` why it is not corrected, ``not_kept`` why it
      does not apply to other devices of the type, ``not_live`` why a live estimate ignores it. ``of_table``: an error
      of the table, whose axes give its parameters; ``of_encoders``: an external encoder may have the same;
      ``within_turns``: it vanishes over a turn from rest to rest; ``alike``: all gyros have the same columns;
      ``any_phase``: the ratio of its parameters differs between gyros.
    - ``label``, with settings in braces, replaces the name where that is ambiguous. ``display`` maps SI units without a
      usual display unit to (unit, factor). ``origin`` is the file or package it came from, "" if built in.
    """

    name: str
    parameters: tuple[Parameter, ...] | Callable[[Sequence[str], Settings], tuple[Parameter, ...]]
    law: str = ""
    regressors: Callable[[Settings, Conditions, Axes], Floats] | None = None
    formula: str = ""
    kind: Kind = Kind.LAW
    shared: bool = False
    shown_by: str = ""
    confused_with: tuple[str, ...] | Callable[[Settings], tuple[str, ...]] = ()
    settings: tuple[Setting, ...] = ()
    depends_on: str = ""
    suspected_of: tuple[str, ...] = ()
    needs: frozenset[str] = frozenset()
    odds: Odds = Odds()
    searched: bool = True
    plausible: Callable[[Floats], bool] = of_plausible_size
    planned: bool = True
    listed: Callable[[float], tuple[Settings, ...]] = lambda duration_s: ({},)
    assumed: Callable[[float, float], Sequence[Settings]] | None = None
    power: int = 1
    acts: Acts | None = None
    left_out: str = ""
    not_kept: str = ""
    not_live: str = ""
    of_table: bool = False
    of_encoders: bool = False
    within_turns: bool = False
    alike: bool = False
    any_phase: bool = False
    label: str = ""
    display: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    origin: str = ""

    @property
    def kept_settings(self) -> tuple[Setting, ...]:
        """Settings that a model stores."""
        return tuple(setting for setting in self.settings if setting.key)

    @property
    def grid(self) -> Setting | None:
        """The setting that is searched for over many values, None without one."""
        return next((setting for setting in self.settings if setting.grid is not None), None)

    def effect(self, gimbals: Sequence[str] = (), **settings: Value) -> "Effect":
        """Return the effect for a table with ``gimbals``, its axes, and with ``settings`` by key.

        The settings are inserted into law, label and names of parameters. An effect without a law has the record's
        regressors, or none. LawError if the law is invalid, KeyError if a setting is missing.
        """
        own = self.parameters if isinstance(self.parameters, tuple) else self.parameters(gimbals, settings)
        law = self.law.format(**settings) if settings else self.law
        needs = self.needs
        columns = partial(self.regressors, settings) if self.regressors else _none
        if law:
            needs |= needs_of(law)
            columns = partial(columns_of, law)
        alike = self.confused_with if isinstance(self.confused_with, tuple) else self.confused_with(settings)
        named = tuple(Parameter(p.name.format(**settings), p.unit, p.largest) for p in own)
        return Effect(
            name=(self.label or self.name).format(**settings),
            parameters=named,
            regressors=columns,
            needs=needs,
            record=self,
            law=law,
            confused_with=alike,
        )

    def check(self) -> None:
        """Raise EffectError, with the reason, if the station cannot work with this record.

        Checked are the name, the types of tuples, SI units and sizes of parameters, whether the law can be read and has
        a term for each parameter, and that an effect without a law has regressors and says how it is corrected or why
        not.
        """
        if not re.fullmatch("[a-z][a-z0-9_]*", self.name):
            raise EffectError(f"the effect {self.name!r} has no name of small letters, digits and underscores")
        for key in ("parameters", "confused_with", "suspected_of"):
            if not (isinstance(value := getattr(self, key), tuple) or callable(value)):
                raise EffectError(f"the effect {self.name}: {key}: write a tuple, (..., )")
        for own in self.parameters if isinstance(self.parameters, tuple) else ():
            if re.search("deg|ppm|%", own.unit):
                raise EffectError(f"the effect {self.name}: {own.unit!r} of {own.name} is no SI unit: write rad, K, 1")
            if not (isinstance(own.largest, (int, float)) and 0 < own.largest < math.inf):
                raise EffectError(sentence("effects.no_size", effect=self.name, parameter=own.name, size=own.largest))
        for settings in self.listed(1.0) if self.law else ():
            try:
                terms, count = self.effect(("z",), **settings).parameters, len(parsed(self.law.format(**settings)))
            except (LawError, KeyError) as error:
                raise EffectError(f"the effect {self.name} has no law: {error}") from None
            if count != len(terms):
                raise EffectError(f"the law of the effect {self.name} has {count} terms for {len(terms)} parameters")
        if self.kind is Kind.LAW and not self.law:
            if self.regressors is None:
                raise EffectError(f"the effect {self.name} has neither a law nor regressors")
            if not (self.acts or self.left_out or self.not_kept):
                raise EffectError(f"the effect {self.name} says neither how it is undone nor why not: acts, left_out")


@dataclass(kw_only=True, frozen=True, slots=True)
class Effect:
    """An effect for one table, with values for its settings; its ``law`` has them inserted, "" if it has none.

    ``regressors`` returns the columns of one gyro (N, parameters). ``needs`` names the data they require.
    """

    name: str
    parameters: tuple[Parameter, ...]
    regressors: Regressors
    needs: frozenset[str]
    record: Record
    law: str = ""
    confused_with: tuple[str, ...] = ()

    @property
    def shared(self) -> bool:
        """Whether all gyros have one set of its parameters."""
        return self.record.shared

    @property
    def largest(self) -> Floats:
        """Largest plausible size of each parameter (p,)."""
        return np.array([parameter.largest for parameter in self.parameters])

    def columns(self, conditions: Conditions, array: SensorArray, gyro: int) -> Floats:
        """Return the regressors (N, parameters) of gyro number ``gyro``: rad/s per unit of each parameter."""
        return self.at(conditions, Axes(array.p[gyro], array.j[gyro], array.k[gyro]))

    def at(self, conditions: Conditions, axes: Axes) -> Floats:
        """Return the regressors (N, parameters) of a gyro with these axes, in the order of the parameters."""
        return self.regressors(conditions, axes).reshape(len(conditions.t_s), len(self.parameters))

    @property
    def acts(self) -> Acts | None:
        """How it is corrected; None if it is not.

        Without a law, or left out of corrections, as its record says. Else by the law: effects that need neither rate
        nor acceleration are subtracted; effects with acceleration, temperature change or memory are computed once from
        the motion, as iteration must not repeat them; all others are solved with the rate.
        """
        if self.record.left_out or not self.law:
            return self.record.acts
        names, functions = variables_of(self.law), functions_of(self.law)
        kinds = {VARIABLES[name][0] for name in names}
        if not kinds & {"rate", "acceleration"}:
            return Acts.ADDED
        return Acts.MOTION if "acceleration" in kinds or "Tdot" in names or functions & _UNSTEADY else Acts.RATE


def family(name: str, /, **coded: dict[str, Any]) -> tuple[Record, ...]:
    """Return the effects of the family file NAME.toml in its order; ``coded`` has by effect what only code can define.

    Fields in ``coded`` replace those of the file; effects that the file lacks are ignored.
    """
    found = []
    for effect, facts in packaged_toml("estimator.effects", f"{name}.toml").items():
        read = {key: _READ[key](value) if key in _READ else value for key, value in facts.items()}
        found.append(Record(name=effect, **read | coded.get(effect, {})))
    return tuple(found)


def _parameter(name: str, unit: str, largest: float, angle: str = "") -> Parameter:
    return Parameter(name, unit, float(np.radians(largest)) if angle == "deg" else largest)


_READ: Mapping[str, Callable[[Any], Any]] = {
    "parameters": lambda rows: tuple(_parameter(*row) for row in rows),
    "settings": lambda rows: tuple(Setting(**{**row, "text": row.get("text", "{}").format}) for row in rows),
    "odds": lambda odds: Odds(**odds),
    "needs": frozenset,
    "kind": Kind,
    "acts": lambda name: Acts[name],
    "listed": lambda rows: lambda duration_s: tuple(rows),
    "assumed": lambda rows: lambda first_s, last_s: rows,
    **dict.fromkeys(("confused_with", "suspected_of"), tuple),
}
