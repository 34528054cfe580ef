"""Captures of the protocols that the drivers decode: bytes off a line, or a log of a bus, as columns for an import."""

import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import DeviceError
from drivers.imus.can.imu import load_dbc
from drivers.imus.signals import MessageKey, SignalReader, is_j1939, message_key, parameter_group
from drivers.imus.stim300 import codec as stim300
from drivers.imus.stim300.special import Configuration
from drivers.imus.stim300.units import ACCEL_LSB_G, UNITS, accel_unit_mps2, gyro_unit_rps
from drivers.imus.vectornav.codec import Frames, VectorNavDecoder
from drivers.imus.xsens import mtdata2
from drivers.imus.xsens.xbus import Mid, XbusDecoder
from drivers.packaged import packaged_toml
from drivers.types import Floats
from estimator.errors import RecordingError
from estimator.importing.mapping.mapping import Capture, Protocols
from estimator.strict_toml import StrictTable
from station.bench.can_mappings import MappingError, load_mapping

Columns = dict[str, Floats]
_Decoded = tuple[Columns, tuple[str, ...]]

_WRAPS = {"SampleTimeFine": mtdata2.SAMPLE_TIME_MODULUS, "PacketCounter": mtdata2.PACKET_COUNTER_MODULUS}
_VNIMU = {"imu.uncomp_mag": slice(3), "imu.uncomp_accel": slice(3, 6), "imu.uncomp_gyro": slice(6, 9)}
_VNIMU_FIELDS = 11
_FRAME = re.compile(
    r"\s*\((\d+\.\d+)\)\s+\S+\s+([0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})(?:#|\s+\[\d+\]\s+)((?:[0-9A-Fa-f]{2} ?)*)\s*[RT]?\s*"
)
_STANDARD_DIGITS = 3
_GALIL_HEADER = re.compile(rb"(?=([\x84-\x87][\x01-\xff][\s\S][\x00\x01]))")  # general block, S, T; axes; length
_GALIL_MODULUS, _TM_1000_US = 65536, 1e6 / 1024  # TM 1000, the usual, is 976 us: command references, TIME
_SAME_SAMPLE = 0.6  # of a message's period: one further away is of another sample


def _gathered(pieces: Sequence[Mapping[str, Floats]], lead: str) -> Columns:
    """Return the columns of all pieces joined in order, NaN where a piece lacks one.

    Pieces without the column ``lead`` are left out, unless none has it; no columns without pieces.
    """
    kept = [piece for piece in pieces if lead in piece] or pieces
    widths = {name: values.shape[1:] for piece in kept for name, values in piece.items()}
    lengths = [len(next(iter(piece.values()))) for piece in kept]
    return {
        name: np.concatenate([p.get(name, np.full((n, *width), np.nan)) for p, n in zip(kept, lengths, strict=True)])
        for name, width in widths.items()
    }


def _damaged(count: int, damaged: str) -> tuple[str, ...]:
    return (f"{count} damaged {damaged} were skipped",) if count else ()


def _xbus(raw: bytes, names: Sequence[str]) -> _Decoded:
    """Return MTData2 packets by the maker's names, and ``time`` (s) of SampleTimeFine if that is there.

    Messages without the first of ``names`` are left out, unless none has it. Counts go on over their wraps. Also notes
    on damaged messages.
    """
    decoder = XbusDecoder()
    pieces: list[Columns] = []
    malformed = 0
    for messages in [*decoder.feed(raw), *decoder.flush()]:
        found, bad = mtdata2.parse_mtdata2(messages.data) if messages.mid == Mid.MTDATA2 else ([], 0)
        pieces += [_packets(samples) for samples in found]
        malformed += bad
    columns = _gathered([piece for piece in pieces if piece], names[0])
    columns |= {name: np.unwrap(columns[name], period=period) for name, period in _WRAPS.items() if name in columns}
    if "SampleTimeFine" in columns:
        columns["time"] = columns["SampleTimeFine"] * mtdata2.SAMPLE_TIME_TICK_S
    return columns, _damaged(decoder.bad_messages + malformed, "messages")


