"""Files that strangers made, by the thousand: every command refuses or uses them, in bounded time and memory.

``python tests/bench/untrusted.py [KIND ...] [--count N] [--seed S]`` tries N mutants of every kind and prints what went
wrong. A batch of cases shares one forked process; what a case does beyond an exit code of the station is told.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import IO, NoReturn

import h5py
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from support import direct_recording

from estimator.recordings import safe_open
from estimator.recordings.writing import write_recording
from station.bench.bench import default_bench_text
from station.bench.can_mappings import MAPPING_FOLDER
from station.bench.descriptions import DESCRIPTIONS
from station.cli import main
from station.scripts.script import Rest, Rotate, Script

DATA = Path(__file__).parents[1] / "data"
LIMIT_S = 60.0
MOST_BYTES = 2 << 30
EXIT_CODES = (0, 1, 2, 3, 4)

SCRIPT = """name = "brief"
[[step]]
kind = "rest"
duration = "3 s"
[[step]]
kind = "rotate"
axis = "x"
rate = "40 deg/s"
acceleration = "20 deg/s2"
duration = "8 s"
label = "a turn"
[[step]]
kind = "move"
axis = "y"
angle = "30 deg"
rate = "20 deg/s"
acceleration = "20 deg/s2"
"""
HIDDEN = """devices = ["array"]
[scale_asymmetry]
size = ["2000 ppm", "-2000 ppm", "1500 ppm", "2000 ppm"]
[g_sensitivity]
x = "20 deg/h"
"""
LISTED = """name = "a map of its own"
dbc = "aceinna.dbc"
"""


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of file: the seed, the name that it has in a folder made by ``beside``, and what is typed to read it."""

    name: str
    seed: Callable[[], bytes]
    file: str
    typed: tuple[tuple[str, ...], ...]
    beside: Callable[[Path], None] = lambda folder: None
    mutate: Callable[[random.Random, bytes, Path], bytes] | None = None


@dataclass(slots=True)
class Ended:
    """How a case ended. ``wrong`` says why that is no way to end, empty if it is one."""

    name: str
    typed: str
    code: int | None = None
    said: str = ""
    wrong: str = ""
    seconds: float = 0.0
    peak_bytes: int = 0
    notes: dict[str, str] = field(default_factory=dict)


def brief_recording(path: Path, seed: int = 1) -> Path:
    """Write a recording of two minutes with four gyros, small enough to be read a thousand times."""
    turns = tuple(Rotate(axis, sign * 0.5, 6.0, 0.3, f"{axis}{sign}") for axis in "xyz" for sign in (1, -1))
    script = Script("brief", (Rest(10.0), *turns, Rest(10.0)))
    write_recording(path, direct_recording(seed, script=script, rate_hz=25.0))
    return path


def _exit(code: int = 0) -> NoReturn:
    """Leave a forked process without what the other one has to do at its end, but not its helper."""
    safe_open._prober._end()
    os._exit(code)


@cache
def _seeds() -> Path:
    """Return a folder with what the commands themselves wrote: a calibrated recording, an investigation, a model."""
    folder = Path(tempfile.mkdtemp(prefix="station-untrusted-"))
    recording = brief_recording(folder / "recording.h5")
    if not (child := os.fork()):  # what reads files for this process stays out of those that are forked later
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            main(["calibrate", "--write", "--json", "--jobs", "1", str(recording)])
            main(["investigate", str(recording), "--json", "-o", str(folder / "investigation.h5")])
        _exit()
    os.waitpid(child, 0)
    with h5py.File(folder / "investigation.h5") as file:
        held = file["investigation"]
        text = held["error_model"][()].decode() if "error_model" in held else ""
    (folder / "model.json").write_text(text or MODEL)
    return folder


