"""STOP over the socket of a running session: from the line on the socket to the stop command on the table's wire.

A 2 kHz STIM300 on a pty and a table on Modbus TCP, their twins in one process, the session in another, real time. On
the wire to the table stands a process that notes when each drive is told to stop; both use the system's monotonic
clock. A client reads snapshots all the while and says "stop" at a random moment of a turn.

    python tests/bench/stop.py --times 20
    python tests/bench/stop.py --times 20 --clients 5     that many more look on
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import random
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection
from pathlib import Path

from acquire import bench_of
from support import TwinProcess, command

from drivers.tables.modbus.registers import load_profile
from station.remote.attaching import RemoteSession, running_sessions

AXES = {3: "z", 2: "y", 1: "x"}  # unit ids of the built-in bench
TURNING = "x"  # told last of the three
SCRIPT = f"""
[[step]]
kind = "rest"
duration = "1 s"

[[step]]
kind = "rotate"
axis = "{TURNING}"
rate = "40 deg/s"
acceleration = "40 deg/s2"
duration = "60 s"
label = "turn"
"""
_HEADER = 6  # bytes of a Modbus TCP frame before the unit id
_WRITE_ONE = 6


def listen_in(link: str, say: Connection) -> None:
    """Stand between station and table; say the port, then (monotonic s, axis) of each stop command that passes."""
    profile = load_profile("kinco")
    stop = bytes([_WRITE_ONE, *profile["controlword"].address.to_bytes(2), *profile.commands["quick_stop"].to_bytes(2)])
    host, port = link.removeprefix("tcp://").split(":")
    server = socket.create_server(("127.0.0.1", 0))
    say.send(server.getsockname()[1])

    def carry(source: socket.socket, target: socket.socket, watched: bool) -> None:
        while data := source.recv(4096):
            now_s = time.monotonic()
            target.sendall(data)
            if watched and data[_HEADER + 1 :].startswith(stop):  # one request at a time: a frame comes whole
                say.send((now_s, AXES[data[_HEADER]]))
        target.close()

    while True:
        near, _ = server.accept()
        far = socket.create_connection((host, int(port)))
        for end in (near, far):
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        threading.Thread(target=carry, args=(near, far, True), daemon=True).start()
        threading.Thread(target=carry, args=(far, near, False), daemon=True).start()


async def stop_once(pid: int, after_s: float) -> tuple[float, dict[str, object]]:
    """Say stop so long after the turn began; return when that was (monotonic s), and the session's result."""
    while not (found := [p for p in running_sessions() if p.stem == str(pid)]):
        await asyncio.sleep(0.02)
    session = await RemoteSession.connect(found[0])
    due_s = said_s = 0.0
    message: dict[str, object] = {}
    async for message in session.messages():
        if message["kind"] == "result":
            break
        if message.get("label") == "turn" and not due_s:
            due_s = time.monotonic() + after_s
        if due_s and not said_s and time.monotonic() >= due_s:
            await asyncio.sleep(random.uniform(0, 0.1))  # not in step with the snapshots
            said_s = time.monotonic()
            session.stop()
    if not said_s or message["kind"] != "result":
        raise RuntimeError(f"the session ended by itself: {message}")
    return said_s, message


async def look_on(pid: int) -> None:
    """Read all that a session says, until it ends."""
    while not (found := [p for p in running_sessions() if p.stem == str(pid)]):
        await asyncio.sleep(0.02)
    session = await RemoteSession.connect(found[0])
    async for _ in session.messages():
        pass


async def follow(pid: int, after_s: float, clients: int) -> tuple[float, dict[str, object]]:
    """Stop once while others look on."""
    said, *_ = await asyncio.gather(stop_once(pid, after_s), *(look_on(pid) for _ in range(clients)))
    return said


def percentiles(name: str, values_s: Sequence[float]) -> str:
    """Return median, 99th percentile and largest of some latencies in words."""
    ordered = [1e3 * value for value in sorted(values_s)]
    high = ordered[min(round(0.99 * len(ordered)), len(ordered) - 1)]
    return f"{name}: p50 {ordered[len(ordered) // 2]:.1f} ms, p99 {high:.1f} ms, max {ordered[-1]:.1f} ms"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--clients", type=int, default=0)
    arguments = parser.parse_args()
    first, turning = [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "bench.toml").write_text(bench_of("stim300"))
        (folder / "script.toml").write_text(SCRIPT)
        with TwinProcess("--bench", folder / "bench.toml") as twin:
            heard, say = multiprocessing.Pipe(duplex=False)
            between = multiprocessing.get_context("spawn").Process(
                target=listen_in, args=(twin.links["table"], say), daemon=True
            )
            between.start()
            table = f"table=tcp://127.0.0.1:{heard.recv()}"
            for number in range(arguments.times):
                path = folder / f"{number}.h5"
                run = subprocess.Popen(
                    command(
                        "run", "--host", "--bench", folder / "bench.toml", "--script", folder / "script.toml", "--json",
                        "--device", "stim300", *twin.options("stim300"), "--link", table, "-o", path,
                    ),
                    stdout=subprocess.DEVNULL,
                )  # fmt: skip
                after_s = random.uniform(0.5, 5.0)
                said_s, result = asyncio.run(follow(run.pid, after_s, arguments.clients))
                run.wait()
                told: dict[str, float] = {}
                while heard.poll(0.1):
                    at_s, axis = heard.recv()
                    told.setdefault(axis, at_s - said_s)
                first.append(min(told.values()))
                turning.append(told[TURNING])
                print(
                    json.dumps({"after_s": round(after_s, 2), "ms": {a: round(1e3 * t, 2) for a, t in told.items()}}),
                    result["outcome"],
                    flush=True,
                )
            between.terminate()
            between.join()
    print(percentiles("line to the first stop command on the wire", first))
    print(percentiles("line to that of the turning axis, the last of three", turning))


if __name__ == "__main__":
    main()
