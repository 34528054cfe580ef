"""The VectorNav codec against public frames and sentences, and against everything a line does to them."""

from __future__ import annotations

import binascii
import json
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from drivers.imus.vectornav.codec import (
    ATTITUDE,
    COMMON,
    GPS,
    GPS2,
    IMU,
    INS,
    TIME,
    Frames,
    Layout,
    Sentence,
    VectorNavDecoder,
    encode_frames,
    encode_sentence,
    error_code,
    error_text,
    layout_of,
    layout_of_header,
)

VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "vectornav.json").read_text())["vectors"]
NEGATIVE = [vector for vector in VECTORS if "expect" in vector["decoded"]]
SENTENCES = [vector for vector in VECTORS if "header" in vector["decoded"]]
BINARY = [vector for vector in VECTORS if "groups" in vector["decoded"]]
FIELDS = {
    "time_startup_ns": "common.time_startup",
    "ypr_deg": "common.yaw_pitch_roll",
    "angular_rate_radps": "common.angular_rate",
    "accel_mps2": "common.accel",
    "uncomp_accel_mps2": "imu.uncomp_accel",
    "uncomp_gyro_radps": "imu.uncomp_gyro",
    "temp_C": "imu.temperature",
}
SIZES = {
    COMMON: (8, 8, 8, 12, 16, 12, 24, 12, 12, 24, 20, 28, 2, 4, 8),
    TIME: (8, 8, 8, 2, 8, 8, 8, 4, 4, 1),
    IMU: (2, 12, 12, 12, 4, 4, 16, 12, 12, 12, 12, 2, 40),
    GPS: (8, 8, 2, 1, 1, 24, 24, 12, 12, 12, 4, 4, 2, 28),
    ATTITUDE: (2, 12, 16, 36, 12, 12, 12, 12, 12, 12, 28, 24, 12),
    INS: (2, 24, 24, 12, 12, 12, 12, 12, 12, 4, 4, 68, 64),
    GPS2: (8, 8, 2, 1, 1, 24, 24, 12, 12, 12, 4, 4, 2, 28),
}
LONGEST = 3 + 2 * 7 + sum(map(sum, SIZES.values())) + 2
SHIPPED = layout_of({COMMON: 0x0001, IMU: 0x001C})
OTHER = layout_of({COMMON: 0x0121})
REPLY = Sentence("VNRRG", ("01", "VN-100S-CR"))


def named(vector: dict[str, Any]) -> str:
    return vector.get("ascii", vector["hex"][:12])


def frames(layout: Layout, count: int, seed: int = 0) -> list[bytes]:
    """Return frames with any bytes for their values."""
    raw = np.frombuffer(np.random.default_rng(seed).bytes(count * layout.size), dtype=layout.dtype)
    data = encode_frames(layout, raw)
    return [data[at : at + layout.size] for at in range(0, len(data), layout.size)]


def encoded(found: list[Sentence | Frames]) -> list[bytes]:
    """Return the bytes of each thing found, however frames were grouped."""
    out: list[bytes] = []
    for item in found:
        if isinstance(item, Sentence):
            out.append(encode_sentence(item))
        else:
            data, size = encode_frames(item.layout, item.values), item.layout.size
            out += [data[at : at + size] for at in range(0, len(data), size)]
    return out


def counts(decoder: VectorNavDecoder) -> tuple[int, int, int]:
    return decoder.dropped_bytes, decoder.bad_frames, decoder.bad_sentences


@pytest.mark.parametrize("vector", BINARY, ids=named)
def test_a_frame_decodes_to_its_stated_values(vector: dict[str, Any]) -> None:
    decoder = VectorNavDecoder()
    (found,) = decoder.feed(bytes.fromhex(vector["hex"]))
    assert isinstance(found, Frames)
    assert found.layout.masks == tuple(
        (group, int(text.split()[0], 16))
        for group, text in zip(
            (i for i in range(7) if found.layout.header[1] >> i & 1), vector["decoded"]["group_fields"], strict=True
        )
    )
    stated = {FIELDS[name]: value for name, value in vector["decoded"].items() if name in FIELDS}
    assert set(stated) == set(found.values.dtype.names[1:-1])
    for name, value in stated.items():
        np.testing.assert_array_equal(found.values[0][name], np.asarray(value, dtype=found.values[name].dtype), name)
    assert counts(decoder) == (0, 0, 0)


@pytest.mark.parametrize("vector", SENTENCES, ids=named)
def test_a_sentence_decodes_to_its_header_and_fields(vector: dict[str, Any]) -> None:
    decoder = VectorNavDecoder()
    (found,) = decoder.feed(bytes.fromhex(vector["hex"]))
    assert found == Sentence(vector["decoded"]["header"], tuple(vector["decoded"]["fields"]))
    assert counts(decoder) == (0, 0, 0)


@pytest.mark.parametrize("vector", BINARY + SENTENCES, ids=named)
def test_it_encodes_back_to_its_bytes(vector: dict[str, Any]) -> None:
    raw = bytes.fromhex(vector["hex"])
    assert encoded(VectorNavDecoder().feed(raw)) == [raw]


