"""Has imported the station, and forks a process for each command that is asked for at a socket.

python -P server.py SOCKET PIPE      until nobody has the named pipe open for writing

Most tests that start the station ask what a command does, and not how Python starts: importing numpy, h5py and the rest
would take longer than the command. A process that is forked here has its own arguments, environment, folder, streams
and signals, and goes on as the main program of an interpreter does: it returns from ``main``, waits for its threads,
runs what is registered for the exit and flushes its streams. Only the memory it does not free: that would copy every
page that it shares with the server, and take twice the time of the rest.
"""

from __future__ import annotations

import array
import atexit
import gc
import importlib
import io
import marshal
import os
import pkgutil
import selectors
import signal
import socket
import sys
import tempfile
import time
import types
from collections.abc import Callable
from contextlib import suppress
from importlib.util import find_spec
from typing import Any

import drivers
import sims
import station.cli
import station.commands
from station.campaigns import ONE_BLAS_THREAD

PROGRAM = "station.cli"
ALSO = (
    *("scipy.linalg", "scipy.optimize", "scipy.signal", "scipy.special", "scipy.stats"),
    *("cantools", "filterpy.kalman", "jinja2", "matplotlib.figure", "matplotlib.backends.backend_svg"),
    *("multiprocessing.popen_fork", "station.report.dcc", "station.report.document"),
)
"""What commands import when they come to need it."""
OF_THE_START = ("PYTHON", "LC_", "LANG", "OPENBLAS_", "OMP_", "MKL_", "MPL", "HOME", "XDG_CONFIG_", "XDG_CACHE_", "LD_")
"""Beginnings of the variables that act while Python starts or libraries are imported."""
ACTED_ON = {"PYTHONUNBUFFERED", "PYTHONDONTWRITEBYTECODE", "PYTHONSAFEPATH", *ONE_BLAS_THREAD}
"""Those of them that a fork acts on, or that the station itself sets for all of its commands."""
_LENGTH_BYTES = 4


class Server:
    """Listens at a socket, forks, and tells each client the number of its process and then how it ended."""

    def __init__(self, address: str, alive: str, start: dict[str, str]) -> None:
        """Listen; ``alive`` is a named pipe that is open as long as anybody may want this server.

        ``start`` are the variables that a process must have in common with this one to be forked from it.
        """
        self._start = start
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(f"{address}.new")
        self._listener.listen(64)
        self._events = selectors.DefaultSelector()
        self._events.register(self._listener, selectors.EVENT_READ, self._accept)
        self._events.register(os.open(alive, os.O_RDONLY), selectors.EVENT_READ, None)
        self._clients: dict[int, socket.socket] = {}
        os.rename(f"{address}.new", address)

    def serve(self) -> dict[str, Any] | None:
        """Serve until nobody may want it, then return None; in a process that was forked, return its order."""
        while True:
            for key, _ in self._events.select():
                if key.data is None:
                    return None
                if (order := key.data(key.fileobj)) is not None:
                    return order

    def _accept(self, listener: socket.socket) -> dict[str, Any] | None:
        client, _ = listener.accept()
        received = receive(client)
        if received is None:
            client.close()
            return None
        order, streams = received
        if of_the_start(order["environment"]) != self._start:
            client.sendall(b"\n")
            client.close()
            _close(streams)
            return None
        process = os.fork()
        if process == 0:
            self._leave()
            client.close()
            return {**order, "streams": streams}
        _close(streams)
        self._clients[process] = client
        client.sendall(f"{process}\n".encode())
        self._events.register(os.pidfd_open(process), selectors.EVENT_READ, lambda handle: self._ended(handle, process))
        self._events.register(client, selectors.EVENT_READ, lambda _: self._abandoned(process))
        return None

    def _ended(self, handle: int, process: int) -> None:
        """Tell the client of a process how that ended."""
        _, status = os.waitpid(process, 0)
        self._events.unregister(handle)
        os.close(handle)
        client = self._clients.pop(process)
        if client.fileno() >= 0:
            self._events.unregister(client)
            with suppress(OSError):  # it may have been killed a moment ago
                client.sendall(f"{os.waitstatus_to_exitcode(status)}\n".encode())
            client.close()

    def _abandoned(self, process: int) -> None:
        """Kill a process whose client was killed."""
        client = self._clients.get(process)
        if client is None:  # it has ended meanwhile
            return
        self._events.unregister(client)
        client.close()
        os.kill(process, signal.SIGKILL)

    def _leave(self) -> None:
        """Close what a process that was forked has of the server."""
        for key in list(self._events.get_map().values()):
            os.close(key.fd) if isinstance(key.fileobj, int) else key.fileobj.close()
        self._events.close()