def _packets(samples: mtdata2.Samples) -> Columns:
    out = {}
    for kind in {mtdata2.kind_of(packet.data_id) for packet in samples.packets} & set(mtdata2.KINDS):
        values = samples.numbers(kind) if mtdata2.KINDS[kind].integers is None else samples.integers(kind)
        assert values is not None
        out[mtdata2.KINDS[kind].name] = np.asarray(values if values.shape[1] > 1 else values[:, 0], dtype=np.float64)
    return out


def _stim300(section: StrictTable, _folder: Path) -> Capture:
    codes = {name: code for code, name in UNITS.items()}
    stated = section.string("gyro_output", one_of=codes) if section.has("gyro_output") else ""
    range_g = section.integer("accel_range_g", 10)
    if range_g not in ACCEL_LSB_G:
        raise section.fail("accel_range_g", f"{range_g}: write one of {', '.join(map(str, ACCEL_LSB_G))}")
    return partial(_read_stim300, codes.get(stated), range_g)


def _read_stim300(code: int | None, range_g: int, raw: bytes, names: Sequence[str]) -> _Decoded:
    """Return ``gyro`` (n, 3) in rad/s, ``accelerometer`` (n, 3) in m/s2, ``temperature`` (degC), ``time`` (s); notes.

    The time is that of the counter, less the delay of the gyro output. ``code`` is the gyro output, None if not stated,
    ``range_g`` that of the accelerometers; a configuration sent by the device takes precedence. Datagrams without the
    first of ``names`` are left out, unless none has it. Nothing if there are fewer than two datagrams.
    """
    decoder = stim300.Stim300Decoder()
    found = decoder.feed(raw)
    columns = _gathered([_datagram(item) for item in found if isinstance(item, stim300.Datagrams)], names[0])
    if len(columns.get("time", ())) < 2:
        return {}, ()
    counter = columns["time"].astype(np.int64)
    count = np.concatenate([[0], np.cumsum(np.diff(counter) % stim300.COUNTER_MODULUS)])  # it never goes back
    ticks = max(round(float(np.median(np.diff(count)))), 1)
    notes = _damaged(decoder.bad_datagrams, "datagrams")
    accel_code = 0
    for item in found:
        if isinstance(item, Configuration):
            code, accel_code, range_g = item.gyro_unit, item.accel_unit, item.accel_ranges_g[0] or range_g
    if code is None:
        notes = (
            *notes,
            "the kind of gyro output is not stated, so a rate is assumed. Otherwise state gyro_output in [file]",
        )
    rate_hz = stim300.INTERNAL_RATE_HZ // ticks
    gyro, accel = gyro_unit_rps(code or 0, rate_hz), accel_unit_mps2(accel_code, range_g, rate_hz)
    t_ns = np.round(count * (1e9 / stim300.INTERNAL_RATE_HZ)).astype(np.int64)
    columns["gyro"] = gyro.rates(columns["gyro"], counter, t_ns, ticks)
    if "accelerometer" in columns:
        columns["accelerometer"] = accel.rates(columns["accelerometer"], counter, t_ns, ticks)
    columns["time"] = count / stim300.INTERNAL_RATE_HZ - gyro.centre_s
    return columns, notes


def _datagram(data: stim300.Datagrams) -> Columns:
    names = {"gyro": "gyro", "accelerometer": "accelerometer", "gyro_temperature": "temperature"}
    out = {names[group]: stim300.vouched(*raw) for group, raw in data.groups.items() if group in names}
    if "temperature" in out:
        out["temperature"] = out["temperature"].mean(axis=1) * stim300.TEMPERATURE_LSB_C
    return out | {"time": data.counter.astype(np.float64)}


