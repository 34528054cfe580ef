"""The guard's own process: waits for the death of the station, then makes its devices safe, the table first.

It imports no more than that needs, and all of that before the table is enabled: memory and disk may be short when it
is called on. Run as ``python -m station.run.guard.process``; standard input is the pipe from the station.
"""

import asyncio
import ctypes
import os
import pickle
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Coroutine, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import serial  # noqa: F401  a serial link imports it when it is opened, which would be late

from drivers.kind import DeviceKind, SafeState
from drivers.links.lock import check_own, inherited
from drivers.recipe import unpacked_device
from station.run.event_loop.loops import ScaledLoop
from station.run.guard.words import ARM, DISMISS, READY, Order

_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP", "SIGPIPE")
_GIVE_UP_S, _PAUSE_S = 60.0, 0.5
_LAST_WORDS_S = 1.0  # for the terminal and the disk, by the wall's clock
_PR_SET_PDEATHSIG = 1
_OOM_STEPS = range(-1000, 1000, 100)

_Device = tuple[DeviceKind, Any]
"""A kind and a driver of it."""


def main() -> None:
    """Read the order from stdin, confirm it, wait for the station's end, act on it, and end this process.

    Signals that end or stop a process are ignored.
    """
    for name in _SIGNALS:
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    _ask_to_be_spared()
    _ask_to_be_continued()
    size = int.from_bytes(_read(4), "big")
    order: Order = pickle.loads(_read(size))
    with asyncio.Runner(loop_factory=lambda: ScaledLoop(order.time_scale)) as runner:
        runner.run(_stand_guard(order))
        os._exit(0)  # the station may wait for it


def _read(size: int) -> bytes:
    """Wait for ``size`` bytes of the pipe and return them; end this process if the station is gone before."""
    data = b""
    while len(data) < size:
        more = os.read(0, size - len(data))
        if not more:
            sys.exit()
        data += more
    return data


def _ask_to_be_spared() -> None:
    """Ask the kernel to end this process last when memory runs out, as far as this user may; no error otherwise."""
    for value in _OOM_STEPS:
        try:
            with open("/proc/self/oom_score_adj", "w", encoding="ascii") as file:
                file.write(str(value))
        except PermissionError:
            continue
        except OSError:
            pass  # not Linux
        return


def _ask_to_be_continued() -> None:
    """Let the kernel continue this process at the station's death, in case it was stopped (SIGSTOP)."""
    with suppress(OSError, AttributeError):  # not Linux
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGCONT), 0, 0, 0)


async def _stand_guard(order: Order) -> None:
    """Build the drivers, report that the guard is ready, and make the devices safe if the station dies while armed.

    A driver that cannot be built is reported on stderr and left out; without any it ends at once, and is never ready.
    After a death it also holds the station's locks until all is done, and writes the log named in the order.
    """
    devices: list[_Device] = []
    for packed in order.devices:
        try:
            devices.append(unpacked_device(packed))
        except Exception as error:  # errors in a plug-in: the other devices are guarded all the same
            os.write(2, f"station: the guard cannot create a driver: {type(error).__name__}: {error}\n".encode())
    if not devices:
        return
    log = _Log(order)
    os.write(1, READY)
    if await _station_dies(order.pid):
        with inherited(order.locks, f"guard of {order.who}, which has died: stopping {_named(devices)}"):
            await _make_devices_safe(order, devices, log)
        log.close()


async def _station_dies(pid: int) -> bool:
    """Wait until the station has died or dismissed this guard; return True only if it died while the guard was armed.

    Death shows at the pipe and, on Linux, at the process: a forked child of the station may keep the pipe open.
    """
    loop = asyncio.get_running_loop()
    woken, ended = asyncio.Event(), asyncio.Event()
    os.set_blocking(0, False)
    loop.add_reader(0, woken.set)
    process = _process(pid)

    def see_end() -> None:
        loop.remove_reader(process)
        ended.set()
        woken.set()

    if process >= 0:
        loop.add_reader(process, see_end)
    armed = False
    while True:
        await woken.wait()
        woken.clear()
        words, closed = _heard_so_far()
        if DISMISS in words:
            return False
        armed = armed or ARM in words
        if closed or ended.is_set():
            loop.remove_reader(0)
            return armed


def _process(pid: int) -> int:
    """Return a descriptor that becomes readable when the station, process ``pid``, ends.

    -1 if the system has none, or if the station is not the parent of this process, as after its end.
    """
    if not hasattr(os, "pidfd_open"):
        return -1
    try:
        process = os.pidfd_open(pid)
    except OSError:  # an old kernel, or it has ended: then the pipe tells so
        return -1
    if os.getppid() != pid:  # it has ended, and its number may be another process's
        os.close(process)
        return -1
    return process


