"""A first look at an external file: its columns with their possible meanings, and a draft of a mapping.

All of it is guessed, from names and from values, and said to be: a person who knows the device corrects the mapping.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from estimator.errors import RecordingError
from estimator.importing.columns import by_rows
from estimator.importing.stamps import ISO, pattern_of
from estimator.recordings.safe_open import probe
from estimator.types import Floats, runs_of
from estimator.untrusted import read_bytes

_MOST_ROWS = 50000
_HEADING_LINES = 50
_SHOWN = 3  # values of a column
_UNIT = re.compile(r"[\[(]([^\])]*)[\])]\s*$")
_AXIS = re.compile(r"^(.*?)[\s_.:-]*([xyz])$|^([xyz])[\s_.:-]+(.*)$", re.IGNORECASE)
_KINDS = {
    "accelerometer": re.compile(r"acc|^a$|force|^f$", re.IGNORECASE),
    "magnetometer": re.compile(r"mag|^m$|^b$", re.IGNORECASE),
    "reference": re.compile(r"ref|true|table|^r$|opt|vicon|encoder", re.IGNORECASE),
    "gyro": re.compile(r"gyr|omega|^w$|^g$|rate|ang.*vel|^$", re.IGNORECASE),
}
"""What three columns x, y, z are, by the name that they share; the first that fits."""
_TIME = re.compile(r"^t$|time|stamp|^sec|zeit|clock", re.IGNORECASE)
_TEMPERATURE = re.compile(r"temp|^tc?$|degc", re.IGNORECASE)
_ANGLE = re.compile(r"enc|angle|pos|pitch|roll|yaw|theta|deg$", re.IGNORECASE)
_RATE = re.compile(r"rate|freq|^fs$|hz", re.IGNORECASE)
_QUATERNION = re.compile(r"^(?:q|quat).{0,12}?[\s_.]?([wxyz0-3s])$", re.IGNORECASE)
_RATES = {
    "rad/s": ("rad/s", "rps", "rad/sec"),
    "deg/s": ("deg/s", "dps", "°/s", "deg/sec", "degree/s"),
    "mdps": ("mdps",),
}
_FORCES = {"m/s2": ("m/s2", "m/s^2", "m/s²", "m/s/s"), "g": ("g",), "mg": ("mg",)}
_STEPS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_USUAL_S = 1e-4, 1.0  # between samples
_FAST_RADS, _GRAVITY_NEAR = 35.0, 0.25  # rates above cannot be rad/s; how near a length must be to that of gravity
_REST_S, _WINDOW_S, _LOUD, _QUIET = 2.0, 0.5, 4.0, 0.1
_POSES = 9  # rests from which on gravity can be the reference


@dataclass(frozen=True, slots=True)
class Column:
    """One column or variable: its first values as texts, its range in words, and a guess of its meaning."""

    name: str
    first: str
    range: str
    guess: str


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """The columns of a file, a mapping for them, and notes."""

    columns: tuple[Column, ...]
    mapping: str
    notes: tuple[str, ...]


@dataclass(kw_only=True, slots=True, eq=False)
class _File:
    """The content of a file: names in order, numbers (n,) or (n, width) by name, texts by name, keys of the table
    [file].

    ``rate`` is a single-valued variable that by its name is a sampling rate in Hz, if there is one.
    """

    path: Path
    names: list[str]
    numbers: dict[str, Floats]
    texts: dict[str, list[str]]
    keys: list[str]
    rate: tuple[str, float] | None = None
    guesses: dict[str, str] = field(default_factory=dict)


def look(path: Path) -> Look:
    """Return what is in a text or MATLAB file, with a guessed mapping and notes.

    Guessed are the time, a gyro, an accelerometer, the temperature and the reference; placeholders stand for what is
    not found. RecordingError if the file cannot be read.
    """
    file = _matlab(path) if path.suffix.lower() == ".mat" else _text(path)
    time, time_keys, step_s = _time(file)
    triples = _triples(file)
    tables = ['[device]\nname = "?"  # what was measured', "[file]\n" + "\n".join(file.keys)]
    tables.append("[time]\n" + "\n".join(time_keys))
    notes = []
    gyro = _first(triples, "gyro")
    if gyro is None:
        notes.append("no three columns look like a gyro. Name them in [gyro]")
    felt = _first(triples, "accelerometer")
    tables.append(_gyro(file, gyro))
    if felt is not None:
        tables.append(_accelerometer(file, felt))
    for name in file.names:
        if name not in file.guesses and _TEMPERATURE.search(name) and name in file.numbers:
            file.guesses[name] = "temperature (degC, a guess)"
            tables.append(f'[temperature]\ncolumn = "{name}"\nunit = "degC"')
            break
    rests = _rests(file, gyro, step_s)
    if rests:
        notes.append(f"it appears to rest {'once' if rests == 1 else f'{rests} times'} for {_REST_S:g} s or more")
    tables.append(_reference(file, triples, rests, felt is not None))
    if time is None:
        notes.append("no column looks like a time. State rate_hz in [time]")
    elif step_s > 0:
        notes.append(f"the sample rate is {1 / step_s:.4g} Hz according to the column {time}")
    columns = tuple(_column(file, name) for name in file.names)
    return Look(
        columns,
        "# Guessed from the names and values of " + path.name + ": correct it.\n\n" + "\n\n".join(tables) + "\n",
        tuple(notes),
    )


def _column(file: _File, name: str) -> Column:
    """Return the description of one column: its first values, its span, and what it is guessed to be.

    A column of texts has the number of different ones as its span, and may be labels if these are few.
    """
    if name in file.numbers:
        values = file.numbers[name]
        first = ", ".join(f"{v:.6g}" for v in values.ravel()[:_SHOWN])
        known = values[np.isfinite(values)]
        span = f"{known.min():.5g} to {known.max():.5g}" if len(known) else "no number"
        shape = f", {values.shape[0]} x {values.shape[1]}" if values.ndim > 1 else ""
        return Column(name, first, span + shape, file.guesses.get(name, "not used"))
    texts = file.texts[name]
    kinds = list(dict.fromkeys(texts))
    span = f"{len(kinds)} different texts"
    guess = "labels of sections (a guess)" if 1 < len(kinds) <= max(len(texts) // 20, 2) else "not used"
    return Column(name, ", ".join(texts[:_SHOWN]), span, file.guesses.get(name, guess))


def _matlab(path: Path) -> _File:
    """Return the content of a MATLAB file: its longest arrays of numbers, and a variable that looks like a sample rate.

    At most ``_MOST_ROWS`` rows are kept. RecordingError if it cannot be read or holds no array of numbers.
    """
    from scipy.io import loadmat

    probe(path, "MATLAB")
    found = {k: v for k, v in loadmat(str(path), squeeze_me=False).items() if not k.startswith("__")}
    numeric = {k: np.asarray(v, dtype=np.float64) for k, v in found.items() if np.issubdtype(v.dtype, np.number)}
    long = {k: v for k, v in by_rows(numeric).items() if v.size > 1}
    if not long:
        raise RecordingError(f"{path.name} holds no array of numbers")
    rows = max(len(v) for v in long.values())
    used = {
        k: (v[:, 0] if v.ndim > 1 and v.shape[1] == 1 else v)[:_MOST_ROWS] for k, v in long.items() if len(v) == rows
    }
    single = {k: float(v.ravel()[0]) for k, v in numeric.items() if v.size == 1}
    rate = next(((k, v) for k, v in single.items() if _RATE.search(k) and v > 0), None)
    return _File(path=path, names=list(used), numbers=used, texts={}, keys=['format = "mat"'], rate=rate)


def _text(path: Path) -> _File:
    """Return the content of a text file, with guesses of delimiter, decimal mark and heading.

    At most 20 MB and ``_MOST_ROWS`` lines are looked at; those of another width than the middle one are skipped.
    Columns with numbers in a fifth of the rows at most are kept as texts, unless they are blank. RecordingError if it
    is no text or has fewer than three lines.
    """
    raw = read_bytes(path, RecordingError, name=path.name)[:20_000_000]
    text = raw.decode("utf-16" if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig", errors="replace")
    if "\0" in text[:4000]:
        raise RecordingError(
            f"{path.name} is not a text file. State its format in [file] "
            '("mat", "binary" with '
            "its record, or a protocol)"
        )
    lines = [line for line in re.split(r"\r\n|\n|\r", text) if line.strip()][:_MOST_ROWS]
    if len(lines) < 3:
        raise RecordingError(f"{path.name} has {len(lines)} lines, too few to analyse")
    middle = lines[len(lines) // 2]
    delimiter = next((mark for mark in (";", "\t", ",") if mark in middle), None)
    split = [[f.strip().strip("\"'") for f in (line.split(delimiter) if delimiter else line.split())] for line in lines]
    width = len(split[len(split) // 2])
    comma = delimiter != "," and any("," in f for f in split[len(split) // 2])
    head = next(
        (
            n
            for n, own in enumerate(split[:_HEADING_LINES])
            if len(own) in (width, width + 1) and not any(map(_numeric, own))
        ),
        None,
    )
    names = [f"c{n + 1}" for n in range(width)] if head is None else [_plain(f) for f in split[head][:width]]
    keys = ['format = "csv"']
    if delimiter != ",":
        keys.append(f'delimiter = "{ {";": ";", None: "space"}.get(delimiter, "tab") }"')
    keys += ['decimal = ","'] if comma else []
    if head is None or len(split[head]) != width:
        keys.append(f"columns = [{', '.join(chr(34) + n + chr(34) for n in names)}]")
    rows = [own for own in split[(-1 if head is None else head) + 1 :] if len(own) == width]
    numbers: dict[str, Floats] = {}
    texts: dict[str, list[str]] = {}
    for at, name in enumerate(names):
        fields = [own[at].replace(",", ".") if comma else own[at] for own in rows]
        known = [_number(f) for f in fields]
        if np.isfinite(known).mean() > 0.2 or all(f == "" for f in fields):
            numbers[name] = np.array(known)
        else:
            texts[name] = [own[at] for own in rows]
    return _File(path=path, names=names, numbers=numbers, texts=texts, keys=keys)


def _plain(name: str) -> str:
    return re.sub(r"^\s*(#+|%+|//)\s*", "", name)


def _numeric(field: str) -> bool:
    return bool(np.isfinite(_number(field.replace(",", "."))))


def _number(field: str) -> float:
    try:
        return float(field)
    except ValueError:
        return float("nan")


def _time(file: _File) -> tuple[str | None, list[str], float]:
    """Return the name of the time column, the lines of the table [time] as text, and the usual step in s (0: unknown).

    Columns named like a time come first, then any that rise evenly or hold times of day; texts have no step. Without
    such a column it is a variable with the rate; without one (None) a placeholder. A guessed column is noted in the
    file.
    """
    named = [name for name in file.names if _TIME.search(_base(name))]
    for name in [*named, *(n for n in file.names if n not in named)]:
        if name in file.texts:
            pattern = pattern_of(file.texts[name][:2000]) if name in named or ":" in file.texts[name][0] else None
            if pattern is None:
                continue
            file.guesses[name] = f"time ({pattern})"
            more = [] if pattern == ISO else [f'pattern = "{pattern}"']
            return name, [f'column = "{name}"', f'unit = "{ISO if pattern == ISO else "pattern"}"', *more], 0.0
        values = file.numbers[name]
        if values.ndim > 1 or not np.isfinite(values).all() or len(values) < 3:
            continue
        steps = np.diff(values)
        step = float(np.median(steps))
        if step <= 0 or np.mean(steps < 0) > 0.01 or (name not in named and np.ptp(steps) > 0.5 * step):
            continue
        unit = _said(name, {key: (key,) for key in _STEPS}) or next(
            (u for u, size in _STEPS.items() if _USUAL_S[0] <= step * size <= _USUAL_S[1]), "s"
        )
        file.guesses[name] = f"time ({unit})"
        return name, [f'column = "{name}"', f'unit = "{unit}"'], step * _STEPS[unit]
    if file.rate is not None:
        name, rate_hz = file.rate
        return name, [f'rate_variable = "{name}"'], 1 / rate_hz
    return None, ["rate_hz = 100  # no column looks like a time; state the sample rate"], 0.0


def _base(name: str) -> str:
    return _UNIT.sub("", name).strip()


def _said(name: str, units: Mapping[str, Sequence[str]]) -> str | None:
    """Return the unit that stands in brackets, or at the end, of a name."""
    found = _UNIT.search(name)
    text = (found[1] if found else name.rsplit("_", 1)[-1]).strip().lower()
    return next((unit for unit, spelled in units.items() if text in spelled), None)


def _triples(file: _File) -> dict[str, tuple[str, list[str]]]:
    """Return by common name what three columns x, y, z, or one variable of width three, seem to be, and their names.

    They seem to be what the common name says, else by their length an accelerometer or a gyro. If no names are of that
    kind, neighbouring columns are taken in threes. Columns that are guessed already are left out.
    """
    shared: dict[str, dict[str, str]] = {}
    for name in file.names:
        if name in file.guesses or name not in file.numbers:
            continue
        if file.numbers[name].ndim > 1 and file.numbers[name].shape[1] == 3:
            shared[name] = {"xyz": name}
        elif (found := _AXIS.match(_base(name))) and not _QUATERNION.match(_base(name)):
            axis, base = (found[2] or found[3]).lower(), found[1] if found[2] else found[4]
            shared.setdefault(base, {})[axis] = name
    triples = {}
    for base, own in shared.items():
        if len(own) == 3 or "xyz" in own:
            names = [own[axis] for axis in "xyz"] if len(own) == 3 else [own["xyz"]]
            kind = next((kind for kind, words in _KINDS.items() if words.search(base)), "")
            triples[base] = kind or _by_length(file, names), names
    return triples or _by_place(file)


def _by_place(file: _File) -> dict[str, tuple[str, list[str]]]:
    """Return columns of numbers that have no guess, in threes in the order of the file, for names that say nothing.

    By the first one's name: what the three seem to be, and their names. Those as long as gravity are accelerometers,
    all others gyros. One or two columns at the end are left out.
    """
    left = [n for n in file.names if n in file.numbers and n not in file.guesses and file.numbers[n].ndim == 1]
    found = {}
    for first in range(0, len(left) - 2, 3):
        names = left[first : first + 3]
        found[names[0]] = _by_length(file, names), names
    return found


def _values(file: _File, names: Sequence[str]) -> Floats:
    return np.column_stack([file.numbers[name] for name in names])


def _by_length(file: _File, names: Sequence[str]) -> str:
    length = float(np.nanmedian(np.linalg.norm(_values(file, names), axis=1)))
    return "accelerometer" if _force_unit(length) else "gyro"


def _force_unit(length: float) -> str | None:
    sizes = {"m/s2": 9.81, "g": 1.0, "mg": 1000.0}
    return next((unit for unit, size in sizes.items() if abs(length / size - 1) < _GRAVITY_NEAR), None)


def _first(triples: Mapping[str, tuple[str, list[str]]], kind: str) -> list[str] | None:
    return next((names for own, names in triples.values() if own == kind), None)


def _listed(names: Sequence[str]) -> str:
    return "[" + ", ".join(f'"{name}"' for name in names) + "]"


def _rate_unit(file: _File, names: Sequence[str]) -> tuple[str, str]:
    """Return the unit of rates in these columns, and how it was found in words: by the first name, or guessed by size.

    Large numbers are counts, whose unit is "raw".
    """
    if unit := _said(names[0], _RATES):
        return unit, "by its name"
    largest = float(np.nanmax(np.abs(_values(file, names))))
    if largest > 5000:
        return "raw", "counts, a guess"
    return ("deg/s" if largest > _FAST_RADS else "rad/s"), "a guess by its size"


def _gyro(file: _File, names: Sequence[str] | None) -> str:
    """Return the text of the table [gyro] for the columns ``names``, with placeholders for None.

    There is one for the size of a count, too, if no unit is found. The guess is noted in the file.
    """
    if names is None:
        return '[gyro]\ncolumns = ["?", "?", "?"]\nunit = "deg/s"'
    unit, how = _rate_unit(file, names)
    file.guesses.update(dict.fromkeys(names, f"gyro ({unit}, {how})"))
    count = (
        '\ncount = 0.01  # size of one count, in count_unit: see the data sheet\ncount_unit = "deg/s"'
        if unit == "raw"
        else ""
    )
    return f'[gyro]\ncolumns = {_listed(names)}\nunit = "{unit}"  # {how}{count}'


def _accelerometer(file: _File, names: Sequence[str]) -> str:
    """Return the text of the table [accelerometer] for the columns ``names``, its unit by name or size.

    Otherwise they are counts, with a placeholder for their size. The guess is noted in the file.
    """
    unit = _said(names[0], _FORCES) or _force_unit(float(np.nanmedian(np.linalg.norm(_values(file, names), axis=1))))
    file.guesses.update(dict.fromkeys(names, f"accelerometer ({unit or 'counts'})"))
    if unit is None:
        return (
            f'[accelerometer]\ncolumns = {_listed(names)}\nunit = "raw"\ncount = 1  # size of one\ncount_unit = "m/s2"'
        )
    return f'[accelerometer]\ncolumns = {_listed(names)}\nunit = "{unit}"'


def _rests(file: _File, names: Sequence[str] | None, step_s: float) -> int:
    """Return how often the gyro rests: for at least 2 s in a row, in windows of 0.5 s nearly as quiet as the quietest.

    ``names`` are the columns of the gyro, ``step_s`` is the sampling period in s. Return 0 without columns (None),
    without a time (``step_s`` not above 0), with fewer than four windows, or if no window is much quieter than the
    others. A gyro that is equally quiet all the time rests once.
    """
    if names is None or not step_s > 0:
        return 0
    rows = max(round(_WINDOW_S / step_s), 5)
    values = _values(file, names)
    count = len(values) // rows
    if count < 4:
        return 0
    scatter = values[: count * rows].reshape(count, rows, -1).std(axis=1).max(axis=1)
    least = float(np.nanquantile(scatter, 0.05))
    still = float(np.nanstd(values, axis=0).max()) < _LOUD * least
    if not still and least > _QUIET * float(np.nanmedian(scatter)) and least > _QUIET * float(np.nanmax(scatter)):
        return 0  # nowhere is it much quieter than elsewhere
    quiet = np.asarray(scatter <= _LOUD * max(least, 1e-12))
    return sum((stop - start) * rows * step_s >= _REST_S for start, stop in runs_of(quiet))


def _reference(file: _File, triples: Mapping[str, tuple[str, list[str]]], rests: int, felt: bool) -> str:
    """Return the text of the table [reference]: attitude, rate or angle if columns look like it, else gravity or rest.

    The first kind in this order that is found is taken. ``triples`` are groups of three columns by their names;
    ``rests`` is how often the gyro rests: gravity needs nine rests, and an accelerometer (``felt``). The guess is noted
    in the file.
    """
    four = {found[1].lower(): name for name in file.names if (found := _QUATERNION.match(_base(name)))}
    for order, axes in (("wxyz", "wxyz"), ("wxyz", "sxyz"), ("wxyz", "0123")):
        if all(axis in four for axis in axes):
            names = [four[axis] for axis in axes]
            file.guesses.update(dict.fromkeys(names, "attitude (quaternion)"))
            return f'[reference]\nkind = "attitude"\ncolumns = {_listed(names)}\norder = "{order}"'
    wide = [
        n for n in file.names if n in file.numbers and file.numbers[n].ndim > 1 and file.numbers[n].shape[1] in (4, 9)
    ]
    if wide:
        order = "wxyz" if file.numbers[wide[0]].shape[1] == 4 else "matrix"
        file.guesses[wide[0]] = f"attitude ({order}, a guess)"
        return f'[reference]\nkind = "attitude"\ncolumns = ["{wide[0]}"]\norder = "{order}"'
    told = _first(triples, "reference")
    if told is not None:
        unit, how = _rate_unit(file, told)
        file.guesses.update(dict.fromkeys(told, f"rate of the reference ({unit}, {how})"))
        return f'[reference]\nkind = "rate"\ncolumns = {_listed(told)}\nunit = "{unit}"  # {how}'
    for name in file.names:
        if name in file.numbers and name not in file.guesses and _ANGLE.search(_base(name)):
            unit = "deg" if float(np.nanmax(np.abs(file.numbers[name]))) > 7 else "rad"
            file.guesses[name] = f"angle of an encoder ({unit}, a guess)"
            return f'[reference]\nkind = "angle"\ncolumn = "{name}"\nunit = "{unit}"\naxis = "z"  # a guess'
    if felt and rests >= _POSES:
        return '[reference]\nkind = "gravity"  # rests with turns by hand between them; "rest" uses the rests alone'
    return '[reference]\nkind = "rest"'
