"""One request at a time on a byte link, and answers that surely belong to their requests.

Languages of plain lines put no number on an answer. As long as every request got its answer in time, the next bytes
answer the next request: the stream is *in step*. After a time-out, a malformed answer, a cancel or a byte that nobody
asked for it is *in doubt*: what comes next may belong to an older request. It is then brought back by a token, a
request whose answer cannot be anything else's. A controller answers in order, so all that comes before the answer to
the token is old: it is discarded and counted.
"""

import asyncio
import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

from drivers.errors import BadReply, LinkLost
from drivers.protocols import ByteLink
from drivers.requests.turn import Turn
from drivers.types import LinkCounts

_LONGEST_ANSWER = 4096  # bytes; longer data are not an answer
_ATTEMPTS = 2
_MALFORMED_AT_MOST = 3  # answers to one request that are none, before it is given up
_KEEP_LOOKING_FOR_TOKEN = 512  # bytes that are searched for a token's answer


@dataclass(frozen=True, slots=True)
class Answer:
    """The text of an answer without its framing, with the loop times at which the request was sent and the answer
    arrived.
    """

    text: str
    refused: bool
    repeated: bool
    sent_s: float
    received_s: float


@dataclass(frozen=True, slots=True)
class Framed:
    """An answer at the beginning of the bytes received; it takes ``length`` of them."""

    text: str
    refused: bool
    length: int


@dataclass(frozen=True, slots=True)
class Token:
    """A request with an unmistakable answer; ``find`` returns where that begins and ends in the bytes received."""

    request: bytes
    find: Callable[[bytes], tuple[int, int] | None]


class Framing(Protocol):
    """How a language puts requests and answers into bytes."""

    @property
    def idle(self) -> bytes:
        """Bytes that may come at any time and mean nothing."""

    @property
    def settle_s(self) -> float:
        """How long nothing may follow the answer to a token, for a language whose tokens are not unmistakable."""

    def request(self, line: str) -> bytes:
        """Return the bytes of a request."""

    def answer(self, line: str, received: bytes) -> Framed | None:
        """Return the answer to ``line`` that the bytes begin with, None while it is not complete."""

    def token(self) -> Token:
        """Return a token that differs from those before."""


class UnexpectedReply(BadReply):
    """Repeated answers that do not fit the request; ``text`` is the last of them."""

    def __init__(self, device: str, message: str, text: str) -> None:
        """Keep the controller's own text."""
        super().__init__(device, message)
        self.text = text


class Unanswered(LinkLost):
    """The controller answers, but it is unknown whether it carried out a request that must not be repeated."""


class _MalformedError(Exception):
    """An answer that fits no pattern; the argument is its text."""


