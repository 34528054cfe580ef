"""The STIM300 codec against datagrams built from the datasheet, and against everything a line does to them."""

from __future__ import annotations

import json
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.stim300 import (
    ACCEL_LSB_G,
    GYRO_LSB_DPS,
    LAYOUTS,
    TEMPERATURE_LSB_C,
    Datagrams,
    Stim300Decoder,
    crc32_mpeg2,
    encode,
)

VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "stim300_normal.json").read_text())["vectors"]
INCLINOMETER_LSB_G = 2.0**-22
LONGEST = max(layout.size for layout in LAYOUTS.values()) + 2
FIELDS = (
    "gyro",
    "gyro_status",
    "counter",
    "latency_us",
    "accelerometer",
    "accelerometer_status",
    "inclinometer",
    "inclinometer_status",
    "temperatures",
)


def terminated(vector: dict[str, Any]) -> bool:
    return bool(vector["decoded"].get("crlf_termination", False))


def datagrams(identifier: int, count: int, seed: int = 0) -> Datagrams:
    """Return datagrams of any kind with values over the whole range."""
    rng = np.random.default_rng(seed)
    layout = LAYOUTS[identifier]

    def cluster(present: bool) -> tuple[Any, Any]:
        if not present:
            return None, None
        return rng.integers(-(1 << 23), 1 << 23, (count, 3)), rng.integers(0, 256, count)

    gyro, gyro_status = cluster(True)
    accelerometer, accelerometer_status = cluster(layout.accelerometer)
    inclinometer, inclinometer_status = cluster(layout.inclinometer)
    return Datagrams(
        identifier,
        gyro,
        gyro_status,
        np.arange(count) % 256,
        rng.integers(0, 1 << 16, count),
        accelerometer,
        accelerometer_status,
        inclinometer,
        inclinometer_status,
        rng.integers(-(1 << 15), 1 << 15, (count, layout.clusters, 3)) if layout.temperature else None,
    )


def joined(parts: Iterable[Datagrams], field: str) -> np.ndarray | None:
    values = [getattr(part, field) for part in parts]
    return None if not values or values[0] is None else np.concatenate(values)


def assert_same(found: list[Datagrams], sent: Datagrams) -> None:
    assert {part.identifier for part in found} == {sent.identifier}
    for field in FIELDS:
        got, wanted = joined(found, field), getattr(sent, field)
        assert (got is None) == (wanted is None), field
        if wanted is not None:
            np.testing.assert_array_equal(got, wanted, field)


def encoded(parts: Iterable[Datagrams]) -> list[bytes]:
    """Return each datagram's bytes, for comparing what was found however it was grouped."""
    out = []
    for part in parts:
        data, size = encode(part), LAYOUTS[part.identifier].size
        out += [data[i : i + size] for i in range(0, len(data), size)]
    return out


def test_the_crc_gives_its_check_value() -> None:
    assert crc32_mpeg2(b"123456789") == 0x0376E6E7


@pytest.mark.parametrize("vector", VECTORS, ids=lambda v: v["hex"][:8])
def test_a_datagram_decodes_to_its_stated_values(vector: dict[str, Any]) -> None:
    stated = vector["decoded"]
    decoder = Stim300Decoder(line_termination=terminated(vector))
    (found,) = decoder.feed(bytes.fromhex(vector["hex"]))
    assert found.identifier == stated["id"]
    np.testing.assert_array_equal(found.gyro[0] * GYRO_LSB_DPS, stated["gyro_dps"])
    assert found.counter[0] == stated["counter"]
    assert found.latency_us[0] == stated["latency_us"]
    status = [s[0] for s in (found.gyro_status, found.accelerometer_status, found.inclinometer_status) if s is not None]
    assert status == stated.get("status", [stated.get("gyro_status", 0)] + [0] * (len(status) - 1))
    if "acc_g" in stated:
        assert found.accelerometer is not None
        scale = ACCEL_LSB_G[stated.get("acc_range_g", 10)]
        np.testing.assert_array_equal(found.accelerometer[0] * scale, stated["acc_g"])
    if "incl_g" in stated:
        assert found.inclinometer is not None
        np.testing.assert_array_equal(found.inclinometer[0] * INCLINOMETER_LSB_G, stated["incl_g"])
    temperatures = stated.get("temps_C") or [stated[k] for k in ("gyro_temp_C", "acc_temp_C") if k in stated]
    if temperatures:
        assert found.temperatures is not None
        np.testing.assert_array_equal(found.temperatures[0] * TEMPERATURE_LSB_C, temperatures)
    assert (decoder.dropped_bytes, decoder.bad_datagrams) == (0, 0)


