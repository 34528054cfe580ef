"""Register maps: the Kinco profile against the maker's frames, and what is wrong with a bad profile."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, strategies as st
from pymodbus.framer import FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadHoldingRegistersResponse,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

from drivers.tables.modbus.registers import PROFILE_FOLDER, DriveProfile, ProfileError, Register, load_profile
from station.bench.bench import default_bench_text, read_bench
from station.errors import BenchError, UsageError
from station.schema.tables import Table

VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "modbus_cia402.json").read_text())["vectors"]
COUNTS = 65536
KINCO_TEXT = (PROFILE_FOLDER / "kinco.toml").read_text()


def vectors(key: str) -> list[dict[str, Any]]:
    return [v for v in VECTORS if v["transport"] == "rtu" and key in v["decoded"]]


@pytest.fixture(scope="module")
def kinco() -> DriveProfile:
    return load_profile("kinco")


def frame(request: Any) -> str:
    return FramerRTU(DecodePDU(True)).buildFrame(request).hex()


@pytest.mark.parametrize("vector", vectors("target_velocity_dps"), ids=lambda v: v["decoded"]["raw"])
def test_rates_are_the_words_of_the_vectors(kinco: DriveProfile, vector: dict[str, Any]) -> None:
    raw = bytes.fromhex(vector["hex"])
    words = list(struct.unpack(">2H", raw[7:11]))
    turns_per_s = vector["decoded"]["target_velocity_dps"] / 360
    register = kinco["target_rate"]
    assert register.encode(turns_per_s, COUNTS) == words
    lsb_dps = 360 / (60 * 512 / 1875 * COUNTS)
    assert register.decode(words, COUNTS) * 360 == pytest.approx(turns_per_s * 360, abs=0.5 * lsb_dps)
    written = WriteMultipleRegistersRequest(dev_id=1, address=register.address, registers=words)
    assert frame(written) == vector["hex"]


def test_a_position_is_counts_with_the_low_word_first(kinco: DriveProfile) -> None:
    (vector,) = vectors("deg_at_65536_cpr")
    words = list(struct.unpack(">2H", bytes.fromhex(vector["hex"])[3:7]))
    assert words == [0xC000, 0xFFFF]
    assert kinco["position"].decode(words, COUNTS) * 360 == vector["decoded"]["deg_at_65536_cpr"]
    assert kinco["position"].encode(-0.25, COUNTS) == words


@pytest.mark.parametrize(
    ("rpm", "raw"), [(-100.0, bytes.fromhex("7EB1E4FF")), (200.0, bytes.fromhex("039D3600"))], ids=str
)
def test_speeds_are_the_manuals_bytes(kinco: DriveProfile, rpm: float, raw: bytes) -> None:
    words = kinco["target_rate"].encode(rpm / 60, COUNTS)
    assert struct.pack("<2H", *words) == raw


def test_an_acceleration_is_the_manuals_bytes(kinco: DriveProfile) -> None:
    assert struct.pack("<2H", *kinco["acceleration"].encode(100.0, COUNTS)) == bytes.fromhex("6EA30100")


def test_a_stock_rtu_framer_sends_the_manuals_three_frames(kinco: DriveProfile) -> None:
    manual = [v["hex"] for v in VECTORS if v["transport"] == "rtu" and v["kind"] == "manual example"]
    control, rate = kinco["controlword"], kinco["target_rate"]
    value = 546133 / (rate.scale or 1.0) / COUNTS
    requests = [
        ReadHoldingRegistersRequest(dev_id=1, address=kinco["statusword"].address, count=2),
        WriteSingleRegisterRequest(
            dev_id=1, address=control.address, registers=control.encode(kinco.commands["enable"], COUNTS)
        ),
        WriteMultipleRegistersRequest(dev_id=1, address=rate.address, registers=rate.encode(value, COUNTS)),
    ]
    assert [frame(request) for request in requests] == manual


@pytest.mark.parametrize("vector", vectors("meaning"), ids=lambda v: v["decoded"]["meaning"])
def test_the_derived_frames_are_those_of_the_profile(kinco: DriveProfile, vector: dict[str, Any]) -> None:
    decoded = vector["decoded"]
    by_address = {r.address: r for r in kinco.registers.values()}
    register = by_address[int(decoded["addr"], 16)]
    if "value" in decoded:
        words = register.encode(decoded["value"], COUNTS)
        assert frame(WriteSingleRegisterRequest(dev_id=1, address=register.address, registers=words)) == vector["hex"]
    else:
        read = ReadHoldingRegistersRequest(dev_id=1, address=register.address, count=register.words)
        assert frame(read) == vector["hex"]


@pytest.mark.parametrize(
    ("command", "meaning"),
    [
        ("shutdown", "shutdown / ready"),
        ("enable", "enable operation"),
        ("fault_reset", "fault reset"),
        ("move_arm", "abs position arm"),
        ("move_go", "abs position go"),
    ],
)
def test_commands_are_the_makers_controlwords(kinco: DriveProfile, command: str, meaning: str) -> None:
    (value,) = [v["decoded"]["value"] for v in vectors("meaning") if v["decoded"]["meaning"] == meaning]
    assert kinco.commands[command] == value


@given(st.sampled_from(["i8", "u8", "u16", "i16", "i32", "u32"]), st.booleans(), st.data())
def test_every_value_that_fits_comes_back(kind: str, low_word_first: bool, data: st.DataObject) -> None:
    bits = int(kind[1:])
    low = -(1 << (bits - 1)) if kind[0] == "i" else 0
    raw = data.draw(st.integers(low, low + (1 << bits) - 1))
    register = Register("r", 0, kind, low_word_first)
    words = register.encode(raw, COUNTS)
    assert len(words) == register.words
    assert all(0 <= word <= 0xFFFF for word in words)
    assert register.decode(words, COUNTS) == raw


def test_the_word_order_is_a_matter_of_the_profile() -> None:
    low, high = (Register("r", 0, "i32", order) for order in (True, False))
    assert low.encode(0x00085555, COUNTS) == [0x5555, 0x0008]
    assert high.encode(0x00085555, COUNTS) == [0x0008, 0x5555]


@pytest.mark.parametrize(
    ("kind", "value"),
    [("u16", 65536), ("u16", -1), ("i16", 32768), ("i8", -129), ("u8", 256), ("i32", 1 << 31), ("u32", -1)],
)
def test_a_value_that_does_not_fit_is_refused_by_name(kind: str, value: int) -> None:
    with pytest.raises(ValueError, match="some_register"):
        Register("some_register", 0, kind, True).encode(value, COUNTS)


def test_a_value_that_does_not_fit_after_scaling_is_refused(kinco: DriveProfile) -> None:
    with pytest.raises(ValueError, match="target_rate"):
        kinco["target_rate"].encode(2001.0, COUNTS)


def test_a_value_that_is_no_number_is_refused(kinco: DriveProfile) -> None:
    with pytest.raises(ValueError, match="target_rate|NaN|finite"):
        kinco["target_rate"].encode(math.nan, COUNTS)


def test_every_rtu_vector_is_what_a_stock_framer_makes_of_it(kinco: DriveProfile) -> None:
    by_address = {r.address: r for r in kinco.registers.values()}
    for vector in VECTORS:
        if vector["transport"] != "rtu":
            continue
        raw = bytes.fromhex(vector["hex"])
        requests = "reply" not in vector["decoded"]
        used, pdu = FramerRTU(DecodePDU(requests)).handleFrame(raw, 1, 0)
        assert used == len(raw)
        assert pdu is not None
        if requests:
            assert pdu.address in by_address
            assert frame(pdu) == vector["hex"]
        elif isinstance(pdu, ReadHoldingRegistersResponse):
            assert kinco["position"].decode(pdu.registers, COUNTS) == -0.25
        else:
            assert (pdu.isError(), pdu.function_code, pdu.exception_code) == (True, 0x81, 2)


def tcp_vector(address: str) -> tuple[dict[str, Any], Any]:
    (vector,) = [v for v in VECTORS if v["transport"] == "tcp" and str(v["decoded"]["addr"]).startswith(address)]
    raw = bytes.fromhex(vector["hex"])
    used, pdu = FramerSocket(DecodePDU(True)).handleFrame(raw, raw[6], 0)
    assert used == len(raw)
    assert FramerSocket(DecodePDU(True)).buildFrame(pdu) == raw
    return vector["decoded"], pdu


@pytest.mark.parametrize(
    ("address", "kind", "low_word_first", "key"),
    [("0x6040", "u16", True, "value"), ("0x60FF", "i32", True, "raw"), ("0x2102", "u32", True, "value")],
)
def test_the_mitsubishi_vectors_are_objects_with_the_low_word_first(
    address: str, kind: str, low_word_first: bool, key: str
) -> None:
    decoded, pdu = tcp_vector(address)
    register = Register(address, int(address, 16), kind, low_word_first)
    assert pdu.address == register.address
    assert register.encode(decoded[key], 1) == pdu.registers
    assert register.decode(pdu.registers, 1) == decoded[key]


def test_the_mitsubishi_statusword_is_one_register_at_its_object() -> None:
    decoded, pdu = tcp_vector("0x6041")
    assert (pdu.address, pdu.count, pdu.dev_id, pdu.transaction_id) == (0x6041, 1, 255, decoded["transaction"])


def test_the_lexium_vectors_are_two_registers_with_the_high_word_first() -> None:
    lexium = load_profile("lexium32")
    decoded, pdu = tcp_vector("6914")
    control = lexium["controlword"]
    assert (control.address, control.words) == (pdu.address, pdu.count) == (6914, 2)
    assert control.encode(lexium.commands["enable"], 1) == pdu.registers
    assert control.decode(pdu.registers, 1) == decoded["value"]
    decoded, pdu = tcp_vector("4614")
    gain = Register("CTRL1_KPp", 4614, "u16", low_word_first=False, least_words=2)
    assert (gain.address, gain.words) == (pdu.address, pdu.count)
    words = [int(word, 16) for word in decoded["reply_words"]]
    assert gain.decode(words, 1) == 200
    assert gain.encode(200, 1) == words


def test_a_short_value_in_two_registers_keeps_its_sign() -> None:
    mode = load_profile("lexium32")["mode"]
    assert mode.encode(-6, 1) == [0xFFFF, 0xFFFA]
    assert mode.decode([0xFFFF, 0xFFFA], 1) == -6
    assert mode.decode([0x0000, 0xFFFA], 1) == -6  # whether or not the drive fills the upper word


def test_a_scale_may_be_in_units_of_the_turn_whatever_the_encoder() -> None:
    rate = load_profile("lexium32")["target_rate"]
    assert rate.encode(1.0, 16384) == rate.encode(1.0, 65536) == [600000 >> 16, 600000 & 0xFFFF]


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0x0200, "error code 0x0200, following error"),
        (0x0220, "error code 0x0220, supply voltage too high and following error"),
        (0, "the drive gives no error code"),
    ],
)
def test_error_codes_are_told_in_plain_words(kinco: DriveProfile, code: int, text: str) -> None:
    assert kinco.error_text(code) == text


def test_an_error_code_that_the_profile_lacks_is_told_as_it_is() -> None:
    assert load_profile("lexium32").error_text(0x1234) == "error code 0x1234, see the drive's manual"


def written(folder: Path, text: str) -> str:
    path = folder / "drive.toml"
    path.write_text(text)
    return str(path)


def test_a_profile_may_be_a_file_of_ones_own(tmp_path: Path, kinco: DriveProfile) -> None:
    assert load_profile(written(tmp_path, KINCO_TEXT)) == kinco


def test_an_unknown_profile_is_refused_with_those_known() -> None:
    with pytest.raises(ProfileError, match="no drive profile acme: give one of .*kinco"):
        load_profile("acme")


def test_a_profile_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match=r"no drive profile .*absent\.toml"):
        load_profile(str(tmp_path / "absent.toml"))


@pytest.mark.parametrize(
    ("find", "put", "complaint"),
    [
        ("[homing]", '[[on_open]]\nregister = "guard"\nvalue = 1\n[homing]', "lacks the register guard of"),
        ("[registers]", "[registers", "cannot be read"),
        ("0x0001 = ", "zero = ", "lacks or misspells .*zero"),
        ("address = 0x3200, ", "", "lacks or misspells 'address'"),
    ],
)
def test_a_faulty_profile_is_refused_with_its_fault(tmp_path: Path, find: str, put: str, complaint: str) -> None:
    assert find in KINCO_TEXT
    with pytest.raises(ProfileError, match=complaint):
        load_profile(written(tmp_path, KINCO_TEXT.replace(find, put)))


@pytest.mark.parametrize(
    ("find", "put", "complaint"),
    [
        ("statusword      =", "status_word     =", r"table \[registers.statusword\] is missing"),
        ("quick_stop  = 0x0B", "", r"line \d+: commands: quick_stop is missing"),
        ('type = "u16"', 'type = "u24"', r"line \d+: registers.controlword.type: 'u24' is not one of i8, u8"),
        (
            'unit = "turn/s2"',
            'unit = "deg/s2"',
            r"line \d+: registers.acceleration.unit: 'deg/s2' is not one of",
        ),
        ('word_order = "little"', 'word_order = "middle"', r"line \d+: word_order: 'middle' is not one of little, big"),
        ('word_order = "little"', "", "word_order is missing"),
        ("address = 0x3200, ", "", "registers.statusword: address is missing"),
        ("address = 0x3200, ", "address = 70000, ", r"line \d+: registers.statusword.address: 70000: give 0 to 65535"),
        ('name = "Kinco FD/CD/JD"', "", "name is missing"),
        ("[registers]", "[registers", "not valid TOML"),
        ("[homing]", "[housing]", r"table \[homing\] is missing"),
        ("[homing]", "[homing]\nmetod = 35", r"line \d+: homing.metod: unknown key; did you mean method\?"),
        ("[homing]", '[[on_open]]\nregister = "guard"\nvalue = 1\n[homing]', "lacks the register guard of"),
        ("[homing]", '[[on_open]]\nregister = "mode"\n[homing]', "on_open.0: value is missing"),
        ("0x0001 = ", "zero = ", "lacks or misspells .*zero"),
    ],
)
def test_a_bench_tells_what_is_wrong_with_a_profile_by_file_line_and_key(
    tmp_path: Path, find: str, put: str, complaint: str
) -> None:
    assert find in KINCO_TEXT
    path = written(tmp_path, KINCO_TEXT.replace(find, put, 1))
    text = default_bench_text().replace('profile = "kinco"', f'profile = "{path}"')
    with pytest.raises(BenchError, match=rf"bench, line \d+: table.profile: .*drive.toml.*{complaint}"):
        read_bench(text, "bench")


@pytest.mark.parametrize("name", ["kinco", "lexium32"])
def test_profiles_that_ship_are_as_they_are_declared(name: str) -> None:
    Table.load(PROFILE_FOLDER / f"{name}.toml", UsageError).check("profile.profile")
