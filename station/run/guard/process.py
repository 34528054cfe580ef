"""The guard's own process: waits for the death of the station, then brings the table to rest and switches it off.

It imports no more than that needs, and all of that before the table is enabled: memory and disk may be short when it
is called on. Run as ``python -m station.run.guard.process``; standard input is the pipe from the station.
"""

import asyncio
import os
import pickle
import signal
import sys
import time
from collections.abc import Coroutine
from contextlib import suppress
from typing import Any

import serial  # noqa: F401  a serial link imports it when it is opened, which would be late

from drivers.errors import DeviceError
from drivers.links.lock import inherited
from drivers.protocols import Turntable
from drivers.tables.making_safe import Rest, make_safe
from drivers.tables.recipe import unpacked_table
from station.run.event_loop.loops import ScaledLoop
from station.run.guard.words import ARM, DISMISS, READY, Order

_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP", "SIGPIPE")
_GIVE_UP_S, _PAUSE_S = 60.0, 0.5
_OOM_STEPS = range(-1000, 1000, 100)


def main() -> None:
    """Read the order, say that it can be carried out, and wait."""
    for name in _SIGNALS:
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    _ask_to_be_spared()
    size = int.from_bytes(_read(4), "big")
    order: Order = pickle.loads(_read(size))
    with asyncio.Runner(loop_factory=lambda: ScaledLoop(order.time_scale)) as runner:
        runner.run(_guard(order))
        os._exit(0)  # the station may wait for it


def _read(size: int) -> bytes:
    """Return so many bytes of the pipe; the process ends if the station is gone before."""
    data = b""
    while len(data) < size:
        more = os.read(0, size - len(data))
        if not more:
            sys.exit()
        data += more
    return data


def _ask_to_be_spared() -> None:
    """Have the kernel end this process last when memory runs out, as far as this user may ask for that."""
    for value in _OOM_STEPS:
        try:
            with open("/proc/self/oom_score_adj", "w", encoding="ascii") as file:
                file.write(str(value))
        except PermissionError:
            continue
        except OSError:
            pass  # not Linux
        return


async def _guard(order: Order) -> None:
    try:
        table = unpacked_table(order.table)
    except Exception as error:  # what stands in a plug-in
        os.write(2, f"station: the guard cannot make the table's driver: {type(error).__name__}: {error}\n".encode())
        return
    os.write(1, READY)
    if await _station_dies():
        with inherited(order.locks, f"guard of {order.who}, which has died: it stops the table"):
            await _act(order, table)


async def _station_dies() -> bool:
    """Return at the station's death whether the table was its own then, or false when this guard is dismissed."""
    loop = asyncio.get_running_loop()
    armed, told = False, asyncio.Event()
    loop.add_reader(0, told.set)
    while True:
        await told.wait()
        told.clear()
        data = os.read(0, 64)
        if DISMISS in data:
            return False
        armed = armed or ARM in data
        if not data:
            loop.remove_reader(0)
            return armed


async def _act(order: Order, table: Turntable) -> None:
    say = _Log(order)
    say(f"{order.who} has died with the table in its hands: the guard stops it")
    loop = asyncio.get_running_loop()
    began_s = loop.time()
    while True:
        rest = await _tried(make_safe(table, time_scale=order.time_scale, unconfirmed=say))
        after_s = (loop.time() - began_s) / order.time_scale
        if not rest.trouble:
            say(f"the table is at rest, its power off, {after_s:.2f} s after the death was known")
            return
        if after_s > _GIVE_UP_S:
            say(f"the guard gives up after {after_s:.0f} s: {rest.trouble}")
            return
        say(f"{rest.trouble}; the guard tries again")
        with suppress(DeviceError, OSError):
            table.close()
        await asyncio.sleep(_PAUSE_S * order.time_scale)


async def _tried(way: Coroutine[Any, Any, Rest]) -> Rest:
    try:
        return await way
    except Exception as error:  # a driver from outside may raise anything: there is nobody else to stop the table
        return Rest(trouble=f"defect of the driver ({type(error).__name__}: {error})", seen=False)


class _Log:
    """Says what is done, on the terminal and in a file beside the recording, if that can be written."""

    def __init__(self, order: Order) -> None:
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
        self._file = -1
        with suppress(OSError):
            self._file = os.open(order.log, flags, 0o666)

    def __call__(self, text: str) -> None:
        now = time.time()
        stamp = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(now)) + f".{int(now % 1 * 1000):03d}Z"
        for file, line in ((2, f"station: {text}\n"), (self._file, f"{stamp} {text}\n")):
            with suppress(OSError):  # the terminal may be gone, the disk full
                os.write(file, line.encode())


if __name__ == "__main__":
    main()
