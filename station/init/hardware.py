"""Ports of this machine for devices: serial ports and CAN interfaces."""

from dataclasses import dataclass
from pathlib import Path

_NETWORK = Path("/sys/class/net")
_ARPHRD_CAN = "280"  # linux/if_arp.h


@dataclass(frozen=True, slots=True)
class SerialFound:
    """A serial port: its link, its description, and whether it is a plugged-in adapter."""

    link: str
    description: str
    plugged_in: bool


def serial_ports() -> list[SerialFound]:
    """Return the serial ports of this machine, plugged-in adapters (on USB) before built-in ports, each group by name.

    A description that says no more than the name is left empty.
    """
    from serial.tools import list_ports

    found = []
    for port in sorted(list_ports.comports(), key=lambda port: str(port.device)):
        name = str(port.device)
        link = f"serial://{name}" if name.startswith("/") else f"serial:{name}"
        description = str(port.description or "")
        found.append(SerialFound(link, "" if description in ("n/a", name) else description, port.vid is not None))
    return sorted(found, key=lambda port: not port.plugged_in)


def can_interfaces() -> list[str]:
    """Return links to the SocketCAN interfaces of this machine; none where there is no SocketCAN."""
    try:
        names = sorted(path.name for path in _NETWORK.iterdir() if _kind(path) == _ARPHRD_CAN)
    except OSError:
        return []
    return [f"can:socketcan:{name}" for name in names]


def _kind(path: Path) -> str:
    try:
        return (path / "type").read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        return ""
