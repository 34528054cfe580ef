"""A drive's Modbus register map, read from a profile file: address, width, sign, word order, scale, unit."""

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

PROFILE_FOLDER = Path(__file__).with_name("profiles")

_BITS = {"i8": 8, "u8": 8, "u16": 16, "i16": 16, "i32": 32, "u32": 32}


class ProfileError(ValueError):
    """A profile file with missing or impossible entries."""


@dataclass(frozen=True, slots=True)
class Register:
    """One value of the drive: raw = value * scale * counts_per_turn where a scale is given, else raw = value.

    ``per_count`` false: the scale is already raw per turn, so raw = value * scale. ``least_words``: registers that even
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
        """Return the words of a value, in the order in which they are sent.

        The value is in turns, turns/s or turns/s2, of ``counts_per_turn`` of the axis, or a plain number. It is rounded
        to a whole raw number. ValueError if it is not finite or out of range.
        """
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
        """Return the value of ``words`` in turns, turns/s or turns/s2, or as a plain number; see ``encode``."""
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


@dataclass(kw_only=True, frozen=True, slots=True)
class DriveProfile:
    """All differences between one make of drive and another.

    ``on_open``: registers and the values written to them when the link is opened. ``errors``: meanings of the codes in
    the register ``error_code``; codes that are single bits may be combined. ``interlock``: the register of the inputs
    that enable the power stage, and its value when all are closed.
    """

    name: str
    registers: Mapping[str, Register]
    commands: Mapping[str, int]
    homing_method: int
    on_open: tuple[tuple[str, int], ...] = ()
    errors: Mapping[int, str] = field(default_factory=dict)
    interlock: tuple[str, int] = ("", 0)

    def error_text(self, code: int) -> str:
        """Return an error code with its meaning in words.

        A code that is not listed is taken apart into bits if all of them are, joined by "and"; others refer to the
        manual. 0 means that the drive gives no code.
        """
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


def load_profile(name_or_path: str) -> DriveProfile:
    """Return a drive profile by name, of those in the package, or by the path of a .toml file; ProfileError if it is
    invalid.

    Unknown keys are not looked for: station/schema/profile.toml declares the keys, and a bench checks its file by that.
    A relative path counts from the working folder. Without a command abort, quick_stop is taken for it.
    """
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = PROFILE_FOLDER / f"{name_or_path}.toml"
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        known = ", ".join(sorted(p.stem for p in PROFILE_FOLDER.glob("*.toml")))
        raise ProfileError(f"no drive profile {name_or_path}: give one of {known}, or the path of a .toml") from None
    except (OSError, ValueError, RecursionError) as error:
        raise ProfileError(f"drive profile {path} cannot be read: {error}") from None
    try:
        commands = {"abort": data["commands"]["quick_stop"], **data["commands"]}
        common = {"low_word_first": data["word_order"] == "little", "least_words": data.get("least_words", 1)}
        profile = DriveProfile(
            name=data["name"],
            registers={name: _register(name, entry, common) for name, entry in data["registers"].items()},
            commands=commands,
            homing_method=data["homing"]["method"],
            on_open=tuple((write["register"], write["value"]) for write in data.get("on_open", [])),
            errors={int(code, 0): text for code, text in data.get("errors", {}).items()},
            interlock=(data["interlock"]["register"], data["interlock"]["closed"]) if "interlock" in data else ("", 0),
        )
    except (LookupError, TypeError, AttributeError, ValueError, ArithmeticError) as error:
        raise ProfileError(f"drive profile {path} lacks or misspells {error}") from None
    for name in (*(name for name, _ in profile.on_open), profile.interlock[0]):
        if name and name not in profile.registers:
            raise ProfileError(f"drive profile {path} lacks the register {name} of [[on_open]] or [interlock]")
    return profile


def _register(name: str, entry: Mapping[str, Any], common: Mapping[str, Any]) -> Register:
    stated = {key: entry[key] for key in ("scale", "unit", "per_count") if key in entry}
    return Register(name, entry["address"], entry["type"], **common, **stated)