@pytest.mark.parametrize("vector", VECTORS, ids=lambda v: v["hex"][:8])
def test_a_datagram_encodes_back_to_its_bytes(vector: dict[str, Any]) -> None:
    raw = bytes.fromhex(vector["hex"])
    (found,) = Stim300Decoder(line_termination=terminated(vector)).feed(raw)
    assert encode(found, line_termination=terminated(vector)) == raw


@pytest.mark.parametrize("identifier", sorted(LAYOUTS))
def test_every_kind_comes_back_from_its_own_bytes(identifier: int) -> None:
    sent = datagrams(identifier, 20)
    assert_same(Stim300Decoder().feed(encode(sent)), sent)


def test_where_the_stream_is_cut_changes_nothing() -> None:
    sent = encode(datagrams(0x90, 2)) + b"\x00\x90noise" + encode(datagrams(0xA7, 2, seed=1))
    whole = Stim300Decoder()
    wanted = encoded(whole.feed(sent))
    assert len(wanted) == 4
    for cut in range(len(sent) + 1):
        decoder = Stim300Decoder()
        found = decoder.feed(sent[:cut]) + decoder.feed(sent[cut:])
        assert encoded(found) == wanted
        assert (decoder.dropped_bytes, decoder.bad_datagrams) == (whole.dropped_bytes, whole.bad_datagrams)


def test_a_stream_may_come_byte_by_byte() -> None:
    sent = datagrams(0x94, 12)
    decoder = Stim300Decoder(line_termination=True)
    stream = encode(sent, line_termination=True)
    found = [part for byte in stream for part in decoder.feed(bytes([byte]))]
    assert_same(found, sent)
    assert (decoder.dropped_bytes, decoder.bad_datagrams) == (0, 0)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.binary(max_size=200), min_size=1, max_size=5), st.lists(st.integers(0, 1500), max_size=8))
def test_foreign_bytes_are_counted_and_the_datagrams_between_them_found(junk: list[bytes], cuts: list[int]) -> None:
    wanted, stream = [], b""
    for i, noise in enumerate(junk):
        part = encode(datagrams(0x94, 3, seed=i))
        stream += noise + part
        wanted += [part[at : at + 25] for at in range(0, len(part), 25)]
    # Noise may look like the start of a datagram: what follows must be long enough to tell.
    behind = encode(datagrams(0x94, 6, seed=99))
    decoder, found = Stim300Decoder(), []
    edges = [0, *sorted(cuts), len(stream)]
    for start, stop in pairwise(edges):
        found += encoded(decoder.feed(stream[start:stop]))
    found += encoded(decoder.feed(behind))
    assert found[:-6] == wanted
    assert decoder.dropped_bytes == sum(len(noise) for noise in junk)


def test_a_datagram_cut_short_costs_itself_only() -> None:
    size = LAYOUTS[0x94].size
    stream = encode(datagrams(0x94, 5))
    whole = [stream[i : i + size] for i in range(0, len(stream), size)]
    for missing in range(1, size):
        decoder = Stim300Decoder()
        found = encoded(decoder.feed(whole[0] + whole[1][:-missing] + b"".join(whole[2:])))
        assert found == [whole[0], *whole[2:]]
        assert decoder.dropped_bytes == size - missing
        assert decoder.bad_datagrams >= 1


def test_a_flipped_bit_costs_its_datagram_only() -> None:
    size = LAYOUTS[0x94].size
    stream = encode(datagrams(0x94, 6))
    whole = [stream[i : i + size] for i in range(0, len(stream), size)]
    for bit in range(8 * size):
        flipped = bytearray(stream)
        flipped[size + bit // 8] ^= 1 << bit % 8
        decoder = Stim300Decoder()
        assert encoded(decoder.feed(bytes(flipped))) == [whole[0], *whole[2:]]
        assert decoder.dropped_bytes == size
        if bit >= 8:  # a flipped id may be none at all: then it is foreign bytes, not a bad datagram
            assert decoder.bad_datagrams >= 1


def test_a_megabyte_of_noise_is_not_kept() -> None:
    noise = np.random.default_rng(5).bytes(1 << 20)
    decoder = Stim300Decoder()
    for start in range(0, len(noise), 4096):
        assert decoder.feed(noise[start : start + 4096]) == []
        assert start + 4096 - decoder.dropped_bytes < LONGEST
    sent = datagrams(0x94, 10)
    found = encoded(decoder.feed(encode(sent)))
    assert found == encoded([sent])


def test_values_that_the_id_promises_must_be_there() -> None:
    bare = datagrams(0x90, 1)
    for identifier in (0x91, 0x94):
        with pytest.raises(ValueError, match="datagram"):
            encode(Datagrams(identifier, bare.gyro, bare.gyro_status, bare.counter, bare.latency_us))
