"""Byte links: a serial port (or pyserial URL), a TCP stream, a wire in memory."""

from drivers.memory_link import MemoryLink
from drivers.serial_link import SerialLink
from drivers.tcp_link import TcpLink

__all__ = ["MemoryLink", "SerialLink", "TcpLink"]
