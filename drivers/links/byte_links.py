"""Byte links: a serial port (or pyserial URL), a TCP stream, a wire in memory."""

from drivers.links.memory_link import MemoryLink
from drivers.links.serial_link import SerialLink
from drivers.links.tcp_link import TcpLink

__all__ = ["MemoryLink", "SerialLink", "TcpLink"]
