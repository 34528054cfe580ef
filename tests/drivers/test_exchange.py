"""Requests and answers in step: late, malformed, doubled, cut and missing answers, with a peer made of lines."""

from __future__ import annotations

import asyncio
import random
import re
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from itertools import pairwise

import pytest
from hypothesis import given, settings, strategies as st
from turntable_rigs import virtually
from wire_pair import pair

from drivers.errors import LinkLost
from drivers.links.memory_link import MemoryLink
from drivers.links.tcp_link import TcpLink
from drivers.requests.exchange import Exchange, Token, Unanswered, UnexpectedReply
from drivers.tables.galil.language import NOTHING, NUMBER, GalilFraming
from station.run.event_loop.loops import ScaledLoop

TOKEN = re.compile(rb'MG "(T[0-9A-F]+)"')


class Peer:
    """Answers ``Qn`` by n as a Galil would, in order; ``answer`` may be replaced to misbehave."""

    def __init__(self, link: MemoryLink) -> None:
        self.link = link
        self.heard: list[bytes] = []
        self.answer: Callable[[bytes], None] = self.say
        self.says_tokens = True
        self._free_s = 0.0
        self._under_way: deque[bytes] = deque()

    def write(self, data: bytes, late_s: float = 0.0) -> None:
        """Write so much later, and after what was written before."""
        loop = asyncio.get_running_loop()
        self._free_s = max(self._free_s, loop.time() + late_s)
        self._under_way.append(data)
        loop.call_at(self._free_s, lambda: self.link.write(self._under_way.popleft()))

    async def serve(self) -> None:
        buffer = b""
        while True:
            buffer += (await self.link.receive()).data
            *lines, buffer = buffer.split(b"\r")
            for line in lines:
                self.take(line)

    def take(self, line: bytes) -> None:
        token = TOKEN.fullmatch(line)
        if token and self.says_tokens:
            self.write(token[1] + b"\r\n:")
        elif line and not token:
            self.heard.append(line)
            self.answer(line)
        elif not token:
            self.write(b":")

    def say(self, line: bytes, late_s: float = 0.0) -> None:
        self.write(b" " + line[1:] + b"\r\n:", late_s)


@asynccontextmanager
async def exchange(timeout_s: float = 0.2) -> AsyncIterator[tuple[Exchange, Peer]]:
    near, far = pair("table")
    peer = Peer(far)
    serving = asyncio.get_running_loop().create_task(peer.serve())
    made = Exchange("table", near, GalilFraming(), timeout_s)
    try:
        await made.open()
        yield made, peer
    finally:
        made.close()
        serving.cancel()


def test_an_answer_carries_its_round_trip() -> None:
    async def main() -> None:
        async with exchange() as (made, peer):
            peer.answer = lambda line: peer.say(line, 0.05)
            answer = await made.ask("Q7", NUMBER)
            assert (answer.text, answer.refused, answer.repeated) == ("7", False, False)
            assert answer.received_s - answer.sent_s == pytest.approx(0.05)

    virtually(main)


def test_requests_of_several_tasks_take_turns() -> None:
    async def main() -> None:
        async with exchange() as (made, peer):
            peer.answer = lambda line: peer.say(line, 0.03)
            answers = await asyncio.gather(*(made.ask(f"Q{n}", NUMBER) for n in range(10)))
            assert [answer.text for answer in answers] == [str(n) for n in range(10)]
            assert made.counts.timeouts == 0

    virtually(main)


@pytest.mark.parametrize("late_s", [0.21, 0.3, 0.39, 0.5, 0.9, 2.0])
def test_a_late_answer_is_never_taken_for_the_next_one(late_s: float) -> None:
    async def main() -> None:
        async with exchange() as (made, peer):
            first: list[bytes] = []

            def late_once(line: bytes) -> None:
                if line in first or line != b"Q111":
                    peer.say(line)
                else:
                    first.append(line)
                    peer.say(line, late_s)

            peer.answer = late_once
            answered = 0
            for n in range(100, 300):
                try:
                    assert (await made.ask(f"Q{n}", NUMBER)).text == str(n)
                    answered += 1
                except LinkLost:
                    assert late_s >= 0.39
                await asyncio.sleep(0.0137)
            assert made.counts.timeouts >= 1
            assert answered >= 194

    virtually(main)