@pytest.mark.parametrize("vector", NEGATIVE, ids=named)
def test_a_wrong_checksum_is_refused_and_counted(vector: dict[str, Any]) -> None:
    raw = bytes.fromhex(vector["hex"])
    decoder = VectorNavDecoder()
    assert decoder.feed(raw) == []
    assert counts(decoder) == (len(raw), 0, 1)
    right = raw.replace(b"*0C", f"*{vector['decoded']['correct']}".encode())
    assert encoded(decoder.feed(right)) == [right]


def test_every_group_has_the_sizes_of_the_manual() -> None:
    for group, sizes in SIZES.items():
        assert [layout_of({group: 1 << bit}).size - 6 for bit in range(len(sizes))] == list(sizes)
        with pytest.raises(ValueError, match="known"):
            layout_of({group: 1 << len(sizes)})


def test_the_crc_gives_its_check_value() -> None:
    assert binascii.crc_hqx(b"123456789", 0) == 0x31C3


def test_a_layout_reads_as_in_a_register() -> None:
    # UM001, 4.2.3: $VNWRG,75,1,16,15,0001,000C,0014
    assert layout_of({COMMON: 0x0001, IMU: 0x000C, ATTITUDE: 0x0014}).register_fields == ("15", "0001", "000C", "0014")


@pytest.mark.parametrize("check", ["xor", "crc", "none"])
def test_each_kind_of_check_is_taken(check: Any) -> None:
    raw = encode_sentence(REPLY, check)
    assert re.fullmatch({"xor": rb".*\*..\r\n", "crc": rb".*\*.{4}\r\n", "none": rb".*\*XX\r\n"}[check], raw)
    assert VectorNavDecoder().feed(raw) == [REPLY]
    assert VectorNavDecoder().feed(raw.replace(b"\r", b"")) == [REPLY]
    if check != "none":
        assert VectorNavDecoder().feed(raw.replace(b"CR", b"CT")) == []


@pytest.mark.parametrize(("header", "fields"), [("XXRRG", ()), ("VNRRG", ("1,2",)), ("VNRRG", ("a\n",)), ("VN", ())])
def test_a_sentence_that_cannot_be_is_refused(header: str, fields: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match="cannot be"):
        Sentence(header, fields)


def test_error_codes_are_told_in_words() -> None:
    # Hex by the manual; 12 stands in a public capture in decimal.
    assert [error_code(text) for text in ("0C", "12", "A", "10", "FF", "255", "07", "x")] == [
        12,
        12,
        10,
        10,
        255,
        255,
        7,
        -1,
    ]
    assert error_text(12) == "error 12 (baud rate too low for the output asked for)"
    assert error_text(77) == "error 77 (not in its manual)"


def test_selectors_may_go_on_in_another_byte_or_word_that_adds_nothing() -> None:
    plain = frames(OTHER, 1)[0]
    longer = bytes([0xFA, 0x81, 0x00, 0x21, 0x81, 0x00, 0x00]) + plain[4:-2]
    raw = longer + binascii.crc_hqx(longer[1:], 0).to_bytes(2, "big")
    (found,) = VectorNavDecoder().feed(raw + raw)
    assert isinstance(found, Frames)
    assert len(found.values) == 2
    assert found.layout.masks == OTHER.masks
    assert encode_frames(found.layout, found.values[:1]) == raw


@pytest.mark.parametrize(
    "header", ["fa00", "fa80 00", "fa81 01 0100", "fa01 0000", "fa01 0180 0100", "fa02 0004", "fb01 0100 00"]
)
def test_frames_of_unknown_size_are_foreign_bytes(header: str) -> None:
    raw = bytes.fromhex(header)
    with pytest.raises(ValueError, match="known"):
        layout_of_header(raw)
    decoder = VectorNavDecoder()
    assert encoded(decoder.feed(raw + encode_sentence(REPLY))) == [encode_sentence(REPLY)]
    assert counts(decoder) == (len(raw), 0, 0)


@settings(max_examples=60, deadline=None)
@given(
    st.dictionaries(st.sampled_from(sorted(SIZES)), st.integers(1, (1 << 15) - 1), min_size=1),
    st.integers(1, 5),
    st.integers(0, 99),
)
def test_any_fields_come_back_from_their_own_bytes(masks: dict[int, int], count: int, seed: int) -> None:
    known = {group: mask & (1 << len(SIZES[group])) - 1 or 1 for group, mask in masks.items()}
    sent = frames(layout_of(known), count, seed)
    decoder = VectorNavDecoder()
    (found,) = decoder.feed(b"".join(sent))
    assert isinstance(found, Frames)
    assert dict(found.layout.masks) == known
    assert found.layout.size == 4 + 2 * len(known) + sum(
        size for group, mask in known.items() for bit, size in enumerate(SIZES[group]) if mask >> bit & 1
    )
    assert encoded([found]) == sent
    assert counts(decoder) == (0, 0, 0)


