"""The STIM300 codec against datagrams built from the datasheet, and against everything a line does to them."""

from __future__ import annotations

import json
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from drivers.imus.stim300.codec import (
    INCLINOMETER_LSB_G,
    LAYOUTS,
    TEMPERATURE_LSB_C,
    Datagrams,
    Stim300Decoder,
    crc32_mpeg2,
    encode,
    encode_special,
    invalid_channels,
)
from drivers.imus.stim300.special import (
    SPECIAL_LAYOUTS,
    BiasTrim,
    Configuration,
    ExtendedError,
    PartNumber,
    SerialNumber,
    Special,
)
from drivers.imus.stim300.units import ACCEL_LSB_G, GYRO_LSB_DPS

VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "stim300_normal.json").read_text())["vectors"]
LONGEST = max(layout.size for layout in LAYOUTS.values()) + 2
SPECIALS: tuple[Special, ...] = (
    PartNumber("84167-440000-3321", "K"),
    SerialNumber("N25582405002002"),
    Configuration.of(rate_hz=2000, temperature=True, gyro_unit=3, accel_range_g=30, firmware=7),
    BiasTrim((16384, -1, 8388607), (-8388608, 0, 1), (2, 3, 4), 0xDEADBEEF, 9958),
    ExtendedError(1 << 16 | 1 << 101 | 1 << 127),
)


def terminated(vector: dict[str, Any]) -> bool:
    return bool(vector["decoded"].get("crlf_termination", False))


def datagrams(identifier: int, count: int, seed: int = 0) -> Datagrams:
    """Return datagrams of any kind with values over the whole range."""
    rng = np.random.default_rng(seed)
    groups = {}
    for name, numbers, width in LAYOUTS[identifier].groups:
        top = 1 << (8 * width - 1)
        groups[name] = rng.integers(-top, top, (count, numbers)), rng.integers(0, 256, count)
    return Datagrams(identifier, np.arange(count) % 256, rng.integers(0, 1 << 16, count), groups)


def normal(found: Iterable[Datagrams | Special]) -> list[Datagrams]:
    return [part for part in found if isinstance(part, Datagrams)]


def taken(found: Iterable[Datagrams | Special]) -> list[bytes | Special]:
    """Return what was found in its order, normal datagrams as their bytes one by one."""
    out: list[bytes | Special] = []
    for part in found:
        out += encoded([part]) if isinstance(part, Datagrams) else [part]
    return out


def test_a_configuration_with_a_range_that_the_device_does_not_have_is_refused_with_those_it_has() -> None:
    with pytest.raises(ValueError, match="no range of 20 g: it is one of 5, 10, 30, 80"):
        Configuration.of(rate_hz=2000, accel_range_g=20)


def columns(part: Datagrams) -> dict[str, np.ndarray]:
    out = {"counter": part.counter, "latency_us": part.latency_us}
    for name, (values, status) in part.groups.items():
        out |= {name: values, f"{name} status": status}
    return out


def assert_same(found: list[Datagrams], sent: Datagrams) -> None:
    assert {part.identifier for part in found} == {sent.identifier}
    for name, wanted in columns(sent).items():
        np.testing.assert_array_equal(np.concatenate([columns(part)[name] for part in found]), wanted, name)


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
    decoder = Stim300Decoder()
    (found,) = normal(decoder.feed(bytes.fromhex(vector["hex"])))
    assert found.identifier == stated["id"]
    first = {name: values[0] for name, (values, _) in found.groups.items()}
    np.testing.assert_array_equal(first["gyro"] * GYRO_LSB_DPS, stated["gyro_dps"])
    assert found.counter[0] == stated["counter"]
    assert found.latency_us[0] == stated["latency_us"]
    clusters = [name for name in ("gyro", "accelerometer", "inclinometer") if name in found.groups]
    status = [found.groups[name][1][0] for name in clusters]
    assert status == stated.get("status", [stated.get("gyro_status", 0)] + [0] * (len(status) - 1))
    if "acc_g" in stated:
        scale = ACCEL_LSB_G[stated.get("acc_range_g", 10)]
        np.testing.assert_array_equal(first["accelerometer"] * scale, stated["acc_g"])
    if "incl_g" in stated:
        np.testing.assert_array_equal(first["inclinometer"] * INCLINOMETER_LSB_G, stated["incl_g"])
    temperatures = stated.get("temps_C") or [stated[k] for k in ("gyro_temp_C", "acc_temp_C") if k in stated]
    if temperatures:
        raw = [first[f"{name}_temperature"] for name in clusters]
        np.testing.assert_array_equal(np.array(raw) * TEMPERATURE_LSB_C, temperatures)
    assert (decoder.dropped_bytes, decoder.bad_datagrams) == (0, 0)


