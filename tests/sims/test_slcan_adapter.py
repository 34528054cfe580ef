"""The slcan adapter twin: Lawicel's commands, the vectors, and python-can's own slcan on a real pty."""

from __future__ import annotations

import json
import os
import random
import select
import threading
import tty
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import can
import cantools
import pytest
from hypothesis import given, strategies as st

from drivers.imus.can.imu import BUILT_IN_DBC
from sims.wires.slcan_adapter import SlcanAdapter, decode_frame, encode_frame

VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "slcan.json").read_text())["vectors"]
FRAMES = [v for v in VECTORS if v["ascii"][0] in "tTrRdDbB"]


class Host:
    """An adapter with what it has written and what it has put on the bus."""

    def __init__(self, **options: Any) -> None:
        self.heard: list[can.Message] = []
        self.out = bytearray()
        self.adapter = SlcanAdapter(self.out.extend, self.heard.append, **options)

    def ask(self, *lines: str) -> bytes:
        self.out.clear()
        for line in lines:
            self.adapter.received(line.encode() + b"\r")
        return bytes(self.out)


def opened(**options: Any) -> Host:
    host = Host(**options)
    host.ask("S6", "O")
    return host


def test_closing_with_an_argument_is_refused_and_closes_nothing() -> None:
    host = opened()
    assert host.ask("C1") == b"\a"
    assert host.ask("C") == b"\r"


@pytest.mark.parametrize("vector", FRAMES, ids=lambda v: v["ascii"])
def test_frames_of_the_vectors_decode(vector: dict[str, Any]) -> None:
    host, told = opened(), vector["decoded"]
    assert host.ask(vector["ascii"]) == (b"Z\r" if vector["ascii"][0].isupper() else b"z\r")
    (message,) = host.heard
    assert message.arbitration_id == told["id"]
    assert message.is_extended_id == told.get("ext", False)
    assert message.is_remote_frame == told.get("rtr", False)
    assert message.is_fd == told.get("fd", False)
    assert message.bitrate_switch == told.get("brs", False)
    if "dlc" in told:
        assert message.dlc == told["dlc"]
    if "data" in told:
        assert bytes(message.data).hex() == told["data"]
    if message.is_fd:
        assert message.dlc == len(message.data) == 16
    stamped = "timestamp_ms" in told
    assert encode_frame(message) == (vector["ascii"][:-4] if stamped else vector["ascii"])


def test_stamps_of_the_vectors_are_milliseconds_in_four_digits() -> None:
    (vector,) = (v for v in VECTORS if "timestamp_ms" in v["decoded"])
    host = Host(clock=lambda: 120.0 + vector["decoded"]["timestamp_ms"] / 1000 + 1e-4)
    host.ask("Z1", "O")
    host.out.clear()
    host.adapter.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\xaa\xbb"))
    assert host.out.hex() == vector["hex"]


def test_what_python_can_writes_to_open_opens() -> None:
    (vector,) = (v for v in VECTORS if v["kind"] == "measured")
    host = Host()
    host.adapter.received(bytes.fromhex(vector["hex"]))
    assert host.adapter.is_open
    # Closing what is closed and opening what is open are refused; python-can does not mind.
    assert bytes(host.out) == b"\a\r\r\r\a"


@pytest.mark.parametrize(
    ("before", "line", "answer"),
    [
        ((), "S6", b"\r"),
        ((), "S", b"\a"),
        ((), "S66", b"\a"),
        (("O",), "S6", b"\a"),
        ((), "s031C", b"\r"),
        ((), "s03", b"\a"),
        ((), "O", b"\r"),
        ((), "L", b"\r"),
        ((), "O1", b"\a"),
        (("O",), "O", b"\a"),
        (("O",), "C", b"\r"),
        ((), "C", b"\a"),
        ((), "V", b"V1013\r"),
        ((), "N", b"NA123\r"),
        ((), "V1", b"\a"),
        ((), "F", b"\a"),
        (("O",), "F", b"F00\r"),
        ((), "Z1", b"\r"),
        (("O",), "Z1", b"\a"),
        ((), "M00000000", b"\r"),
        ((), "mFFFFFFFF", b"\r"),
        ((), "M00000100", b"\a"),
        ((), "t1230", b"\a"),
        (("L",), "t1230", b"\a"),
        (("O",), "t1230", b"z\r"),
        (("O",), "T000001230", b"Z\r"),
        (("O",), "t1239" + 18 * "0", b"\a"),
        (("O",), "t1232AA", b"\a"),
        (("O",), "t1232AABBC", b"\a"),
        (("O",), "t8000", b"\a"),
        (("O",), "t12", b"\a"),
        (("O",), "tXYZ0", b"\a"),
        (("O", "X0"), "t1230", b"\r"),
        (("O",), "P", b"\a"),
        (("O", "X0"), "P", b"\r"),
        (("O", "X0"), "A", b"A\r"),
        ((), "X2", b"\a"),
        ((), "?", b"\a"),
        ((), "", b"\r"),
        ((), "é", b"\a"),
    ],
)
def test_every_command_is_answered_as_the_manual_says(before: tuple[str, ...], line: str, answer: bytes) -> None:
    host = Host()
    host.ask(*before)
    assert host.ask(line) == answer


