"""Messages to and from one Xbus device on a byte link: requests with their answers, and unrequested data."""

import asyncio
from collections import deque
from collections.abc import Callable

from drivers.errors import DeviceRefused, LinkLost
from drivers.imus.one_source import OneSource
from drivers.imus.xsens.xbus import ERROR_DATA_OVERFLOW, Messages, Mid, XbusDecoder, encode, error_text
from drivers.protocols import ByteLink

_TRIES = 2


class XbusDevice(OneSource[ByteLink]):
    """A single device on its wire."""

    def __init__(self, device: str, link: ByteLink, timeout_s: float) -> None:
        """``timeout_s`` is for one try, of which each request has two."""
        super().__init__(device, link)
        self._timeout_s, self._decoder = timeout_s, XbusDecoder()
        self._inbox: deque[tuple[int, Messages]] = deque()  # with the instant of arrival, ns
        self._hears_data = False

    async def _receive(self) -> tuple[int, Messages]:
        """Return the next messages, all of one kind, with the loop time at which they arrived; LinkLost if the link
        ends.
        """
        while not self._inbox:
            await self._fill()
        return self._inbox.popleft()

    async def _request(self, mid: Mid, data: bytes = b"", expected: Callable[[bytes], bool] = lambda _: True) -> bytes:
        """Send a request with ``data``, twice at most, and return the data of its answer.

        That is the first answer that is ``expected``, else the last one within the time limit; only without any is the
        request sent again. Answers carry no number of their request, and devices answer in order. A late answer can
        therefore only be mistaken for that to a later request of the same kind; unless it is as expected, the right one
        is waited for. Other messages are dropped, those received before as well. LinkLost without an answer,
        DeviceRefused as ``_find_answer``.
        """
        self._inbox.clear()
        dropped, self._hears_data = self._decoder.dropped_bytes, False
        for _ in range(_TRIES):
            self._link.write(encode(mid, data))
            answer: bytes | None = None
            try:
                async with asyncio.timeout(self._timeout_s):
                    while answer is None or not expected(answer):
                        answer = await self._answer_to(mid)
                return answer
            except TimeoutError:
                # The answer may be inside bytes that looked like the beginning of a long message.
                self._inbox.extend((0, messages) for messages in self._decoder.flush())
            hidden = self._find_answer(mid)
            if hidden is not None:
                return hidden
            if answer is not None:
                return answer
        raise LinkLost(self._device, self._why_silent(mid, noise=self._decoder.dropped_bytes > dropped))

    async def _fill(self) -> None:
        chunk = await self._link.receive()
        self._inbox.extend((chunk.t_ns, messages) for messages in self._decoder.feed(chunk.data))

    async def _answer_to(self, mid: Mid) -> bytes:
        while (answer := self._find_answer(mid)) is None:
            await self._fill()
        return answer

    def _find_answer(self, mid: Mid) -> bytes | None:
        """Return the data of the first answer to ``mid`` in the inbox; None if there is none.

        It may be empty (b""). It and the messages before it are removed, later ones stay; data among those removed are
        noted in ``_hears_data``. DeviceRefused if an Error comes first. Ignored are errors of data overflow, and all
        errors while GoToConfig is asked: it is never refused.
        """
        while self._inbox:
            t_ns, messages = self._inbox.popleft()
            self._hears_data |= messages.mid == Mid.MTDATA2
            if messages.mid == mid + 1:
                answer, *more = messages.each()
                if more:
                    self._inbox.appendleft((t_ns, Messages(messages.mid, messages.data[1:])))
                return answer
            # GoToConfig is never refused: an Error that comes then is older than the request.
            if messages.mid == Mid.ERROR and mid != Mid.GO_TO_CONFIG:
                error = messages.each()[0]
                if error[:1] != bytes([ERROR_DATA_OVERFLOW]):
                    raise DeviceRefused(self._device, f"it refused {mid.label} with {error_text(error)}")
        return None

    def _why_silent(self, mid: Mid, *, noise: bool) -> str:
        """Return the error message for a request without an answer.

        It names the likely cause: by whether other messages of data came, else bytes that are not Xbus (``noise``),
        else nothing.
        """
        silent = f"no answer to {mid.label} within {_TRIES * self._timeout_s:g} s"
        if self._hears_data:
            return (
                f"{silent}, yet it sends data. Is the wire to the device connected? To listen "
                "only, set configure = false"
            )
        if noise:
            return f"{silent}, and the received data are not Xbus. Does the baud rate match the device?"
        return f"{silent}. Is it powered? Does its baud rate match the link?"
