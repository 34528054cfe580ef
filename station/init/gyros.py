"""What is asked about gyros on CAN: how they lie, and which signals they are."""

import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from drivers.packaged import packaged_toml
from station.errors import UsageError
from station.init.bench_text import ImuAnswer
from station.init.checks import quantity_of, whole_number
from station.init.dialogue import Dialogue

_ARRAYS: Mapping[str, str] = packaged_toml("station.init", "devices.toml")["arrays"]
GYROS: Mapping[str, int] = packaged_toml("station.init", "devices.toml")["gyros"]
"""Number of gyros by array, where the array says it."""
_BUILT_IN = 4
_MOST = 64
_UNIT_AXES = ("1 0 0", "0 1 0", "0 0 1")


def built_in_channels(count: int) -> tuple[tuple[str, str], ...]:
    """Return the signals of the built-in DBC: the rate and the temperature of each gyro."""
    return tuple((f"GYRO{n}_RATE.Rate", f"GYRO{n}_TEMPERATURE.Temperature") for n in range(1, count + 1))


def ask_gyros(dialogue: Dialogue, answer: ImuAnswer, folder: Path, checked: Callable[[ImuAnswer], object]) -> ImuAnswer:
    """Return the device with its geometry and its signals; ``checked`` raises UsageError for what cannot be."""
    dialogue.say("  How do its gyros lie?")
    geometry, count = _ask_geometry(dialogue, dialogue.choose("array", _ARRAYS, "tetrahedron"))
    answer = replace(answer, geometry=geometry)
    dialogue.say(
        "  Which signals are they? - for the built-in DBC, of up to four gyros; a mapping (sbg_ecan, xsens_mti600,\n"
        "  aceinna_openimu300ri, or a .toml of your own); or a .dbc."
    )

    def usable(text: str) -> None:
        if text.endswith(".dbc"):
            _signals(folder / text)
        elif text:
            checked(replace(answer, mapping=text, channels=()))
        elif count > _BUILT_IN:
            raise UsageError(f"the built-in DBC has {_BUILT_IN} gyros, and these are {count}: give a mapping or a .dbc")
        else:
            checked(replace(answer, channels=built_in_channels(count)))

    chosen = dialogue.ask("mapping or DBC", "", usable)
    if chosen.endswith(".dbc"):
        return replace(answer, dbc=chosen, channels=_ask_channels(dialogue, folder / chosen, count))
    return replace(answer, mapping=chosen, channels=() if chosen else built_in_channels(count))


def _ask_geometry(dialogue: Dialogue, kind: str) -> tuple[dict[str, str], int]:
    """Return the keys of an array, values as TOML, and how many gyros it has."""
    if kind in GYROS:
        return {"array": json.dumps(kind)}, GYROS[kind]
    count = int(dialogue.ask("number of gyros", "3", whole_number(3, _MOST)))
    if kind == "cone":
        angle = dialogue.ask("angle between each and z", "54.7 deg", quantity_of("angle"))
        return {"array": json.dumps(kind), "gyros": str(count), "half_angle": json.dumps(angle)}, count
    axes = [
        _direction(dialogue.ask(f"sense axis of gyro {n + 1}: x y z", _UNIT_AXES[n % 3], _direction))
        for n in range(count)
    ]
    return {"p": json.dumps(axes)}, count


def _direction(text: str) -> list[float]:
    """Return a direction as a vector of length one; UsageError if it is none."""
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
        raise UsageError(
            f"{path} cannot be read as a DBC: {(str(error) or type(error).__name__).splitlines()[0]}"
        ) from None
    return [f"{message.name}.{s.name}" for message in getattr(base, "messages", ()) for s in message.signals]


def _ask_channels(dialogue: Dialogue, path: Path, count: int) -> tuple[tuple[str, str], ...]:
    signals = _signals(path)
    dialogue.say("  signals: " + ", ".join(signals))

    def known(text: str) -> None:
        if text not in signals:
            raise UsageError(f"{text!r} is no signal of {path.name}")

    channels = []
    for n in range(1, count + 1):
        rate = dialogue.ask(f"rate of gyro {n}, MESSAGE.Signal", "", known)
        channels.append(
            (rate, dialogue.ask("its temperature; - for none", "", lambda text: known(text) if text else None))
        )
    return tuple(channels)
