"""A temperature chamber: a kind of device of one's own, with a driver, and its twin.

A bench file takes it by ``plugins = ["climate_chamber.py"]`` and a section [[chamber]] with ``protocol = "espec"`` and
a ``temperature``. The language is that of ESPEC P-300 controllers: lines of text on TCP or a serial port.
"""

import asyncio
import math
import re
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from typing import Any

from drivers.errors import DeviceFault, DeviceRefused
from drivers.kind import DeviceKind
from drivers.plugins import Registry
from drivers.protocols import ByteLink
from drivers.requests.exchange import Exchange, Framed, Token
from drivers.specs import DeviceSetup, DeviceSpec, Key
from drivers.types import Identity
from sims.wires.line_controller import LineDevice

SAFE_C = 25.0  # off while it is cold it gets wet
POLL_S = 1.0
TYPE, NUMBERS = re.compile(rb"T,[^\r\n]*\r\n"), re.compile(r"-?\d+\.\d(, ?-?\d+\.\d){3}")


class EspecFraming:
    """Requests and answers as bytes: a line each. Only the answer to TYPE? begins with T."""

    idle, settle_s = b"\r\n", 0.05

    def request(self, line: str) -> bytes:
        return f"{line}\r\n".encode()

    def answer(self, line: str, received: bytes) -> Framed | None:
        text, end, _ = received.partition(b"\r\n")
        return Framed(text.decode("ascii", "replace"), text.startswith(b"NA:"), len(text) + 2) if end else None

    def token(self) -> Token:
        return Token(self.request("TYPE?"), lambda received: (found := TYPE.search(received)) and found.span())


class EspecChamber:
    """The driver. It appends temperature and set point to the recording."""

    columns: Mapping[str, str] = {"temperature_c": "degC", "set_point_c": "degC"}

    def __init__(self, setup: DeviceSetup, link: ByteLink) -> None:
        self._name = setup.name
        self._exchange = Exchange(setup.name, link, EspecFraming(), setup.timeout_s)
        self.open, self.close = self._exchange.open, self._exchange.close

    async def identify(self) -> Identity:
        return Identity(f"ESPEC {(await self._exchange.ask('TYPE?', re.compile('T,.*'))).text}")

    async def rows(self) -> AsyncIterator[tuple[int, Sequence[float]]]:
        while True:
            actual_c, set_point_c, *_ = await self.temperatures()
            yield round(asyncio.get_running_loop().time() * 1e9), (actual_c, set_point_c)
            await asyncio.sleep(POLL_S)

    async def temperatures(self) -> list[float]:
        """Return actual temperature, set point, upper and lower limit, in degC."""
        answer = await self._exchange.ask("TEMP?", NUMBERS)
        if answer.refused:
            raise DeviceRefused(self._name, f"tells no temperature: {answer.text}")
        return [float(number) for number in answer.text.split(",")]

    async def refused(self, set_point: float) -> str:
        _, _, highest_c, lowest_c = await self.temperatures()
        beyond = f"{set_point:g} degC is beyond its limits of {lowest_c:g} and {highest_c:g} degC"
        return "" if lowest_c < set_point < highest_c else beyond

    async def go_to(self, temperature_c: float) -> None:
        """Start on the way to a temperature."""
        for line in (f"TEMP, S{temperature_c:.1f}", "MODE,CONSTANT"):
            answer = await self._exchange.ask(line, re.compile("OK:.*"))
            if answer.refused:
                raise DeviceRefused(self._name, f"refuses {line!r}: {answer.text}")

    async def make_safe(self) -> None:
        await self._exchange.tell_all([f"TEMP, S{SAFE_C:.1f}"])
        _, set_point_c, *_ = await self.temperatures()
        if set_point_c != SAFE_C:
            raise DeviceFault(self._name, f"it was told to go to {SAFE_C:g} degC and goes to {set_point_c:g} degC")


async def ready(chamber: EspecChamber, settings: Mapping[str, Any]) -> None:
    """Bring the chamber to its temperature, and wait until it is there."""
    loop, target_c = asyncio.get_running_loop(), settings["temperature"]
    await chamber.go_to(target_c)
    until_s = loop.time() + settings["wait"]
    while abs((await chamber.temperatures())[0] - target_c) > settings["within"]:
        if loop.time() > until_s:
            raise DeviceFault("chamber", f"it is not at {target_c:g} degC after {settings['wait']:g} s")
        await asyncio.sleep(POLL_S)


class EspecTwin(LineDevice):
    """The twin: the same lines; its temperature follows the set point with a time constant of 20 s."""

    ends, skipped = b"\n", b"\r"

    def __init__(self, setup: DeviceSetup, write: Callable[[bytes], None]) -> None:
        super().__init__(write)
        self._set_point_c, self._from_c, self._mode = 23.0, 23.0, "STANDBY"
        self._since_s = asyncio.get_running_loop().time()

    def _take(self, line: bytes) -> None:
        self._write(f"{self._answer(line.decode('ascii', 'replace').strip())}\r\n".encode())

    def _answer(self, text: str) -> str:
        if text == "TYPE?":
            return "T,T,S2,160.0"
        now_s = asyncio.get_running_loop().time()
        fall = math.exp(-(now_s - self._since_s) / 20.0) if self._mode == "CONSTANT" else 1.0
        actual_c = self._set_point_c + (self._from_c - self._set_point_c) * fall
        if text == "TEMP?":
            return f"{actual_c:.1f}, {self._set_point_c:.1f}, 150.0, -60.0"
        if found := re.fullmatch(r"TEMP, S(-?\d+\.\d)", text):
            self._from_c, self._since_s, self._set_point_c = actual_c, now_s, float(found[1])
        elif text == "MODE,CONSTANT":
            self._from_c, self._since_s, self._mode = actual_c, now_s, "CONSTANT"
        else:
            return "NA:CMD ERR"
        return f"OK:{text}"


SPEC = DeviceSpec(
    name="espec",
    kind="chamber",
    what="ESPEC chambers with a P-300 controller, an example",
    link="tcp://192.168.1.20:10001",
    make=EspecChamber,
    twin=EspecTwin,
)
KIND = DeviceKind(
    name="chamber",
    what="the chamber",
    protocols=Registry(DeviceSpec, "turntable_station.chambers", {"espec": SPEC}),
    keys=(
        Key("temperature", "temperature", "where a run is made", required=True, example="27 degC"),
        Key("within", "number", "how near it must be before the script begins, in K", 0.5, bound="above_zero"),
        Key("wait", "time", "how long it may take to get there", "2 h", bound="above_zero"),
    ),
    ready=ready,
    set_point="temperature",
    safe_order=10,
    made_safe=f"it goes to {SAFE_C:g} degC",
)
