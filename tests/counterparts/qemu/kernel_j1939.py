"""The kernel's own J1939 on an interface: ``kernel_j1939.py ask IFACE`` asks a device, ``be IFACE RATE`` is one.

``ask`` prints one object of JSON: what the device at address 0x80 claims, says of its version, and how often it sends.
"""

from __future__ import annotations

import json
import socket
import struct
import sys
import time

DEVICE, HOST, EVERYBODY = 0x80, 0x21, 0xFF
REQUEST, CLAIM, VERSION, ARI, ACCS = 0xEA00, 0xEE00, 0xFEDA, 0xF02A, 0xF02D
SETTINGS = (0xFF55, 0xFF56)
NAME = 1 << 63 | 3 << 49 | 130 << 40 | 299 << 21 | 123_456
"""Arbitrary address, vehicle system 3, function 130, manufacturer 299, identity 123456."""


def opened(interface: str, name: int, address: int) -> socket.socket:
    """Return a socket of the kernel's J1939, which claims nothing by itself."""
    line = socket.socket(socket.PF_CAN, socket.SOCK_DGRAM, socket.CAN_J1939)
    line.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
    line.setsockopt(socket.SOL_CAN_BASE + socket.CAN_J1939, socket.SO_J1939_PROMISC, 1)
    line.bind((interface, name, socket.J1939_NO_PGN, address))
    return line


def ask(interface: str) -> dict[str, object]:
    """Ask for the NAME and the version of the device, and count its samples for two seconds."""
    line = opened(interface, socket.J1939_NO_NAME, HOST)
    said: dict[str, object] = {}
    samples = 0

    def request(group: int) -> None:
        line.sendto(group.to_bytes(3, "little"), (interface, socket.J1939_NO_NAME, REQUEST, DEVICE))

    request(CLAIM)
    line.settimeout(20)
    ends = time.monotonic() + 2
    while time.monotonic() < ends or not {"claim", "version"} <= said.keys():
        data, (_, name, group, address) = line.recvfrom(1785)
        if address != DEVICE:
            continue
        samples += group == ARI
        if group == CLAIM:
            said["claim"] = struct.unpack("<Q", data)[0]
            time.sleep(0.5)  # an address is its claimant's after 250 ms
            request(VERSION)
        elif group == VERSION:
            said |= {"version": list(data), "name": name}  # the kernel's own record of whose the address is
    return said | {"samples": samples}


def be(interface: str, rate_hz: float) -> None:
    """Claim an address, then send rates and accelerations, and answer requests, until killed."""
    line = opened(interface, NAME, DEVICE)
    claim = struct.pack("<Q", NAME)

    def send(data: bytes, group: int) -> None:
        line.sendto(
            data, (interface, socket.J1939_NO_NAME, group, EVERYBODY if group < 0xF000 else socket.J1939_NO_ADDR)
        )

    send(claim, CLAIM)
    time.sleep(0.3)  # the kernel sends nothing else for 250 ms
    rates = struct.pack("<4H", *(round((rate + 250) * 128) for rate in (1.0, -2.0, 3.0)), 0xFFFF)
    force = struct.pack("<4H", 32000, 32000, 32981, 0xFFFF)
    print("ready", flush=True)
    held = {CLAIM: claim, VERSION: bytes((2, 7, 18, 1, 44))}
    due = time.monotonic()
    while True:
        due += 1 / rate_hz
        send(force, ACCS)
        send(rates, ARI)
        while (left := due - time.monotonic()) > 0:
            line.settimeout(left)
            try:
                data, (_, _, group, address) = line.recvfrom(1785)
            except TimeoutError:
                break
            if address == DEVICE:
                continue
            if group in SETTINGS and data[0] == DEVICE:
                held[group] = data
            elif group == REQUEST and (wanted := int.from_bytes(data, "little")) in held:
                send(held[wanted], wanted)


if __name__ == "__main__":
    if sys.argv[1] == "ask":
        print(json.dumps(ask(sys.argv[2])))
    else:
        be(sys.argv[2], float(sys.argv[3]))
