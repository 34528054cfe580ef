"""Questions about gyros on CAN, or described by a file: their axes and signals."""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from drivers.packaged import packaged_toml
from station.bench.descriptions import DESCRIPTIONS, load_description
from station.errors import UsageError, sentence
from station.init.asking import Data, ask_key
from station.init.dialogue import Dialogue
from station.schema.tables import keys_of

_ARRAYS: Mapping[str, str] = packaged_toml("station.init", "devices.toml")["arrays"]
GYROS: Mapping[str, int] = packaged_toml("station.init", "devices.toml")["gyros"]
"""Number of gyros by array, where the array says it."""
_BUILT_IN = 4
_COUNT, _HALF_ANGLE = keys_of("bench.cone")
_COUNT = replace(_COUNT, bound="3 to 64", told="give a whole number from 3 to 64")
_UNIT_AXES = ("1 0 0", "0 1 0", "0 0 1")


def built_in_channels(count: int) -> list[Data]:
    """Return the signals of the built-in DBC: the rate and the temperature of each gyro."""
    return [
        {"rate": f"GYRO{n}_RATE.Rate", "temperature": f"GYRO{n}_TEMPERATURE.Temperature"} for n in range(1, count + 1)
    ]


def ask_gyros(dialogue: Dialogue, imu: Data, folder: Path, checked: Callable[[Data], object]) -> Data:
    """Return a copy of the device ``imu`` with its array and its signals: a mapping, or channels of a DBC.

    That is the built-in DBC if none is named. Array and channels that ``imu`` has are replaced. Paths count from
    ``folder``. ``checked`` raises UsageError for an invalid device; the question is then repeated.
    """
    dialogue.say("  How are its gyros arranged?")
    bare = {key: value for key, value in imu.items() if key not in ("array", "channels")}
    geometry, count = _ask_geometry(dialogue, dialogue.choose("array", _ARRAYS, "tetrahedron"))
    bare = {**bare, **geometry}
    dialogue.say(sentence("init.signals"))

    def usable(text: str) -> None:
        """Check the answer: a DBC by reading it, a mapping or no answer (the built-in DBC) by ``checked``.

        UsageError if it is wrong, or if there is no answer and there are more gyros than in the built-in DBC.
        """
        if text.endswith(".dbc"):
            _signals(folder / text)
        elif text:
            checked({**bare, "mapping": text})
        elif count > _BUILT_IN:
            raise UsageError(f"the built-in DBC has {_BUILT_IN} gyros, but there are {count}. Give a mapping or a .dbc")
        else:
            checked({**bare, "channels": built_in_channels(count)})

    chosen = dialogue.ask("mapping or DBC", "", usable)
    if chosen.endswith(".dbc"):
        return {**bare, "dbc": chosen, "channels": _ask_channels(dialogue, folder / chosen, count)}
    return {**bare, "mapping": chosen} if chosen else {**bare, "channels": built_in_channels(count)}


def ask_description(dialogue: Dialogue, imu: Data, folder: Path) -> Data:
    """Return a copy of the device ``imu`` with its description and, if that does not have three gyros, another array.

    Paths count from ``folder``. A description that is invalid is asked for again.
    """
    shipped = ", ".join(sorted(path.stem for path in DESCRIPTIONS.glob("*.toml")))
    question = f"its description: {shipped}, or the path of a .toml"
    chosen = dialogue.ask(question, "csv", lambda text: load_description(text, folder))
    count = len(load_description(chosen, folder).channels[0].rates)
    if count != GYROS["triad"]:
        dialogue.say(f"  How are its {count} gyros arranged?")
        fitting = {kind: meaning for kind, meaning in _ARRAYS.items() if GYROS.get(kind, count) == count}
        geometry, _ = _ask_geometry(dialogue, dialogue.choose("array", fitting, next(iter(fitting))), count)
        imu = {key: value for key, value in imu.items() if key != "array"} | geometry
    return {**imu, "description": chosen}


def _ask_geometry(dialogue: Dialogue, kind: str, count: int = 0) -> tuple[Data, int]:
    """Return the keys of an array of this kind, and its number of gyros.

    The number is that of the kind, else ``count``, else, if that is 0, asked for; so are the angle of a cone or the
    sense axes of any other, which are its only key.
    """
    if kind in GYROS:
        return {"array": kind}, GYROS[kind]
    made: Data = ask_key(dialogue, {}, _COUNT, "number of gyros", "3") if not count else {"gyros": count}
    count = made["gyros"]
    if kind == "cone":
        return {"array": kind, **ask_key(dialogue, made, _HALF_ANGLE, "angle between each and z", "54.7 deg")}, count
    axes = [
        _direction(dialogue.ask(f"sense axis of gyro {n + 1}: x y z", _UNIT_AXES[n % 3], _direction))
        for n in range(count)
    ]
    return {"p": axes}, count


def _direction(text: str) -> list[float]:
    """Return three numbers, separated by blanks or commas, as a unit vector; UsageError if they are none, or zero."""
    try:
        x, y, z = (float(part) for part in re.split(r"[\s,]+", text.strip()))
    except ValueError:
        raise UsageError("give three numbers, for instance 0 0 1") from None
    length = math.hypot(x, y, z)
    if not 0 < length < math.inf:
        raise UsageError("give three numbers that are not all zero")
    return [x / length, y / length, z / length]


def _signals(path: Path) -> list[str]:
    """Return the signals of a DBC as MESSAGE.Signal; UsageError if it cannot be read."""
    import cantools

    try:
        base = cantools.database.load_file(path)
    except Exception as error:  # cantools has a kind of error of its own for every parser
        why = (str(error) or type(error).__name__).splitlines()[0]
        raise UsageError(sentence("init.no_dbc", path=path, why=why)) from None
    return [f"{message.name}.{s.name}" for message in getattr(base, "messages", ()) for s in message.signals]


def _ask_channels(dialogue: Dialogue, path: Path, count: int) -> list[Data]:
    """Return a channel for each of ``count`` gyros: a rate and possibly a temperature, of the signals of the DBC at
    ``path``.

    All signals are shown first; other names are asked for again. UsageError if the DBC cannot be read.
    """
    signals = _signals(path)
    dialogue.say("  signals: " + ", ".join(signals))

    def known(text: str) -> None:
        if text not in signals:
            raise UsageError(f"{text!r} is not a signal of {path.name}")

    channels = []
    for n in range(1, count + 1):
        channel = {"rate": dialogue.ask(f"rate of gyro {n}, MESSAGE.Signal", "", known)}
        if temperature := dialogue.ask("its temperature; - for none", "", lambda text: known(text) if text else None):
            channel["temperature"] = temperature
        channels.append(channel)
    return channels