def _vectornav(raw: bytes, names: Sequence[str]) -> _Decoded:
    """Return fields by group.field, those of VNIMU sentences likewise, and notes on damaged messages.

    ``time`` (s) is since start-up, if that was sent. Sentences are used only if no frame has the first of ``names``;
    else frames without that are left out.
    """
    decoder = VectorNavDecoder()
    pieces: list[Columns] = []
    sentences: list[list[float]] = []
    not_numbers = 0
    for item in [*decoder.feed(raw), *decoder.flush()]:
        if isinstance(item, Frames):
            fields = [name for name in item.values.dtype.names or () if item.values[name].dtype.kind != "V"]
            pieces.append({name: item.values[name].astype(np.float64) for name in fields if "." in name})
        elif item.header == "VNIMU" and len(item.fields) == _VNIMU_FIELDS:
            try:
                sentences.append([float(field) for field in item.fields])
            except ValueError:
                not_numbers += 1
    if sentences and not any(names[0] in piece for piece in pieces):
        rows = np.array(sentences, dtype=np.float64)
        pieces = [{name: rows[:, at] for name, at in _VNIMU.items()} | {"imu.temperature": rows[:, 9]}]
    columns = _gathered(pieces, names[0])
    for name in ("common.time_startup", "time.time_startup"):
        if name in columns:
            columns["time"] = columns[name] * 1e-9
    return columns, _damaged(decoder.bad_frames + decoder.bad_sentences + not_numbers, "messages")


def _candump(section: StrictTable, folder: Path) -> Capture:
    name = section.string("dbc")
    try:
        dbc = folder / name if name.endswith(".dbc") else load_mapping(name).dbc
        return partial(_read_candump, load_dbc(name, dbc), dbc)
    except (MappingError, DeviceError) as error:
        raise section.fail("dbc", str(error)) from None


def _read_candump(database: Any, dbc: Path, raw: bytes, names: Sequence[str]) -> _Decoded:
    """Return signals named MESSAGE.Signal in units of the DBC, and ``time`` (s), from the bytes of a candump log.

    The time is that of the message of the first of ``names``. Signals of other messages are those of the nearest frame,
    NaN if that belongs to another sample; signals whose message does not occur are left out. RecordingError for an
    unknown signal; nothing if the first message does not occur. Also notes on damaged frames: those of another length,
    and lines that are no frame.
    """
    try:
        readers = {
            name: SignalReader(device="", database=database, dbc=dbc, name=name, quantity="count")
            for name in names
            if name != "time"
        }
    except DeviceError as error:
        raise RecordingError(error.message) from None
    keys = {name: _key(*message_key(reader.message), is_j1939(reader.message)) for name, reader in readers.items()}
    lengths = {keys[name]: reader.length for name, reader in readers.items()}
    stamps: dict[MessageKey, list[float]] = defaultdict(list)
    frames: dict[MessageKey, list[bytes]] = defaultdict(list)
    lines = [line for line in raw.decode("ascii", errors="replace").splitlines() if line.strip()]
    found = [match.groups() for match in map(_FRAME.fullmatch, lines) if match]
    damaged = len(lines) - len(found)
    for stamp, identifier, digits in found:
        plain, data = (int(identifier, 16), len(identifier) > _STANDARD_DIGITS), bytes.fromhex(digits)
        for key in lengths.keys() & {_key(*plain, False), _key(*plain, True)}:
            damaged += len(data) != lengths[key]
            if len(data) == lengths[key]:
                stamps[key].append(float(stamp))
                frames[key].append(data)
    if keys[names[0]] not in frames:
        return {}, ()
    columns = {"time": np.array(stamps[keys[names[0]]])}
    for name, key in keys.items():
        if key in frames:
            table = np.frombuffer(b"".join(frames[key]), np.uint8).reshape(-1, lengths[key])
            columns[name] = _nearest(columns["time"], np.array(stamps[key]), readers[name].values(table))
    return columns, _damaged(damaged, "frames")


