"""The screen beside a real session: how soon it is there, what it costs, how fast STOP is.

python tests/bench/screen.py                     first picture, then a run at real time with a source of 2 kHz
python tests/bench/screen.py --seconds 60 --tries 200 --size 200x60
python tests/bench/screen.py --seconds 500 --size 200x60     a million samples with all plots on: none is lost

The screen runs in a pseudo-terminal. Between it and the session is a relay that passes everything on, except for the
word to stop, whose instant it notes: so the run goes on, and STOP is timed again and again, from the byte of the key
in the terminal to the line on the session's socket, at random instants.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import select
import signal
import socket
import subprocess
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
from support import command
from terminal import Terminal

from station.bench.bench import default_bench_text

_FIRST_PICTURE = "History"
_FEW_CELLS = 10
"""So many cells at least have dots where a curve is drawn."""


class Relay:
    """A socket of a session in another folder: everything passes but the word to stop, whose instants are kept."""

    def __init__(self, session: Path, folder: Path) -> None:
        """Listen in a folder of sockets that only the screen looks into."""
        self.stops: list[float] = []
        self.arrived = threading.Event()
        place = folder / f"station-{os.getuid()}"
        place.mkdir(mode=0o700, parents=True)
        self._session = session
        self._server = socket.socket(socket.AF_UNIX)
        self._server.bind(str(place / session.name))
        self._server.listen()
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            client, _ = self._server.accept()
            threading.Thread(target=self._pass_on, args=(client,), daemon=True).start()

    def _pass_on(self, client: socket.socket) -> None:
        with suppress(OSError), client, socket.socket(socket.AF_UNIX) as session:
            session.connect(str(self._session))
            while True:
                for ready in select.select([client, session], [], [])[0]:
                    data = ready.recv(65536)
                    if not data:
                        return
                    if ready is session:
                        client.sendall(data)
                    elif b'"stop"' in data:
                        self.stops.append(time.monotonic())
                        self.arrived.set()


def files(folder: Path, seconds: float) -> list[str]:
    """Write the built-in bench with its STIM300 at 2 kHz in place of the array, and a script that is long enough."""
    text = default_bench_text().replace('rate = "500 Hz"', 'rate = "2000 Hz"')
    text = text.replace("used = false", "used = true").replace('name = "array"', 'name = "array"\nused = false')
    (folder / "fast.toml").write_text(text)
    turn = 'kind = "rotate"\nrate = "20 deg/s"\nduration = "{} s"'
    steps = [f'[[step]]\naxis = "{axis}"\n{turn.format(seconds / 3 + 60)}\n' for axis in "xyz"]
    (folder / "long.toml").write_text("".join(steps))
    return ["--bench", str(folder / "fast.toml"), "--script", str(folder / "long.toml")]


def first_picture(columns: int, rows: int, folder: Path) -> float:
    """Return the seconds from the start of the process to the first picture."""
    variables = {"XDG_STATE_HOME": str(folder / "state")}
    with Terminal(command("ui", "--folder", folder), columns, rows, variables) as terminal:
        terminal.wait_for(_FIRST_PICTURE, limit_s=20)
        return time.monotonic() - terminal.began_s


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0, help="how long the cost is measured; default: 30")
    parser.add_argument("--tries", type=int, default=120, help="how often STOP is pressed; default: 120")
    parser.add_argument("--size", default="140x40", help="columns x rows; default: 140x40")
    arguments = parser.parse_args()
    columns, rows = map(int, arguments.size.split("x"))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        first = [first_picture(columns, rows, folder) for _ in range(5)]
        print(f"first picture after {np.median(first):.2f} s (median of 5, {min(first):.2f} to {max(first):.2f})")
        recording = folder / "run.h5"
        run = subprocess.Popen(
            command("run", "--host", "--json", *files(folder, arguments.seconds), "-o", recording),
            env={**os.environ, "XDG_RUNTIME_DIR": str(folder)},
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        try:
            measure(run, folder, columns, rows, arguments)
        finally:
            run.send_signal(signal.SIGINT)
            out, _ = run.communicate(timeout=60)
            found = json.loads(out)
            for name, source in found["sources"].items():
                print(f"{name}: {source['lost']} of {source['samples'] + source['lost']} samples lost")
            print(found["outcome"], found["reason"])


def measure(run: subprocess.Popen[bytes], folder: Path, columns: int, rows: int, arguments: argparse.Namespace) -> None:
    """Attach a screen to a run through the relay, and measure its cost and STOP."""
    session = folder / f"station-{os.getuid()}" / f"{run.pid}.sock"
    while not session.exists():
        time.sleep(0.05)
    relay = Relay(session, folder / "seen")
    seen = {name: str(folder / "seen") for name in ("XDG_RUNTIME_DIR", "XDG_STATE_HOME", "TMPDIR")}
    terminal = Terminal(command("ui", "--attach", "--folder", folder), columns, rows, seen)
    time.sleep(20)  # the session homes, the estimates begin, each chart has been drawn
    cells = terminal.charts()  # now: to read what is drawn in all of the time would take minutes
    drawn = [name for name, count in cells.items() if count >= _FEW_CELLS]
    print(f"charts with a curve: {len(drawn)} of {len(cells)} in sight; cells with dots: {cells}")
    cpu_s, began_s, sent = terminal.cpu_s(), time.monotonic(), terminal.bytes
    time.sleep(arguments.seconds)
    span_s = time.monotonic() - began_s
    share, kilobytes = (terminal.cpu_s() - cpu_s) / span_s, (terminal.bytes - sent) / span_s / 1e3
    print(f"{columns} x {rows}: {share:.1%} of a core, {kilobytes:.1f} kB/s to the terminal, over {span_s:.0f} s")
    latencies = []
    for _ in range(arguments.tries):
        time.sleep(random.uniform(0.05, 0.25))
        relay.arrived.clear()
        pressed_s = time.monotonic()
        terminal.press("f9")
        if not relay.arrived.wait(5):
            raise SystemExit("STOP did not arrive within 5 s")
        latencies.append(relay.stops[-1] - pressed_s)
    ms = np.array(latencies) * 1e3
    print(
        f"STOP, key to line on the socket, {len(ms)} tries: median {np.median(ms):.1f} ms, "
        f"p99 {np.percentile(ms, 99):.1f} ms, most {ms.max():.1f} ms"
    )
    terminal.close()


if __name__ == "__main__":
    main()
