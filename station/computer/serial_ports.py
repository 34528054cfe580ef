"""Serial ports: rights, stable names, latency of USB adapters, other programs that use them."""

import grp
import os
import pwd
import stat
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from station.computer.finding import Finding

_MOST_LATENCY_MS = 1


def look_at_serial_port(port: str, root: Path = Path("/")) -> Iterator[Finding]:
    """Yield problems of a serial port, such as /dev/ttyUSB0, and advice; nothing if it is fine.

    Looked at are its presence, its permissions, programs that have it open unless it is a pseudo-terminal, names that
    may change, and slow adapters. A missing port, or a path that is none, ends the list. ``root`` is the root of the
    file system to look at.
    """
    path = root / port.lstrip("/")
    if not path.exists():
        yield _missing(port, root)
        return
    if not stat.S_ISCHR(path.stat().st_mode):
        yield Finding(port, "is not a serial port", "ls -l /dev/serial/by-id", wrong=True)
        return
    if not os.access(path, os.R_OK | os.W_OK):
        yield _refused(port, path)
    if not path.resolve().is_relative_to(root / "dev/pts"):  # a pseudo-terminal is held by the program that made it
        yield from _held_by_others(port, path, root)
    yield from _unstable_name(port, path, root)
    yield from _slow_adapter(port, path, root)


def _missing(port: str, root: Path) -> Finding:
    """Return the finding that a port does not exist, with the stable names of ports that do, if there are any."""
    there = sorted(f"/dev/serial/by-id/{p.name}" for p in _links_by_id(root))
    if there:
        return Finding(
            port, f"does not exist. Available ports: {', '.join(there)}", "ls -l /dev/serial/by-id", wrong=True
        )
    return Finding(
        port, "does not exist, and there is no serial adapter. Is it plugged in?", "sudo dmesg | tail", wrong=True
    )


def _refused(port: str, path: Path) -> Finding:
    """Return the finding that this user may not use a port, and the command that changes it.

    It differs for a user who is in the port's group already and only has to log in again.
    """
    group_id = path.stat().st_gid
    try:
        group = grp.getgrgid(group_id).gr_name
        members = grp.getgrgid(group_id).gr_mem
    except KeyError:
        group, members = str(group_id), []
    try:
        user = pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        user = str(os.getuid())
    if user in members:
        text = f"is not accessible yet: {user} was added to the group {group} after logging in. Log in again"
        return Finding(port, text, f"newgrp {group}", wrong=True)
    text = f"is not accessible to {user}: it belongs to the group {group}. Join the group and log in again"
    return Finding(port, text, f"sudo usermod -aG {group} {user}", wrong=True)


def _held_by_others(port: str, path: Path, root: Path) -> Iterator[Finding]:
    """Yield each other program that has the port open, as far as this user may see.

    ``path`` is ``port`` below ``root``, including ``root``, and must exist. This process and unreadable ones are
    skipped.
    """
    device = path.stat().st_rdev
    for process in sorted((root / "proc").glob("[0-9]*")):
        if process.name == str(os.getpid()):
            continue
        with suppress(OSError):
            if any(_is_device(opened, device) for opened in (process / "fd").iterdir()):
                name = (process / "comm").read_text(errors="replace").strip()
                text = f"is in use by {name} (process {process.name}). End that program first"
                yield Finding(port, text, f"ps -fp {process.name}", wrong=True)


def _is_device(opened: Path, device: int) -> bool:
    try:
        found = opened.stat()
    except OSError:
        return False
    return stat.S_ISCHR(found.st_mode) and found.st_rdev == device


def _links_by_id(root: Path) -> list[Path]:
    with suppress(OSError):
        return list((root / "dev/serial/by-id").iterdir())
    return []


def _unstable_name(port: str, path: Path, root: Path) -> Iterator[Finding]:
    """Yield a finding for each stable name of a port whose number may change when adapters are plugged in again.

    Nothing for a port that is named by a link already, or has no such name. ``path`` is ``port`` below ``root``,
    including ``root``.
    """
    if path.is_symlink():
        return
    for link in _links_by_id(root):
        if (link.parent / os.readlink(link)).resolve() == path.resolve():
            stable = f"/dev/serial/by-id/{link.name}"
            text = (
                f"may change its number when adapters are plugged in again. Write serial://{stable} in the bench file"
            )
            yield Finding(port, text)


def _slow_adapter(port: str, path: Path, root: Path) -> Iterator[Finding]:
    """Yield that a USB adapter delays bytes, if its latency timer is above 1 ms, as FTDI's 16 ms by default.

    Nothing for a port without such a timer. ``path`` is ``port`` below ``root``, including ``root``.
    """
    name = path.resolve().name
    setting = f"/sys/bus/usb-serial/devices/{name}/latency_timer"
    with suppress(OSError, ValueError):
        latency_ms = int((root / setting.lstrip("/")).read_text())
        if latency_ms > _MOST_LATENCY_MS:
            text = f"its adapter delays bytes by up to {latency_ms} ms (latency timer)"
            yield Finding(port, text, f"echo {_MOST_LATENCY_MS} | sudo tee {setting}")