MODEL = json.dumps(
    {
        "format": "turntable-error-model",
        "format_version": 1,
        "effects": [
            {
                "effect": "scale_asymmetry",
                "shared": False,
                "parameters": [{"name": "scale_asymmetry", "unit": "1", "mean": 0.001, "sd": 0.002}],
                "found": {"gyro1": [[0.001, 0.0001]]},
            }
        ],
        "left_out": {"latency": "it is of the installation"},
    },
    indent=1,
)


def _read(name: str) -> Callable[[], bytes]:
    return lambda: (_seeds() / name).read_bytes()


def _data(name: str) -> Callable[[], bytes]:
    return lambda: (DATA / name).read_bytes()


def _copy(*names: str) -> Callable[[Path], None]:
    def copy(folder: Path) -> None:
        for name in names:
            shutil.copy(DATA / name, folder)

    return copy


def _with_bench(*changes: tuple[str, str]) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        text = default_bench_text()
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (folder / "bench.toml").write_text(text)

    return write


def _with_recording(folder: Path) -> None:
    shutil.copy(_seeds() / "recording.h5", folder / "recording.h5")


def _described(folder: Path) -> None:
    text = (DATA / "benches/described.toml").read_text().replace('"hipnuc_hi91"', '"own.toml"')
    (folder / "bench.toml").write_text(text)


def _mapped(folder: Path) -> None:
    text = (DATA / "benches/described.toml").read_text().replace('"hipnuc_hi91"', '"own.toml"')
    text = text.replace('protocol = "described"\ndescription = "own.toml"', 'protocol = "can"\nmapping = "own.toml"')
    (folder / "bench.toml").write_text(text)
    shutil.copy(MAPPING_FOLDER / "aceinna.dbc", folder)


def _candump() -> bytes:
    lines = [f"({i * 0.01:.6f}) can0 032#{(100 + i):04X}{200:04X}{300:04X}" for i in range(400)]
    return "\n".join(lines).encode()


ANY_REST = """[reference]
kind = "rest"
where = "everywhere"
rest_limit_dps = 500
"""
CSV_MAPPING = """[device]
name = "any"
[file]
format = "csv"
[time]
column = "t"
unit = "s"
[gyro]
columns = ["x", "y", "z"]
unit = "deg/s"
[temperature]
column = "warmth"
unit = "degC"
[reference]
kind = "rate"
columns = ["rx", "ry", "rz"]
unit = "deg/s"
"""


def _csv() -> bytes:
    rng = np.random.default_rng(1)
    t = np.arange(400) * 0.05
    truth = 20 * np.sin(np.outer(t, [0.5, 0.7, 0.9]))
    rows = np.column_stack([t, truth + rng.normal(0, 0.1, truth.shape), 20 + 0.01 * t, truth])
    head = "t,x,y,z,warmth,rx,ry,rz\n"
    return (head + "\n".join(",".join(f"{value:.5f}" for value in row) for row in rows) + "\n").encode()


def _with(name: str, text: str | bytes) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode()) and None


