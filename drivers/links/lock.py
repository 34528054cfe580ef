"""One master a table: whoever holds a link on this machine is told by name to who comes second.

Every user has a lock file of their own for each link, in a folder that all users share: nobody writes into a file of
somebody else. Whoever takes a link locks their own file first, then looks whether another user's is locked, so two who
come at once may both be refused, and never both have it. Locks of files (flock) end with their process, however it
ends. The files stay: only a lock says that a link is in use.
"""

import asyncio
import os
import re
import socket
import stat
import sys
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import ExitStack, asynccontextmanager, contextmanager, suppress
from urllib.parse import quote, urlsplit

from drivers.errors import DeviceRefused

_SHARED = ("/run/lock", "/var/lock", "/tmp")
_HOLDER_BYTES = 500
_HOLDER = re.compile(r"(\d{1,10}) (.*)", re.DOTALL)


@asynccontextmanager
async def held(device: str, link: str, default_port: int | None, description: str) -> AsyncIterator[tuple[int, ...]]:
    """Hold the lock of a link while this context lasts; DeviceRefused, naming the holder, if another program has it.

    ``link`` is a URL, completed by ``default_port``; ``device`` is for the error. ``description`` tells whoever comes
    second what this program is. Yields the descriptors of the locked files: a process that inherits them keeps the lock
    if this one dies. Without flock (Windows) nothing is locked and none are yielded. DeviceRefused as well if the lock
    cannot be taken, for instance as a lock file is not a plain file of this user.
    """
    with ExitStack() as stack:
        names = await _names(link, default_port) if sys.platform != "win32" else ()
        yield tuple([_lock(stack, device, link, name, description) for name in names])


@contextmanager
def inherited(files: Sequence[int], description: str) -> Iterator[None]:
    """Hold the locks that a dead process held, for the duration; ``files`` are its descriptors (``held``)."""
    with ExitStack() as stack:
        for file in files:
            _sign(stack, file, description)
        yield


def check_own(path: str, file: int) -> None:
    """Check that ``path`` still names the open file ``file``, a regular one of this user with no second name; OSError
    if not.

    Where others can write to the folder, the name may lead to a different file of this user.
    """
    named = os.lstat(path)
    _check_is_own(path, named)
    if not os.path.samestat(named, os.fstat(file)):
        raise OSError(f"{path} was replaced meanwhile. Try again")


async def _names(link: str, default_port: int | None) -> list[str]:
    """Return the names to lock for a link: the real path of a serial device, or each address of its host with the port.

    The port is that of ``link``, else ``default_port``. All addresses of this machine have one name. A host that cannot
    be resolved is named as it is written.
    """
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


def _lock(stack: ExitStack, device: str, link: str, name: str, description: str) -> int:
    """Lock this user's file for ``name`` until the stack is closed, write ``description`` into it, and return its
    descriptor.

    DeviceRefused, naming the holder, if this user's file or that of another user is locked already; or if the lock
    cannot be taken. ``device`` and ``link`` are for the error.
    """
    import fcntl

    folder, stem = _folder(), f"turntable-station-{quote(name, safe='')}"
    path = os.path.join(folder, f"{stem}.{os.geteuid()}.lock")
    try:
        file = _open_own(path)
        stack.callback(os.close, file)
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        check_own(path, file)
        _sign(stack, file, description)
        for other in _other_files(folder, stem):
            _check_unlocked(other)
    except BlockingIOError as error:
        holder = error.args[0] if isinstance(error, _InUse) else _holder(file)
        raise DeviceRefused(
            device, f"{link} is in use by {holder}. A table must have one master; end that program first"
        ) from None
    except OSError as error:
        raise DeviceRefused(device, f"{link} cannot be locked against a second master: {error}") from None
    return file


class _InUse(BlockingIOError):
    """Another user holds the link; the argument says who."""


