"""What comes as text from adapters and servers: cut anywhere, damaged, and nothing but noise."""

from __future__ import annotations

import json
import random
import socket
import threading
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings, strategies as st

from drivers.links.can_buses import Raw, SlcanBus, SocketcandBus

VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "slcan.json").read_text())["vectors"]
LINES = [v for v in VECTORS if v["ascii"][0] in "tTrRdDbB"]
FULL = pytest.param(10_000_000, marks=[pytest.mark.full, pytest.mark.timeout(900)])


class Wire:
    """A bus whose other end is the test's."""

    def __init__(self, bus: Any, put: Callable[[bytes], Any], close: Callable[[], Any]) -> None:
        self.bus, self.put, self._close = bus, put, close

    def take(self, quiet: int = 20) -> list[Raw]:
        """Return all frames that there are: until nothing has come some times in a row."""
        found, silent = [], 0
        while silent < quiet:
            frames = self.bus.frames(0)
            found += frames
            silent = 0 if frames else silent + 1
        return found

    def __enter__(self) -> Wire:
        return self

    def __exit__(self, *_: object) -> None:
        self.bus.shutdown()
        self._close()


def slcan() -> Wire:
    """An slcan bus on pyserial's loop: it hears what it writes, and has no descriptor, as on Windows."""
    bus = SlcanBus("loop://", sleep_after_open=0)
    wire = Wire(bus, bus.serialPortOrig.write, lambda: None)
    wire.take()  # its own commands
    return wire


def socketcand() -> Wire:
    """A socketcand bus whose server says yes to everything."""
    server = socket.create_server(("127.0.0.1", 0))
    accepted: list[socket.socket] = []

    def serve() -> None:
        peer, _ = server.accept()
        accepted.append(peer)
        for greeting in (b"< hi >", b"< o", b"k >< ok >"):
            peer.sendall(greeting)

    thread = threading.Thread(target=serve)
    thread.start()
    bus = SocketcandBus("can0", *server.getsockname())
    thread.join()
    server.close()
    return Wire(bus, accepted[0].sendall, accepted[0].close)


@pytest.mark.parametrize("vector", LINES, ids=lambda v: v["ascii"])
def test_the_lines_of_the_vectors_are_frames(vector: dict[str, Any]) -> None:
    with slcan() as wire:
        wire.put(bytes.fromhex(vector["hex"]))
        told = vector["decoded"]
        plain = vector["ascii"][0] in "tT"  # other frames carry no data of ours
        expected = [(told["id"], told.get("ext", False), bytes.fromhex(told.get("data", "")))] if plain else []
        assert (wire.take(), wire.bus.malformed) == (expected, 0)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.sampled_from(LINES), max_size=5), st.binary(max_size=60), st.lists(st.integers(0, 400)))
def test_lines_in_any_pieces_and_after_any_noise_are_the_same_frames(
    lines: list[dict[str, Any]], noise: bytes, cuts: list[int]
) -> None:
    good = b"".join(bytes.fromhex(line["hex"]) for line in lines)
    text = noise + b"\r" + good
    with slcan() as whole, slcan() as pieces, slcan() as clean:
        whole.put(text)
        expected = whole.take(100)
        found = []
        for start, stop in pairwise(sorted({0, len(text), *(min(cut, len(text)) for cut in cuts)})):
            pieces.put(text[start:stop])
            found += pieces.take(100)
        assert found == expected
        clean.put(good)
        told = clean.take()
        assert expected[len(expected) - len(told) :] == told


@pytest.mark.parametrize("size", [200_000, FULL])
@pytest.mark.parametrize("make", [slcan, socketcand])
def test_noise_never_raises_and_is_not_kept(make: Callable[[], Wire], size: int) -> None:
    rng = random.Random(1)
    with make() as wire:
        for _ in range(size // 2000):
            noise = rng.randbytes(1000) + bytes(rng.choices(b"tTrRdDbB0123456789ABCDEF\r\a< >frame.", k=1000))
            wire.put(noise)
            wire.take(100)
        bus = wire.bus
        kept = len(bus._buffer) if isinstance(bus, SlcanBus) else len(bus._rest)
        assert kept <= 256


def test_frames_of_a_server_that_cannot_be_read_are_counted_and_left_out() -> None:
    with socketcand() as wire:
        wire.put(b"< frame zz 1.0 00 >< frame 123 x 00 >< frame 123 1.0 0 >< frame 123 1.0 0102 >< other >")
        bus = wire.bus
        assert bus.frames(1.0) == [(0x123, False, b"\x01\x02")]
        assert bus.malformed == 3