def of_the_start(environment: dict[str, str] | os._Environ[str]) -> dict[str, str]:
    """Return the variables that act while Python starts or libraries are imported."""
    return {
        name: value for name, value in environment.items() if name.startswith(OF_THE_START) and name not in ACTED_ON
    }


def receive(client: socket.socket) -> tuple[dict[str, Any], list[int]] | None:
    """Return an order and the streams that came with it; None if the client is gone."""
    streams = array.array("i")
    head, ancillary, _, _ = client.recvmsg(_LENGTH_BYTES, socket.CMSG_SPACE(3 * streams.itemsize))
    for _, _, data in ancillary:
        streams.frombytes(data)
    packed = bytearray()
    while head and len(packed) < int.from_bytes(head, "big"):
        packed += (part := client.recv(65536))
        if not part:
            _close(list(streams))
            return None
    return (marshal.loads(packed), list(streams)) if head else None


def _close(handles: list[int]) -> None:
    for handle in handles:
        os.close(handle)


def become(order: dict[str, Any]) -> None:
    """Give a process that was forked all that a new one would have of who starts it."""
    os.setsid()
    for handle, stream in enumerate(order["streams"]):
        os.dup2(stream, handle)
        os.close(stream)
    os.chdir(order["folder"])
    os.environ.clear()
    os.environ.update(order["environment"])
    time.tzset()
    tempfile.tempdir = None
    for number in order["ignored_signals"]:
        signal.signal(number, signal.SIG_IGN)
    sys.dont_write_bytecode = "PYTHONDONTWRITEBYTECODE" in os.environ
    if not (order["safe_path"] or os.environ.get("PYTHONSAFEPATH")):
        sys.path.insert(0, order["folder"])
    open_streams(unbuffered=bool(os.environ.get("PYTHONUNBUFFERED")))
    main = types.ModuleType("__main__")
    main.__spec__ = find_spec(PROGRAM)
    main.__file__ = station.cli.__file__
    sys.modules["__main__"] = main
    sys.argv = [str(station.cli.__file__), *order["arguments"]]


def open_streams(*, unbuffered: bool) -> None:
    """Open stdin, stdout and stderr as Python does when it starts."""
    encoding, errors = sys.stdout.encoding, sys.stdout.errors

    def text(handle: int, mode: str, **how: Any) -> io.TextIOWrapper:
        raw = io.FileIO(handle, mode, closefd=False)
        if mode == "r":
            return io.TextIOWrapper(io.BufferedReader(raw), encoding, **how)
        binary = raw if unbuffered else io.BufferedWriter(raw)
        return io.TextIOWrapper(binary, encoding, newline="\n", write_through=unbuffered, **how)  # type: ignore[arg-type]

    sys.stdin = sys.__stdin__ = text(0, "r", errors=errors, line_buffering=os.isatty(0))  # type: ignore[misc]
    sys.stdout = sys.__stdout__ = text(1, "w", errors=errors, line_buffering=os.isatty(1))  # type: ignore[misc]
    sys.stderr = sys.__stderr__ = text(2, "w", errors="backslashreplace", line_buffering=True)  # type: ignore[misc]


class Exit:
    """Ends a process that was forked as soon as all else that the interpreter does at its exit is done."""

    def __init__(self) -> None:
        """Register this exit; of the functions that are registered, the first one runs last."""
        self._code: int | None = None
        atexit.register(self._leave)

    def run(self, program: Callable[[], int]) -> int:
        """Run the program and return its exit code; what it raises passes on."""
        try:
            self._code = program()
        except SystemExit as end:
            if end.code is None or isinstance(end.code, int):
                self._code = end.code or 0
            raise
        return self._code

    def _leave(self) -> None:
        if self._code is None:  # the server, or a program that did not end by itself
            return
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        except (OSError, ValueError):  # the interpreter has its own words for it, and its own exit code
            return
        os._exit(self._code & 0xFF)


def import_all() -> None:
    """Import what commands are made of, and leave it out of what later collections look at."""
    for module in pkgutil.iter_modules(station.commands.__path__, "station.commands."):
        importlib.import_module(module.name)
    for package in (drivers, sims):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            importlib.import_module(module.name)
    for name in ALSO:
        importlib.import_module(name)
    gc.collect()
    gc.freeze()


def main() -> int:
    """Serve; in a process that was forked, be the station."""
    address, alive = sys.argv[1:]
    exit_of_forks = Exit()  # before all imports, which register what is to run earlier
    start = of_the_start(os.environ)
    os.environ.update(ONE_BLAS_THREAD)
    import_all()
    order = Server(address, alive, start).serve()
    if order is None:
        return 0
    become(order)
    return exit_of_forks.run(station.cli.main)


if __name__ == "__main__":
    sys.exit(main())