def _key(identifier: int, extended: bool, j1939: bool) -> MessageKey:
    """Return the key of a message's frames: its identifier, or for J1939 its parameter group (below zero)."""
    return (-1 - parameter_group(identifier) if j1939 and extended else identifier), extended


def _nearest(at_s: Floats, t_s: Floats, values: Floats) -> Floats:
    """Return the values at ``t_s`` (k,) nearest to ``at_s`` (n,); NaN where the nearest is of another sample.

    That is more than 0.6 of the median interval of ``t_s`` away. A single value is used for all.
    """
    if len(t_s) < 2:
        return np.full(len(at_s), values[0])
    order = np.argsort(t_s, kind="stable")
    t_s, values = t_s[order], values[order]
    index = np.searchsorted((t_s[1:] + t_s[:-1]) / 2, at_s)
    near = np.abs(t_s[index] - at_s) <= _SAME_SAMPLE * np.median(np.diff(t_s))
    return np.where(near, values[index], np.nan)


def _read_galil(sample_s: float, raw: bytes, _names: Sequence[str]) -> _Decoded:
    """Return positions of each axis in counts ("A.position", "A.reference", "A.auxiliary"), and ``time`` (s).

    ``time`` counts from the first record in samples of ``sample_s``; two records must be less than 65536 samples apart.
    The most frequent header is used whose length fits its blocks in the layout of a controller family. Nothing if there
    is none. Also notes on the family and on what is no record.
    """
    headers = Counter(found[1] for found in _GALIL_HEADER.finditer(raw))
    known = ((header, *_galil_record(header)) for header, _ in headers.most_common())
    header, layout, family = next((one for one in known if one[1]), (b"", None, ""))
    if layout is None:
        return {}, ()
    record = re.escape(header) + b"[\\s\\S]{%d}(?=[:\\s]*(?:%s|$))" % (layout.itemsize - 4, re.escape(header))
    rows = np.frombuffer(b"".join(re.findall(record, raw)), layout)
    columns = {name: rows[name].astype(np.float64) for name in layout.names or ()}
    columns["time"] = np.unwrap(columns["time"], period=_GALIL_MODULUS) * sample_s
    columns["time"] -= columns["time"][:1]
    damaged = sum(bool(piece.strip(b":\r\n ")) for piece in re.split(record, raw))
    return columns, (f"data records as of {family}", *_damaged(damaged, "stretches"))


def _galil_record(header: bytes) -> tuple[np.dtype[Any] | None, str]:
    """Return the layout of records with this header (4 bytes) and the controller family; None and "" if none has it.

    Its fields are "time" in samples and, for each axis, "A.reference", "A.position" and "A.auxiliary" in counts.
    """
    axes = [axis for bit, axis in enumerate("ABCDEFGH") if header[1] >> bit & 1]
    planes = (header[0] & 3).bit_count()
    for family, (general, plane, block) in packaged_toml("drivers", "layouts.toml")["galil"].items():
        first = 4 + general + planes * plane
        if (size := first + len(axes) * block) == int.from_bytes(header[2:], "little"):
            places = {"time": ("<u2", 4)} | {
                f"{axis}.{quantity}": ("<i4", first + number * block + at)
                for number, axis in enumerate(axes)
                for quantity, at in (("reference", 4), ("position", 8), ("auxiliary", 16))
            }
            formats, offsets = zip(*places.values(), strict=True)
            return np.dtype({"names": [*places], "formats": formats, "offsets": offsets, "itemsize": size}), family
    return None, ""


PROTOCOLS: Protocols = {
    "xbus": lambda _section, _folder: _xbus,
    "stim300": _stim300,
    "vectornav": lambda _section, _folder: _vectornav,
    "candump": _candump,
    "galil": lambda section, _: partial(_read_galil, section.number("sample_us", _TM_1000_US, positive=True) * 1e-6),
}
"""Formats of captures that a mapping file may name, beside those of the estimator."""
