"""One master a table: whoever holds a link on this machine is told by name to who comes second.

Locks of files (flock) end with their process, however it ends. The files stay: only a lock says that a link is in use.
"""

import asyncio
import getpass
import os
import socket
import stat
import sys
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import ExitStack, asynccontextmanager, contextmanager, suppress
from urllib.parse import quote, urlsplit

from drivers.errors import DeviceRefused

_SHARED = ("/run/lock", "/var/lock", "/tmp")


@asynccontextmanager
async def held(device: str, link: str, default_port: int | None, what: str) -> AsyncIterator[tuple[int, ...]]:
    """Hold a link while this lasts; DeviceRefused, which names the holder, if another program or user does.

    ``what`` is said of this program to whoever comes second. Yields the descriptors of the locked files, none on
    systems without flock, which hold nothing. A process that is given these keeps the lock if this one dies.
    """
    with ExitStack() as stack:
        names = await _names(link, default_port) if sys.platform != "win32" else ()
        yield tuple([_lock(stack, device, link, name, what) for name in names])


@contextmanager
def inherited(files: Sequence[int], what: str) -> Iterator[None]:
    """Hold on, while this lasts, to what a process held that has died; ``files`` are its descriptors (``held``)."""
    with ExitStack() as stack:
        for file in files:
            _sign(stack, file, what)
        yield


async def _names(link: str, default_port: int | None) -> list[str]:
    """Return what a link leads to: a device, or each address of its host, where all of this machine are one."""
    url = urlsplit(link)
    if url.scheme == "serial":
        return [os.path.realpath(url.path)]
    port = url.port or default_port
    try:
        found = await asyncio.get_running_loop().getaddrinfo(url.hostname, port, type=socket.SOCK_STREAM)
    except OSError:
        return [f"{url.hostname}:{port}"]
    return sorted({f"{'this' if _is_ours(family, at[0]) else at[0]}:{port}" for family, _, _, _, at in found})


def _is_ours(family: int, address: object) -> bool:
    """Return whether an address is one of this machine's own: others cannot be bound."""
    with suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
        probe.bind((address, 0))
        return True
    return False


def _lock(stack: ExitStack, device: str, link: str, name: str, what: str) -> int:
    """Lock the file of a name until the stack is closed; return its descriptor."""
    import fcntl

    path = os.path.join(_folder(), f"turntable-station-{quote(name, safe='')}.lock")
    try:
        try:
            file = os.open(path, os.O_RDWR)  # no O_CREAT, which systems may refuse for another user's file there
        except FileNotFoundError:
            file = os.open(path, os.O_RDWR | os.O_CREAT)
            os.fchmod(file, 0o666)  # whatever the umask: others are to lock it, too
        stack.callback(os.close, file)
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.pread(file, 500, 0).decode("utf-8", "replace") or "another program"
        raise DeviceRefused(device, f"{link} is in use by {holder}: a table has one master; end that first") from None
    except OSError as error:
        raise DeviceRefused(device, f"{link} cannot be locked against a second master: {error}") from None
    _sign(stack, file, what)
    return file


def _sign(stack: ExitStack, file: int, what: str) -> None:
    """Write into a locked file who holds it; when the stack is closed, it is empty and unlocked."""
    import fcntl

    stack.callback(fcntl.flock, file, fcntl.LOCK_UN)  # also for children that were forked meanwhile
    stack.callback(os.ftruncate, file, 0)
    os.ftruncate(file, 0)
    os.pwrite(file, f"process {os.getpid()} of {getpass.getuser()} ({what})".encode(), 0)


def _folder() -> str:
    """Return the folder that all users of this machine may write to, the same for each."""
    return next((name for name in _SHARED if os.path.isdir(name) and os.stat(name).st_mode & stat.S_IWOTH), _SHARED[-1])