class Exchange:
    """Requests and answers on a link; a controller counts as silent after two time-outs."""

    def __init__(self, device: str, link: ByteLink, framing: Framing, timeout_s: float) -> None:
        """Prepare for requests of two attempts of ``timeout_s`` each, resynchronisation included.

        ``framing`` is the language of the controller: how requests, answers and tokens look. ``device`` is for errors.
        The first request resynchronises. The counts are those of the link, if it has any.
        """
        self._device, self._link, self._framing, self._timeout_s = device, link, framing, timeout_s
        self._turn = Turn()
        self._in_doubt = True  # a serial line may hold answers to an earlier program
        self._silence_s = float("-inf")  # when the controller was last found silent
        self._failed = False  # since the link was opened, and not answered since
        self._heard = b""  # last
        self.counts: LinkCounts = getattr(link, "counts", LinkCounts())

    async def open(self) -> None:
        """Open the link and get in step; LinkLost if the controller does not answer."""
        await self._link.open()
        self._in_doubt, self._failed = True, False
        await self.get_in_step()

    async def tell_all(self, lines: Iterable[str]) -> None:
        """Send lines at once without waiting for any answer, as for stopping; LinkLost if they cannot be sent.

        If the last request or write failed, or this write fails, the link is closed and opened anew first. An empty
        line goes ahead, which ends a line that was cut off on its way. The next request resynchronises first, past
        whatever the controller answers.
        """
        data = b"".join(map(self._framing.request, ("", *lines)))
        async with self._turn:
            if not self._failed:
                with suppress(LinkLost):
                    self._write(data)
                    return
            self.close()
            await self._link.open()
            self._failed = False
            self._write(data)

    def close(self) -> None:
        """Close the link."""
        self._link.close()

    async def ask(self, line: str, pattern: re.Pattern[str], *, repeat: bool = True) -> Answer:
        """Send a request and return its answer, which matches ``pattern`` in full or is a refusal.

        Requests of several tasks wait for one another. Before a new attempt, and after a malformed answer, the exchange
        is resynchronised. With ``repeat`` false the request is sent at most once. LinkLost if no answer comes in two
        attempts, or if the link is gone. Unanswered, a LinkLost, if a request that must not be repeated has no answer
        although the controller is there. UnexpectedReply after three malformed answers, or after one if it must not be
        repeated. Time-outs and malformed answers are counted.
        """
        arrived = asyncio.get_running_loop().time()
        async with self._turn:
            began = self._began(arrived)
            attempt, malformed, sent = 1, 0, False
            while attempt <= _ATTEMPTS:
                try:
                    async with asyncio.timeout_at(began + attempt * self._timeout_s):
                        await self._be_in_step()
                        if sent and not repeat:
                            raise Unanswered(self._device, f"it is unknown whether {line!r} was carried out")
                        repeated, sent = sent, True
                        return await self._once(line, pattern, repeated)
                except TimeoutError:
                    self.counts.timeouts += 1
                    attempt += 1
                except Unanswered:  # the controller is there, and in step
                    raise
                except LinkLost:
                    self._failed = True
                    raise
                except _MalformedError as error:
                    self.counts.malformed += 1
                    malformed += 1
                    if malformed == _MALFORMED_AT_MOST or not repeat:
                        self._failed = True
                        text = str(error)
                        raise UnexpectedReply(self._device, f"answers {text[:60]!r} to {line!r}", text) from None
            raise self._silent(f"to {line!r}")

    async def get_in_step(self, line: str | None = None) -> bytes:
        """Send ``line`` if given, then a token; return the bytes received before the token's answer, the last 512 at
        most.

        LinkLost if no answer to the token comes in two attempts, or if the link is gone.
        """
        arrived = asyncio.get_running_loop().time()
        async with self._turn:
            self._write(b"" if line is None else self._framing.request(line))
            began = self._began(arrived)
            before = b""
            for attempt in range(1, _ATTEMPTS + 1):
                try:
                    async with asyncio.timeout_at(began + attempt * self._timeout_s):
                        before += await self._resync()
                        return before
                except TimeoutError:
                    self.counts.timeouts += 1
            raise self._silent("")

    def _began(self, arrived: float) -> float:
        """Return when a request's time began: earlier than now, to half a time-out's rest, if silence was met since."""
        self._heard = b""
        now = asyncio.get_running_loop().time()
        return now - 1.5 * self._timeout_s if self._silence_s > arrived else now

    def _silent(self, to_what: str) -> LinkLost:
        self._silence_s, self._failed = asyncio.get_running_loop().time(), True
        within = f"within {_ATTEMPTS * self._timeout_s:g} s after two requests"
        why = "is the controller switched on and connected?"
        if self._heard:
            why = f"only late or unrelated data arrived ({self._heard[-20:]!r})"
        return LinkLost(self._device, f"no answer {to_what + ' ' if to_what else ''}{within}: {why}")

    async def _be_in_step(self) -> None:
        if not self._in_doubt:
            stray = await self._waiting()
            self.counts.discarded += len(stray)
            self._in_doubt = bool(stray.strip(self._framing.idle))
        if self._in_doubt:
            await self._resync()

    async def _once(self, line: str, pattern: re.Pattern[str], repeated: bool) -> Answer:
        """Send the request once and return its answer; _MalformedError if the bytes do not fit, or more follow the
        answer.

        ``repeated`` is noted in the answer: the request was sent before. Waits without limit: the caller sets a
        time-out. After a refusal the next request is preceded by a resynchronisation.
        """
        sent_s = asyncio.get_running_loop().time()
        self._write(self._framing.request(line))
        received = b""
        while True:
            chunk = await self._link.receive()
            received += chunk.data
            self._heard = received
            framed = self._framing.answer(line, received)
            if framed is not None:
                break
            if len(received) > _LONGEST_ANSWER:
                raise self._malformed(received)
        beyond = received[framed.length :]
        if beyond.strip(self._framing.idle) or not (framed.refused or pattern.fullmatch(framed.text)):
            raise self._malformed(received)
        # A refusal is one character, which may be noise: its reason is requested in step.
        self._in_doubt, self._failed = framed.refused, False
        return Answer(framed.text, framed.refused, repeated, sent_s, chunk.t_ns * 1e-9)

    def _malformed(self, received: bytes) -> _MalformedError:
        self.counts.discarded += len(received)
        return _MalformedError(received.decode("ascii", "replace").strip())

    async def _resync(self) -> bytes:
        """Send a token, again after each answer that no silence follows; return the last bytes before the last answer.

        At most 512 bytes are kept. Nothing is sent again while no answer comes, without limit: the caller sets a
        time-out. Afterwards requests and answers are in step. All bytes passed over are counted as discarded.
        """
        before = b""
        while True:
            token = self._framing.token()
            self._write(token.request)
            while (found := token.find(before)) is None:
                chunk = await self._link.receive()
                before += chunk.data
                self._heard = before
                self.counts.discarded += max(len(before) - _KEEP_LOOKING_FOR_TOKEN, 0)
                before = before[-_KEEP_LOOKING_FOR_TOKEN:]
            start, end = found
            before, after = before[:start], before[end:] + await self._waiting(self._framing.settle_s)
            if not after.strip(self._framing.idle):
                self.counts.discarded += start
                self._in_doubt = False
                return before
            before += after

    async def _waiting(self, for_s: float = 0.0) -> bytes:
        """Return the bytes that arrive within ``for_s`` seconds without a request, by default those that are already
        here.

        It ends earlier once more than 4096 have come; LinkLost if the link is gone.
        """
        received = b""
        await asyncio.sleep(0)  # lets a socket deliver bytes that it already has
        try:
            async with asyncio.timeout(for_s):
                while len(received) <= _LONGEST_ANSWER:
                    received += (await self._link.receive()).data
        except TimeoutError:
            pass
        return received

    def _write(self, data: bytes) -> None:
        self._in_doubt = True  # until the answer is here, also if the wait for it is cancelled
        try:
            self._link.write(data)
        except OSError as error:
            raise LinkLost(self._device, f"cannot send ({error}). Is it still plugged in?") from None
