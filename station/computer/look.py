"""All checks of the computer for the links of a bench."""

from collections.abc import Iterable
from urllib.parse import urlsplit

from station.computer.can_interfaces import look_at_can_interface
from station.computer.finding import Finding
from station.computer.serial_ports import look_at_serial_port
from station.computer.timekeeping import look_at_load, look_at_power_saving, look_at_usb_suspend


def look_at_computer(links: Iterable[str]) -> list[Finding]:
    """Return problems and advice for runs over these links: ports, their USB adapters, CAN interfaces, power saving,
    load; nothing for twins.

    ``links`` are as in a bench file: serial:///dev/ttyUSB0?baud=921600, can:socketcan:can0, can:slcan:/dev/ttyACM0. Of
    other links, such as TCP, only the computer is looked at.
    """
    wires = [link for link in dict.fromkeys(links) if not link.startswith("twin:")]
    found: list[Finding] = []
    for link in wires:
        port = _serial_port_of(link)
        if port:
            found += [*look_at_serial_port(port), *look_at_usb_suspend(port)]
        elif link.startswith("can:socketcan:"):
            found += look_at_can_interface(link.split(":", 2)[2].partition("?")[0])
    if wires:
        found += [*look_at_power_saving(), *look_at_load()]
    return found


def _serial_port_of(link: str) -> str:
    """Return the path of the serial port that a link leads to; empty if it leads to none."""
    if link.startswith("can:slcan:"):
        path = link.split(":", 2)[2].partition("?")[0].partition("@")[0]
        return path if path.startswith("/") else ""
    address = urlsplit(link)
    return address.path if address.scheme == "serial" else ""
