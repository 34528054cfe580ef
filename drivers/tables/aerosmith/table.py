"""EXPERIMENTAL: a single-axis Ideal Aerosmith table (1270VS and kin) by its table language.

No manual was found; this is what public programs send (actigraph/RateTableSweepGUI and others), tried on a twin that
knows no more. Three letters and a number without a space, ended by CR; the answer ends with the prompt ``>``, and a
``?`` in it is a refusal. While the table jogs, the prompt is held back until the next command comes. Rates are whole
deg/s (JOG, VEL), and so are accelerations (ACL). Not known: what the bits of STA mean, whether angles go on beyond a
turn, whether a move's prompt comes before or after it. So a fault is only seen where the bench says which bits
of STA tell one, and angles are counted on over the turns while the table is read often enough.
"""

import asyncio
import math
import re

from drivers.errors import DeviceRefused
from drivers.packaged import sentence
from drivers.protocols import ByteLink
from drivers.requests.exchange import Answer, Framed, Token
from drivers.specs import TableSetup, TableSpec, described
from drivers.tables.line_table import LineTable, unwrapped
from drivers.tables.unwrap import Unwrapper
from drivers.types import AxisState, AxisStatus, Identity

INTEGER = re.compile(r"(?:STA)?\s*(\d+)")
NUMBER = re.compile(r"(?:PPO|PVE)?\s*([-+]?\d+(?:\.\d*)?)")

_ANSWER = re.compile(rb"[^>]*>[\r\n]*")
_STATUS_ANSWER = re.compile(rb"(?:STA)?\s*\d+\s*[\r\n]+>[\r\n]*")
_POLL_S = 0.05
_AT_REST_DPS = 0.02
_ON_TARGET_DEG = 0.02
_JOG_REACHED_DPS = 0.1
_BEGUN_S = 0.3  # a motion that is to come has begun by then
_SETTLE_SHARE = 0.15  # of a time-out, in which nothing may follow the answer to a token


class AerosmithFraming:
    """Bytes of requests and answers.

    The token is STA, which no other request is answered like: with one integer. It is not unmistakable, as an earlier
    STA is answered alike; hence nothing may follow its answer for a while. An answer that comes still later may be
    mistaken.
    """

    idle = b"\r\n "

    def __init__(self, settle_s: float) -> None:
        """Listen for ``settle_s`` after the answer to a token."""
        self.settle_s = settle_s

    def request(self, line: str) -> bytes:
        """Return a command, ended by CR."""
        return line.encode("ascii") + b"\r"

    def answer(self, line: str, received: bytes) -> Framed | None:
        """Return the text before the prompt, None while that is incomplete; "?" in it marks a refusal."""
        found = _ANSWER.match(received)
        if found is None:
            return None
        text = received[: received.index(b">")].decode("ascii", "replace").strip()
        return Framed(text, "?" in text, found.end())

    def token(self) -> Token:
        """Return STA, which asks for the status word; the last such answer counts."""

        def find(received: bytes) -> tuple[int, int] | None:
            found = list(_STATUS_ANSWER.finditer(received))
            return found[-1].span() if found else None

        return Token(b"STA\r", find)


