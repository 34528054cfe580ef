"""Signals taken out of frames in bulk, against cantools' own decoding of the same DBC."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pytest
from cantools.database.can import Message, Signal
from cantools.database.conversion import LinearConversion, LinearIntegerConversion
from hypothesis import given, strategies as st

from drivers.errors import DeviceError
from drivers.imus.signals import SignalReader, parameter_group, plain_unit

DBC = Path("made.dbc")


class Database:
    """One message, as cantools' database gives it by name."""

    def __init__(self, message: Any) -> None:
        self._message = message

    def get_message_by_name(self, name: str) -> Any:
        if name != self._message.name:
            raise KeyError(name)
        return self._message


@st.composite
def signals(draw: st.DrawFn) -> Signal:
    """Any signal that fits a frame of eight bytes: 1 to 64 bits, either byte order."""
    length = draw(st.integers(1, 64))
    first = draw(st.integers(0, 64 - length))  # from the left in big endian, from the right in little endian
    big = draw(st.booleans())
    start = 8 * (first // 8) + 7 - first % 8 if big else first
    scale, offset = draw(st.sampled_from([(1, 0), (0.005, 0), (1 / 128, -250.0), (-2.0, 3.0)]))
    conversion = LinearIntegerConversion(scale, offset) if scale == 1 else LinearConversion(scale, offset, False)
    return Signal(
        "s",
        start,
        length,
        "big_endian" if big else "little_endian",
        draw(st.booleans()),
        conversion=conversion,
        unit="deg/s",
    )


@given(signals(), st.lists(st.binary(min_size=8, max_size=8), min_size=1, max_size=20))
def test_every_signal_is_read_as_cantools_reads_it(signal: Signal, frames: list[bytes]) -> None:
    message = Message(1, "M", 8, [signal])
    reader = SignalReader(device="imu", database=Database(message), dbc=DBC, name="M.s", quantity="rate", unit="rad/s")
    data = np.frombuffer(b"".join(frames), dtype=np.uint8).reshape(-1, 8)
    expected = [message.decode(frame, scaling=True)["s"] for frame in frames]
    np.testing.assert_allclose(reader.values(data), np.array(expected, dtype=np.float64), rtol=1e-12, atol=1e-12)
    raw = [message.decode(frame, scaling=False)["s"] & (1 << 64) - 1 for frame in frames]
    assert [int(number) & (1 << 64) - 1 for number in reader.raw(data)] == raw


def database(text: str) -> Any:
    return cantools.database.load_string('VERSION ""\nNS_ :\nBS_:\nBU_: A\n' + text)


def test_floats_are_read_as_floats() -> None:
    made = database(
        "BO_ 1 M: 8 A\n"
        ' SG_ X : 0|32@1- (1,0) [0|0] "rad/s" A\n SG_ Y : 32|32@1- (1,0) [0|0] "deg/s" A\n'
        "SIG_VALTYPE_ 1 X : 1;\nSIG_VALTYPE_ 1 Y : 1;\n"
    )
    data = np.array([[0.25, 90.0]], dtype="<f4").view(np.uint8)
    assert SignalReader(device="imu", database=made, dbc=DBC, name="M.X", quantity="rate").values(
        data
    ) == pytest.approx([0.25])
    assert SignalReader(device="imu", database=made, dbc=DBC, name="M.Y", quantity="rate").values(
        data
    ) == pytest.approx([np.pi / 2])


def test_a_multiplexed_signal_is_there_only_where_its_multiplexer_says_so() -> None:
    made = database(
        "BO_ 1 M: 3 A\n"
        ' SG_ Page M : 0|8@1+ (1,0) [0|0] "" A\n'
        ' SG_ X m0 : 8|16@1- (0.1,0) [0|0] "deg/s" A\n SG_ T m1 : 8|16@1- (0.1,0) [0|0] "degC" A\n'
    )
    data = np.array([[0, 10, 0], [1, 250, 0]], dtype=np.uint8)
    reader = SignalReader(device="imu", database=made, dbc=DBC, name="M.X", quantity="rate")
    assert reader.present(data).tolist() == [True, False]
    np.testing.assert_allclose(reader.values(data), [np.radians(1.0), np.nan])
    np.testing.assert_allclose(
        SignalReader(device="imu", database=made, dbc=DBC, name="M.T", quantity="temperature").values(data),
        [np.nan, 25.0],
    )


@pytest.mark.parametrize(
    ("text", "si"),
    [
        ("deg/s", np.pi / 180),
        ("°/s", np.pi / 180),
        ("dps", np.pi / 180),
        ("degrees/sec", np.pi / 180),
        ("Deg/s", np.pi / 180),
        ("deg/h", np.pi / 180 / 3600),
        ("mrad/s", 1e-3),
        ("rad/s", 1.0),
    ],
)
def test_units_of_rate_are_understood_as_files_spell_them(text: str, si: float) -> None:
    made = database(f'BO_ 1 M: 2 A\n SG_ X : 0|16@1- (2,0) [0|0] "{text}" A\n')
    data = np.array([[3, 0]], dtype=np.uint8)
    assert SignalReader(device="imu", database=made, dbc=DBC, name="M.X", quantity="rate").values(
        data
    ) == pytest.approx([6 * si])


@pytest.mark.parametrize(
    ("text", "plain"),
    [("m/s^2", "m/s2"), ("m/s²", "m/s2"), ("m/s/s", "m/s2"), ("µs", "us"), ("°C", "degC"), ("K", "K")],
)
def test_other_units_too(text: str, plain: str) -> None:
    assert plain_unit(text) == plain


def test_kelvin_becomes_degrees() -> None:
    made = database('BO_ 1 M: 2 A\n SG_ T : 0|16@1+ (0.1,0) [0|0] "K" A\n')
    reader = SignalReader(device="imu", database=made, dbc=DBC, name="M.T", quantity="temperature")
    assert reader.values(np.array([[0xA4, 0x0B]], dtype=np.uint8)) == pytest.approx([298.0 - 273.15])
    assert reader.unscaled(25.0) == pytest.approx(298.15)


def test_a_unit_of_the_mapping_counts_before_that_of_the_dbc() -> None:
    made = database('BO_ 1 M: 2 A\n SG_ X : 0|16@1- (1,0) [0|0] "" A\n')
    with pytest.raises(DeviceError, match=r"imu: M\.X in made\.dbc has unit '', not deg/s or rad/s"):
        SignalReader(device="imu", database=made, dbc=DBC, name="M.X", quantity="rate")
    reader = SignalReader(device="imu", database=made, dbc=DBC, name="M.X", quantity="rate", unit="mrad/s")
    assert reader.values(np.array([[250, 0]], dtype=np.uint8)) == pytest.approx([0.25])


def test_a_parameter_group_has_no_priority_no_sender_and_no_destination() -> None:
    assert {parameter_group(i) for i in (0x0CF02A80, 0x18F02A01)} == {0xF02A}
    assert {parameter_group(i) for i in (0x18EA8000, 0x18EAFF80)} == {0xEA00}
    assert parameter_group(0x19F02A80) == 0x1F02A
