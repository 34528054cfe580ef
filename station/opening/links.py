"""Meanings of links in a bench file: twin:, serial:, tcp:, rfc2217:, socket:, can:."""

import re
from contextlib import suppress
from typing import Any
from urllib.parse import SplitResult, parse_qs, urlsplit

from drivers.links.can_link import CanLink
from drivers.links.serial_link import SerialLink
from drivers.links.tcp_link import TcpLink
from drivers.specs import DeviceSpec
from drivers.tables.modbus.line import SerialPort
from station.errors import BenchError, sentence
from station.schema.tables import link_of

_HERE = re.compile(r"//(?:127\.|localhost|\[::1\])|/dev/pts/|udp_multicast|can:virtual")
_BYTE_LINKS = "write serial:///dev/ttyUSB0?baud=921600, tcp://host:port, rfc2217://host:port, or twin:"
_SERIAL_OPTIONS = {"baud", "parity", "stop_bits"}
_TCP_LIMIT_S = 2.0
_LEAST_GATHER_S = 0.002  # less saves nothing; more, in scaled time, would exceed the buffer of a pty


def driver_link(spec: DeviceSpec, link: str, device: str, time_scale: float = 1.0, *, gather_s: float = 0.0) -> Any:
    """Return the link for the driver of a device: CAN frames, serial or TCP bytes, not yet open; BenchError if invalid.

    A driver that opens links itself gets the address: a ``SerialPort``, or host and port. A TCP port or baud rate that
    the link lacks is the protocol's. Time limits are stretched by ``time_scale``, how fast the loop's clock runs. Bytes
    of a serial stream may be handed over every ``gather_s``, in s of that clock; 0 hands them over at once.
    """
    if spec.on_can:
        return CanLink(device, *can_address(link, device))
    try:
        url = urlsplit(link_of(link))
    except ValueError as error:
        raise BenchError(f"{device}: {error}") from None
    if url.scheme != "tcp":
        serial = _serial(url, link, device, spec.baud)
        gather_s = max(gather_s / time_scale, _LEAST_GATHER_S) if gather_s else 0.0
        if spec.opens_links:
            return serial
        parity, stop_bits = serial.parity, serial.stop_bits
        return SerialLink(device, serial.port, serial.baud, parity=parity, stop_bits=stop_bits, gather_s=gather_s)
    port = url.port or spec.tcp_port
    if not url.hostname or port is None:
        raise BenchError(f"{device}: {link!r} is not a link it supports. Write tcp://host:port, or twin:")
    return (url.hostname, port) if spec.opens_links else TcpLink(device, url.hostname, port, _TCP_LIMIT_S * time_scale)


def ends_here(link: str) -> bool:
    """Return whether a link ends at a program on this computer, as far as its address tells."""
    return bool(_HERE.search(link))


def can_address(link: str, device: str) -> tuple[str, str, dict[str, Any]]:
    """Split can:INTERFACE:CHANNEL?option=value into interface, channel and options; BenchError for any other link.

    Options that are numbers are converted; slcan gets a short pause after opening by default.
    """
    address, _, query = link.partition("?")
    parts = address.split(":", 2)
    if len(parts) != 3 or parts[0] != "can" or not parts[1]:
        raise BenchError(sentence("bench.no_can_link", device=device, link=link))
    options: dict[str, Any] = {key: values[0] for key, values in parse_qs(query).items()}
    for key, value in options.items():
        with suppress(ValueError):
            options[key] = float(value) if "." in value else int(value)
    if parts[1] == "slcan":
        options.setdefault("sleep_after_open", 0.1)  # python-can waits two seconds for an Arduino's boot
    return parts[1], parts[2], options


def _serial(url: SplitResult, link: str, device: str, baud: int) -> SerialPort:
    """Return the serial port of a link, with ``baud`` as its default rate, no parity and one stop bit by default.

    Its port is a path or, of socket and rfc2217, the link without options. BenchError, which names ``device``, for
    another kind of link, and an unknown or invalid option.
    """
    options = {key: values[0] for key, values in parse_qs(url.query).items()}
    port = url.path if url.scheme == "serial" else link.partition("?")[0]
    if url.scheme not in ("serial", "socket", "rfc2217") or not (url.path or url.netloc) or not port:
        raise BenchError(f"{device}: {link!r} is not a link it supports: {_BYTE_LINKS}")
    unknown = sorted(set(options) - _SERIAL_OPTIONS)
    parity, stop_bits = options.get("parity", "N").upper(), options.get("stop_bits", "1")
    number = options.get("baud", str(baud))
    if unknown or parity not in ("N", "E", "O") or stop_bits not in ("1", "2") or not number.isdigit() or number == "0":
        raise BenchError(sentence("bench.serial_options", device=device, link=link))
    return SerialPort(port, int(number), parity, int(stop_bits))