def test_a_silent_peer_is_lost_within_two_time_outs_and_back_when_it_speaks() -> None:
    async def main() -> None:
        async with exchange() as (made, peer):
            loop = asyncio.get_running_loop()
            peer.answer, peer.says_tokens = lambda line: None, False
            for _ in range(3):
                began = loop.time()
                with pytest.raises(LinkLost, match="no answer to 'Q1' within 0.4 s after two requests"):
                    await made.ask("Q1", NUMBER)
                assert loop.time() - began == pytest.approx(0.4)
            peer.answer, peer.says_tokens = peer.say, True
            assert (await made.ask("Q2", NUMBER)).text == "2"

    virtually(main)


def test_whoever_waits_for_others_knows_within_half_a_second_too() -> None:
    async def main() -> None:
        async with exchange() as (made, peer):
            loop = asyncio.get_running_loop()
            peer.answer, peer.says_tokens = lambda line: None, False
            began = loop.time()
            results = await asyncio.gather(*(made.ask(f"Q{n}", NUMBER) for n in range(2)), return_exceptions=True)
            assert all(isinstance(result, LinkLost) for result in results)
            assert loop.time() - began <= 0.5 + 1e-9

    virtually(main)


def test_a_request_that_must_not_be_repeated_is_sent_once() -> None:
    async def main() -> None:
        async with exchange() as (made, peer):
            peer.answer = lambda line: None
            with pytest.raises(Unanswered, match="unknown whether 'DO' was carried out"):
                await made.ask("DO", NOTHING, repeat=False)
            assert peer.heard == [b"DO"]
            peer.answer = peer.say
            assert (await made.ask("Q5", NUMBER)).text == "5"

    virtually(main)


def test_an_answer_that_cannot_be_one_is_asked_for_again() -> None:
    async def main() -> None:
        async with exchange() as (made, peer):
            replies = iter([b" 1\x802\r\n:", b" 12\r\n:"])
            peer.answer = lambda line: peer.link.write(next(replies))
            assert (await made.ask("Q12", NUMBER)).text == "12"
            assert (made.counts.malformed, made.counts.timeouts) == (1, 0)
            peer.answer = lambda line: peer.link.write(b"rubbish\r\n:")
            with pytest.raises(UnexpectedReply, match="answers 'rubbish.*' to 'Q1'"):
                await made.ask("Q1", NUMBER)
            peer.answer = peer.say
            assert (await made.ask("Q3", NUMBER)).text == "3"

    virtually(main)


def test_a_doubled_answer_does_not_shift_what_follows() -> None:
    async def main() -> None:
        async with exchange() as (made, peer):

            def twice(line: bytes) -> None:
                peer.say(line)
                peer.say(line, 0.01)

            peer.answer = twice
            for n in range(20):
                assert (await made.ask(f"Q{n}", NUMBER)).text == str(n)
                await asyncio.sleep(0.02)
            assert made.counts.discarded > 0

    virtually(main)


def test_a_cancelled_request_leaves_its_answer_to_nobody() -> None:
    async def main() -> None:
        async with exchange() as (made, peer):
            loop = asyncio.get_running_loop()
            peer.answer = lambda line: peer.say(line, 0.1)
            asking = loop.create_task(made.ask("Q1", NUMBER))
            await asyncio.sleep(0.05)
            asking.cancel()
            with pytest.raises(asyncio.CancelledError):
                await asking
            peer.answer = peer.say
            assert (await made.ask("Q2", NUMBER)).text == "2"
            await asyncio.sleep(0.2)
            assert (await made.ask("Q3", NUMBER)).text == "3"

    virtually(main)


