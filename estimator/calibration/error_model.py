"""The error model of a type of device: the effects that an investigation added, and how large they typically are.

An investigation finds effects on one device. What it says of the next device of the same type is which effects to
expect, the value of what is not linear in them (a time constant, a frequency), and their typical size: the prior under
which states and effects of that device are then estimated together. The file is JSON, in SI units; the file that
``station investigate -o`` writes holds the same text.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import h5py
import numpy as np

from estimator.effects.catalogue import record_of
from estimator.effects.effect import Effect, Record, Value, positive
from estimator.effects.law import VARIABLES, axes_of, variables_of
from estimator.errors import MISSHAPEN, EstimatorError
from estimator.packaged import sentence
from estimator.recordings.safe_open import probe
from estimator.types import Floats
from estimator.untrusted import read_json, read_text

FORMAT = "turntable-error-model"
FORMAT_VERSION = 1
WHERE = "investigation/error_model"
"""Where the file of an investigation (HDF5) holds the text of the model."""


class ModelError(EstimatorError):
    """A file without an error model, or a model that cannot be used for a recording."""


@dataclass(frozen=True, slots=True)
class Size:
    """Expected value of one parameter of an effect: mean and standard deviation in its SI unit."""

    name: str
    unit: str
    mean: float
    sd: float


@dataclass(frozen=True, slots=True)
class KnownEffect:
    """An effect of the catalogue, or a constructed one, with its sizes for a type of gyro.

    ``settings`` are its non-linear settings, by key. ``sizes`` are by parameter. ``found`` is their origin: by gyro, or
    by "all gyros" for a shared effect, value and standard deviation of each parameter.
    """

    name: str
    shared: bool
    sizes: tuple[Size, ...]
    settings: Mapping[str, Value] = field(default_factory=dict)
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
        shown = (setting.text(self.settings[setting.key]) for setting in self.record.kept_settings)
        return " ".join([self.name, *shown])

    @property
    def record(self) -> Record:
        """Its record in the catalogue."""
        record = record_of(self.name)
        assert record is not None, self.name
        return record

    @property
    def law(self) -> str:
        """Its law; "" if it cannot be written as a law."""
        return self.record.law.format(**self.settings)

    @property
    def axes(self) -> tuple[str, ...]:
        """Axes of the table that it names."""
        return axes_of(self.law) if self.law else (str(self.settings["axis"]),) if "axis" in self.settings else ()

    @property
    def of_the_table(self) -> bool:
        """Whether it is about axes of the table, or about directions fixed to its base."""
        names = variables_of(self.law) if self.law else ()
        return bool(self.axes) or any(VARIABLES[name][0] == "angle" for name in names)

    def effect(self, gimbals: Sequence[str]) -> Effect:
        """Return the effect for a table with these gimbals (none: no table), with its sizes as the largest plausible
        ones.

        ModelError if the effect does not fit the table. Without a table it is made for the axes that it names; if its
        parameters are then others than in the model, the sizes stay those of the catalogue.
        """
        lacking = [axis for axis in self.axes if axis not in gimbals]
        if lacking and gimbals:
            raise ModelError(f"the model has {self.called}, and the table has no axis {', '.join(lacking)}")
        # Without a table it is refused for what it needs.
        made = self.record.effect(self.axes if lacking else gimbals, **self.settings)
        if len(made.parameters) != len(self.sizes):
            if not gimbals:
                return made
            raise ModelError(
                f"the model's {self.called} has {len(self.sizes)} parameters, but {len(made.parameters)} on a table "
                f"with the axes {', '.join(gimbals)}: it was found on another table. Leave out --model"
            )
        sizes = zip(made.parameters, self.sizes, strict=True)
        return replace(made, parameters=tuple(replace(p, name=s.name, largest=s.sd) for p, s in sizes))


@dataclass(kw_only=True, frozen=True, slots=True)
class KnownForceEffect:
    """An effect of accelerometers, each with its own parameters, with their expected sizes for a type of device.

    The expected values are zero. ``found`` is their origin: by accelerometer value and standard deviation of each
    parameter.
    """

    name: str
    sizes: tuple[Size, ...]
    found: Mapping[str, tuple[tuple[float, float], ...]] = field(default_factory=dict)

    @property
    def sd(self) -> Floats:
        """Expected standard deviation of each parameter (p,)."""
        return np.array([size.sd for size in self.sizes])


@dataclass(frozen=True, slots=True)
class ErrorModel:
    """Effects beyond the four states, and effects that were found but do not apply to another device, with the reason.

    ``effects`` are those of gyros, ``forces`` those of accelerometers. ``text`` returns the file's content; ``parse``
    and ``read`` restore the model.
    """

    effects: tuple[KnownEffect, ...]
    left_out: Mapping[str, str] = field(default_factory=dict)
    forces: tuple[KnownForceEffect, ...] = ()

    @property
    def is_empty(self) -> bool:
        """Whether it has no effect at all."""
        return not self.effects and not self.forces

    def made(self, gimbals: Sequence[str], offers: frozenset[str]) -> list[Effect]:
        """Return the effects for a recording with the data in ``offers``, in the order of ``self.effects``.

        ModelError if one needs more, or does not fit a table with these ``gimbals``.
        """
        effects = [known.effect(gimbals) for known in self.effects]
        for what, remedy in _REMEDIES.items():
            lacking = [known.called for known, e in zip(self.effects, effects, strict=True) if what in e.needs - offers]
            if lacking:
                raise ModelError(f"the model has {', '.join(lacking)}, for which {remedy}, or leave out --model")
        return effects

    @property
    def needs_temperature(self) -> bool:
        """Whether an effect of it needs the temperature of the gyros."""
        return any("temperature" in known.effect(()).needs for known in self.effects)

    def text(self) -> str:
        """Return the model as JSON text, which ``parse`` reads: effects with settings, sizes and where these come from,
        and what was left out.

        Without accelerometers that key is left out.
        """
        effects = [
            {
                "effect": known.name,
                **({"from": known.record.origin} if known.record.origin else {}),
                **known.settings,
                "shared": known.shared,
                **_sizes_object(known.sizes, known.found),
            }
            for known in self.effects
        ]
        model = {"format": FORMAT, "format_version": FORMAT_VERSION, "effects": effects, "left_out": {**self.left_out}}
        if self.forces:  # a model of gyros alone keeps its text, by which recordings name it
            model["accelerometers"] = [
                {"effect": known.name, **_sizes_object(known.sizes, known.found)} for known in self.forces
            ]
        return json.dumps(model, indent=1)

    @classmethod
    def parse(cls, text: str, where: str) -> Self:
        """Return the model in a text; ``where`` names the text in errors.

        ModelError, with the reason, if it is no model, of another version, damaged, lists an effect twice, or has one
        that the catalogue lacks. Effects of accelerometers are compared with their catalogue only when used.
        """
        try:
            whole = read_json(text)
        except (ValueError, RecursionError):
            raise ModelError(f"{where} is not an error model. {_GIVE}") from None
        if not isinstance(whole, dict) or whole.get("format") != FORMAT:
            raise ModelError(f"{where} is not an error model. {_GIVE}")
        if (version := whole.get("format_version")) != FORMAT_VERSION:
            raise ModelError(sentence("calibration.other_version", where=where, version=version, ours=FORMAT_VERSION))
        try:
            effects = tuple(_read_effect(entry, where) for entry in whole["effects"])
            left_out = {str(name): str(reason) for name, reason in whole.get("left_out", {}).items()}
            forces = tuple(map(_read_force_effect, whole.get("accelerometers", [])))
        except MISSHAPEN as error:
            raise ModelError(f"{where} is a damaged error model ({type(error).__name__}: {error}). {_GIVE}") from None
        names = [*(known.called for known in effects), *(f"accelerometers: {known.name}" for known in forces)]
        if len(set(names)) < len(names):
            raise ModelError(f"{where} is a damaged error model: it lists an effect twice")
        return cls(effects, left_out, forces)

    @classmethod
    def read(cls, path: Path | str) -> Self:
        """Return the model in a file: JSON, or the HDF5 file of an investigation.

        ModelError if it is no file, cannot be read, or holds no model (``parse``); RecordingError for an HDF5 file that
        ``probe`` refuses, as one that is damaged.
        """
        path = Path(path)
        try:
            if not path.is_file():
                raise ModelError(f"{path} is not a file. {_GIVE}")
            if h5py.is_hdf5(path):
                return cls.parse(_text_in(path), str(path))
        except (OSError, ValueError) as error:
            raise ModelError(f"{path} cannot be read: {error}") from None
        return cls.parse(read_text(path, ModelError), str(path))


_GIVE = "Give the file that `station investigate ... -o FILE` wrote"

_REMEDIES = {
    "temperature": "the recording must hold the temperature of the gyros: record it with the rates",
    "gimbals": "the recording must be of a table with angles: drive the gyros on one",
    "specific force": "the recording must hold the specific force: record accelerometers, or use a table",
}


def _read_effect(entry: Mapping[str, Any], where: str) -> KnownEffect:
    """Return one effect of a model; ModelError if the catalogue lacks it or does not keep it for models.

    ValueError if its parameters differ or a value is out of range, KeyError if one is missing. ``where`` names the
    model in errors.
    """
    name = str(entry["effect"])
    record = record_of(name)
    if record is None or record.not_kept:
        remedy = "use the version of the station that found it, give --plugin for your own effect, or investigate again"
        if "from" in entry:
            remedy = f"it is of {entry['from']}; install the package, or give the file with --plugin"
        raise ModelError(f"{where} has the effect {name}, which this station's catalogue does not know: {remedy}")
    settings = {setting.key: setting.read(setting.key, entry[setting.key]) for setting in record.kept_settings}
    sizes, found = _read_sizes(entry)
    known = KnownEffect(name, bool(entry["shared"]), sizes, settings, found)
    made = record.effect((str(settings.get("axis", "z")),), **settings)
    units = [parameter.unit for parameter in made.parameters]
    # The number of the parameters of effects of the table follows the table.
    if known.shared != made.shared or (not record.of_table and units != [size.unit for size in sizes]):
        raise ValueError(f"{name} of the catalogue has other parameters")
    return known


def _sizes_object(sizes: Sequence[Size], figures: Mapping[str, tuple[tuple[float, float], ...]]) -> dict[str, Any]:
    """Return the parameters of an effect, and what they come from, as values of JSON."""
    return {
        "parameters": [{"name": s.name, "unit": s.unit, "mean": s.mean, "sd": s.sd} for s in sizes],
        "found": {who: [list(pair) for pair in pairs] for who, pairs in figures.items()},
    }


def _read_sizes(entry: Mapping[str, Any]) -> tuple[tuple[Size, ...], dict[str, tuple[tuple[float, float], ...]]]:
    """Return the parameters of an effect, and what they come from; see ``_sizes_object``.

    KeyError if a value is missing, ValueError for one that is not finite or a deviation that is not above 0.
    """
    sizes = tuple(
        Size(str(p["name"]), str(p["unit"]), _finite("mean", p["mean"]), positive("sd", p["sd"]))
        for p in entry["parameters"]
    )
    found = {
        str(who): tuple((_finite("found", value), _finite("found", sd)) for value, sd in pairs)
        for who, pairs in entry.get("found", {}).items()
    }
    return sizes, found


def _read_force_effect(entry: Mapping[str, Any]) -> KnownForceEffect:
    """Return one effect of accelerometers; whether the station knows it shows when it is used."""
    sizes, found = _read_sizes(entry)
    return KnownForceEffect(name=str(entry["effect"]), sizes=sizes, found=found)


def _finite(key: str, value: object) -> float:
    number = float(value)  # type: ignore[arg-type]
    if not np.isfinite(number):
        raise ValueError(f"{key} is {value}")
    return number


def _text_in(path: Path) -> str:
    """Return the text of the model in an investigation's HDF5 file, which a child process reads first; ModelError if
    none, RecordingError if that process refuses the file.
    """
    probe(path)
    with h5py.File(path, "r") as file:
        held = file.get(WHERE)
        if not isinstance(held, h5py.Dataset) or held.shape != ():
            raise ModelError(f"{path} holds no error model. {_GIVE} with this version")
        value = held[()]
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
