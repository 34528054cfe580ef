"""What sessions say, kept as lines of their sockets' language; and a socket that says it again, up to a chosen instant.

python tests/station/screen/streams.py      makes tests/data/screen/* anew, from sessions on twins

Pictures show figures from these files only. A figure that a test computes
differs in its last digits between processors.

Each line of a stream is a message with "at_s" beside it: the instant on the loop's clock, in virtual time, at which it
was said. A snapshot a second is kept, its figures to five digits.
"""

from __future__ import annotations

import asyncio
import io
import json
import math
import os
import socket
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import redirect_stdout, suppress
from pathlib import Path
from typing import Any

import h5py

from station.bench.bench import default_bench_text, load_bench
from station.cli import main
from station.opening import open_bench
from station.remote.hosting import introduction
from station.render.printing import result_object
from station.run.event_loop.loops import VirtualLoop
from station.run.session import RunOptions, Session
from station.run.snapshot import EventKind
from station.scripts.script import Script, load_script
from station.views.json_values import json_object

STREAMS = Path(__file__).parents[2] / "data" / "screen"
RECORDING = "recordings/run-20261121-101502.h5"


def turns(name: str, rest_s: float, turn_s: float, rates_dps: tuple[float, float, float], more: str = "") -> str:
    """Return a script: a rest, a turn about each axis, a rest; ``more`` are further lines of each turn."""
    rest = f'[[step]]\nkind = "rest"\nduration = "{rest_s} s"\n'
    turned = "".join(
        f'[[step]]\nkind = "rotate"\naxis = "{axis}"\nrate = "{rate} deg/s"\n{more}duration = "{turn_s} s"\n'
        for axis, rate in zip("xyz", rates_dps, strict=True)
    )
    return f'name = "{name}"\n{rest}{turned}{rest}'


SCRIPT = turns("short", 4, 11, (40, -40, 40))
TINY = turns("tiny", 3, 6, (60, 60, 60), 'acceleration = "50 deg/s2"\n')
"""As short as a calibration can be."""
_DIGITS = 5
_BREATH_S = 0.5


def bench_text(end: str = "") -> str:
    """Return the built-in bench with limits that suit a short script, and patterns."""
    text = default_bench_text()
    for name in ("scale_factor_error", "bias", "misalignment"):
        text = text.replace(f"sd_{name} = ", f"# sd_{name} = ")
    return f'{text}\n[station]\noperator_pattern = "[A-Z][A-Za-z. ]+"\nserial_pattern = "SN-[0-9]{{4}}"\n{end}'


async def listen(
    folder: Path, act: Callable[[Session, float], None], end: str = "", manual: bool = False
) -> list[dict[str, Any]]:
    """Run a session and return what it says; ``act(session, t_s)`` is called once a second."""
    (folder / "bench.toml").write_text(bench_text(end))
    (folder / "short.toml").write_text(SCRIPT)
    bench = load_bench(folder / "bench.toml")
    script = Script("manual", ()) if manual else load_script(folder / "short.toml")
    loop = asyncio.get_running_loop()
    said: list[dict[str, Any]] = []

    def tell(t_s: float, kind: EventKind, text: str) -> None:
        said.append({"at_s": loop.time(), "kind": "event", "t_s": t_s, "event": kind, "text": text})

    async def watch(session: Session) -> None:
        while True:
            said.append({"at_s": loop.time(), "kind": "snapshot", **json_object(session.snapshot())})
            act(session, loop.time())
            await asyncio.sleep(1.0)

    async with open_bench(bench) as opened:
        told = {"operator": "A. Operator", "device_serial": "SN-0042"}
        session = Session(opened, script, folder / "run.h5", options=RunOptions(**told, manual=manual), on_event=tell)
        hello = introduction(bench, "bench.toml", script, Path(RECORDING), session.gyros)
        head = {
            "at_s": 0.0,
            "kind": "hello",
            "version": 2,
            "pid": 4242,
            "time_scale": 5.0,
            **hello,
            **told,
            "manual": manual,
        }
        watching = asyncio.create_task(watch(session))
        result = await session.run()
        watching.cancel()
    found = result_object(result.verdict, RECORDING, result.calibration)
    head |= {"recording": RECORDING, "bench_file": "bench.toml"}
    return [head, *said, {"at_s": loop.time(), "kind": "result", **found}]


def make(
    name: str, act: Callable[[Session, float], None] = lambda session, t_s: None, end: str = "", manual: bool = False
) -> None:
    """Make one stream."""
    with tempfile.TemporaryDirectory() as folder, asyncio.Runner(loop_factory=VirtualLoop) as runner:
        lines = runner.run(listen(Path(folder), act, end, manual))
    text = "".join(json.dumps(_rounded(line), allow_nan=False) + "\n" for line in lines)
    (STREAMS / f"{name}.jsonl").write_text(text)
    print(f"{name}: {len(lines)} lines, {len(text)} bytes, {lines[-1]['outcome']}")


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None
    return value