KINDS = (
    Kind("bench", lambda: default_bench_text().encode(), "bench.toml", (("check", "bench.toml", "--json"),)),
    Kind(
        "planned bench",
        lambda: default_bench_text().encode(),
        "bench.toml",
        (("plan", "script.toml", "--bench", "bench.toml", "--json"),),
        _with("script.toml", SCRIPT),
    ),
    Kind("script", SCRIPT.encode, "script.toml", (("plan", "script.toml", "--json"),)),
    Kind(
        "hidden effects",
        HIDDEN.encode,
        "hidden.toml",
        (("check", "bench.toml", "--json"),),
        _with_bench(("[twin]\n", '[twin]\nhidden = "hidden.toml"\n')),
    ),
    Kind(
        "drive profile",
        lambda: (Path(__file__).parents[2] / "drivers/tables/modbus/profiles/lexium32.toml").read_bytes(),
        "own.toml",
        (("check", "bench.toml", "--json"),),
        _with_bench(('profile = "kinco"', 'profile = "own.toml"')),
    ),
    Kind(
        "description",
        lambda: (DESCRIPTIONS / "hipnuc_hi91.toml").read_bytes(),
        "own.toml",
        (("check", "bench.toml", "--json"),),
        _described,
    ),
    Kind(
        "CAN mapping",
        lambda: (MAPPING_FOLDER / "aceinna_openimu300ri.toml").read_bytes(),
        "own.toml",
        (("check", "bench.toml", "--json"),),
        _mapped,
    ),
    Kind(
        "DBC",
        lambda: (MAPPING_FOLDER / "aceinna.dbc").read_bytes(),
        "aceinna.dbc",
        (("check", "bench.toml", "--json"),),
        lambda folder: None,
    ),
    Kind(
        "import mapping",
        CSV_MAPPING.encode,
        "mapping.toml",
        (("import", "mapping.toml", "data.csv", "-o", "out.h5"),),
        lambda folder: (folder / "data.csv").write_bytes(_csv()) and None,
    ),
    Kind(
        "section mapping",
        _data("ferraris/mapping.toml"),
        "mapping.toml",
        (("import", "mapping.toml", "session.csv", "-o", "out.h5"),),
        _copy("ferraris/session.csv", "ferraris/session_list.json"),
    ),
    Kind(
        "section list",
        _data("ferraris/session_list.json"),
        "session_list.json",
        (("import", "mapping.toml", "session.csv", "-o", "out.h5"),),
        _copy("ferraris/session.csv", "ferraris/mapping.toml"),
    ),
    Kind(
        "CSV",
        _csv,
        "data.csv",
        (("import", "mapping.toml", "data.csv", "-o", "out.h5"),),
        _with("mapping.toml", CSV_MAPPING),
    ),
    Kind(
        "MAT",
        _data("mpu6050/yaw_medium_110s.mat"),
        "data.mat",
        (("import", "yaw.toml", "data.mat", "-o", "out.h5"),),
        _copy("mpu6050/yaw.toml"),
    ),
    Kind(
        "Xbus capture",
        _data("xsens/capture1.bin"),
        "capture.bin",
        (("import", "mti_capture.toml", "capture.bin", "-o", "out.h5"),),
        _copy("shapes/mti_capture.toml"),
    ),
    Kind(
        "candump",
        _candump,
        "can.log",
        (("import", "can_log.toml", "can.log", "-o", "out.h5"),),
        _with("can_log.toml", (DATA / "shapes/can_log.toml").read_text().partition("[accelerometer]")[0] + ANY_REST),
    ),
    Kind(
        "recording",
        _read("recording.h5"),
        "recording.h5",
        (
            ("calibrate", "recording.h5", "--json", "--jobs", "1"),
            ("report", "recording.h5", "-o", "out.html"),
            ("export", "recording.h5", "--format", "c"),
            ("screen",),
        ),
    ),
    Kind(
        "recording inside",
        _read("recording.h5"),
        "recording.h5",
        (
            ("calibrate", "recording.h5", "--json", "--jobs", "1"),
            ("report", "recording.h5", "-o", "out.html"),
            ("export", "recording.h5", "--format", "json"),
            ("screen",),
        ),
        mutate=lambda rng, seed, folder: within_hdf5(rng, seed, folder),
    ),
    Kind(
        "investigated recording",
        _read("recording.h5"),
        "recording.h5",
        (("investigate", "recording.h5", "--json", "--most-effects", "1"),),
        mutate=lambda rng, seed, folder: within_hdf5(rng, seed, folder),
    ),
    Kind(
        "investigation",
        _read("investigation.h5"),
        "investigation.h5",
        (("report", "recording.h5", "--investigation", "investigation.h5", "-o", "out.html"),),
        _with_recording,
        mutate=lambda rng, seed, folder: (within_hdf5 if rng.random() < 0.8 else _bytes)(rng, seed, folder),
    ),
    Kind(
        "error model",
        _read("model.json"),
        "model.json",
        (("calibrate", "recording.h5", "--model", "model.json", "--json", "--jobs", "1"),),
        _with_recording,
    ),
    Kind(
        "state of the screen",
        lambda: json.dumps({"operator": "A", "bench": "b.toml", "script": "", "serials": {"b": "1"}}).encode(),
        "turntable-station/screen.json",
        (("remembered",),),
        lambda folder: (folder / "turntable-station").mkdir(),
    ),
)

