"""The Xbus codec against real captures, published messages, and everything a line does to them."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from drivers.imus.xsens import mtdata2
from drivers.imus.xsens.mtdata2 import (
    EVERY,
    FORMATS,
    FP12_20,
    FP16_32,
    KINDS,
    RATE_OF_TURN,
    SAMPLE_TIME_FINE,
    UTC_TIME,
    Output,
    Samples,
    decode_outputs,
    encode_mtdata2,
    encode_outputs,
    format_of,
    kind_of,
    name_of,
    parse_mtdata2,
)
from drivers.imus.xsens.xbus import (
    LONGEST_DATA,
    Messages,
    Mid,
    XbusDecoder,
    encode,
    error_text,
    firmware_of,
    product_of,
    serial_of,
)

TESTS = Path(__file__).parents[1]
CAPTURES = TESTS / "data" / "xsens"
VECTORS = json.loads((TESTS / "vectors" / "xsens_xbus.json").read_text())["vectors"]
MEASURED = [v for v in VECTORS if v["hex"].startswith("faff36")]
COMMANDS = [v for v in VECTORS if v["hex"].startswith("faff") and v not in MEASURED]
CONFIGURATIONS = [v for v in VECTORS if not v["hex"].startswith("faff")]
FRAMES = {0: "EastNorthUp", 4: "NorthEastDown", 8: "NorthWestUp"}
LONGEST = LONGEST_DATA + 7

Found = list[tuple[int, bytes]]


def each(messages: list[Messages]) -> Found:
    return [(some.mid, data) for some in messages for data in some.each()]


def single(stream: bytes) -> Samples:
    ((mid, data),) = each(XbusDecoder().feed(stream))
    assert mid == Mid.MTDATA2
    (samples,), malformed = parse_mtdata2(np.frombuffer(data, dtype=np.uint8)[None])
    assert malformed == 0
    return samples


def values(samples: Samples, data_id: int) -> np.ndarray:
    """Return all values (n, fields) of one data identifier."""
    if KINDS[kind_of(data_id)].integers is not None:
        found = samples.integers(kind_of(data_id))
    else:
        found = samples.numbers(kind_of(data_id))
    assert found is not None
    return found


def captured(number: int) -> tuple[bytes, list[str]]:
    """Return a capture and the text of each of its messages."""
    text = (CAPTURES / f"capture{number}.decoded.txt").read_text()
    return (CAPTURES / f"capture{number}.bin").read_bytes(), text.strip().split("\n\n")


def packets_of(text: str) -> dict[str, list[str]]:
    """Return the values of each packet of a message, as texts."""
    packets: dict[str, list[str]] = {}
    name = ""
    for line in text.splitlines():
        if line.startswith(" "):
            packets[name].append(line.strip())
        else:
            name = line.rstrip(":")
            packets[name] = []
    return packets


def spoken(samples: Samples) -> dict[str, list[str | float]]:
    """Return the values of the only message in ``samples`` under the names of the texts, in their order."""
    out: dict[str, list[str | float]] = {}
    for packet in samples.packets:
        kind, row = KINDS[kind_of(packet.data_id)], values(samples, packet.data_id)[0].tolist()
        name = name_of(packet.data_id)
        if kind.name in ("EulerAngles", "Quaternion", "RotationMatrix", "VelocityXYZ"):
            name = name.replace("(", f"({FRAMES[packet.data_id & 0xC]},")
        if kind_of(packet.data_id) == UTC_TIME:
            ns, year, month, day, hour, minute, second, _ = row
            fraction = f".{ns:09d}".rstrip("0").rstrip(".")
            out[name] = [f"{year}-{month:02d}-{day:02d}T{hour:02d}:{minute:02d}:{second:02d}{fraction}Z"]
        elif kind.name.startswith("Status"):
            out[name] = [f"{row[0]:0{32 if kind.name == 'StatusWord' else 8}b}"]
        else:
            out[name] = row
    return out


@pytest.mark.parametrize("number", [1, 2, 5])
def test_every_message_of_a_real_capture_decodes_to_the_text_beside_it(number: int) -> None:
    stream, texts = captured(number)
    decoder = XbusDecoder()
    found = each(decoder.feed(stream))
    assert len(found) == len(texts) == 100
    assert (decoder.dropped_bytes, decoder.bad_messages) == (0, 0)
    for (mid, data), text in zip(found, texts, strict=True):
        stated, got = packets_of(text), spoken(single(encode(mid, data)))
        assert set(got) == set(stated)
        for name, wanted in stated.items():
            if name == "UTCTime" or name.startswith("Status"):
                assert got[name] == wanted
            else:
                np.testing.assert_array_equal(got[name], [float(value.rpartition(":")[2]) for value in wanted], name)


@pytest.mark.parametrize("number", [1, 2, 5])
def test_a_real_capture_encodes_back_to_its_bytes(number: int) -> None:
    stream, _ = captured(number)
    again = b""
    for mid, data in each(XbusDecoder().feed(stream)):
        samples = single(encode(mid, data))
        if any(kind_of(packet.data_id) == 0x7020 for packet in samples.packets):
            again += encode(mid, data)  # satellites are not taken apart
        else:
            again += encode_mtdata2([(p.data_id, values(samples, p.data_id)) for p in samples.packets])
    assert again == stream


@pytest.mark.parametrize("number", [1, 2, 5])
def test_messages_of_a_capture_parsed_together_hold_what_each_holds(number: int) -> None:
    stream, _ = captured(number)
    at = 0
    singles = [single(encode(mid, data)) for mid, data in each(XbusDecoder().feed(stream))]
    for messages in XbusDecoder().feed(stream):
        found, malformed = parse_mtdata2(messages.data)
        assert malformed == 0
        for samples in found:
            for row in range(len(samples.data)):
                alone = singles[at]
                assert alone.packets == samples.packets
                for packet in samples.packets:
                    np.testing.assert_array_equal(
                        values(samples, packet.data_id)[row], values(alone, packet.data_id)[0]
                    )
                at += 1
    assert at == 100


@pytest.mark.parametrize("vector", MEASURED, ids=lambda v: v["hex"][8:40])
def test_a_published_message_decodes_to_its_stated_values_and_encodes_back(vector: dict[str, Any]) -> None:
    stream = bytes.fromhex(vector["hex"])
    samples = single(stream)
    assert {f"0x{packet.data_id:04X}" for packet in samples.packets} == set(vector["decoded"])
    for packet in samples.packets:
        stated = vector["decoded"][f"0x{packet.data_id:04X}"]
        row = values(samples, packet.data_id)[0]
        if kind_of(packet.data_id) == UTC_TIME:
            ns, year, month, day, hour, minute, second, flags = row.tolist()
            assert stated["utc"] == f"{year}-{month:02d}-{day:02d}T{hour:02d}:{minute:02d}:{second:02d}"
            assert (stated["ns"], stated["flags"]) == (ns, flags)
        else:
            (value,) = stated.values()
            np.testing.assert_array_equal(row, np.atleast_1d(value))
    assert encode_mtdata2([(p.data_id, values(samples, p.data_id)) for p in samples.packets]) == stream


@pytest.mark.parametrize("vector", COMMANDS, ids=lambda v: v["decoded"]["message"])
def test_a_published_command_or_answer_is_read_and_written(vector: dict[str, Any]) -> None:
    stream = bytes.fromhex(vector["hex"])
    ((mid, data),) = each(XbusDecoder().feed(stream))
    assert mid == vector["decoded"]["mid"]
    assert len(data) == vector["decoded"]["len"]
    assert encode(mid, data) == stream


@pytest.mark.parametrize("vector", CONFIGURATIONS, ids=lambda v: v["hex"][-16:])
def test_a_published_output_configuration_reads_as_its_text(vector: dict[str, Any]) -> None:
    data = bytes.fromhex(vector["hex"])
    outputs = decode_outputs(data)
    assert outputs is not None
    stated = [(name.rstrip(":"), rate) for name, rate in zip(*[iter(vector["decoded"])] * 2, strict=True)]
    for output, (name, rate) in zip(outputs, stated, strict=True):
        assert name_of(output.data_id) == name.replace("EastNorthUp,", "")
        assert rate == ("Max" if output.rate_hz == EVERY else f"{output.rate_hz} Hz")
    assert encode_outputs(outputs) == data


@pytest.mark.parametrize("number", [1, 2, 5])
def test_the_output_configuration_of_a_capture_names_what_was_sent(number: int) -> None:
    outputs = decode_outputs((CAPTURES / f"capture{number}.outputconfig.bin").read_bytes())
    assert outputs is not None
    stream, _ = captured(number)
    sent = {p.data_id for mid, data in each(XbusDecoder().feed(stream)) for p in single(encode(mid, data)).packets}
    assert sent <= {output.data_id for output in outputs}


def test_answers_about_identity_are_read_as_text() -> None:
    assert firmware_of(bytes.fromhex("0108020000002500011534")) == "1.8.2 build 37"
    assert firmware_of(bytes([1, 8, 2])) == "1.8.2"
    assert serial_of(bytes.fromhex("03700715")) == "03700715"
    assert serial_of(bytes.fromhex("0000000003700715")) == "03700715"  # the newer ones have eight bytes
    assert product_of(b"MTI-300-2A5G4       ") == "MTI-300-2A5G4"


def test_an_error_is_said_with_its_code_and_in_words() -> None:
    assert error_text(bytes([33])) == "error 33: a parameter is not valid"
    assert error_text(bytes([41])).startswith("error 41: it makes more data than the line carries")
    assert error_text(bytes([200])).startswith("error 200")
    assert error_text(b"").startswith("error 0")


@pytest.mark.parametrize(
    ("wire", "name"),
    [
        (0x00, "ReqDID"),
        (0x02, "Init"),
        (0x0C, "ReqConfiguration"),
        (0x10, "GoToMeasurement"),
        (0x12, "ReqFirmwareRev"),
        (0x1C, "ReqProductCode"),
        (0x1E, "ReqHardwareVersion"),
        (0x30, "GoToConfig"),
        (0x36, "Mtdata2"),
        (0x3E, "WakeUp"),
        (0x40, "Reset"),
        (0x42, "Error"),
        (0xC0, "OutputConfiguration"),
    ],
)
def test_messages_have_the_identifiers_of_the_low_level_protocol(wire: int, name: str) -> None:
    assert Mid(wire).label == name
    assert encode(Mid(wire), b"")[2] == wire


@pytest.mark.parametrize(
    ("data", "said"),
    [("010203", "1.2.3"), ("01080300000017", "1.8.3 build 23"), ("0108030000001700000001", "1.8.3 build 23")],
)
def test_firmware_has_a_build_where_the_device_tells_one(data: str, said: str) -> None:
    assert firmware_of(bytes.fromhex(data)) == said


def test_an_output_is_said_with_its_name_format_and_rate() -> None:
    assert str(Output(0x8023, 400)) == "RateOfTurn(Float64) at 400 Hz"
    assert str(Output(0x1020, EVERY)) == "PacketCounter with every message"
    assert name_of(0xF7F0) == "data F7F0"


@settings(deadline=None)
@given(
    number_format=st.integers(0, 3),
    rows=st.lists(st.tuples(*[st.floats(-2000, 2000)] * 3), min_size=1, max_size=5),
    ticks=st.integers(0, 2**32 - 1),
)
def test_values_come_back_in_every_number_format(
    number_format: int, rows: list[tuple[float, float, float]], ticks: int
) -> None:
    sent = np.array(rows)
    stream = encode_mtdata2([(SAMPLE_TIME_FINE, np.full((len(rows), 1), ticks)), (RATE_OF_TURN | number_format, sent)])
    (messages,) = XbusDecoder().feed(stream)
    (samples,), _ = parse_mtdata2(messages.data)
    assert format_of(samples.packets[1].data_id) == number_format
    step = {"Float32": 2.0**-13, "FP1220": 2.0**-20, "FP1632": 2.0**-32, "Float64": 0.0}[FORMATS[number_format]]
    np.testing.assert_allclose(values(samples, RATE_OF_TURN), sent, rtol=0, atol=step / 2)
    np.testing.assert_array_equal(values(samples, SAMPLE_TIME_FINE), ticks)


@pytest.mark.parametrize(("number_format", "limit"), [(FP12_20, 2048.0), (FP16_32, 32768.0)])
def test_fixed_point_ends_at_its_range(number_format: int, limit: float) -> None:
    sent = np.array([[1e9, -1e9, 0.0]])
    samples = single(encode_mtdata2([(RATE_OF_TURN | number_format, sent)]))
    np.testing.assert_allclose(values(samples, RATE_OF_TURN), [[limit, -limit, 0.0]], atol=1e-5)


def test_a_long_message_has_its_length_in_two_bytes_more() -> None:
    for length in (0, 1, 254, 255, 256, LONGEST_DATA):
        data = bytes(i % 251 for i in range(length))
        stream = encode(Mid.MTDATA2, data)
        assert len(stream) == length + (5 if length < 255 else 7)
        assert each(XbusDecoder().feed(stream)) == [(Mid.MTDATA2, data)]
        decoder = XbusDecoder()  # in two reads, the second with the check sum alone
        assert decoder.feed(stream[:-1]) == []
        assert each(decoder.feed(stream[-1:])) == [(Mid.MTDATA2, data)]
        assert decoder.dropped_bytes == 0
    with pytest.raises(ValueError, match="at most 2048 bytes"):
        encode(Mid.MTDATA2, bytes(LONGEST_DATA + 1))


@pytest.mark.parametrize(
    "data",
    [
        "8020",  # ends within a head
        "80200c3f8000003f800000",  # ends within its value
        "8020083f8000003f800000",  # two numbers where there are three
        "80220c3f8000003f8000003f800000",  # a size of another number format
        "102004000000ff",  # a counter of four bytes
        "70200900000000010000000000",  # half a satellite
    ],
)
def test_a_message_whose_packets_do_not_fit_is_refused_and_counted(data: str) -> None:
    rows = np.frombuffer(bytes.fromhex(data), dtype=np.uint8)[None]
    assert parse_mtdata2(rows) == ([], 1)


def test_an_unknown_packet_is_passed_over() -> None:
    stream = encode_mtdata2([(RATE_OF_TURN, np.ones((1, 3)))])
    samples = single(encode(Mid.MTDATA2, bytes.fromhex("f7f003010203") + stream[4:-1]))
    np.testing.assert_array_equal(values(samples, RATE_OF_TURN), [[1, 1, 1]])
    assert samples.numbers(mtdata2.ACCELERATION) is None
    assert samples.integers(mtdata2.PACKET_COUNTER) is None


def test_what_cannot_be_encoded_is_refused() -> None:
    with pytest.raises(ValueError, match="RateOfTurn"):
        encode_mtdata2([(RATE_OF_TURN, np.ones((2, 2)))])
    with pytest.raises(ValueError, match="data F7F0"):
        encode_mtdata2([(0xF7F0, np.ones((2, 2)))])


def stream_of(count: int, seed: int = 0) -> tuple[bytes, Found]:
    """Return a stream of messages of changing lengths and kinds, and what is in it."""
    rng = np.random.default_rng(seed)
    stream, found = b"", []
    for i in range(count):
        if i % 7 == 3:
            mid, data = int(Mid.GO_TO_CONFIG) + 1, b""
        elif i % 11 == 5:
            mid, data = int(Mid.MTDATA2), rng.bytes(300)
        else:
            mid = int(Mid.MTDATA2)
            data = encode_mtdata2([(RATE_OF_TURN | i // 4 % 4, rng.normal(size=(1, 3)))])[4:-1]
        stream += encode(mid, data)
        found.append((mid, data))
    return stream, found


def test_where_the_stream_is_cut_changes_nothing() -> None:
    first, second = stream_of(8)[0], stream_of(4, seed=1)[0]
    sent = first + b"\x00\xfa\xfanoise\xfa\xff\x36\x03bad!" + second
    whole = XbusDecoder()
    wanted = each(whole.feed(sent))
    assert len(wanted) == 12
    for cut in range(len(sent) + 1):
        decoder = XbusDecoder()
        assert each(decoder.feed(sent[:cut]) + decoder.feed(sent[cut:])) == wanted
        assert (decoder.dropped_bytes, decoder.bad_messages) == (whole.dropped_bytes, whole.bad_messages)


def test_a_stream_may_come_byte_by_byte() -> None:
    sent, wanted = stream_of(30)
    decoder = XbusDecoder()
    assert each([part for byte in sent for part in decoder.feed(bytes([byte]))]) == wanted
    assert (decoder.dropped_bytes, decoder.bad_messages) == (0, 0)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.binary(max_size=200), min_size=1, max_size=5), st.lists(st.integers(0, 1500), max_size=8))
def test_foreign_bytes_are_counted_and_the_messages_between_them_found(junk: list[bytes], cuts: list[int]) -> None:
    # Noise that ends like the beginning of a message, or is one by chance of 1 in 256, is another matter.
    junk = [noise.replace(b"\xfa", b"\xfb") for noise in junk]
    wanted, stream = [], b""
    for i, noise in enumerate(junk):
        part, found = stream_of(3, seed=i)
        stream += noise + part
        wanted += found
    decoder, got = XbusDecoder(), []
    for start, stop in pairwise([0, *sorted(cuts), len(stream)]):
        got += each(decoder.feed(stream[start:stop]))
    assert got == wanted
    assert decoder.dropped_bytes == sum(len(noise) for noise in junk)
    assert decoder.bad_messages == 0


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=60), st.integers(0, 255), st.integers(0, 255))
def test_what_looks_like_a_beginning_costs_no_message_behind_it(noise: bytes, mid: int, length: int) -> None:
    sent, wanted = stream_of(12)
    decoder = XbusDecoder()
    false = b"\xfa\xff" + bytes([mid, length]) + noise.replace(b"\xfa", b"\xfb")
    got = each(decoder.feed(false + sent) + decoder.flush())
    # One in 256 such beginnings is closed by the right checksum and swallows what it covers.
    assert got[-3:] == wanted[-3:]
    if decoder.bad_messages:
        assert [message for message in got if message in wanted] == wanted


def test_what_a_false_beginning_hides_comes_out_when_no_more_follows() -> None:
    answer = encode(Mid.GO_TO_CONFIG + 1)
    decoder = XbusDecoder()
    assert decoder.feed(b"\xfa\xff\x36\xff\x07\xff" + answer) == []
    assert each(decoder.flush()) == [(Mid.GO_TO_CONFIG + 1, b"")]
    assert decoder.dropped_bytes == 6


def test_a_flipped_bit_costs_its_message_only() -> None:
    part = encode_mtdata2([(RATE_OF_TURN, np.arange(3.0)[None])])
    behind, wanted = stream_of(200)  # a flipped length may claim as much as there can be
    for bit in range(8 * len(part)):
        flipped = bytearray(part)
        flipped[bit // 8] ^= 1 << bit % 8
        decoder = XbusDecoder()
        got = each(decoder.feed(part + bytes(flipped) + behind))
        assert got[1:] == wanted
        assert decoder.dropped_bytes == len(part)


def test_a_message_cut_short_costs_itself_only() -> None:
    part = encode_mtdata2([(RATE_OF_TURN, np.arange(3.0)[None])])
    behind, wanted = stream_of(6)
    for missing in range(1, len(part)):
        decoder = XbusDecoder()
        assert each(decoder.feed(part[:-missing] + behind)) == wanted
        assert decoder.dropped_bytes == len(part) - missing


def feed_noise(size: int) -> None:
    rng = np.random.default_rng(5)
    decoder = XbusDecoder()
    for chunk in range(-(-size // 4096)):
        noise = rng.bytes(4096)
        if chunk % 3 == 0:  # enough that looks like a message
            noise = noise.replace(b"\x00", b"\xfa\xff").replace(b"\x01", b"\xfa\xff\x36\x10")
        for messages in decoder.feed(noise):
            found, _ = parse_mtdata2(messages.data)
            for samples in found:
                for packet in samples.packets:
                    if kind_of(packet.data_id) in KINDS:
                        values(samples, packet.data_id)
        assert len(decoder._buffer) < LONGEST
    stream, wanted = stream_of(120)
    assert each(decoder.feed(stream))[-60:] == wanted[-60:]


def test_noise_is_neither_kept_nor_raises() -> None:
    feed_noise(200_000)


@pytest.mark.full
@pytest.mark.timeout(600)
def test_ten_million_bytes_of_noise_are_neither_kept_nor_raise() -> None:
    feed_noise(10_000_000)


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=120))
def test_no_data_of_a_message_raises(data: bytes) -> None:
    found, malformed = parse_mtdata2(np.frombuffer(data, dtype=np.uint8)[None])
    assert len(found) + malformed == 1
    for samples in found:
        for packet in samples.packets:
            if kind_of(packet.data_id) in KINDS:
                values(samples, packet.data_id)
    decode_outputs(data)


@settings(max_examples=100, deadline=None)
@given(st.sampled_from(sorted(KINDS)), st.integers(0, 3), st.data())
def test_no_value_of_a_known_packet_raises(kind: int, number_format: int, data: st.DataObject) -> None:
    size = next(n for n in range(256) if KINDS[kind].fits(number_format, n))
    raw = data.draw(st.binary(min_size=size, max_size=size))
    body = (kind | number_format).to_bytes(2, "big") + bytes([size]) + raw
    assert values(single(encode(Mid.MTDATA2, body)), kind).shape == (1, len(KINDS[kind].fields))