def _open_own(path: str) -> int:
    """Open this user's lock file for reading and writing, creating it if missing, and return its descriptor.

    A new file is readable by all, whatever the umask. OSError if the path is anything but a regular file of this user
    with one name.
    """
    flags = os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        file = os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o644)
    except FileExistsError:
        _check_is_own(path, os.lstat(path))  # also before it is opened: opening a device may do something
        return os.open(path, flags)
    os.fchmod(file, 0o644)  # regardless of the umask: others must see whether it is locked
    return file


def _check_is_own(path: str, status: os.stat_result) -> None:
    """Check that ``status``, the state of ``path``, is that of a regular file of this user without a second name.

    OSError that says what it is instead and who is to remove it.
    """
    if stat.S_ISLNK(status.st_mode):
        wrong = "is a symbolic link"
    elif not stat.S_ISREG(status.st_mode):
        wrong = "is not a regular file"
    elif status.st_uid != os.geteuid():
        wrong = f"belongs to {_user(status.st_uid)}"
    elif status.st_nlink != 1:
        wrong = "has a second name (hard link)"
    else:
        return
    who = "" if status.st_uid == os.geteuid() else f"have {_user(status.st_uid)} or root "
    raise OSError(
        f"{path} {wrong}, and this program did not create it: {who}remove it, and find out where it came from"
    )


def _other_files(folder: str, stem: str) -> Iterator[str]:
    """Yield the paths in ``folder`` of other users' lock files for a link; their names begin with ``stem``.

    Only regular files count that belong to the user whose number is in the name. A file that vanishes is skipped.
    """
    named = re.compile(rf"{re.escape(stem)}\.(\d{{1,10}})\.lock")
    for entry in sorted(os.listdir(folder)):
        match = named.fullmatch(entry)
        if match is None or int(match[1]) == os.geteuid():
            continue
        path = os.path.join(folder, entry)
        with suppress(FileNotFoundError):
            found = os.lstat(path)
            if stat.S_ISREG(found.st_mode) and found.st_uid == int(match[1]):
                yield path


def _check_unlocked(path: str) -> None:
    """Check that another user's lock file is not locked, without writing to it; a missing file counts as unlocked.

    _InUse if it is locked; OSError if the file cannot be opened.
    """
    import fcntl

    try:
        file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        raise _InUse(_holder(file)) from None
    finally:
        os.close(file)


def _holder(file: int) -> str:
    """Return in words who holds a locked file: the user is the file's owner, the rest the holder's own text."""
    text = os.pread(file, _HOLDER_BYTES, 0).decode("utf-8", "replace")
    match = _HOLDER.fullmatch("".join(letter if letter.isprintable() else "?" for letter in text))
    user = _user(os.fstat(file).st_uid)
    return f"process {match[1]} of {user} ({match[2]})" if match else f"a program of {user}"


def _user(uid: int) -> str:
    import pwd

    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return f"the user with the number {uid}"


def _sign(stack: ExitStack, file: int, description: str) -> None:
    """Write the process id and ``description`` into the locked file; closing the stack empties and unlocks it.

    ``description`` is that of this program; the text is cut to 500 bytes. A failure to write is ignored, as others can
    fill the disk: the lock holds all the same.
    """
    import fcntl

    stack.callback(fcntl.flock, file, fcntl.LOCK_UN)  # also for children that were forked meanwhile
    stack.callback(os.ftruncate, file, 0)
    with suppress(OSError):
        os.ftruncate(file, 0)
        os.pwrite(file, f"{os.getpid()} {description}".encode()[:_HOLDER_BYTES], 0)


def _folder() -> str:
    """Return the first shared folder that is world-writable with the sticky bit; the last of the list if none is."""
    for name in _SHARED:
        with suppress(OSError):
            mode = os.stat(name).st_mode
            if stat.S_ISDIR(mode) and mode & stat.S_IWOTH and mode & stat.S_ISVTX:
                return name
    return _SHARED[-1]
