"""A drive's Modbus register map, read from a profile file: address, width, sign, word order, scale, unit."""

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

PROFILE_FOLDER = Path(__file__).with_name("profiles")

_BITS = {"i8": 8, "u8": 8, "u16": 16, "i16": 16, "i32": 32, "u32": 32}
_UNITS = ("", "turn", "turn/s", "turn/s2")


class ProfileError(Exception):
    """A profile file that is missing something or says something impossible."""


@dataclass(frozen=True, slots=True)
class Register:
    """One value of the drive. raw = value * scale * counts_per_turn where a scale is given, else raw = value.

    ``per_count`` false: the scale already is raw a turn, so raw = value * scale. ``least_words``: registers that even
    a short value takes.
    """

    name: str
    address: int
    kind: str
    low_word_first: bool
    scale: float | None = None
    unit: str = ""
    per_count: bool = True
    least_words: int = 1

    @property
    def words(self) -> int:
        """Number of 16-bit registers."""
        return max(_BITS[self.kind] // 16, self.least_words)

    def encode(self, value: float, counts_per_turn: int) -> list[int]:
        """Return the words of a value (turns, turns/s, turns/s2, or a plain number); ValueError if out of range."""
        if not math.isfinite(value):
            raise ValueError(f"{self.name} = {value} is not finite")
        raw = round(value * self._factor(counts_per_turn))
        bits = _BITS[self.kind]
        low, high = (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) if self.kind[0] == "i" else (0, (1 << bits) - 1)
        if not low <= raw <= high:
            raise ValueError(f"{self.name} = {raw} does not fit {self.kind} ({low} to {high})")
        raw &= (1 << (16 * self.words)) - 1 if bits >= 16 else 0xFF
        words = [(raw >> (16 * i)) & 0xFFFF for i in range(self.words)]
        return words if self.low_word_first else words[::-1]

    def decode(self, words: Sequence[int], counts_per_turn: int) -> float:
        """Return the value of these words, in turns, turns/s, turns/s2, or as a plain number."""
        ordered = words if self.low_word_first else list(words)[::-1]
        raw = sum((word & 0xFFFF) << (16 * i) for i, word in enumerate(ordered))
        bits = _BITS[self.kind]
        raw &= (1 << bits) - 1
        if self.kind[0] == "i" and raw >> (bits - 1):
            raw -= 1 << bits
        return raw / self._factor(counts_per_turn)

    def _factor(self, counts_per_turn: int) -> float:
        if self.scale is None:
            return 1.0
        return self.scale * counts_per_turn if self.per_count else self.scale


@dataclass(frozen=True, slots=True)
class DriveProfile:
    """Everything that tells one make of drive from another.

    ``on_open``: registers and what is written to them when the link is opened. ``errors``: plain words of the codes
    in the register ``error_code``; codes that are single bits may come together.
    """

    name: str
    registers: Mapping[str, Register]
    commands: Mapping[str, int]
    homing_method: int
    on_open: tuple[tuple[str, int], ...] = ()
    errors: Mapping[int, str] = field(default_factory=dict)

    def error_text(self, code: int) -> str:
        """Return what an error code means, the code included."""
        if not code:
            return "the drive gives no error code"
        bits = [1 << i for i in range(code.bit_length()) if code >> i & 1]
        if code in self.errors:
            meaning = self.errors[code]
        elif bits and all(bit in self.errors for bit in bits):
            meaning = " and ".join(self.errors[bit] for bit in bits)
        else:
            meaning = "see the drive's manual"
        return f"error code 0x{code:04X}, {meaning}"

    def __getitem__(self, name: str) -> Register:
        return self.registers[name]


REQUIRED_REGISTERS = (
    "controlword",
    "statusword",
    "mode",
    "position",
    "rate",
    "target_position",
    "profile_rate",
    "acceleration",
    "deceleration",
    "homing_method",
    "homing_rate_1",
    "homing_rate_2",
    "target_rate",
)
REQUIRED_COMMANDS = ("shutdown", "switch_on", "enable", "quick_stop", "fault_reset", "home", "move_arm", "move_go")


def load_profile(name_or_path: str) -> DriveProfile:
    """Return a profile that ships with the station by name, or one from a .toml file by path; ProfileError."""
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = PROFILE_FOLDER / f"{name_or_path}.toml"
    try:
        data = tomllib.loads(path.read_text())
    except FileNotFoundError:
        known = ", ".join(sorted(p.stem for p in PROFILE_FOLDER.glob("*.toml")))
        raise ProfileError(f"no drive profile {name_or_path}: give one of {known}, or the path of a .toml") from None
    except (OSError, ValueError) as error:
        raise ProfileError(f"drive profile {path} cannot be read: {error}") from None
    try:
        order = {"little": True, "big": False}[data["word_order"]]
        least_words = int(data.get("least_words", 1))
        registers = {key: _register(key, r, order, least_words) for key, r in data["registers"].items()}
        commands = {name: int(word) for name, word in data["commands"].items()}
        if "quick_stop" in commands:
            commands.setdefault("abort", commands["quick_stop"])
        profile = DriveProfile(
            data["name"],
            registers,
            commands,
            int(data["homing"]["method"]),
            tuple((write["register"], int(write["value"])) for write in data.get("on_open", [])),
            {int(code, 0): str(text) for code, text in data.get("errors", {}).items()},
        )
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ProfileError(f"drive profile {path} lacks or misspells {error}") from None
    missing = [r for r in REQUIRED_REGISTERS if r not in registers]
    missing += [c for c in REQUIRED_COMMANDS if c not in profile.commands]
    missing += [f"the register {name} of [[on_open]]" for name, _ in profile.on_open if name not in registers]
    if missing:
        raise ProfileError(f"drive profile {path} lacks {', '.join(missing)}")
    for register in registers.values():
        if register.kind not in _BITS or register.unit not in _UNITS:
            raise ProfileError(
                f"drive profile {path}: {register.name} has type {register.kind!r} and unit {register.unit!r}; "
                f"types are {', '.join(_BITS)}, units {', '.join(u for u in _UNITS if u)}"
            )
    return profile


def _register(name: str, entry: Mapping[str, Any], low_word_first: bool, least_words: int) -> Register:
    scale = entry.get("scale")
    return Register(
        name,
        int(entry["address"]),
        entry["type"],
        low_word_first,
        None if scale is None else float(scale),
        entry.get("unit", ""),
        bool(entry.get("per_count", True)),
        least_words,
    )