@pytest.mark.parametrize("vector", VECTORS, ids=lambda v: v["hex"][:8])
def test_a_datagram_encodes_back_to_its_bytes(vector: dict[str, Any]) -> None:
    raw = bytes.fromhex(vector["hex"])
    (found,) = normal(Stim300Decoder().feed(raw))
    assert encode(found, line_termination=terminated(vector)) == raw


@pytest.mark.parametrize("identifier", sorted(LAYOUTS))
def test_every_kind_comes_back_from_its_own_bytes(identifier: int) -> None:
    sent = datagrams(identifier, 20)
    assert_same(normal(Stim300Decoder().feed(encode(sent))), sent)


def test_where_the_stream_is_cut_changes_nothing() -> None:
    specials = b"".join(encode_special(value, line_termination=bool(i % 2)) for i, value in enumerate(SPECIALS))
    ended = encode(datagrams(0xA7, 2, seed=1), line_termination=True)
    sent = encode(datagrams(0x90, 2)) + b"\x00\x90noise" + specials + ended
    whole = Stim300Decoder()
    wanted = taken(whole.feed(sent))
    assert len(wanted) == 4 + len(SPECIALS)
    for cut in range(len(sent) + 1):
        decoder = Stim300Decoder()
        found = decoder.feed(sent[:cut]) + decoder.feed(sent[cut:])
        assert taken(found) == wanted
        assert (decoder.dropped_bytes, decoder.bad_datagrams) == (whole.dropped_bytes, whole.bad_datagrams)


def test_a_stream_may_come_byte_by_byte() -> None:
    sent = datagrams(0x94, 12)
    decoder = Stim300Decoder()
    stream = encode(sent, line_termination=True)
    found = normal(part for byte in stream for part in decoder.feed(bytes([byte])))
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
        found += encoded(normal(decoder.feed(stream[start:stop])))
    found += encoded(normal(decoder.feed(behind)))
    assert found[:-6] == wanted
    line_ends = sum(noise.startswith(b"\r\n") for noise in junk[1:])  # taken for the datagram's own
    assert decoder.dropped_bytes == sum(len(noise) for noise in junk) - 2 * line_ends


def test_a_datagram_cut_short_costs_itself_only() -> None:
    size = LAYOUTS[0x94].size
    stream = encode(datagrams(0x94, 5))
    whole = [stream[i : i + size] for i in range(0, len(stream), size)]
    for missing in range(1, size):
        decoder = Stim300Decoder()
        found = encoded(normal(decoder.feed(whole[0] + whole[1][:-missing] + b"".join(whole[2:]))))
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
        assert encoded(normal(decoder.feed(bytes(flipped)))) == [whole[0], *whole[2:]]
        assert decoder.dropped_bytes == size
        if bit >= 8:  # a flipped id may be none at all: then it is foreign bytes, not a bad datagram
            assert decoder.bad_datagrams >= 1


def feed_noise(decoder: Stim300Decoder, noise: bytes) -> None:
    before = decoder.dropped_bytes
    for start in range(0, len(noise), 4096):
        assert decoder.feed(noise[start : start + 4096]) == []
        assert min(start + 4096, len(noise)) - (decoder.dropped_bytes - before) < LONGEST


@pytest.mark.full
def test_ten_million_random_bytes_are_dropped_and_counted() -> None:
    feed_noise(Stim300Decoder(), np.random.default_rng(6).bytes(10_000_000))


def test_noise_is_not_kept() -> None:
    noise = np.random.default_rng(5).bytes(200_000)
    decoder = Stim300Decoder()
    feed_noise(decoder, noise)
    sent = datagrams(0x94, 10)
    found = encoded(normal(decoder.feed(encode(sent))))
    assert found == encoded([sent])