def mixed() -> bytes:
    noise = b"\x00\xfa$VN\xfa\x05\x01noise$VNRRG,01*00\r\n"
    return b"".join(
        [*frames(SHIPPED, 2), noise, encode_sentence(REPLY), *frames(OTHER, 3), b"$", encode_sentence(REPLY, "crc")]
    )


def test_where_the_stream_is_cut_changes_nothing() -> None:
    sent = mixed()
    whole = VectorNavDecoder()
    wanted = encoded(whole.feed(sent))
    assert len(wanted) == 7
    assert whole.bad_sentences == 2
    for cut in range(len(sent) + 1):
        decoder = VectorNavDecoder()
        assert encoded(decoder.feed(sent[:cut]) + decoder.feed(sent[cut:])) == wanted
        assert counts(decoder) == counts(whole)


def test_a_stream_may_come_byte_by_byte() -> None:
    whole, decoder = VectorNavDecoder(), VectorNavDecoder()
    wanted = encoded(whole.feed(mixed()))
    assert encoded([item for byte in mixed() for item in decoder.feed(bytes([byte]))]) == wanted
    assert counts(decoder) == counts(whole)


@settings(max_examples=80, deadline=None)
@given(st.lists(st.binary(max_size=200), min_size=1, max_size=5), st.lists(st.integers(0, 1500), max_size=8))
def test_foreign_bytes_are_counted_and_what_is_between_them_found(junk: list[bytes], cuts: list[int]) -> None:
    wanted, stream = [], b""
    for i, noise in enumerate(junk):
        part = [*frames(SHIPPED, 2, seed=i), encode_sentence(REPLY), *frames(OTHER, 1, seed=i)]
        stream += noise + b"".join(part)
        wanted += part
    decoder, found = VectorNavDecoder(), []
    for start, stop in pairwise([0, *sorted(cuts), len(stream)]):
        found += encoded(decoder.feed(stream[start:stop]))
    found += encoded(decoder.flush())
    assert found == wanted
    assert decoder.dropped_bytes == sum(map(len, junk))


def test_a_flipped_bit_costs_its_frame_only() -> None:
    whole = [*frames(SHIPPED, 3), encode_sentence(REPLY), *frames(SHIPPED, 2, seed=1)]
    for damaged in (1, 3):
        for bit in range(8 * len(whole[damaged])):
            flipped = bytearray(whole[damaged])
            flipped[bit // 8] ^= 1 << bit % 8
            decoder = VectorNavDecoder()
            found = encoded(decoder.feed(b"".join([*whole[:damaged], bytes(flipped), *whole[damaged + 1 :]])))
            found += encoded(decoder.flush())
            assert found == whole[:damaged] + whole[damaged + 1 :]
            assert decoder.dropped_bytes == len(flipped)


def test_a_frame_cut_short_costs_itself_only() -> None:
    for whole in ([*frames(SHIPPED, 5)], [encode_sentence(REPLY)] * 5):
        for missing in range(1, len(whole[1])):
            decoder = VectorNavDecoder()
            found = encoded(decoder.feed(b"".join([whole[0], whole[1][:-missing], *whole[2:]])))
            found += encoded(decoder.flush())
            assert found == [whole[0], *whole[2:]]
            assert decoder.dropped_bytes == len(whole[1]) - missing
            if len(whole[1]) - missing > len(SHIPPED.header):
                assert decoder.bad_frames + decoder.bad_sentences >= 1


def test_a_reply_behind_the_beginning_of_a_frame_is_given_when_nothing_more_comes() -> None:
    decoder = VectorNavDecoder()
    begun = frames(SHIPPED, 1)[0][:9]
    reply = encode_sentence(REPLY)
    assert decoder.feed(begun + reply) == []
    assert decoder.flush() == [REPLY]
    assert counts(decoder) == (len(begun), 1, 0)
    assert decoder.flush() == []


def test_at_the_device_only_sentences_come_in() -> None:
    decoder = VectorNavDecoder(binary=False)
    begun = frames(SHIPPED, 1)[0][:9]
    assert decoder.feed(begun + encode_sentence(REPLY)) == [REPLY]


def noise_leaves_nothing(size: int) -> None:
    """Feed noise, half of it made of what frames and sentences are made of; a good frame is found after it."""
    rng = np.random.default_rng(5)
    alike = np.frombuffer(b"\xfa\xfa\x01\x05\x00\x01\x0c$$VVNNRG,0123*XX\r\n", dtype=np.uint8)
    decoder = VectorNavDecoder()
    fed = taken = 0
    while fed < size:
        data = rng.bytes(4096) if rng.random() < 0.5 else rng.choice(alike, 4096).tobytes()
        taken += sum(map(len, encoded(decoder.feed(data))))
        fed += len(data)
        assert fed - taken - decoder.dropped_bytes < LONGEST
    decoder.flush()
    wanted = frames(SHIPPED, 3)
    assert encoded(decoder.feed(b"".join(wanted))) == wanted


def test_noise_is_not_kept() -> None:
    noise_leaves_nothing(200_000)


@pytest.mark.full
def test_ten_megabytes_of_noise_are_not_kept() -> None:
    noise_leaves_nothing(10_000_000)
