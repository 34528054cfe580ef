"""The error model of a type of gyro: the effects that an investigation added, and how large they typically are.

An investigation finds effects on one device. What it says of the next device of the same type is which effects to
expect, the value of what is not linear in them (a time constant, a frequency), and their typical size: the prior under
which states and effects of that device are then estimated together. The file is JSON, in SI units; the file that
``station investigate -o`` writes holds the same text.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from estimator.effects.constructed import NAME as CONSTRUCTED
from estimator.effects.constructed import axes_of, constructed
from estimator.effects.drift import bias_drift, warm_up
from estimator.effects.dynamics import acceleration_sensitivity, bandwidth, latency, tone
from estimator.effects.effect import Effect
from estimator.effects.scale import dead_band, scale_asymmetry, scale_cubic, scale_quadratic
from estimator.effects.site import earth_rate, g_sensitivity
from estimator.effects.table import table_axes, table_harmonic, table_rate
from estimator.effects.thermal import thermal_bias, thermal_bias_quadratic, thermal_gradient, thermal_scale
from estimator.errors import EstimatorError
from estimator.recordings.safe_open import probe
from estimator.types import Floats

FORMAT = "turntable-error-model"
FORMAT_VERSION = 1
WHERE = "investigation/error_model"
"""Where the file of an investigation (HDF5) holds the text of the model."""
_MOST_CHARACTERS = 1_000_000


class ModelError(EstimatorError):
    """A file that holds no error model, or a model that a recording cannot be estimated with."""


@dataclass(frozen=True, slots=True)
class Size:
    """What is expected of one parameter of an effect: mean and standard deviation in its SI unit."""

    name: str
    unit: str
    mean: float
    sd: float


@dataclass(frozen=True, slots=True)
class KnownEffect:
    """An effect of the catalogue, or one constructed, as a type of gyro has it.

    ``settings`` hold what is not linear in it, by name: "time_constant_s", "frequency_hz", "width_rps", "order",
    "axis", the "law" of one constructed. ``sizes`` are by parameter. ``found`` is what they come from: by gyro, or by
    "all gyros" for a shared effect, value and standard deviation of each parameter.
    """

    name: str
    shared: bool
    sizes: tuple[Size, ...]
    settings: Mapping[str, float | int | str] = field(default_factory=dict)
    found: Mapping[str, tuple[tuple[float, float], ...]] = field(default_factory=dict)

    @property
    def mean(self) -> Floats:
        """Expected value of each parameter (p,)."""
        return np.array([size.mean for size in self.sizes])

    @property
    def sd(self) -> Floats:
        """Expected standard deviation of each parameter (p,)."""
        return np.array([size.sd for size in self.sizes])

    @property
    def called(self) -> str:
        """Name and settings, different for each effect of a model."""
        return " ".join([self.name, *(_WORDS[key](self.settings[key]) for key in SETTINGS.get(self.name, ()))])

    @property
    def law(self) -> str:
        """The law of a constructed effect, empty for those of the catalogue."""
        return str(self.settings.get("law", ""))

    @property
    def axes(self) -> tuple[str, ...]:
        """Axes of the table that it names."""
        return axes_of(self.law) if self.law else (str(self.settings["axis"]),) if "axis" in self.settings else ()

    def effect(self, gimbals: Sequence[str]) -> Effect:
        """Return the effect, made by the catalogue's function, on a table with these gimbals (none: no table).

        The sizes stand in the place of the largest plausible ones. Raises ModelError if the table does not fit.
        """
        lacking = [axis for axis in self.axes if axis not in gimbals]
        if lacking and gimbals:
            raise ModelError(f"the model has {self.called}, and the table has no axis {', '.join(lacking)}")
        # Without a table it is refused for what it needs.
        made = MAKERS[self.name](self.settings, self.axes if lacking else gimbals)
        if len(made.parameters) != len(self.sizes):
            if not gimbals:
                return made
            raise ModelError(
                f"the model's {self.called} has {len(self.sizes)} parameters, but {len(made.parameters)} on a table "
                f"with the axes {', '.join(gimbals)}: it was found on another table; leave out --model"
            )
        sizes = zip(made.parameters, self.sizes, strict=True)
        return replace(made, parameters=tuple(replace(p, name=s.name, largest=s.sd) for p, s in sizes))


@dataclass(frozen=True, slots=True)
class ErrorModel:
    """Effects beyond the four states, and effects that were found but say nothing of another device, with the reason.

    ``text`` gives the file's content, ``parse`` and ``read`` bring it back.
    """

    effects: tuple[KnownEffect, ...]
    left_out: Mapping[str, str] = field(default_factory=dict)

    def made(self, gimbals: Sequence[str], offers: frozenset[str]) -> list[Effect]:
        """Return the effects for a recording that holds what ``offers`` names; ModelError if one needs more."""
        effects = [known.effect(gimbals) for known in self.effects]
        for what, remedy in _REMEDIES.items():
            lacking = [known.called for known, e in zip(self.effects, effects, strict=True) if what in e.needs - offers]
            if lacking:
                raise ModelError(f"the model has {', '.join(lacking)}, for which {remedy}, or leave out --model")
        return effects

    @property
    def needs_temperature(self) -> bool:
        """Whether an effect of it needs the temperature of the gyros."""
        return any("temperature" in MAKERS[e.name](e.settings, ("z", "y", "x")).needs for e in self.effects)

    def text(self) -> str:
        """Return the model as JSON."""
        effects = [
            {
                "effect": known.name,
                **known.settings,
                "shared": known.shared,
                "parameters": [{"name": s.name, "unit": s.unit, "mean": s.mean, "sd": s.sd} for s in known.sizes],
                "found": {who: [list(pair) for pair in pairs] for who, pairs in known.found.items()},
            }
            for known in self.effects
        ]
        whole = {"format": FORMAT, "format_version": FORMAT_VERSION, "effects": effects, "left_out": {**self.left_out}}
        return json.dumps(whole, indent=1)

    @classmethod
    def parse(cls, text: str, where: str) -> ErrorModel:
        """Return the model that a text holds; ModelError, with what is wrong, if there is none."""
        try:
            whole = json.loads(text)
        except (ValueError, RecursionError):
            raise ModelError(f"{where} is no error model: {_GIVE}") from None
        if not isinstance(whole, dict) or whole.get("format") != FORMAT:
            raise ModelError(f"{where} is no error model: {_GIVE}")
        if whole.get("format_version") != FORMAT_VERSION:
            raise ModelError(
                f"{where} has version {whole.get('format_version')} of the format of error models, and this station "
                f"reads version {FORMAT_VERSION}: investigate again with this version"
            )
        try:
            effects = tuple(_read_effect(entry, where) for entry in whole["effects"])
            left_out = {str(name): str(reason) for name, reason in whole.get("left_out", {}).items()}
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ModelError(f"{where} is a damaged error model ({type(error).__name__}: {error}): {_GIVE}") from None
        if len({known.called for known in effects}) < len(effects):
            raise ModelError(f"{where} is a damaged error model: it has an effect twice")
        return cls(effects, left_out)

    @classmethod
    def read(cls, path: Path) -> ErrorModel:
        """Return the model in a file: JSON, or what an investigation wrote (HDF5). ModelError if it holds none."""
        try:
            if not path.is_file():
                raise ModelError(f"{path} is not a file: {_GIVE}")
            if h5py.is_hdf5(path):
                return cls.parse(_text_in(path), str(path))
            text = path.read_text(encoding="utf-8") if path.stat().st_size <= _MOST_CHARACTERS else ""
        except UnicodeDecodeError:
            text = ""
        except OSError as error:
            raise ModelError(f"{path} cannot be read: {error}") from None
        return cls.parse(text, str(path))


_GIVE = "give the file that `station investigate ... -o FILE` wrote"

_REMEDIES = {
    "temperature": "the recording must hold the temperature of the gyros: record it with the rates",
    "gimbals": "the recording must be of a table with angles: drive the gyros on one",
    "specific force": "the recording must hold the specific force: record accelerometers, or use a table",
}

MAKERS: Mapping[str, Callable[[Mapping[str, Any], Sequence[str]], Effect]] = {
    "earth_rate": lambda s, g: earth_rate(),
    "g_sensitivity": lambda s, g: g_sensitivity(),
    "thermal_bias": lambda s, g: thermal_bias(),
    "thermal_bias_quadratic": lambda s, g: thermal_bias_quadratic(),
    "thermal_scale": lambda s, g: thermal_scale(),
    "thermal_gradient": lambda s, g: thermal_gradient(),
    "bias_drift": lambda s, g: bias_drift(),
    "warm_up": lambda s, g: warm_up(s["time_constant_s"]),
    "scale_asymmetry": lambda s, g: scale_asymmetry(),
    "scale_quadratic": lambda s, g: scale_quadratic(),
    "scale_cubic": lambda s, g: scale_cubic(),
    "dead_band": lambda s, g: dead_band(s["width_rps"]),
    "latency": lambda s, g: latency(),
    "sample_hold": lambda s, g: replace(latency(), name="sample_hold"),
    "bandwidth": lambda s, g: bandwidth(),
    "acceleration_sensitivity": lambda s, g: acceleration_sensitivity(),
    "table_harmonic": lambda s, g: replace(table_harmonic(g, s["order"], (s["axis"],)), name="table_harmonic"),
    "table_axes": lambda s, g: table_axes(g),
    "table_rate": lambda s, g: table_rate(g),
    "tone": lambda s, g: tone(s["frequency_hz"]),
    CONSTRUCTED: lambda s, g: constructed(s["law"]),
}
"""How the catalogue makes each effect, from its settings and the gimbals of a table."""

SETTINGS = {
    "warm_up": ("time_constant_s",),
    "dead_band": ("width_rps",),
    "table_harmonic": ("order", "axis"),
    "tone": ("frequency_hz",),
    CONSTRUCTED: ("law",),
}

_WORDS: Mapping[str, Callable[[Any], str]] = {
    "time_constant_s": "{:g} s".format,
    "frequency_hz": "{:g} Hz".format,
    "width_rps": lambda width: f"{np.degrees(width):.3g} deg/s",
    "order": str,
    "axis": str,
    "law": str,
}


def _read_effect(entry: Mapping[str, Any], where: str) -> KnownEffect:
    name = str(entry["effect"])
    if name not in MAKERS:
        raise ModelError(
            f"{where} has the effect {name}, which this station's catalogue does not know: use the version of the "
            "station that found it, or investigate again"
        )
    settings: dict[str, float | int | str] = {}
    for key in SETTINGS.get(name, ()):
        value = entry[key]
        settings[key] = _READ[key](value) if key in _READ else _positive(key, value)
    sizes = tuple(
        Size(str(p["name"]), str(p["unit"]), _finite("mean", p["mean"]), _positive("sd", p["sd"]))
        for p in entry["parameters"]
    )
    found = {
        str(who): tuple((_finite("found", value), _finite("found", sd)) for value, sd in pairs)
        for who, pairs in entry.get("found", {}).items()
    }
    known = KnownEffect(name, bool(entry["shared"]), sizes, settings, found)
    made = MAKERS[name](settings, (str(settings.get("axis", "z")),))
    units = [parameter.unit for parameter in made.parameters]
    if known.shared != made.shared or (name not in _OF_GIMBALS and units != [size.unit for size in sizes]):
        raise ValueError(f"{name} of the catalogue has other parameters")
    return known


_READ: Mapping[str, Callable[[Any], float | int | str]] = {"axis": str, "order": int, "law": str}
_OF_GIMBALS = ("table_axes", "table_rate")  # the number of their parameters follows the table


def _finite(key: str, value: object) -> float:
    number = float(value)  # type: ignore[arg-type]
    if not np.isfinite(number):
        raise ValueError(f"{key} is {value}")
    return number


def _positive(key: str, value: object) -> float:
    number = _finite(key, value)
    if number <= 0:
        raise ValueError(f"{key} is {value}")
    return number


def _text_in(path: Path) -> str:
    """Return the text of the model in the file of an investigation, read by a child process first."""
    probe(path)
    with h5py.File(path, "r") as file:
        held = file.get(WHERE)
        if not isinstance(held, h5py.Dataset) or held.shape != ():
            raise ModelError(f"{path} holds no error model: {_GIVE}, as of this version")
        value = held[()]
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
