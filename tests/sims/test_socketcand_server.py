"""A session of the socketcand twin: its commands, cut anywhere, and whatever else may come."""

from __future__ import annotations

from itertools import pairwise

import can
import pytest
from hypothesis import given, strategies as st

from sims.wires.socketcand_server import SocketcandSession


class Client:
    """A session with what it has written and what it has put on the bus."""

    def __init__(self) -> None:
        self.heard: list[can.Message] = []
        self.out = bytearray()
        self.session = SocketcandSession(self.out.extend, "can0", self.heard.append)

    def ask(self, text: str) -> str:
        self.out.clear()
        self.session.received(text.encode())
        return self.out.decode()


def ready() -> Client:
    client = Client()
    client.ask("< open can0 >< rawmode >")
    return client


def test_a_client_is_greeted_opens_the_bus_and_listens() -> None:
    client = Client()
    assert client.out == b"< hi >"
    assert not client.session.listens
    assert client.ask("< open can0 >") == "< ok >"
    assert client.ask("< rawmode >") == "< ok >"
    assert client.session.listens
    assert client.ask("< echo >") == "< echo >"


@pytest.mark.parametrize("text", ["< open can1 >", "< rawmode >", "< send 123 0 >", "< subscribe >", "<>", ">", "x>"])
def test_what_is_no_command_at_this_time_is_refused_and_counted(text: str) -> None:
    client = Client()
    assert client.ask(text) == "< error unknown command >"
    assert client.session.malformed == 1


@pytest.mark.parametrize(
    ("text", "identifier", "extended", "data"),
    [("123 2 a bb", 0x123, False, "0abb"), ("0CF02A80 1 FF", 0x0CF02A80, True, "ff"), ("7FF 0", 0x7FF, False, "")],
)
def test_frames_are_sent(text: str, identifier: int, extended: bool, data: str) -> None:
    client = ready()
    assert client.ask(f"< send {text} >") == ""
    (message,) = client.heard
    assert (message.arbitration_id, message.is_extended_id, message.data.hex()) == (identifier, extended, data)


@pytest.mark.parametrize("text", ["123 2 a", "123 9 1 2 3 4 5 6 7 8 9", "800 0", "zz 0", "", "123 1 100"])
def test_what_is_no_frame_is_refused_and_counted(text: str) -> None:
    client = ready()
    assert client.ask(f"< send {text} >") == "< error unknown command >"
    assert (client.heard, client.session.malformed) == ([], 1)


@given(st.binary(max_size=300), st.lists(st.integers(0, 330)))
def test_any_bytes_in_any_pieces_get_the_same_answers_and_never_raise(data: bytes, cuts: list[int]) -> None:
    whole, pieces = ready(), ready()
    text = data + b"< send 123 1 5 >"
    whole.session.received(text)
    for start, stop in pairwise(sorted({0, len(text), *(min(cut, len(text)) for cut in cuts)})):
        pieces.session.received(text[start:stop])
    assert whole.out == pieces.out
    assert len(whole.heard) == len(pieces.heard) >= 1