def test_a_refusal_is_an_answer() -> None:
    async def main() -> None:
        async with exchange() as (made, peer):
            peer.answer = lambda line: peer.link.write(b"?")
            assert (await made.ask("bg", NOTHING)).refused

    virtually(main)


def test_an_unplugged_link_is_lost_at_once() -> None:
    async def main() -> None:
        async with exchange() as (made, peer):
            peer.link.close()
            began = asyncio.get_running_loop().time()
            with pytest.raises(LinkLost, match="unplugged"):
                await made.ask("Q1", NUMBER)
            assert asyncio.get_running_loop().time() == began

    virtually(main)


@pytest.mark.parametrize("chunks", [200, pytest.param(10_000, marks=pytest.mark.full)])
def test_a_flood_of_bytes_ends_a_request_and_fills_no_memory(chunks: int) -> None:
    dice = random.Random(8)

    async def main() -> None:
        async with exchange() as (made, peer):

            def flood(line: bytes) -> None:
                for _ in range(chunks):
                    peer.link.write(dice.randbytes(1000).replace(b":", b";").replace(b"?", b"!"))

            peer.answer = flood
            with pytest.raises((UnexpectedReply, LinkLost)):
                await made.ask("Q1", NUMBER)
            peer.answer = peer.say
            assert (await made.ask("Q2", NUMBER)).text == "2"
            assert made.counts.discarded >= 1000 * chunks

    virtually(main)


@given(data=st.binary(max_size=300), cuts=st.lists(st.integers(0, 300), max_size=5))
@settings(max_examples=150, deadline=None)
def test_no_bytes_before_a_request_spoil_its_answer(data: bytes, cuts: list[int]) -> None:
    async def main() -> None:
        async with exchange() as (made, peer):
            places = sorted({0, len(data), *(cut for cut in cuts if cut < len(data))})
            for start, end in pairwise(places):
                peer.link.write(data[start:end])
            assert (await made.ask("Q42", NUMBER)).text == "42"
            assert (await made.ask("Q43", NUMBER)).text == "43"

    virtually(main)


def test_late_answers_over_tcp_are_not_taken_for_the_next_ones() -> None:
    """The same on a socket: the first answer to each tenth request comes after the request's time-out."""

    async def main() -> None:
        loop = asyncio.get_running_loop()

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            seen: set[bytes] = set()
            while line := await reader.readline():
                line = line.strip()
                token = TOKEN.fullmatch(line)
                late = not token and line.endswith(b"0") and line not in seen
                seen.add(line)
                reply = token[1] if token else b" " + line[1:]
                if late:
                    await asyncio.sleep(0.07)
                writer.write(reply + b"\r\n:")
            writer.close()
            gone.set()

        class Lines(GalilFraming):
            def request(self, line: str) -> bytes:
                return line.encode() + b"\n"

            def token(self) -> Token:
                token = super().token()
                return Token(token.request.strip(b"\r") + b"\n", token.find)

        gone = asyncio.Event()
        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        link = TcpLink("table", "127.0.0.1", server.sockets[0].getsockname()[1], 1.0)
        made = Exchange("table", link, Lines(), 0.05)
        await made.open()
        for n in range(1, 41):
            assert (await made.ask(f"Q{n}", NUMBER)).text == str(n)
        assert made.counts.timeouts == 4
        made.close()
        await gone.wait()
        server.close()
        await server.wait_closed()
        assert loop.time() < 5.0

    with asyncio.Runner(loop_factory=ScaledLoop) as runner:
        runner.run(main())


def test_a_stop_after_a_request_of_unknown_fate_goes_by_the_connection_that_is_there() -> None:
    async def main() -> None:
        async with exchange() as (made, peer):
            peer.answer = lambda line: None
            with pytest.raises(Unanswered):
                await made.ask("DO", NOTHING, repeat=False)
            await made.tell_all(["ST"])
            await asyncio.sleep(0.01)
            assert peer.heard[-1] == b"ST"

    virtually(main)