class AerosmithTable(LineTable):
    """Turntable driver over a byte link; one axis. Experimental, as its status says."""

    def __init__(self, setup: TableSetup, link: ByteLink) -> None:
        """Prepare for a table with a single axis; ValueError for more.

        The option ``fault_mask`` has the bits of STA that mean a fault, from the manual of the table; with 0 no fault
        is recognised.
        """
        super().__init__(setup, link, AerosmithFraming(_SETTLE_SHARE * setup.timeout_s))
        (self._axis,) = setup.axes
        self._fault_mask = setup.options["fault_mask"]
        self._unwrapper = Unwrapper(360.0)
        self._target_deg: float | None = None
        self._jog_dps: float | None = None
        self._servo_on = False
        self._started_s = -math.inf

    async def open(self) -> None:
        """Open the link and ask for the status; LinkLost if the table does not answer. Turns counted are forgotten."""
        await self._exchange.open()
        self._unwrapper.restart()

    async def identify(self) -> Identity:
        """Return the model without asking: no public program asks the table for it."""
        return Identity(model="Ideal Aerosmith (experimental)")

    async def enable(self) -> None:
        """Switch the servo on; DeviceFault if the table reports a fault."""
        await self._sound(self._axis)
        await self._tell("SRV1")
        self._servo_on = True

    async def home(self) -> None:
        """Turn to the table's home position and wait for it; angles count from there.

        DeviceFault if the table reports a fault, DeviceRefused if homing takes more than a minute.
        """
        self.homing = set(self.limits)
        await self._set_acceleration(self.limits[self._axis].acceleration_rps2)
        await self._start("HOM")
        self._target_deg, self._jog_dps = 0.0, None
        await self._wait_for_home(_POLL_S)

    async def _at_home(self, axis: str) -> bool:
        self._unwrapper.restart()
        return await super()._at_home(axis)

    async def jog(self, axis: str, rate_rps: float, acceleration_rps2: float) -> None:
        """Turn at a whole number of deg/s until the next command, with the acceleration rounded down to whole deg/s2.

        DeviceRefused for any other rate, or an acceleration below 1 deg/s2. The limits of the bench file are not
        checked.
        """
        rate = self._whole_rate(rate_rps)
        await self._set_acceleration(acceleration_rps2)
        await self._start(f"JOG{rate}")
        self._target_deg, self._jog_dps = None, float(rate)

    async def move(self, axis: str, angle_rad: float, rate_rps: float, acceleration_rps2: float) -> None:
        """Set acceleration and rate, and start a move to an angle from home.

        ``rate_rps`` is a speed, of which the sign is ignored; the acceleration is rounded down to whole deg/s2.
        DeviceRefused if the speed is no whole number of deg/s, or the acceleration below 1 deg/s2. The limits of the
        bench file are not checked.
        """
        rate = abs(self._whole_rate(rate_rps))
        await self._set_acceleration(acceleration_rps2)
        await self._tell(f"VEL{rate}")
        target = math.degrees(angle_rad)
        await self._start(f"MOV{target:.4f}")
        self._target_deg, self._jog_dps = target, None

    async def read(self, axis: str) -> AxisState:
        """Measure angle (PPO) and rate (PVE); each is stamped with the middle of its own round trip."""
        position = await self._ask("PPO", NUMBER)
        velocity = await self._ask("PVE", NUMBER)
        return unwrapped(self._unwrapper, (position, _value(position, NUMBER)), (velocity, _value(velocity, NUMBER)))

    async def status(self, axis: str) -> AxisStatus:
        """Read status word, angle and rate; whether a target is reached is judged by the latter two.

        A move is at its target at rest within 0.02 deg of it, 0.3 s after its start at the earliest; a jog within 0.1
        deg/s of its rate; without either, so is a rate below 0.1 deg/s. Enabled means that this driver switched the
        servo on and no fault bit is set: other bits are unknown. An open interlock is never reported.
        """
        word = int(_value(await self._ask("STA", INTEGER), INTEGER))
        state = await self.read(axis)
        angle, rate = math.degrees(state.angle_rad), math.degrees(state.rate_rps)
        if self._target_deg is not None:
            begun = asyncio.get_running_loop().time() - self._started_s >= _BEGUN_S
            reached = begun and abs(rate) <= _AT_REST_DPS and abs(angle - self._target_deg) <= _ON_TARGET_DEG
        else:
            reached = abs(rate - (self._jog_dps or 0.0)) <= _JOG_REACHED_DPS
        faulty = word & self._fault_mask
        fault = f"axis {axis} reports a fault (STA {word}, where {faulty} means fault)" if faulty else ""
        text = f"servo {'on' if self._servo_on else 'off'}, STA {word} (experimental driver: the bits are unknown)"
        return AxisStatus(self._servo_on and not faulty, reached, fault, text)

    async def stop(self) -> str:
        """Stop (STO) and wait for rest, over a new connection if need be; return in words what was seen.

        Raises as ``bring_to_rest``.
        """
        self._target_deg, self._jog_dps = None, None
        return await self._rest(lambda axis: ("STO",), self.read)

    async def abort(self) -> None:
        """Switch the servo off and wait for rest; a table that does not know SRV is stopped by STO all the same.

        Raises as ``bring_to_rest``.
        """
        self._target_deg, self._jog_dps, self._servo_on = None, None, False
        await self._rest(lambda axis: ("STO", "SRV0"), self.read)

    async def _clear_fault(self, axis: str) -> None:
        """Switch the servo off and on, which is all there is."""
        for line in ("SRV0", "SRV1", "SRV0"):
            await self._tell(line)
        self._servo_on = False

    async def disable(self) -> None:
        """Switch the servo off."""
        await self._tell("SRV0")
        self._servo_on = False

    def _whole_rate(self, rate_rps: float) -> int:
        rate = math.degrees(rate_rps)
        whole = round(rate)
        if abs(rate - whole) > 1e-6:
            raise DeviceRefused(self._device, sentence("table.whole_rates", axis=self._axis, dps=rate))
        return whole

    async def _set_acceleration(self, acceleration_rps2: float) -> None:
        """Set the ramp, in whole deg/s2, rounded down; DeviceRefused below 1 deg/s2."""
        whole = math.floor(math.degrees(acceleration_rps2) + 1e-6)
        if whole < 1:
            raise DeviceRefused(self._device, f"axis {self._axis}: the slowest ramp of this controller is 1 deg/s2")
        await self._tell(f"ACL{whole}")

    async def _start(self, line: str) -> None:
        """Send a motion command, whose prompt may come at once or be held back, and see that it is not refused."""
        self._started_s = asyncio.get_running_loop().time()
        before = await self._exchange.get_in_step(line)
        if b"?" in before:
            raise self._refused(line, before.decode("ascii", "replace"))

    async def _refusal(self, line: str, answer: Answer) -> DeviceRefused:
        return self._refused(line, answer.text)

    def _refused(self, line: str, text: str) -> DeviceRefused:
        return DeviceRefused(self._device, f"axis {self._axis} refuses {line!r}: {' '.join(text.split())!r}")


def _value(answer: Answer, pattern: re.Pattern[str]) -> float:
    found = pattern.fullmatch(answer.text)
    return float(found[1]) if found else math.nan


SPEC = described(TableSpec, __package__, make=AerosmithTable)