_TOKENS = (
    b"[" * 3000, b"[[x]]", b"{", b"}", b"]", b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", b"\x1b[2J\x1b]0;x\x07",
    b"\xc2\x9b31m",
    b"\xe2\x80\xae", b"../../../etc/passwd", b"/dev/zero", b"/dev/stdin", b"nan", b"inf", b"-inf", b"1e400", b"1e308",
    b"-1e300", b"1" * 5000, b"-0", b"0", b"0x" + b"f" * 400, b"1979-05-27T07:32:00Z", b"true", b"[]", b"{}",
    b'""', b'"\\u0000"',
    b'"\\ud800"', b'"\\u001b[2J"', b"'''", b'"""', b"#", b"=", b".", b",", b"a.b.c.d", b"a." * 500 + b"a=1",
    b"null", b"NaN",
    b"<script>alert(1)</script>", b"{{7*7}}", b"$\\frac", b"%s%n", b"[1, [2, [3]]]", b'["a", 1]', b"1_000",
    b"9223372036854775808",
)  # fmt: skip
_VALUE = re.compile(rb'"[^"\n]*"|-?\d+\.?\d*(?:[eE]-?\d+)?|\b(?:true|false)\b|\[[^\[\]\n]*\]')


def _bytes(rng: random.Random, seed: bytes, folder: Path) -> bytes:
    """Return a seed with one to four changes: bytes, stretches, tokens, values."""
    data = bytearray(seed)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        at, end = sorted(rng.randrange(len(data) + 1) for _ in range(2))
        kind = rng.random()
        values = list(_VALUE.finditer(bytes(data))) if len(data) < 40000 else []
        if values and kind < 0.4:
            found = rng.choice(values)
            other = rng.choice(values)[0] if rng.random() < 0.3 else rng.choice(_TOKENS)
            data[found.start() : found.end()] = other
        elif kind < 0.6 and data:
            at = min(at, len(data) - 1)
            data[at] = rng.choice((data[at] ^ (1 << rng.randrange(8)), rng.randrange(256), 0, 255))
        elif kind < 0.7:
            data[at:at] = rng.choice(_TOKENS)
        elif kind < 0.8:
            del data[at : min(end, at + rng.choice((1, 8, 80, 10**9)))]
        elif kind < 0.85:
            data = data[:at]
        elif kind < 0.95:
            data[at:at] = data[at : min(end, at + 2000)]
        else:
            lines = bytes(data).split(b"\n")
            rng.shuffle(lines)
            data = bytearray(b"\n".join(lines))
    return bytes(data)


def within_hdf5(rng: random.Random, seed: bytes, folder: Path) -> bytes:
    """Return an HDF5 file of which a few objects or attributes are others, made through the library."""
    path = folder / "mutant.tmp"
    path.write_bytes(seed)
    with h5py.File(path, "r+") as file:
        for _ in range(rng.choice((1, 1, 2, 3))):
            names: list[str] = []
            file.visit(names.append)
            name = rng.choice(names)
            item = file[name]
            with suppress(OSError, ValueError, TypeError, KeyError, RuntimeError):
                if item.attrs and rng.random() < 0.4:
                    _change_attribute(rng, item, rng.choice(list(item.attrs)))
                else:
                    _change_item(rng, file, name, item)
    data = path.read_bytes()
    path.unlink()
    return data