class Replay:
    """A session's socket that says a stream again, until an instant, and then waits for what it is told.

    Used as a context. ``heard`` are the requests that came, ``told`` is set by the first; to "stop" it says the stream
    ``after_stop`` from there on.
    """

    def __init__(
        self,
        name: str,
        until_s: float,
        *,
        after_stop: str = "",
        label: str = "",
        longer_s: float = 0.0,
        pid: int = 4242,
    ) -> None:
        """Listen; ``label`` is that of every step, the script may take ``longer_s`` more than it says.

        ``pid`` is the number of the process that it claims to be, by which several are told apart.
        """
        self._lines = [{**line, **({"label": label} if label and line.get("label") else {})} for line in _lines(name)]
        for line in self._lines:
            if line["kind"] == "snapshot":
                line["longer_s"] = longer_s
            elif line["kind"] == "hello":
                line["script"]["longest_s"] += longer_s
        self._until_s = until_s
        self._clients: list[socket.socket] = []
        self._after = _lines(after_stop) if after_stop else []
        self.heard: list[dict[str, Any]] = []
        self.told = threading.Event()
        folder = Path(os.environ["XDG_RUNTIME_DIR"]) / f"station-{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        self.path = folder / f"{pid}.sock"
        self._server = socket.socket(socket.AF_UNIX)
        self._server.bind(str(self.path))
        self._server.listen()

    def __enter__(self) -> Replay:
        threading.Thread(target=self._accept, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self.vanish()

    def vanish(self) -> None:
        """Be gone, as a process that was killed."""
        with suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        self.hang_up()

    def hang_up(self) -> None:
        """Break all connections, and say nothing on new ones."""
        self._lines = []
        for client in self._clients:
            with suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                client, _ = self._server.accept()
                self._clients.append(client)
                threading.Thread(target=self._talk, args=(client,), daemon=True).start()

    def _breathe(self, stream: Any) -> None:
        """Be heard now and then: a session that says nothing does not live."""
        with suppress(OSError, ValueError):
            while True:
                _say(stream, {"kind": "nothing"})
                time.sleep(_BREATH_S)

    def _talk(self, client: socket.socket) -> None:
        with suppress(OSError), client, client.makefile("rwb") as stream:
            for line in self._lines:
                if line["at_s"] <= self._until_s:
                    _say(stream, line)
                    _say(stream, {"kind": "nothing"})  # else a snapshot would give way to the next
            threading.Thread(target=self._breathe, args=(stream,), daemon=True).start()
            for request in map(json.loads, stream):
                if request["do"] == "course":  # is asked by every screen; it has all from the first instant on
                    continue
                self.heard.append(request)
                self.told.set()
                if request["do"] == "stop" and self._after:
                    for line in self._after:
                        if line["at_s"] > self._until_s:
                            _say(stream, line)
                    client.shutdown(socket.SHUT_WR)


def _lines(name: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (STREAMS / f"{name}.jsonl").read_text().splitlines()]


def _say(stream: Any, line: dict[str, Any]) -> None:
    stream.write(json.dumps({key: value for key, value in line.items() if key != "at_s"}).encode() + b"\n")
    stream.flush()


def by_hand(session: Session, t_s: float) -> None:
    """Go to an angle, home, to another angle, and end."""
    degrees = {8.0: 60.0, 18.0: 0.0, 26.0: -90.0}.get(round(t_s))
    if degrees is not None:
        session.drive("go", {"axis": "y", "angle_rad": math.radians(degrees), "rate_rps": math.radians(10.0)})
    elif t_s > 34:
        session.drive("end", {})


def make_recording(name: str, seed: int, scale_limit: str) -> None:
    """Make one recording of ``TINY`` with a limit of the scale factor error, compressed."""
    with tempfile.TemporaryDirectory() as folder:
        bench, script, path = Path(folder, "bench.toml"), Path(folder, "tiny.toml"), Path(folder, f"{name}.h5")
        script.write_text(TINY)
        limit = 'scale_factor_error = "{}"'
        bench.write_text(bench_text().replace(limit.format("10000 ppm"), limit.format(scale_limit)))
        words = ["--operator", "A. Operator", "--serial-number", "SN-0042", "--seed", str(seed), "--json"]
        files = ["--bench", bench, "--script", script, "--output", path]
        with redirect_stdout(io.StringIO()) as said:
            main(["run", *words, *map(str, files)])
        compress(path, STREAMS / path.name)
    print(f"{name}: {(STREAMS / path.name).stat().st_size} bytes, {json.loads(said.getvalue())['outcome']}")


def compress(source: Path, target: Path) -> None:
    """Copy an HDF5 file with each array compressed, in one chunk that can grow."""
    with h5py.File(source) as old, h5py.File(target, "w") as new:
        new.attrs.update(old.attrs)

        def copy(name: str, item: h5py.Group | h5py.Dataset) -> None:
            if isinstance(item, h5py.Group):
                made = new.create_group(name)
            else:
                how = {"maxshape": item.maxshape, "chunks": item.shape, "compression": "gzip", "shuffle": True}
                made = new.create_dataset(name, data=item[:], dtype=item.dtype, **how)
            made.attrs.update(item.attrs)

        old.visititems(copy)


if __name__ == "__main__":
    STREAMS.mkdir(exist_ok=True)
    make("manual", by_hand, manual=True)
    make("pass")
    make("stopped", lambda session, t_s: session.stop() if t_s > 30 else None)
    make("fault", end='\n[twin.fault]\naxis = "y"\nat = "25 s"\n')
    make_recording("first", 1, "10000 ppm")
    make_recording("second", 2, "3000 ppm")
