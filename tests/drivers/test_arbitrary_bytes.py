"""Every decoder takes any bytes: it drops and counts what is damaged, never raises, and keeps little."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from drivers.imus.aceinna.codec import decode_version
from drivers.imus.described.framing import Decoder
from drivers.imus.stim300.codec import Stim300Decoder
from drivers.imus.stim300.utility import parse_message
from drivers.imus.vectornav.codec import VectorNavDecoder
from drivers.imus.xsens import mtdata2
from drivers.imus.xsens.xbus import XbusDecoder
from drivers.tables.acutrol.language import NUMBERS, absolute_limits, refusal
from drivers.tables.galil.language import error_of, revision
from station.bench.descriptions import load_description
from station.remote.attaching import _Inbox

VECTORS = Path(__file__).parents[1] / "vectors"
XSENS = Path(__file__).parents[1] / "data/xsens"


def described(name: str) -> Callable[[], Any]:
    return lambda: Decoder(load_description(name).framing)


def seeds() -> list[bytes]:
    """Return streams that are whole: captures, and lines and datagrams as devices send them."""
    whole = [path.read_bytes()[:3000] for path in sorted(XSENS.glob("*.bin"))]
    texts = [path.read_bytes()[:3000] for path in sorted(VECTORS.rglob("*")) if path.is_file()]
    return [*whole, *texts[:20], b"$VNIMU,+00.1,+00.2,+00.3,+0.1,+0.2,-9.8,+0.1,+0.2,+0.3,+25.0,+101.3*65\r\n" * 20]


STARTS = (
    b"\xfa\xff",
    b"\xfa",
    b"\x90",
    b"\x91",
    b"\x93",
    b"\x94",
    b"\xbc",
    b"\xaf",
    b"$VN",
    b"\x5a\xa5",
    b"\r\n",
    b":",
    b"?",
)


def streams(count: int, seed: int) -> list[bytes]:
    """Return streams of noise, of whole messages that are damaged, and of the first bytes of messages."""
    rng = random.Random(seed)
    found, whole = [], seeds()
    for _ in range(count):
        kind = rng.random()
        if kind < 0.3:
            data = bytearray(rng.randbytes(rng.choice((1, 40, 900))))
        else:
            data = bytearray(rng.choice(whole))
            for _ in range(rng.choice((1, 5, 50))):
                if data:
                    data[rng.randrange(len(data))] = rng.choice((0, 255, rng.randrange(256)))
        if kind > 0.8:
            data[:0] = rng.choice(STARTS) * rng.choice((1, 30))
        found.append(bytes(data))
    return found


DECODERS: dict[str, Callable[[], Any]] = {
    "xbus": XbusDecoder,
    "stim300": Stim300Decoder,
    "vectornav": VectorNavDecoder,
    "csv": described("csv"),
    "hi91": described("hipnuc_hi91"),
}


def feed_all(make: Callable[[], Any], data: list[bytes], rng: random.Random) -> None:
    decoder = make()
    for stream in data:
        at = 0
        while at < len(stream):
            cut = at + rng.choice((1, 7, 64, 5000))
            for found in decoder.feed(stream[at:cut]):
                if getattr(found, "mid", None) is not None:
                    mtdata2.parse_mtdata2(found.data)
            at = cut
    for leave in (getattr(decoder, "flush", None),):
        if leave is not None:
            leave()


@pytest.mark.parametrize("name", DECODERS)
@pytest.mark.parametrize("count", [60, pytest.param(6000, marks=pytest.mark.full)])
def test_a_decoder_of_a_stream_takes_any_bytes(name: str, count: int) -> None:
    feed_all(DECODERS[name], streams(count, seed=hash(name) % 7), random.Random(1))


ANSWERS: dict[str, Callable[[bytes], object]] = {
    "stim300 utility": parse_message,
    "xsens outputs": mtdata2.decode_outputs,
    "aceinna version": decode_version,
    "acutrol limits": lambda raw: NUMBERS.fullmatch(text := raw.decode("latin-1")) and absolute_limits(text),
    "acutrol refusal": lambda raw: refusal(raw.decode("latin-1")),
    "galil error": lambda raw: error_of(raw.decode("latin-1")),
    "galil revision": lambda raw: revision(raw.decode("latin-1")),
}


@pytest.mark.parametrize("name", ANSWERS)
def test_a_reader_of_an_answer_takes_any_bytes(name: str) -> None:
    for raw in streams(200, seed=3):
        for piece in (raw[:8], raw[:30], raw):
            ANSWERS[name](piece)
    ANSWERS[name](b"")


def test_what_a_session_is_said_to_say_is_taken_or_left() -> None:
    inbox = _Inbox()
    for raw in (
        *streams(100, seed=5),
        b"[" * 100_000 + b"\n",
        b'{"kind": 1}\n',
        b"1e999\n",
        b"9" * 5000 + b"\n",
        b"null\n",
    ):
        inbox.data_received(raw)
