"""Descriptions of IMUs on byte links: frames or lines of text, and which of their numbers are what."""

from dataclasses import replace
from pathlib import Path

import drivers.imus.described
from drivers.imus.can.imu import CanChannel
from drivers.imus.described.checks import Check
from drivers.imus.described.framing import LONGEST, MESSAGE, TIME_TICK_S, FrameCheck, Frames, Lines, Number, database_of
from drivers.imus.described.imu import Description
from drivers.imus.signals import UNITS, plain_unit
from drivers.packaged import packaged_toml
from station.bench.can_mappings import read_source, read_units, shipped_or_own
from station.errors import UsageError
from station.schema.tables import Table

DESCRIPTIONS = Path(drivers.imus.described.__path__[0])
_TYPES = {f"{kind}{bits}": (kind, bits // 8) for kind in "iu" for bits in (8, 16, 24, 32, 64)}
_TYPES |= {"f32": ("f", 4), "f64": ("f", 8)}
_SIGNALS = ("rate", "acceleration", "temperature", "counter", "time")


class DescriptionError(UsageError):
    """A description that lacks something or says something impossible; the message names file, line and key."""


def load_description(name_or_path: str, folder: Path | None = None) -> Description:
    """Return a description that ships with the station by name, or one from a .toml file by path; DescriptionError.

    A relative path counts from ``folder``.
    """
    path = shipped_or_own(name_or_path, folder, DESCRIPTIONS, "description", DescriptionError)
    top = Table.load(path, DescriptionError)
    units = read_units(top)
    source = read_source(top, path.stem, units)
    if top.has("frame") == top.has("line"):
        raise top.fail(None, "needs a table [frame] or a table [line], and not both")
    framing: Frames | Lines
    if top.has("frame"):
        framing, numbers, size = _frame(top.table("frame"))
    else:
        framing, numbers, source = _line(top.table("line"), source)
        size = 8 * len(numbers)
    try:
        database = database_of(numbers, size)
    except ValueError as error:
        raise top.fail("frame", str(error)) from None
    channel = _in_message(top, source, numbers)
    start, stop = _phrases(top, "start"), _phrases(top, "stop")
    description = Description(path, framing, database, channel, start, stop, _whole(top, "baud", 1, 1 << 24, 115200))
    top.done()
    return description


def _in_message(top: Table, source: CanChannel, numbers: dict[str, Number]) -> CanChannel:
    """Return the source with the names of its signals in the message; the units that it needs must be there."""
    named: dict[str, str | tuple[str, ...]] = {}
    for key in _SIGNALS:
        if (names := getattr(source, key)) is None:
            continue
        for name in [names] if isinstance(names, str) else names:
            if name not in numbers:
                raise top.fail(key, f"there is no {name!r}, only {', '.join(numbers)}")
            if key in ("counter", "time") and numbers[name].kind == "f":
                raise top.fail(key, f"{name} is no whole number: it cannot count or tell time")
        if key in UNITS and key != "temperature" and key not in dict(source.units):
            raise top.fail("units", f"{key} is missing: give one of {', '.join(UNITS[key])}")
        named[key] = f"{MESSAGE}.{names}" if isinstance(names, str) else tuple(f"{MESSAGE}.{name}" for name in names)
    if source.counter is not None and source.time is not None:
        raise top.fail("time", "give a counter or a time, not both")
    return replace(source, **named)  # type: ignore[arg-type]


def _frame(table: Table) -> tuple[Frames, dict[str, Number], int]:
    """Return the framing, the numbers in a frame, and its size."""
    size, sync = _whole(table, "bytes", 1, LONGEST), _hex(table, "sync")
    order = _order(table, "little")
    length = check = None
    plus = 0
    if table.has("length"):
        of = table.table("length")
        length, plus = _number(of, order, size), of.integer("plus", 0)
        of.done()
    if table.has("check"):
        of = table.table("check")
        first, end = _whole(of, "from", 0, size, 0), _whole(of, "to", -size, size, size)
        rule = _check(of)
        place = Number(_whole(of, "at", -size, size - rule.bits // 8), "u", rule.bits // 8, _order(of, order) == "big")
        check = FrameCheck(rule, place, first, end if end < size else None)
        of.done()
    numbers, equals = {}, []
    fields = table.table("fields")
    for name in fields.remaining():
        of = fields.table(name)
        if of.has("equals"):
            equals.append((_whole(of, "at", -size, size - 1), _hex(of, "equals")))
        else:
            numbers[name] = _number(of, order, size)
        of.done()
    if check is None and len(sync) + sum(len(same) for _, same in equals) < 2:
        raise table.fail(
            "sync", "is all that tells a frame: give 2 bytes or more, fields that equal something, or a check"
        )
    table.done()
    return Frames(sync, size, tuple(equals), length, plus, check), numbers, size


def _line(table: Table, source: CanChannel) -> tuple[Lines, dict[str, Number], CanChannel]:
    """Return the framing, the numbers in a line, and the source with its wrap as it is kept."""
    columns = table.strings("columns")
    names = [name for name in columns if name != "-"]
    if len(set(names)) < len(names):
        raise table.fail("columns", 'a name is there twice; what is to be passed over is called "-"')
    scales = table.table("scale", optional=True)
    scale = {name: scales.number(name, 1.0) for name in names}
    scales.done()
    unit_s = UNITS["time"][plain_unit(dict(source.units).get("time", "s"))]
    whole = {name: 1.0 for name in names if name == source.counter}
    whole |= {name: scale[name] * unit_s / TIME_TICK_S for name in names if name == source.time}
    scale |= {name: 1.0 if name == source.counter else TIME_TICK_S / unit_s for name in whole}
    numbers = {name: Number(8 * i, "i" if name in whole else "f", 8, scale=scale[name]) for i, name in enumerate(names)}
    check, first = None, 0
    if table.has("check"):
        of = table.table("check")
        check, first = _check(of), _whole(of, "from", 0, LONGEST, 0)
        of.done()
    separator, prefix = table.string("separator", ","), table.string("prefix", "")
    if not separator:
        raise table.fail("separator", 'is empty: give what stands between two columns, as "," or " "')
    table.done()
    lines = Lines(columns, separator.encode(), prefix.encode(), check, first, whole)
    return lines, numbers, replace(source, wrap=round(source.wrap * max(whole.values(), default=1.0)))


def _number(of: Table, order: str, size: int) -> Number:
    kind, length = _TYPES[of.string("type", one_of=_TYPES)]
    at, big = _whole(of, "at", -size, size - length), _order(of, order) == "big"
    return Number(at, kind, length, big, of.number("scale", 1.0), of.number("offset", 0.0))


def _check(of: Table) -> Check:
    if of.has("name"):
        known = packaged_toml("drivers", "codes.toml")["check"]
        return Check(**known[of.string("name", one_of=known)])
    bits = of.integer("bits")
    if bits not in (8, 16, 24, 32, 64):
        raise of.fail("bits", f"{bits}: give 8, 16, 24, 32 or 64")
    polynomial, init, xorout = (_whole(of, key, 0, (1 << bits) - 1, default) for key, default in _OF_CRC.items())
    return Check("crc", bits, polynomial, init, of.flag("reflected", False), xorout)


_OF_CRC = {"polynomial": None, "init": 0, "xorout": 0}


def _order(of: Table, default: str) -> str:
    return of.string("byte_order", default, one_of=("little", "big"))


def _whole(table: Table, key: str, low: int, high: int, default: int | None = None) -> int:
    number = table.integer(key, default)
    if not low <= number <= high:
        raise table.fail(key, f"{number}: give a whole number from {low} to {high}")
    return number


def _hex(table: Table, key: str) -> bytes:
    text = table.string(key)
    try:
        if data := bytes.fromhex(text):
            return data
    except ValueError:
        pass
    raise table.fail(key, f'{text!r}: write bytes in hex, as "5A A5"')


def _phrases(top: Table, key: str) -> tuple[tuple[bytes, float], ...]:
    phrases = []
    for phrase in top.tables(key):
        data = phrase.string("text").encode() if phrase.has("text") else _hex(phrase, "hex")
        phrases.append((data, phrase.quantity("pause", "time", 0.0, "not_negative")))
        phrase.done()
    return tuple(phrases)