def test_values_that_the_id_promises_must_be_there() -> None:
    bare = datagrams(0x90, 1)
    for identifier in (0x91, 0x94, 0xF0):
        with pytest.raises(ValueError, match="datagram"):
            encode(Datagrams(identifier, bare.counter, bare.latency_us, bare.groups))


@pytest.mark.parametrize("line_termination", [False, True])
@pytest.mark.parametrize("value", SPECIALS, ids=lambda v: type(v).__name__)
def test_special_datagrams_are_found_between_normal_ones(value: Special, line_termination: bool) -> None:
    around = [encode(datagrams(0x94, 3, seed=s), line_termination=line_termination) for s in (1, 2)]
    stream = around[0] + encode_special(value, line_termination=line_termination) + around[1]
    decoder = Stim300Decoder()
    found = decoder.feed(stream)
    assert [part for part in found if not isinstance(part, Datagrams)] == [value]
    assert isinstance(found[0], Datagrams)
    assert isinstance(found[2], Datagrams)
    assert len(encoded(normal(found))) == 6
    assert (decoder.dropped_bytes, decoder.bad_datagrams) == (0, 0)


@pytest.mark.parametrize(
    ("identifier", "size"),
    [(0xB1, 20), (0xB3, 20), (0xB5, 20), (0xB7, 20), (0xBC, 26), (0xBD, 26), (0xD1, 40), (0xD2, 40), (0xBE, 21)],
)
def test_special_datagrams_have_the_sizes_of_the_datasheet(identifier: int, size: int) -> None:
    assert SPECIAL_LAYOUTS[identifier].size == size
    (value,) = (v for v in SPECIALS if isinstance(v, SPECIAL_LAYOUTS[identifier].kind))
    raw = encode_special(value, line_termination=SPECIAL_LAYOUTS[identifier].line_termination)
    assert raw[0] == identifier
    assert len(raw) == size + 2 * SPECIAL_LAYOUTS[identifier].line_termination


def test_a_damaged_special_datagram_is_refused_and_counted() -> None:
    raw = bytearray(encode_special(SPECIALS[1]))
    raw[5] ^= 1
    decoder = Stim300Decoder()
    found = decoder.feed(bytes(raw) + encode(datagrams(0x94, 5)))
    assert len(encoded(normal(found))) == 5
    assert len(found) == 1
    assert decoder.bad_datagrams >= 1
    assert decoder.dropped_bytes == len(raw)


def test_a_configuration_says_how_the_device_is_set() -> None:
    # Bytes by the table of the datasheet: firmware 5, 500 Hz, accelerometer of 5 g, integrated angle.
    payload = bytes(
        [ord("K"), 5, 0x4B, 0x10, 0x73, 0x44, 0x40, 0x70, 0x44, 0x40, 0x70, 0x44, 0x40, 0, 0, 0, 0x33, 0x30]
    )
    found = Configuration.parse(payload + bytes(3))
    assert (found.firmware, found.rate_hz, found.accelerometer) == (5, 500, True)
    assert (found.gyro_unit, found.accel_unit, found.gyros_on) == (3, 0, (True, True, True))
    assert found.accel_ranges_g == (5, 5, 5)


def test_an_error_register_is_read_out_in_words() -> None:
    assert ExtendedError(1 << 16 | 1 << 101 | 1 << 127).texts == (
        "start-up phase is active",
        "gyro X is overloaded",
        "error bit 127",
    )


def test_what_cannot_be_a_special_datagram_is_not_made_into_one() -> None:
    for value in (PartNumber("84167-440000-321", "K"), SerialNumber("25582405002002"), PartNumber("x", "K")):
        with pytest.raises(ValueError, match="is no"):
            encode_special(value)


def test_status_names_the_channels_that_are_not_vouched_for() -> None:
    #                 fine  range  overload X  channel Z  which one?  start-up  integrity
    status = np.array([0x00, 0x20, 0x11, 0x0C, 0x08, 0x40, 0x80])
    x, y, z, no = [True, False, False], [False, True, False], [False, False, True], [False] * 3
    assert invalid_channels(status).tolist() == [no, no, x, z, [True] * 3, [True] * 3, [True] * 3]
    assert invalid_channels(np.array([0x12])).tolist() == [y]
