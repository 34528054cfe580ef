"""The STIM300's utility-mode codec against the datasheet's own strings."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from stim300_console import UtilityDecoder, data_of, status_of

from drivers.imus.stim300.utility import UtilityMessage, crc8, encode_message

VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "stim300_utility.json").read_text())["vectors"]
STREAM = [bytes.fromhex(vector["hex"]) for vector in VECTORS]
# Not to be taken: the datasheet's example of a wrong CRC, one without CRC, one too long, one with a strange character.
NEGATIVE = [
    b"$sbto,0.00123,12\r",
    b"$isn\r",
    b"#" + b"a," * 60 + b"12\r",
    b"$i\xe9n,28\r",
    b"$isn,300\r",
    b"$isn,028 \r",
]


def stated(vector: dict[str, Any]) -> UtilityMessage:
    return UtilityMessage(vector["decoded"]["direction"] == "response", tuple(vector["decoded"]["fields"]))


def test_the_crc_gives_the_datasheets_values() -> None:
    assert crc8(b"$isn,") == 28
    assert crc8(b"#UTILITYMODE,") == 234


@pytest.mark.parametrize("vector", VECTORS, ids=lambda v: v["ascii"][:24])
def test_a_message_decodes_to_its_stated_fields_and_encodes_back(vector: dict[str, Any]) -> None:
    decoder = UtilityDecoder()
    assert decoder.feed(bytes.fromhex(vector["hex"])) == [stated(vector)]
    assert (decoder.dropped_bytes, decoder.bad_messages) == (0, 0)
    assert encode_message(stated(vector)).hex() == vector["hex"]


@pytest.mark.parametrize("raw", NEGATIVE)
def test_what_is_no_message_is_refused_and_counted(raw: bytes) -> None:
    decoder = UtilityDecoder()
    assert decoder.feed(raw + STREAM[1]) == [stated(VECTORS[1])]
    assert decoder.bad_messages >= 1
    assert decoder.dropped_bytes == len(raw)


def test_a_reply_tells_its_status_and_what_it_says() -> None:
    refused, told, greeting, bare = UtilityDecoder().feed(
        b"#,2,139\r#isn,0,N2558184602002,32\r#UTILITYMODE,234\r#sconf,V,5,77\r"
    )
    assert (refused.fields[0], status_of(refused), data_of(refused)) == ("", 2, ())
    assert (told.fields[0], status_of(told), data_of(told)) == ("isn", 0, ("N2558184602002",))
    assert (greeting.fields[0], status_of(greeting)) == ("UTILITYMODE", None)
    assert (status_of(bare), data_of(bare)) == (None, ("V", "5"))


def test_where_the_stream_is_cut_changes_nothing() -> None:
    stream = b"\x94\x00#junk" + b"".join(STREAM[:8]) + NEGATIVE[0] + b"".join(STREAM[8:14])
    whole = UtilityDecoder()
    wanted = whole.feed(stream)
    assert wanted == [stated(vector) for vector in VECTORS[:14]]
    for cut in range(len(stream) + 1):
        decoder = UtilityDecoder()
        assert decoder.feed(stream[:cut]) + decoder.feed(stream[cut:]) == wanted
        assert (decoder.dropped_bytes, decoder.bad_messages) == (whole.dropped_bytes, whole.bad_messages)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.binary(max_size=150), min_size=1, max_size=6), st.lists(st.integers(0, 1500), max_size=8))
def test_foreign_bytes_are_counted_and_the_messages_between_them_found(junk: list[bytes], cuts: list[int]) -> None:
    stream = b"".join(noise + STREAM[i] for i, noise in enumerate(junk))
    decoder, found = UtilityDecoder(), []
    for start, stop in pairwise([0, *sorted(cuts), len(stream)]):
        found += decoder.feed(stream[start:stop])
    assert found == [stated(vector) for vector in VECTORS[: len(junk)]]
    assert decoder.dropped_bytes == sum(len(noise) for noise in junk)


def feed_noise(size: int) -> None:
    noise = np.random.default_rng(3).bytes(size)
    decoder = UtilityDecoder()
    for start in range(0, size, 4096):
        decoder.feed(noise[start : start + 4096])
        assert min(start + 4096, size) - decoder.dropped_bytes < 200
    assert decoder.feed(b"\r" + STREAM[1])[-1] == stated(VECTORS[1])


def test_noise_is_not_kept() -> None:
    feed_noise(200_000)


@pytest.mark.full
def test_ten_million_random_bytes_are_dropped_and_counted() -> None:
    feed_noise(10_000_000)


@pytest.mark.parametrize("fields", [("is,n",), ("isn\r",), ("a" * 97,), ("isn", "é")])
def test_what_cannot_be_a_message_is_not_made_into_one(fields: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match="is no message|can't encode"):
        encode_message(UtilityMessage(False, fields))