def _heard_so_far() -> tuple[bytes, bool]:
    """Return what the station has sent since the last call, and whether the pipe is closed; does not wait."""
    words = b""
    with suppress(BlockingIOError):
        while data := os.read(0, 64):
            words += data
        return words, True
    return words, False


def _named(devices: Sequence[_Device]) -> str:
    return " and ".join(kind.what for kind, _ in devices)


async def _make_devices_safe(order: Order, devices: Sequence[_Device], say: "_Log") -> None:
    """Make devices safe: the first, which is the table if there is one, then all others at once.

    The others begin when the first was tried once. Each is tried for a minute; ``say`` gets what is done.
    """
    say(f"{order.who} died while it controlled {_named(devices)}: the guard stops {'them' if devices[1:] else 'it'}")
    first_tried = asyncio.Event()
    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(_until_safe(order, *devices[0], say, first_tried.set))
        await first_tried.wait()
        for kind, device in devices[1:]:
            tasks.create_task(_until_safe(order, kind, device, say, lambda: None))


async def _until_safe(order: Order, kind: DeviceKind, device: Any, say: "_Log", tried: Callable[[], None]) -> None:
    """Make one device safe, trying again for a minute, then give up; progress and outcome go to ``say``.

    ``tried`` is called after every attempt. Before a new attempt the device is closed, as a new connection is made
    then. Any exception of the driver counts as a failed attempt. A driver without ``make_safe`` leaves its device as it
    is.
    """
    loop = asyncio.get_running_loop()
    began_s = loop.time()
    while True:
        state = await _tried(partial(kind.make_safe, device, time_scale=order.time_scale, unconfirmed=say))
        tried()
        after_s = (loop.time() - began_s) / order.time_scale
        if not state.trouble:
            done = kind.made_safe if state.seen else f"{kind.what} is left as it is: its driver has no make_safe"
            say(f"{done}, {after_s:.2f} s after the death was detected")
            return
        if after_s > _GIVE_UP_S:
            say(f"the guard gives up after {after_s:.0f} s: {state.trouble}")
            return
        say(f"{state.trouble}; the guard tries again")
        with suppress(Exception):  # of one device that cannot be closed the others know nothing
            device.close()
        await asyncio.sleep(_PAUSE_S * order.time_scale)


async def _tried(way: Callable[[], Coroutine[Any, Any, SafeState]]) -> SafeState:
    try:
        return await way()
    except Exception as error:  # a driver from outside may raise anything, and no other process makes it safe
        return SafeState(trouble=f"defect of the driver ({type(error).__name__}: {error})", seen=False)


class _Log:
    """Reports what the guard does on the terminal and, if possible, in a file beside the recording."""

    def __init__(self, order: Order) -> None:
        self._terminal = _Sink(lambda: 2)
        self._file = _Sink(partial(_opened_log, order.log))

    def __call__(self, text: str) -> None:
        now = time.time()
        stamp = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(now)) + f".{int(now % 1 * 1000):03d}Z"
        self._terminal.write(f"station: {text}\n")
        self._file.write(f"{stamp} {text}\n")

    def close(self) -> None:
        """Wait until all is written, but not for long."""
        limit_s = time.monotonic() + _LAST_WORDS_S
        for sink in (self._file, self._terminal):
            sink.close(limit_s)


class _Sink:
    """Writes lines to one file or stream in a separate thread.

    A held terminal (Ctrl-S), an unread pipe or a hanging disk must not keep a table turning.
    """

    def __init__(self, opened: Callable[[], int]) -> None:
        """``opened`` returns the descriptor to write to, at the first line."""
        self._opened = opened
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write_all, daemon=True)
        self._thread.start()

    def write(self, line: str) -> None:
        self._lines.put(line)

    def close(self, limit_s: float) -> None:
        """End after the lines so far; wait for that until an instant of the monotonic clock."""
        self._lines.put("")
        self._thread.join(max(limit_s - time.monotonic(), 0.0))

    def _write_all(self) -> None:
        file = None
        while line := self._lines.get():
            with suppress(OSError):  # the terminal may be gone, the disk full
                file = self._opened() if file is None else file
                os.write(file, line.encode())


def _opened_log(path: str) -> int:
    """Open the guard's log file; OSError if it is not this user's own."""
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
    file = os.open(path, flags, 0o666)
    check_own(path, file)  # others may be able to write to the folder
    return file


if __name__ == "__main__":
    main()