def test_frames_wait_to_be_asked_for_where_the_host_wants_it_so() -> None:
    host = opened()
    host.ask("X0")
    for i in range(3):
        host.adapter.send(can.Message(arbitration_id=i, is_extended_id=False))
    assert host.ask("P") == b"t0000\r"
    assert host.ask("A") == b"t0010\rt0020\rA\r"
    for i in range(100):
        host.adapter.send(can.Message(arbitration_id=i, is_extended_id=False))
    assert host.ask("F") == b"F01\r"  # the queue was full
    assert host.ask("F") == b"F00\r"
    assert host.ask("A").count(b"t") == 64


def test_nobody_hears_the_bus_while_the_channel_is_closed() -> None:
    host = Host()
    host.adapter.send(can.Message(arbitration_id=1))
    assert not host.out


@given(st.binary(max_size=400), st.lists(st.integers(0, 400)))
def test_any_bytes_in_any_pieces_get_the_same_answers_and_never_raise(data: bytes, cuts: list[int]) -> None:
    whole, pieces = opened(), opened()
    line = b"\r" + VECTORS[7]["ascii"].encode() + b"\r"
    text = data + line
    whole.out.clear()
    pieces.out.clear()
    whole.adapter.received(text)
    edges = sorted({0, len(text), *(min(cut, len(text)) for cut in cuts)})
    for start, stop in pairwise(edges):
        pieces.adapter.received(text[start:stop])
    assert whole.out == pieces.out
    assert [encode_frame(m) for m in whole.heard] == [encode_frame(m) for m in pieces.heard]


@given(st.text(max_size=30))
def test_no_line_makes_the_frame_decoder_raise(text: str) -> None:
    for kind in "tTrRdDbB":
        decode_frame(kind + text)


@pytest.mark.full
def test_ten_million_random_bytes_leave_nothing_behind() -> None:
    source = random.Random(1)
    host = opened()
    for _ in range(1000):
        host.adapter.received(source.randbytes(10_000))
        host.out.clear()
        host.heard.clear()
    assert len(host.adapter._line) <= 138


@pytest.fixture
def pty_adapter() -> Iterator[tuple[SlcanAdapter, str, list[can.Message]]]:
    """An adapter behind a pty, served by a thread, so that python-can may block as it likes."""
    ours, theirs = os.openpty()
    tty.setraw(ours)
    tty.setraw(theirs)
    heard: list[can.Message] = []
    adapter = SlcanAdapter(lambda data: os.write(ours, data) and None, heard.append)
    leave_reader, leave = os.pipe()

    def serve() -> None:
        while True:
            ready, _, _ = select.select([ours, leave_reader], [], [])
            if leave_reader in ready:
                return
            adapter.received(os.read(ours, 4096))

    thread = threading.Thread(target=serve)
    thread.start()
    yield adapter, os.ttyname(theirs), heard
    os.write(leave, b"x")
    thread.join()
    for descriptor in (ours, theirs, leave_reader, leave):
        os.close(descriptor)


def test_python_cans_own_slcan_exchanges_frames_with_it(
    pty_adapter: tuple[SlcanAdapter, str, list[can.Message]],
) -> None:
    adapter, port, heard = pty_adapter
    bus = can.Bus(interface="slcan", channel=port, bitrate=500_000, sleep_after_open=0)
    assert bus.get_version(1.0) == (10, 13)
    assert bus.get_serial_number(1.0) == "A123"
    sent = [
        can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\x01\x02"),
        can.Message(arbitration_id=0x0CF02A80, is_extended_id=True, data=bytes(range(8))),
        can.Message(arbitration_id=0x7FF, is_extended_id=False, is_remote_frame=True, dlc=4),
        can.Message(arbitration_id=0x321, is_extended_id=False, is_fd=True, data=bytes(16)),
    ]
    for message in sent:
        bus.send(message)
    assert bus.get_version(1.0) == (10, 13)  # by now the adapter has taken all of them
    assert [encode_frame(m) for m in heard] == [encode_frame(m) for m in sent]
    for message in sent:
        adapter.send(message)
        found = bus.recv(1.0)
        assert found is not None
        assert encode_frame(found) == encode_frame(message)
    bus.shutdown()


def test_python_cans_logger_and_cantools_read_the_twins_frames(
    pty_adapter: tuple[SlcanAdapter, str, list[can.Message]], tmp_path: Path
) -> None:
    adapter, port, _ = pty_adapter
    database: Any = cantools.database.load_file(BUILT_IN_DBC)
    bus = can.Bus(interface="slcan", channel=port, bitrate=500_000, sleep_after_open=0)
    assert bus.get_version(1.0) == (10, 13)
    log = tmp_path / "candump.log"
    logger = can.Logger(log)
    for i in range(50):
        data = database.encode_message("GYRO1_RATE", {"Rate": 0.5 * i})
        adapter.send(can.Message(arbitration_id=0x101, is_extended_id=False, data=data))
        found = bus.recv(1.0)
        assert found is not None
        logger.on_message_received(found)
    logger.stop()
    bus.shutdown()
    assert all(" 101#" in line for line in log.read_text().splitlines())
    rates = [database.decode_message(m.arbitration_id, bytes(m.data))["Rate"] for m in can.LogReader(log)]
    assert rates == pytest.approx([0.5 * i for i in range(50)])
