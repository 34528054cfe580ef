"""Programs on CAN that know nothing of this project: python-can, cantools and a DBC, or the J1939 stack of can-j1939.

``python can_stranger.py ROLE CHANNEL INTERFACE ARGUMENT...`` prints what it has seen as one object of JSON.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from typing import Any

import can

SECONDS = 1.5
PERIOD_S = 0.01
RATES_DPS = (10.0, -20.0, 30.0, -40.0)
SOFTWARE_VERSION, RATE_DIVIDER, PACKET_TYPES, ARI, ACCS = 0xFEDA, 0xFF55, 0xFF56, 0xF02A, 0xF02D
NAME = {"manufacturer_code": 299, "identity_number": 123_456, "function": 130}
VERSION = (2, 7, 18, 1, 44)
DEVICE, HOST = 0x80, 0x21
UNKNOWN = 0xFEE5  # engine hours


def listen(bus: can.BusABC, dbc: str) -> dict[str, Any]:
    """Decode what comes in a second and a half; return number, first and last value of each signal."""
    import cantools

    database = cantools.database.load_file(dbc)
    seen: dict[str, Any] = {}
    ends = time.monotonic() + SECONDS
    while (left := ends - time.monotonic()) > 0:
        if (message := bus.recv(left)) is None:
            continue
        kind = database.get_message_by_frame_id(message.arbitration_id)
        for name, value in kind.decode(message.data).items():
            found = seen.setdefault(f"{kind.name}.{name}", {"count": 0, "sum": 0.0})
            found["count"] += 1
            found["sum"] += value
    return seen


def send(bus: can.BusABC, dbc: str, count: str) -> dict[str, Any]:
    """Be the four gyros of a DBC: constant rates, a hundred times a second."""
    import cantools

    database = cantools.database.load_file(dbc)
    start = time.monotonic()
    for i in range(int(count)):
        time.sleep(max(start + i * PERIOD_S - time.monotonic(), 0))
        for gyro, rate in enumerate(RATES_DPS, 1):
            kind = database.get_message_by_name(f"GYRO{gyro}_RATE")
            bus.send(can.Message(arbitration_id=kind.frame_id, is_extended_id=False, data=kind.encode({"Rate": rate})))
    return {"sent": int(count)}


def device(interface: str, channel: str, options: dict[str, Any], long: bool) -> None:
    """Be an inclinometer on J1939 by can-j1939: claim an address, answer requests, take settings, send.

    With ``long`` the software version is a text that takes the transport protocol.
    """
    import j1939

    held: dict[int, list[int]] = {}

    class Device(j1939.ControllerApplication):
        def heard(self, priority: int, group: int, source: int, timestamp: float, data: bytearray) -> None:
            if group in (RATE_DIVIDER, PACKET_TYPES) and data[0] == DEVICE:
                held[group] = list(data)

        def asked(self, source: int, destination: int, group: int) -> None:
            if group == SOFTWARE_VERSION:
                text = list(b"*1.2.3*a version as long as J1939-71 lets it be*") if long else list(VERSION)
                self.send_pgn(0, 0xFE, 0xDA, 6, text)
            elif group in held:
                self.send_pgn(0, group >> 8, group & 0xFF, 6, held[group])

        def sample(self, cookie: object) -> bool:
            if self.state == j1939.ControllerApplication.State.NORMAL:
                raw = [round((rate + 250) * 128) for rate in RATES_DPS[:3]]
                self.send_pgn(0, ARI >> 8, ARI & 0xFF, 3, [b for r in raw for b in (r & 0xFF, r >> 8)] + [0xFF, 0xFF])
                self.send_pgn(0, ACCS >> 8, ACCS & 0xFF, 2, [0x00, 0x7D, 0x00, 0x7D, 0xD5, 0x80, 0xFF, 0xFF])
            return True

    ecu = j1939.ElectronicControlUnit()
    ecu.connect(interface=interface, channel=channel, **options)
    name = j1939.Name(arbitrary_address_capable=0, industry_group=1, vehicle_system=3, reserved_bit=0, **NAME)
    application = Device(name, DEVICE)
    ecu.add_ca(controller_application=application)
    application.subscribe_request(application.asked)
    ecu.subscribe(application.heard)
    ecu.add_timer(PERIOD_S, application.sample)
    application.start()
    until(lambda: application.state == j1939.ControllerApplication.State.NORMAL)
    print("ready", flush=True)
    sys.stdin.read()
    ecu.disconnect()
    ecu.stop()


def host(interface: str, channel: str, options: dict[str, Any]) -> dict[str, Any]:
    """Ask a device on J1939 by can-j1939: who it is, its version, what it does not have; contend for its address."""
    import j1939

    answers: dict[str, Any] = {"samples": 0, "claims": []}

    class Asker(j1939.ControllerApplication):
        def _process_addressclaim(self, mid: Any, data: bytearray, timestamp: float) -> None:
            name = j1939.Name(bytes=data)
            answers["claims"].append([mid.source_address, {part: getattr(name, part) for part in NAME}])
            super()._process_addressclaim(mid, data, timestamp)

    def heard(priority: int, group: int, source: int, timestamp: float, data: bytearray) -> None:
        if source == DEVICE and group == ARI:
            answers["samples"] += 1
        elif source == DEVICE:
            answers[f"{group:04X}"] = list(data)

    ecu = j1939.ElectronicControlUnit()
    ecu.connect(interface=interface, channel=channel, **options)
    ours = j1939.Name(arbitrary_address_capable=1, industry_group=1, vehicle_system=3, reserved_bit=0, **NAME)
    application = Asker(ours, HOST)
    ecu.add_ca(controller_application=application)
    ecu.subscribe(heard)
    application.start()
    until(lambda: application.state == j1939.ControllerApplication.State.NORMAL)
    application.send_request(0, j1939.ParameterGroupNumber.PGN.ADDRESSCLAIM, DEVICE)
    until(lambda: DEVICE in [address for address, _ in answers["claims"]])
    application.send_request(0, UNKNOWN, DEVICE)
    until(lambda: "E800" in answers)
    application.send_request(0, SOFTWARE_VERSION, DEVICE)
    until(lambda: "FEDA" in answers)
    # A long message to the device and one to all take the transport protocol, which it need not have.
    application.send_pgn(0, 0xEF, DEVICE, 6, list(range(40)))
    application.send_pgn(0, 0xFE, 0xE9, 6, list(range(30)))
    before = answers["samples"]
    until(lambda: answers["samples"] > before + 20)
    # Whoever has the lower NAME keeps an address: this one is capable of another, so its NAME is the higher.
    contender = j1939.ControllerApplication(ours, DEVICE)
    ecu.add_ca(controller_application=contender)
    contender.start()
    until(lambda: contender.device_address == DEVICE + 1, must=False)
    answers["contender"] = contender.device_address
    ecu.disconnect()
    ecu.stop()
    return answers


def until(done: Callable[[], bool], *, must: bool = True) -> None:
    """Wait until something is so; SystemExit if it is not within five seconds."""
    ends = time.monotonic() + 5
    while not done():
        if time.monotonic() > ends:
            if must:
                raise SystemExit("not within 5 s")
            return
        time.sleep(0.01)


def main() -> None:
    """Play the role."""
    role, channel, interface, options, *arguments = sys.argv[1:]
    more = json.loads(options)
    if role == "device":
        device(interface, channel, more, *(word == "long" for word in arguments))
        return
    if role == "host":
        print(json.dumps(host(interface, channel, more)))
        return
    with can.Bus(channel=channel, interface=interface, **more) as bus:
        print(json.dumps({"listen": listen, "send": send}[role](bus, *arguments)))


if __name__ == "__main__":
    main()
