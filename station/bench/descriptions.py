"""Descriptions of IMUs on byte links: frames or lines of text, and the meaning of their numbers."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import drivers.imus.described.shipped
from drivers.imus.can.imu import CanChannel
from drivers.imus.checks import Check
from drivers.imus.described.framing import MESSAGE, RESOLUTION, TIME_TICK_S, Frames, Lines, signal
from drivers.imus.described.imu import Description
from drivers.imus.signals import UNITS, plain_unit
from drivers.packaged import packaged_toml
from station.bench.can_mappings import read_source, read_units, shipped_or_own
from station.errors import UsageError
from station.schema.tables import Table

DESCRIPTIONS = Path(drivers.imus.described.shipped.__path__[0])
_HEX = re.compile(r"(\s*([0-9A-Fa-f]{2}|\?\?))*\s*")


class DescriptionError(UsageError):
    """An invalid description; the message names file, line and key."""


def load_description(name_or_path: str, folder: Path | None = None, device: str = "") -> Description:
    """Return a description by name, of those in the package, or by the path of a .toml file.

    A relative path counts from ``folder``, by default the working folder. Its single source is named ``device``.
    DescriptionError if it is missing or invalid, also for fields that overlap.
    """
    from cantools.database import Database, Message
    from cantools.database.errors import Error

    path = shipped_or_own(name_or_path, folder, DESCRIPTIONS, "description", DescriptionError)
    top = Table.load(path, DescriptionError)
    own = top.read("description.description")
    source = read_source(top, read_units(own["units"]), "")
    if (own["frame"] is None) == (own["line"] is None):
        raise top.fail(None, "needs either a table [frame] or a table [line]")
    top.done()
    framing: Frames | Lines
    if own["frame"]:
        framing, signals = _frame(own["frame"])
        size = framing.size
    else:
        framing, signals, source = _line(own["line"], source)
        size = 8 * len(signals)
    try:
        database = Database([Message(0, MESSAGE, size, signals)])
    except Error as error:
        raise top.fail("frame", str(error)) from None
    channel = _checked(top, source, {signal.name: signal for signal in signals})
    start, stop = (tuple(map(_phrase, own[key])) for key in ("start", "stop"))
    channels = (replace(channel, name=device),)
    return Description(path, channels, database=database, framing=framing, start=start, stop=stop)


def _checked(top: Table, source: CanChannel, signals: dict[str, Any]) -> CanChannel:
    """Return the source with the full names of its signals, ``MESSAGE`` and a dot before the name.

    ``signals`` has the known signals by their names alone. The table's error if one is missing, a quantity lacks a unit
    (a temperature needs none), counter or time is not an integer, or both are given.
    """
    full: dict[str, Any] = {}
    for key in ("rate", "acceleration", "temperature", "counter", "time"):
        if (names := getattr(source, key)) is None:
            continue
        listed = [names] if isinstance(names, str) else names
        for name in listed:
            if name not in signals:
                raise top.fail(key, f"there is no {name!r}, only {', '.join(signals)}")
            if key in ("counter", "time") and signals[name].is_float:
                raise top.fail(key, f"{name} is not an integer, so it cannot be a counter or a time")
        if key in UNITS and key not in (*dict(source.units), "temperature"):
            raise top.fail("units", f"{key} is missing: give one of {', '.join(UNITS[key])}")
        named = tuple(f"{MESSAGE}.{name}" for name in listed)
        full[key] = named[0] if isinstance(names, str) else named
    if source.counter and source.time:
        raise top.fail("time", "give either a counter or a time")
    return replace(source, **full)


def _frame(table: Table) -> tuple[Frames, list[Any]]:
    """Return the framing and the signals of a table [frame].

    The table's error if frames could not be recognised, are shorter than sync and end together, or a field or check
    does not fit.
    """
    own = table.read_all("description.frame", sync=_bytes, end=_known)
    size, order = own["bytes"], own["byte_order"]
    sync, end = own["sync"], own["end"]
    framing = Frames(size=size, sync=sync, end=end)
    if own["check"]:
        rule, within = _check(own["check"])
        first, last = within["from"], (within["to"] or 0) % size or size
        big = (within["byte_order"] or order) == "big"
        framing = Frames(
            size=size,
            sync=sync,
            end=end,
            check=rule,
            at=_place(own["check"], within["at"], rule.bits, size),
            big=big,
            first=first,
            last=last,
        )
    known = len(sync) - sync.count(None)
    if not known or (framing.check is None and known + len(end) < 2):
        raise table.fail(
            "sync", "a frame cannot be recognised: give at least 2 bytes in sync and end, or 1 and a check"
        )
    if len(sync) + len(end) > size:
        raise table.fail("bytes", f"{size}: sync and end alone have {len(sync) + len(end)}")
    signals = []
    for name in own["fields"].remaining():
        of = own["fields"].table(name)
        field = of.read_all("description.field")
        kind, big = field["type"], (field["byte_order"] or order) == "big"
        at = _place(of, field["at"], int(kind[1:]), size)
        signals.append(signal(name, at, kind, big, field["scale"], field["offset"]))
    return framing, signals


def _line(table: Table, source: CanChannel) -> tuple[Lines, list[Any], CanChannel]:
    """Return the framing and the signals of a table [line], and the source with its wrap in units of the stored time.

    Columns named "-" are skipped. The table's error if a name occurs twice, the separator is empty or the check
    unknown.
    """
    own, check, first = table.read_all("description.line"), None, 0
    columns = own["columns"]
    names = [name for name in columns if name != "-"]
    if len(set(names)) < len(names):
        raise table.fail("columns", 'a name occurs twice; call columns to skip "-"')
    scale = {name: own["scale"].number(name, 1.0) for name in names}
    own["scale"].done()
    if not own["separator"]:
        raise table.fail("separator", 'give the separator between two columns, as "," or " "')
    unit_s = UNITS["time"][plain_unit(dict(source.units).get("time", "s"))]
    by = dict.fromkeys(names, 1 / RESOLUTION)
    if source.time in by:
        by[source.time] = scale[source.time] * unit_s / TIME_TICK_S
    if source.counter in by:
        by[source.counter] = 1.0
    signals = [signal(name, 8 * i, "i64", False, scale[name] / by[name], 0.0) for i, name in enumerate(names)]
    if own["check"]:
        check, where = _check(own["check"])
        first = where["from"]
    whole = tuple(by.get(name) for name in columns)
    framing = Lines(whole, own["separator"].encode(), own["prefix"].encode(), check, first)
    return framing, signals, replace(source, wrap=round(source.wrap * by.get(source.time or "", 1.0)))


def _check(table: Table) -> tuple[Check, dict[str, Any]]:
    """Return the checksum of a table, by name or as a CRC, and the values of the table, which say where it stands.

    The table's error for an unknown name, for neither of both, or for constants with too many bits.
    """
    own, known = table.read_all("description.check"), packaged_toml("drivers", "codes.toml")["check"]
    if own["name"] in known:
        return Check(**known[own["name"]]), own
    if own["name"] is not None or own["bits"] is None:
        raise table.fail("name", f"give one of {', '.join(known)}; or bits, polynomial and so on of a CRC")
    for key in ("polynomial", "init", "xorout"):
        if own[key] >> own["bits"]:
            raise table.fail(key, f"{own[key]:#x}: give {own['bits']} bits, of a polynomial without the highest")
    return Check("crc", *(own[key] for key in ("bits", "polynomial", "init", "reflected", "xorout"))), own


def _phrase(table: Table) -> tuple[bytes, float]:
    """Return the bytes to send, and the pause after them in s; the table's error without one of text and hex."""
    own = table.read_all("description.phrase", hex=_known)
    if (own["text"] is None) == (own["hex"] is None):
        raise table.fail(None, "needs either text or hex")
    return own["text"].encode() if own["hex"] is None else own["hex"], own["pause"]


def _place(table: Table, at: int | None, bits: int, size: int) -> int:
    """Return the first byte of a number of ``bits``, from the beginning of its frame of ``size`` bytes.

    ``at`` below 0 counts from the end. The table's error if it is None or the number does not fit there.
    """
    if at is None or not -size <= at < size or at % size + bits // 8 > size:
        raise table.fail("at", f"{at}: give a place where {bits // 8} bytes fit in a frame of {size}")
    return at % size


def _bytes(text: str, _: Path) -> tuple[int | None, ...]:
    """Return bytes written in hex, None for ??; ValueError for other text."""
    if not _HEX.fullmatch(text):
        raise ValueError(f'{text!r}: write bytes in hex, as "5A A5"')
    return tuple(None if pair == "??" else int(pair, 16) for pair in re.findall(r"\S\S", text))


def _known(text: str, folder: Path) -> bytes:
    """Return bytes written in hex; ValueError for other text and for ??."""
    if None in (data := _bytes(text, folder)):
        raise ValueError(f"{text!r}: ?? for any byte can only be in sync")
    return bytes(byte for byte in data if byte is not None)
