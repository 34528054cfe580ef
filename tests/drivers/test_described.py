"""Protocols that a file describes: the bytes of frames and lines, the driver of them, and the twin at the far end."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from wire_pair import pair

from drivers.imus.can.imu import ChannelSignals
from drivers.imus.described.framing import Decoder, Frames
from drivers.imus.described.imu import DescribedImu, Description
from drivers.specs import ImuSetup
from drivers.types import ImuBlock
from sims.imus.described import DescribedDevice
from sims.physics.body import Body
from sims.physics.geometry import along
from sims.physics.gyro import GyroArray, GyroTruth
from sims.wires.frames import ImuTwinSetup, NodeFaults
from station.bench.descriptions import DESCRIPTIONS, load_description
from station.run.event_loop.loops import VirtualLoop

VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "hipnuc_hi91.json").read_text())["vectors"]
ARDUINO = """\
name = "sketch"
rate = ["gx", "gy", "gz"]
[units]
rate = "deg/s"
[line]
columns = ["gx", "gy", "gz"]
"""
SENTENCE = """\
name = "sentence"
rate = ["gx", "gy", "gz", "gu"]
temperature = "t"
counter = "n"
wrap = 256
[units]
rate = "mdeg/s"
temperature = "K"
[line]
scale = { gx = 2, gy = 2, gz = 2, gu = 2 }
prefix = "$IMU;"
separator = ";"
columns = ["n", "-", "gx", "gy", "gz", "gu", "t"]
check = { name = "xor8", from = 1 }
"""
MIXED = """\
name = "six gyros, big-endian words of 24 bits, a trailer, a CRC of its own"
rate = ["a", "b", "c", "d", "e", "f"]
counter = "n"
step = 2
units = { rate = "deg/s" }
[frame]
sync = "AA"
end = "33"
bytes = 25
byte_order = "big"
check = { bits = 16, polynomial = 0x8005, init = 0xFFFF, reflected = true, xorout = 0xFF, at = -3, from = 1, to = -3 }
[frame.fields]
n = { at = 1, type = "u8" }
a = { at = 2, type = "i24", scale = 6.103515625e-5 }
b = { at = 5, type = "i24", scale = 6.103515625e-5 }
c = { at = 8, type = "i24", scale = 6.103515625e-5 }
d = { at = 11, type = "i24", scale = 6.103515625e-5 }
e = { at = 14, type = "i24", scale = 6.103515625e-5 }
f = { at = 17, type = "i24", scale = 6.103515625e-5, byte_order = "little" }
status = { at = 20, type = "u16" }
"""


def described(text: str, folder: Path) -> Description:
    path = folder / "imu.toml"
    path.write_text(text, encoding="utf-8")
    return load_description(str(path), device="imu")


@pytest.fixture(scope="module")
def hi91() -> Description:
    return load_description("hipnuc_hi91", device="imu")


def signals(description: Description) -> ChannelSignals:
    return ChannelSignals("imu", description.database, description.dbc, description.channels[0])


def values(description: Description, messages: list[bytes]) -> np.ndarray:
    """Return rates, temperature, accelerations and count or time (n, k) of messages, in SI."""
    data = np.frombuffer(b"".join(messages), dtype=np.uint8).reshape(len(messages), -1)
    own = signals(description)
    last = own.time or own.counter
    columns = [*own.rates, own.temperature, *own.acceleration, *([last] if last is not None else [])]
    return np.column_stack([np.full(len(data), np.nan) if s is None else s.values(data) for s in columns])


def decoded(description: Description, *chunks: bytes) -> np.ndarray:
    decoder = Decoder(description.framing)
    return values(description, [message for chunk in chunks for message in decoder.feed(chunk)])


def stream(description: Description, count: int, *, start: int = 0) -> tuple[np.ndarray, list[bytes]]:
    """Return samples (n, k) as ``values`` gives them, and their frames or lines as the device sends them."""
    own, random = signals(description), np.random.default_rng(count + start)
    rows, frames = [], []
    for i in range(start, start + count):
        row = {signal: float(random.uniform(-3, 3)) for signal in [*own.rates, *own.acceleration]}
        if own.temperature is not None:
            row[own.temperature] = 25.0
        if (last := own.time or own.counter) is not None:
            row[last] = i * 0.01 if own.time else i * own.step % (own.wrap or 256)
        message = description.database.messages[0]
        told = {signal.name: 0.0 for signal in message.signals}
        told |= {signal.name: signal.unscaled(value) for signal, value in row.items()}
        frames.append(description.framing.written(message.encode(told)))
        columns = [*own.rates, own.temperature, *own.acceleration, *([last] if last is not None else [])]
        rows.append([np.nan if column is None else row[column] for column in columns])
    return np.array(rows), frames


def test_published_frames_decode_to_what_the_manual_says(hi91: Description) -> None:
    for vector in VECTORS[:2]:
        row = decoded(hi91, bytes.fromhex(vector["hex"]))[0]
        said = vector["decoded"]
        np.testing.assert_allclose(np.degrees(row[:3]), said["gyr_dps"], atol=6e-4)
        np.testing.assert_allclose(row[4:7] / 9.80665, said["acc_g"], atol=6e-4)
        assert row[3] == said.get("temperature_c", row[3])
        assert row[7] == pytest.approx(said["time_ms"] * 1e-3)


def test_frames_of_another_kind_are_passed_over_whole_and_are_no_damage(hi91: Description) -> None:
    ours, other = (bytes.fromhex(VECTORS[i]["hex"]) for i in (1, 2))
    decoder = Decoder(hi91.framing)
    assert decoder.feed(other + ours + other + b"OK\r\n" + ours) == [ours, ours]
    assert decoder.damaged == 0


def test_an_arduino_takes_six_lines(tmp_path: Path) -> None:
    assert len(ARDUINO.splitlines()) == 6
    rows = decoded(described(ARDUINO, tmp_path), b"4,5,6\r\n0.12,-3.40,0.05\r\n1, 2 ,.5\n-1e1,+2,3.\r\n")
    np.testing.assert_allclose(np.degrees(rows[:, :3]), [[0.12, -3.4, 0.05], [1, 2, 0.5], [-10, 2, 3]])
    assert np.isnan(rows[:, 3]).all()


def test_blanks_may_part_columns_and_a_line_of_blanks_costs_no_time(tmp_path: Path) -> None:
    blanks = described(ARDUINO + 'separator = " "\n', tmp_path)
    decoder = Decoder(blanks.framing)
    messages = decoder.feed(b"\n  1   2\t3 \r\n1" + b" " * 4000 + b"x\n" + b"1" * 5000 + b"\n4 5 6\n")
    np.testing.assert_allclose(np.degrees(values(blanks, messages)[:, :3]), [[1, 2, 3], [4, 5, 6]])
    assert decoder.damaged == 1


def test_a_line_with_prefix_counter_and_checksum(tmp_path: Path) -> None:
    sentence = described(SENTENCE, tmp_path)
    decoder = Decoder(sentence.framing)
    body = b"IMU;7;x y;500;-1000;0;2.5;298.15"
    check = f"{np.bitwise_xor.reduce(np.frombuffer(body, np.uint8)):02X}".encode()
    good = b"$" + body + b"*" + check + b"\r\n"
    good_too = good.replace(b"*" + check, b"*" + check.lower())
    frames = decoder.feed(b"\n" + good_too + good.replace(b"500", b"501") + b"$GPS;1;2*00\r\n# a word\r\nzzz" + good)
    rows = values(sentence, frames)
    np.testing.assert_allclose(rows[:, 5], 7)
    np.testing.assert_allclose(np.degrees(rows[0, :4]), [1, -2, 0, 0.005])
    assert rows[0, 4] == pytest.approx(25.0)
    assert (len(frames), decoder.damaged) == (2, 1)


@pytest.mark.parametrize(
    ("check", "value"),
    [
        ('name = "CRC-16/XMODEM"', 0x31C3),
        ('name = "CRC-16/IBM-3740"', 0x29B1),
        ('name = "CRC-16/KERMIT"', 0x2189),
        ('name = "CRC-16/MODBUS"', 0x4B37),
        ('name = "CRC-32/ISO-HDLC"', 0xCBF43926),
        ('name = "CRC-32/MPEG-2"', 0x0376E6E7),
        ('name = "CRC-8/SMBUS"', 0xF4),
        ("bits = 8, polynomial = 0x07, init = 0xFF", 0xFB),
        ("bits = 32, polynomial = 0x1EDC6F41, init = 0xFFFFFFFF, reflected = true, xorout = 0xFFFFFFFF", 0xE3069283),
        ('name = "sum8"', 0xDD),
        ('name = "negated_sum8"', 0x23),
        ('name = "sum16"', 0x1DD),
        ('name = "xor8"', 0x31),
        ('name = "fletcher8"', 0xDD15),
    ],
)
def test_checks_give_their_published_values_over_123456789(check: str, value: int, tmp_path: Path) -> None:
    text = 'name = "c"\nrate = "g"\nunits = { rate = "deg/s" }\n[frame]\nsync = "31 32"\nbytes = 20\n'
    text += f'check = {{ {check}, at = 9, to = 9 }}\n[frame.fields]\ng = {{ at = 2, type = "u8" }}\n'
    framing = described(text, tmp_path).framing
    assert isinstance(framing, Frames)
    assert framing.check is not None
    assert framing.check.of(b"123456789") == value


@pytest.mark.parametrize("text", [None, ARDUINO, SENTENCE, MIXED], ids=["hi91", "arduino", "sentence", "mixed"])
def test_any_cut_of_a_stream_gives_the_same_samples(text: str | None, hi91: Description, tmp_path: Path) -> None:
    description = hi91 if text is None else described(text, tmp_path)

    @settings(max_examples=40, deadline=None)
    @given(st.data())
    def check(data: st.DataObject) -> None:
        _cut(description, data)

    check()


def _cut(description: Description, data: st.DataObject) -> None:
    _, frames = stream(description, 6, start=250)
    whole = b"\n"
    for frame in frames:  # garbage may lie between frames, and bits may flip
        whole += data.draw(st.sampled_from([b"", b"\x5a\xa5\x4c", b"\xaa\xff\n", b"\n\n$IMU;\n"])) + frame
    if data.draw(st.booleans()):
        at = data.draw(st.integers(0, len(whole) - 1))
        whole = whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1 :]
    once = Decoder(description.framing)
    expected = once.feed(whole)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(whole)), max_size=30)))
    pieces = Decoder(description.framing)
    found = [f for a, b in zip([0, *cuts], [*cuts, len(whole)], strict=True) for f in pieces.feed(whole[a:b])]
    assert found == expected
    assert pieces.damaged == once.damaged


@pytest.mark.parametrize("text", [None, SENTENCE, MIXED], ids=["hi91", "sentence", "mixed"])
def test_garbage_costs_only_the_frames_it_hits(text: str | None, hi91: Description, tmp_path: Path) -> None:
    description = hi91 if text is None else described(text, tmp_path)
    _, frames = stream(description, 40)
    random = np.random.default_rng(5)
    hurt = bytearray(frames[20])
    hurt[len(hurt) // 2] ^= 0x01
    parts = []
    for i, frame in enumerate(frames):
        parts += [random.integers(0, 256, random.integers(0, 50), dtype=np.uint8).tobytes()]
        parts += [b"\n", bytes(hurt) if i == 20 else frame]
    decoder = Decoder(description.framing)
    found = [frame for part in parts for frame in decoder.feed(part)]
    wanted = [frame for i, frame in enumerate(frames) if i != 20]
    # What looks like the beginning of a frame is waited for: the last may not be there yet.
    assert [description.framing.written(frame) for frame in found][:36] == wanted[:36]
    assert decoder.damaged >= 1


@pytest.mark.parametrize("text", [None, ARDUINO, SENTENCE, MIXED], ids=["hi91", "arduino", "sentence", "mixed"])
def test_what_is_encoded_decodes_to_what_went_in(text: str | None, hi91: Description, tmp_path: Path) -> None:
    description = hi91 if text is None else described(text, tmp_path)
    rows, frames = stream(description, 20)
    np.testing.assert_allclose(decoded(description, b"\n" + b"".join(frames)), rows, rtol=1e-6, atol=1e-6)


class Bench:
    """A source and its twin on a wire in memory; the body turns about z at a rate that tells the time."""

    SLOPE_RPS2 = 0.05

    def __init__(
        self,
        description: Description,
        rate_hz: float,
        wire: Callable[[bytes], bytes] = lambda data: data,
        **faults: float,
    ) -> None:
        self.near, self.far = pair("imu")
        body = Body(
            gimbals="z",
            angles=lambda _axis, t: self.SLOPE_RPS2 * t**2 / 2,
            revision=lambda: 0,
            latitude_rad=0.0,
            heading_rad=0.0,
            earth_turns=False,
        )
        axes = np.eye(3)[np.arange(len(description.channels[0].rates)) % 3]
        none = np.zeros(len(axes))
        gyros = GyroArray(
            mounting=along(axes.tolist()),
            truth=GyroTruth(none, none, none, none, 0.0, 0.0),
            body=body,
            rate_hz=rate_hz,
            seed=(1,),
        )
        self.heard = b""
        self.faults = NodeFaults(**faults)
        up = np.array([0.0, 0.0, 1.0])
        ride = ImuTwinSetup(
            gyros=gyros,
            rate_hz=rate_hz,
            up=lambda t_s: np.tile(up, (len(t_s), 1)),
            faults=self.faults,
            signals=description,
        )
        self.device = DescribedDevice(ride, lambda data: self.far.write(wire(data)))
        self.imu = DescribedImu(ImuSetup("imu", rate_hz, 0.5, signals=description), self.near)

    async def _hear(self) -> None:
        while True:
            data = (await self.far.receive()).data
            self.heard += data
            self.device.received(data)

    def run(self, duration_s: float) -> ImuBlock:
        """Return all samples of a while as one block."""

        async def main() -> list[ImuBlock]:
            tasks = [asyncio.ensure_future(self._hear()), asyncio.ensure_future(self.device.serve())]
            await self.imu.open()
            found = []
            try:
                async with asyncio.timeout(duration_s):
                    async for name, block in self.imu.blocks():
                        assert name == "imu"
                        found.append(block)
            except TimeoutError:
                found += [block for _, block in self.imu.flush()]
            for task in tasks[1:]:
                task.cancel()
            self.imu.close()
            await asyncio.gather(*tasks, return_exceptions=True)
            return found

        with asyncio.Runner(loop_factory=VirtualLoop) as runner:
            found = runner.run(main())
        joined = {}
        for name in ("t_ns", "arrival_ns", "rate_rps", "temperature_c", "counter", "accel_mps2"):
            parts = [getattr(block, name) for block in found if getattr(block, name) is not None]
            joined[name] = np.concatenate(parts) if parts else np.empty(0)
        return ImuBlock(**joined)

    def errors_s(self, block: ImuBlock) -> np.ndarray:
        """Return how wrong the times of samples are: the rate about z tells when each was taken."""
        return block.rate_rps[:, 2] / self.SLOPE_RPS2 - block.t_ns * 1e-9


@pytest.mark.parametrize("text", [None, ARDUINO, SENTENCE, MIXED], ids=["hi91", "arduino", "sentence", "mixed"])
def test_a_device_and_its_driver_agree(text: str | None, hi91: Description, tmp_path: Path) -> None:
    description = hi91 if text is None else described(text, tmp_path)
    bench = Bench(description, 100.0, clock_ppm=80.0)
    block, counts = bench.run(20.0), bench.imu.counts("imu")
    assert len(block.t_ns) > 1960
    assert (counts.lost, counts.repeated, counts.corrupt) == (0, 0, 0)
    assert np.abs(bench.errors_s(block)[500:]).max() < 2e-3
    assert np.isnan(block.temperature_c).all() == (description.channels[0].temperature is None)
    if description.channels[0].acceleration:
        np.testing.assert_allclose(block.accel_mps2[:, 2], 9.80665, rtol=1e-6)
    alignment = bench.imu.alignment("imu")
    assert alignment is not None
    assert alignment.drift_ppm == pytest.approx(-80.0, abs=30.0)


@pytest.mark.parametrize(
    ("text", "rate_hz"),
    [(None, 100.0), (None, 400.0), (SENTENCE, 100.0), (MIXED, 500.0)],
    ids=["hi91", "hi91 at 2.5 ms", "sentence", "mixed"],
)
def test_lost_and_doubled_samples_are_counted(
    text: str | None, rate_hz: float, hi91: Description, tmp_path: Path
) -> None:
    description = hi91 if text is None else described(text, tmp_path)
    bench = Bench(description, rate_hz)
    bench.faults.dropped, bench.faults.doubled = 0.05, 0.05
    block, counts = bench.run(10.0), bench.imu.counts("imu")
    sent = round((block.t_ns[-1] - block.t_ns[0]) * 1e-9 * rate_hz) + 1
    assert sent > 9.5 * rate_hz
    assert counts.samples == len(block.t_ns)
    assert counts.lost == pytest.approx(0.05 * sent, rel=0.3)
    assert counts.samples + counts.lost == sent
    assert counts.repeated == pytest.approx(0.05 * sent, rel=0.4)
    assert np.abs(bench.errors_s(block)[200:]).max() < 2e-3


def test_a_time_stamp_wraps(tmp_path: Path) -> None:
    text = (DESCRIPTIONS / "hipnuc_hi91.toml").read_text()
    description = described(text.replace("rate = [", "wrap = 3000\nrate = ["), tmp_path)
    bench = Bench(description, 100.0)
    block, counts = bench.run(20.0), bench.imu.counts("imu")
    assert (counts.lost, counts.repeated) == (0, 0)
    assert len(block.t_ns) > 1960
    assert block.counter is not None
    assert block.counter.max() < 3000
    assert np.abs(bench.errors_s(block)[500:]).max() < 2e-3


def test_start_and_stop_are_sent_and_the_twin_waits_for_them(hi91: Description) -> None:
    bench = Bench(hi91, 100.0)
    assert len(bench.run(1.0).t_ns) > 90
    assert bench.heard == b"AT+EOUT=1\r\nLOG ENABLE\r\nAT+EOUT=0\r\nLOG DISABLE\r\n"
    assert not bench.device.running
    unasked = Bench(replace(hi91, stop=()), 100.0)
    unasked.imu = DescribedImu(ImuSetup("imu", 100.0, 0.5, signals=replace(hi91, start=())), unasked.near)
    assert not len(unasked.run(1.0).t_ns)


@pytest.mark.parametrize("text", [None, ARDUINO, MIXED], ids=["hi91", "arduino", "mixed"])
def test_stuck_and_saturated_gyros_show(text: str | None, hi91: Description, tmp_path: Path) -> None:
    description = hi91 if text is None else described(text, tmp_path)
    bench = Bench(description, 100.0)
    bench.faults.saturated, bench.faults.stuck = {0}, {2}
    block = bench.run(1.0)
    assert (block.rate_rps[:, 0] > np.radians(500)).all()
    assert np.ptp(block.rate_rps[:, 2]) == 0
