"""What QCoDeS' driver needs of Galil's own gclib, which may not be passed on: the wire alone, by the manual's framing.

An answer ends with a colon, or a question mark where the controller refuses (DMC-2x00 user manual p. 75).
"""

from __future__ import annotations

import socket


class GclibError(Exception):
    """The controller refuses, or is gone."""


class py:
    """A connection by TCP."""

    def GOpen(self, address: str) -> None:
        """Connect to HOST:PORT; what follows a blank is for gclib."""
        host, port = address.split(" ")[0].rsplit(":", 1)
        self._wire = socket.create_connection((host, int(port)), timeout=5)

    def GInfo(self) -> str:
        """Return address, revision and serial number as gclib has them."""
        revision, serial = self.GCommand("\x12\x16\r"), self.GCommand("MG _BN\r")
        return f"127.0.0.1, {revision}, {float(serial):.0f}"

    def GClose(self) -> None:
        """Disconnect."""
        self._wire.close()

    def GCommand(self, command: str) -> str:
        """Return what the controller answers."""
        self._wire.sendall(command.encode())
        said = b""
        while not said.endswith((b":", b"?")):
            more = self._wire.recv(1024)
            if not more:
                raise GclibError("closed")
            said += more
        if said.endswith(b"?"):
            raise GclibError(command)
        return said[:-1].decode().strip()