def _odd_value(rng: random.Random) -> object:
    return rng.choice(
        (
            np.nan, np.inf, -1, 0, 2**62, 1e300, -1e300, "", "x", "\x1b[2J\x9b31m\u202e", "<script>alert(1)</script>",
            "[" * 5000, "9" * 5000, "$\\frac{", "../../x", b"\xff\xfe", h5py.Empty("f8"), np.zeros(0), np.zeros((3, 3)),
            np.array([b"a", b"b"]), np.full((2, 2, 2), np.nan), True, np.arange(7), np.array(["x"], dtype="S1"),
            np.array([(1, 2.0)], dtype=[("a", "i4"), ("b", "f8")]), 1 + 2j,
        )
    )  # fmt: skip


def _change_attribute(rng: random.Random, item: h5py.HLObject, name: str) -> None:
    if rng.random() < 0.2:
        del item.attrs[name]
    else:
        item.attrs[name] = _odd_value(rng)


def _change_item(rng: random.Random, file: h5py.File, name: str, item: h5py.HLObject) -> None:
    if not isinstance(item, h5py.Dataset):
        change = rng.randrange(5)
        if change == 0:
            del file[name]
        elif change == 1:
            file.move(name, f"{name}-{rng.choice(('x', '../y', '<b>', chr(27) + '[2J'))}")
        elif change == 2:
            item["cycle"] = file["/"] if rng.random() < 0.5 else h5py.SoftLink(name)
        elif change == 3:
            item[f"extra{rng.randrange(9)}"] = _odd_value(rng)
        else:
            del file[name]
            file[name] = _odd_value(rng)
        return
    values, attributes = item[()], dict(item.attrs)
    change = rng.randrange(14)
    if change == 0 and np.ndim(values) and len(values):
        with suppress(TypeError, ValueError):
            row = rng.randrange(len(values))
            values[row : row + rng.choice((1, 5, 10**9))] = rng.choice((np.nan, np.inf, 0, -1, 1e300, 1e18, -1e9))
            item[...] = values
        return
    del file[name]
    if change == 1:
        return
    if change == 2:
        file[name] = h5py.ExternalLink(str(Path(file.filename).with_name("secret.h5")), "/secret")
    elif change == 3:
        file[name] = h5py.SoftLink(rng.choice((name, "/nothing", "/imu", "/table/t_ns")))
    elif change == 4:
        layout = h5py.VirtualLayout(np.shape(values) or (1,), dtype="f8")
        layout[...] = h5py.VirtualSource(
            str(Path(file.filename).with_name("secret.h5")), "secret", np.shape(values) or (1,)
        )
        file.create_virtual_dataset(name, layout)
    elif change == 5:
        outside = [(str(Path(file.filename).with_name("secret.txt")).encode(), 0, 8 * 1000)]
        file.create_dataset(name, (1000,), "f8", external=outside)
    elif change == 6:
        shape = rng.choice(((400_000_000,), (400_000_000, 4), (2**40,), (1, 2**33), (2, 2, 2**30)))
        file.create_dataset(name, shape, rng.choice(("f8", "i8")), chunks=rng.choice((True, None)))
    elif change == 7:
        file.create_dataset(name, (120_000_000, 4), "f8", chunks=(1_000_000, 4), compression="gzip", fillvalue=1.0)
    elif change == 8:
        file[name] = _odd_value(rng)
    elif change == 9:
        file.create_group(name)
    elif change == 10:
        file[name] = np.asarray(values)[: max(np.shape(values)[0] // 2, 1)] if np.ndim(values) else values
    elif change == 11:
        file[name] = np.asarray(values)[..., None] if rng.random() < 0.5 else np.ravel(values)
    elif change == 12:
        file[name] = np.asarray(values).astype(rng.choice(("f4", "i1", "u8", "S8", "c16"))) if np.ndim(values) else 0
    else:
        file[name] = np.asarray(values)[::-1] if np.ndim(values) else values
    with suppress(KeyError):
        for key, value in attributes.items():
            file[name].attrs[key] = value


def run_typed(typed: Sequence[str]) -> int:
    """Do in this process what a command line does, or what the screen does with a file of the folder."""
    if typed == ("screen",):
        from station.screen.archive.reading import read

        read(Path("recording.h5"), 0.0, True)
        return 0
    if typed == ("remembered",):
        from station.screen.memory import load_remembered

        os.environ["XDG_STATE_HOME"] = os.getcwd()
        load_remembered()
        return 0
    return main(typed)


class _LateError(BaseException):
    pass


def _late(_number: int, _frame: object) -> None:
    raise _LateError


def attempt(name: str, typed: Sequence[str], limit_s: float = LIMIT_S) -> Ended:
    """Do one case in this process and folder; what goes wrong is kept."""
    ended = Ended(name, " ".join(typed))
    out, err = (io.TextIOWrapper(io.BytesIO(), "utf-8", "backslashreplace", write_through=True) for _ in range(2))
    signal.signal(signal.SIGALRM, _late)
    began = time.monotonic()
    try:
        signal.alarm(round(limit_s))
        with redirect_stdout(out), redirect_stderr(err):
            ended.code = run_typed(typed)
    except SystemExit as error:
        ended.code = error.code if isinstance(error.code, int) else 2
    except _LateError:
        ended.wrong = f"no end within {limit_s:.0f} s"
    except BaseException as error:
        frames = traceback.extract_tb(error.__traceback__)
        places = [f"{Path(f.filename).name}:{f.lineno} {f.name}" for f in frames[-4:]]
        ended.wrong = f"{type(error).__name__}: {str(error)[:150]} at {' < '.join(reversed(places))}"
    finally:
        signal.alarm(0)
    ended.seconds = time.monotonic() - began
    ended.said = "".join(stream.buffer.getvalue().decode("utf-8", "replace") for stream in (out, err))
    ended.peak_bytes = 1024 * max(
        resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    if not ended.wrong:
        if ended.code not in EXIT_CODES:
            ended.wrong = f"it ended with {ended.code}"
        elif "Traceback" in ended.said:
            ended.wrong = ended.said[ended.said.find("Traceback") :][-600:]
        elif SECRET in ended.said:
            ended.wrong = "it told what stands in another file"
        elif found := CONTROL.search(ended.said):
            ended.wrong = f"it puts {found[0]!r} on the terminal"
        elif ended.peak_bytes > MOST_BYTES:
            ended.wrong = f"it took {ended.peak_bytes >> 20} MB"
    return ended


SECRET = "nobody may read this"
CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]")


def mutants(kind: Kind, count: int, seed: int, folder: Path) -> Iterator[tuple[str, bytes]]:
    """Yield names and contents of mutants of a kind, the same for the same seed."""
    original = kind.seed()
    if not seed:
        yield f"{kind.name} as it is", original
    for number in range(count):
        rng = random.Random(f"{kind.name} {seed} {number}")
        yield f"{kind.name} {seed} {number}", (kind.mutate or _bytes)(rng, original, folder)


def _batch(kind: Kind, cases: Sequence[tuple[str, bytes]], tell: Callable[[Ended], None], at: list[int]) -> None:
    """Do cases one after another, each in a new folder, beside which stands a secret."""
    for number, (name, data) in enumerate(cases):
        at[0] = number
        with tempfile.TemporaryDirectory(prefix="case-", dir=os.getcwd()) as made:
            folder = Path(made)
            kind.beside(folder)
            (folder / kind.file).write_bytes(data)
            with h5py.File(folder / "secret.h5", "w") as file:
                file["secret"] = np.full(1000, 123456.789)
            (folder / "secret.txt").write_text(SECRET * 500)
            before = set(os.listdir(Path(made).parent))
            os.chdir(folder)
            try:
                for typed in kind.typed:
                    with suppress(OSError):
                        os.unlink("out.h5")
                        os.unlink("out.html")
                    ended = attempt(name, typed)
                    if made_outside := set(os.listdir(folder.parent)) - before:
                        ended.wrong = ended.wrong or f"it wrote outside: {made_outside}"
                    tell(ended)
            finally:
                os.chdir(folder.parent)


def tried(kind: Kind, cases: Sequence[tuple[str, bytes]]) -> Iterator[Ended]:
    """Yield how the cases ended, done in forked processes with bounded memory; one that dies is told and replaced."""
    cases = list(cases)
    while cases:
        at = [0]
        with tempfile.TemporaryDirectory(prefix="untrusted-") as folder:
            read, write = os.pipe()
            child = os.fork()
            if not child:
                os.close(read)
                code = 1
                try:
                    os.chdir(folder)
                    resource.setrlimit(resource.RLIMIT_AS, (4 * MOST_BYTES, 4 * MOST_BYTES))
                    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
                    with os.fdopen(write, "w") as pipe:

                        def tell(ended: Ended, at: list[int] = at, pipe: IO[str] = pipe) -> None:
                            said = ended.said[-400:] if ended.wrong else ""
                            row = [at[0], ended.name, ended.typed, ended.code, ended.wrong, ended.seconds, said]
                            print(json.dumps(row), file=pipe, flush=True)

                        _batch(kind, cases, tell, at)
                    code = 0
                except BaseException:
                    traceback.print_exc()
                finally:
                    _exit(code)
            os.close(write)
            last = -1
            with os.fdopen(read) as pipe:
                for line in pipe:
                    last, name, typed, code, wrong, seconds, said = json.loads(line)
                    yield Ended(name, typed, code, said, wrong, seconds)
            _, status = os.waitpid(child, 0)
            if status == 0:
                return
            dead = min(last + 1, len(cases) - 1) if last < 0 or status else last
            yield Ended(cases[dead][0], "", wrong=f"its process ended with status {status}")
            cases = cases[dead + 1 :]


def campaign(names: Sequence[str], count: int, seed: int, until_s: float = np.inf) -> Iterator[Ended]:
    """Yield how mutants of these kinds ended (all kinds if none is named), 20 of each in turn, until the time is up."""
    _seeds()
    end = time.monotonic() + until_s
    kinds = [kind for kind in KINDS if not names or kind.name in names]
    for first in range(0, count, 20):
        for kind in kinds:
            if time.monotonic() > end:
                return
            with tempfile.TemporaryDirectory() as folder:
                cases = list(mutants(kind, min(20, count - first), seed + first, Path(folder)))
            yield from tried(kind, cases)


def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kinds", nargs="*")
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    total, wrong, seen = 0, 0, dict[str, int]()
    slowest: dict[str, float] = {}
    codes: dict[str, Counter[int | None]] = {}
    for ended in campaign(arguments.kinds, arguments.count, arguments.seed):
        total += 1
        kind = ended.name.rsplit(" ", 2)[0] + ": " + ended.typed.split(" ")[0]
        codes.setdefault(kind, Counter())[ended.code] += 1
        slowest[kind] = max(slowest.get(kind, 0.0), ended.seconds)
        if ended.wrong:
            wrong += 1
            key = re.sub(r"\d+", "#", ended.wrong)[:120] + kind
            seen[key] = seen.get(key, 0) + 1
            if seen[key] <= 2:
                print(f"{ended.name} [{ended.typed}]: {ended.wrong}", flush=True)
    for kind, seconds in slowest.items():
        ends = ", ".join(f"{count} x {code}" for code, count in codes[kind].most_common())
        print(f"{kind:<40} slowest {seconds:.1f} s; exit codes {ends}")
    print(f"{total} cases, {wrong} wrong")


if __name__ == "__main__":
    _main()
