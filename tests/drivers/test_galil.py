"""The Galil language by its public transcripts, and the driver against the twin where the language is its own."""

from __future__ import annotations

import asyncio
import json
import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings, strategies as st
from late_wire import read_under_lateness
from setups import setup_of, twin_on
from turntable_rigs import COUNTS, DEG, LIMITS, MAX_RATE, model_of, rig, settle, virtually
from wire_pair import pair

from drivers.errors import DeviceFault, DeviceRefused
from drivers.links.memory_link import MemoryLink
from drivers.specs import AxisSetup
from drivers.tables.galil.language import NUMBER, GalilFraming, Switches, error_of, floor_acceleration, revision
from drivers.tables.galil.table import GalilTable
from drivers.types import AxisLimits
from sims.physics.table import AxisData, TableModel
from sims.tables.galil_controller import GalilController

VECTORS = [
    vector
    for vector in json.loads(
        Path(__file__).parent.parent.joinpath("vectors/turntable_transcripts.json").read_text("utf-8")
    )["vectors"]
    if vector["protocol"] == "Galil DMC"
]
COUNT = 360.0 / COUNTS["galil"]


def twin_at_rest(**options: Any) -> tuple[GalilController, list[bytes], TableModel]:
    """Return a twin of axes A, B, C at a clock that stands, and what it writes."""
    written: list[bytes] = []
    model = TableModel({axis: AxisData(MAX_RATE, LIMITS.acceleration_rps2, 65536) for axis in "xyz"}, lambda: 0.0)
    return twin_on("galil", model, written.append, dict(zip("xyz", "ABC", strict=True)), **options), written, model


def say(controller: GalilController, written: list[bytes], line: str) -> str:
    del written[:]
    controller.received(line.encode() + b"\r")
    return b"".join(written).decode()


# The language


@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: vector["tx"])
def test_each_transcript_decodes_to_what_it_says(vector: dict[str, Any]) -> None:
    framing, decoded = GalilFraming(), vector["decoded"]
    assert framing.request(vector["tx"]) == vector["tx"].encode() + b"\r"
    received = vector["rx"].encode()
    answer = framing.answer(vector["tx"], received)
    assert answer is not None
    assert answer.length == len(received)
    assert answer.refused == ("error" in decoded)
    assert all(framing.answer(vector["tx"], received[:cut]) is None for cut in range(len(received)))
    if "position_counts" in decoded:
        assert float(answer.text) == decoded["position_counts"]
    elif "tc" in decoded:
        assert error_of(answer.text)[0] == decoded["tc"]
    elif "ts" in decoded:
        switches = Switches(int(answer.text))
        assert switches.word == decoded["ts"]
        assert switches.motor_off
        assert not any((switches.forward_limit, switches.reverse_limit, switches.latched, switches.moving))
    else:
        assert answer.text == ""


@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: vector["tx"])
def test_the_twin_answers_as_the_transcripts_do(vector: dict[str, Any]) -> None:
    controller, written, _ = twin_at_rest()
    before = {"TPX": ["LZ0"], "TC1": ["bg"], "JGA=20000": ["SHA"], "BGA": ["SHA", "JGA=20000"]}.get(vector["tx"], [])
    for line in before:
        say(controller, written, line)
    reply = say(controller, written, vector["tx"])
    if vector["tx"] in ("TC0", "TSA"):  # the transcripts leave out the leading blank
        reply = reply.lstrip(" ")
    assert reply == vector["rx"]


@pytest.mark.parametrize("ending", ["\r", "\r\n", ""])
def test_an_echo_is_no_part_of_an_answer(ending: str) -> None:
    framing = GalilFraming()
    for line, reply, text in (("TPA", " -12345\r\n:", "-12345"), ("SHA", ":", ""), ("bg", "?", "")):
        if ending or reply[0] != " ":
            received = f"{line}{ending}{reply}".encode()
            answer = framing.answer(line, received)
            assert answer is not None
            assert (answer.text, answer.length) == (text, len(received))


def test_an_answer_of_several_lines_is_one() -> None:
    answer = GalilFraming().answer("ID", b"FW, DMC4040 Rev 1.2c\r\nHW, 4040: rev 3\r\n:")
    assert answer is not None
    assert answer.text == "FW, DMC4040 Rev 1.2c\nHW, 4040: rev 3"


def test_a_token_is_found_in_its_own_answer_only() -> None:
    framing = GalilFraming()
    first, second = framing.token(), framing.token()
    word = first.request.split(b'"')[1]
    assert first.find(b" 12345\r\n:::?" + word + b"\r\n:") is not None
    for other in (b" 12345\r\n:", b'MG "' + word + b'"\r\n', word + b"\r\n", second.request.split(b'"')[1] + b"\r\n:"):
        assert first.find(other) is None


@pytest.mark.parametrize(
    ("text", "identity"),
    [
        ("DMC2143 Rev 1.0o", ("DMC2143", "1.0o")),
        ("DMC2280 Rev 1.0o-CM", ("DMC2280", "1.0o-CM")),
        ("RIO47100", ("RIO47100", "")),
    ],
)
def test_a_revision_is_model_and_firmware(text: str, identity: tuple[str, str]) -> None:
    assert revision(text) == identity


@pytest.mark.parametrize(("asked", "done"), [(0, 1024), (1024, 1024), (2047.9, 1024), (2048, 2048), (1e6, 999424)])
def test_an_acceleration_is_a_multiple_of_1024_not_above_what_was_asked(asked: float, done: int) -> None:
    assert floor_acceleration(asked) == done


def test_codes_are_in_plain_words() -> None:
    assert error_of("22 Begin not possible due to Limit Switch") == (22, "cannot begin on a limit switch")
    assert error_of("222 Something new") == (222, "Something new")
    assert error_of("") == (0, "no reason given")


@given(noise=st.binary(max_size=60), data=st.data())
@settings(max_examples=200, deadline=None)
def test_framing_of_any_bytes_never_raises_and_never_invents_bytes(noise: bytes, data: st.DataObject) -> None:
    framing = GalilFraming()
    answer = framing.answer(data.draw(st.sampled_from(["TPA", "SHA", "TC1", "\x12\x16"])), noise)
    assert answer is None or 0 < answer.length <= len(noise)
    framing.token().find(noise)


def feed_noise(count: int) -> None:
    dice = random.Random(5)
    controller, written, model = twin_at_rest(echo=False)
    for _ in range(count // 1000):
        controller.received(dice.randbytes(1000))
        del written[:]
    assert len(controller._line) <= 80
    assert model.at_rest()
    assert say(controller, written, "\rTPA").endswith(" 0\r\n:")


def test_noise_does_not_trouble_the_twin() -> None:
    feed_noise(200_000)


@pytest.mark.full
def test_much_noise_does_not_trouble_the_twin() -> None:
    feed_noise(10_000_000)


# The twin by the manual's forms


def test_the_twin_takes_every_form_of_a_setting() -> None:
    controller, written, _ = twin_at_rest()
    assert say(controller, written, "JG 1000,-2000,500") == ":"
    assert say(controller, written, "JG ?,?,?") == " 1000,-2000, 500\r\n:"  # no blank but those of the numbers
    assert say(controller, written, "JGB=?") == "-2000\r\n:"
    assert say(controller, written, "MG _JGA") == " 1000.0000\r\n:"
    assert say(controller, written, 'MG "pos",_TPA') == "pos 0.0000\r\n:"
    assert say(controller, written, "ACX=5000;MG _ACA") == ": 4096.0000\r\n:"
    assert say(controller, written, "SP ,3001") == ":"
    assert say(controller, written, "SPB=?") == " 3000\r\n:"
    assert say(controller, written, "TP") == " 0, 0, 0\r\n:"
    assert say(controller, written, "ID") == "FW, DMC4030 Rev 1.2c\r\n:"
    assert say(controller, written, "DPA=123;TPA") == ": 123\r\n:"


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("xx", 1),
        ("QQ", 1),
        ("TPH", 1),
        ("BGA", 20),
        ("JGA=13000000", 6),
        ("ACA=1", 6),
        ("PAA=abc", 4),
        ("MG", 4),
        ("P" * 100, 5),
    ],
)
def test_what_the_twin_refuses_has_its_code(line: str, code: int) -> None:
    controller, written, _ = twin_at_rest()
    assert say(controller, written, line) == "?"
    assert say(controller, written, "TC1").startswith(f"{code} ")
    assert say(controller, written, "TC0") == " 0\r\n:"  # told once, forgotten


def test_a_moving_axis_of_the_twin_refuses_what_must_wait() -> None:
    controller, written, _ = twin_at_rest()
    for line in ("SHA", "PAA=100000", "BGA"):
        assert say(controller, written, line) == ":"
    for line, code in (("BGA", 21), ("PAA=5", 7), ("MOA", 7), ("JGA=100", 13), ("DPA=0", 7)):
        assert say(controller, written, line) == "?"
        assert say(controller, written, "TC0") == f" {code}\r\n:"


# The driver


def test_the_driver_works_with_echo_on() -> None:
    async def main() -> None:
        async with rig("galil", echo=True) as made:
            await made.table.enable()
            await made.table.home()
            await made.table.move("x", 45 * DEG, 80 * DEG, 40 * DEG)
            await settle(made.table, "x")
            assert (await made.table.read("x")).angle_rad / DEG == pytest.approx(45.0, abs=COUNT)
            assert made.table.counts.timeouts == 0

    virtually(main)


def test_the_controller_is_known_by_model_firmware_and_serial_number() -> None:
    async def main() -> None:
        async with rig("galil", revision="DMC2143 Rev 1.0o", serial=1234) as made:
            identity = await made.table.identify()
            assert (identity.model, identity.firmware, identity.serial) == ("DMC2143", "1.0o", "1234")

    virtually(main)


def test_the_index_can_be_home() -> None:
    async def main() -> None:
        model = model_of("x", COUNTS["galil"])
        near, far = pair("table")
        controller = twin_on("galil", model, far.write, {"x": "C"})
        table = GalilTable(setup_of("galil", {"x": AxisSetup("C", COUNTS["galil"], LIMITS)}, 0.2, homing="FI"), near)
        carrier = asyncio.get_running_loop().create_task(carry(far, controller))
        await table.open()
        await table.enable()
        await table.home()  # 3 deg past one index pulse, on to the next
        assert model.motion["x"].at(model.clock())[0] / DEG == pytest.approx(360.0)
        assert (await table.read("x")).angle_rad == 0.0
        table.close()
        carrier.cancel()

    virtually(main)


async def carry(link: MemoryLink, controller: GalilController) -> None:
    while True:
        controller.received((await link.receive()).data)


def test_soft_limits_are_set_from_home_and_end_a_jog() -> None:
    async def main() -> None:
        model = model_of("x", COUNTS["galil"])
        near, far = pair("table")
        controller = twin_on("galil", model, far.write, {"x": "A"})
        limits = replace(LIMITS, travel_rad=(-90 * DEG, 45 * DEG))
        axis = AxisSetup("A", COUNTS["galil"], limits, options={"error_limit": 1 * DEG})
        table = GalilTable(setup_of("galil", {"x": axis}, 0.2), near)
        carrier = asyncio.get_running_loop().create_task(carry(far, controller))
        await table.open()
        await table.enable()
        await table.home()
        await table.jog("x", 20 * DEG, 20 * DEG)
        await asyncio.sleep(10.0)
        assert model.motion["x"].at(model.clock())[0] / DEG == pytest.approx(45.0, abs=COUNT)
        status = await table.status("x")
        assert "axis x: it ran into a limit (SC 2, stopped by the forward limit" in status.fault
        with pytest.raises(DeviceFault, match="ran into a limit"):
            await table.enable()
        await table.reset_fault()
        await table.enable()
        await table.move("x", 0.0, 20 * DEG, 20 * DEG)
        await settle(table, "x")
        assert (await table.status("x")).fault == ""
        table.close()
        carrier.cancel()

    virtually(main)


def test_a_limit_switch_stops_the_axis_and_is_told_with_its_codes() -> None:
    async def main() -> None:
        async with rig("galil") as made:
            await made.table.enable()
            await made.table.jog("y", -30 * DEG, 30 * DEG)
            await asyncio.sleep(3.0)
            made.model.press_limit("y", -1)
            await asyncio.sleep(2.0)
            assert made.model.at_rest()
            status = await made.table.status("y")
            assert "axis y: it ran into a limit (SC 3, stopped by the reverse limit; TS" in status.fault
            assert "on its reverse limit switch" in status.text
            with pytest.raises(DeviceRefused, match="refuses 'BGB': TC 22, cannot begin on a limit switch"):
                await made.table.jog("y", -30 * DEG, 30 * DEG)
            await made.table.jog("y", 30 * DEG, 30 * DEG)  # away from it
            await asyncio.sleep(1.0)
            made.model.pressed.clear()
            assert (await made.table.status("y")).fault == ""

    virtually(main)


def test_a_following_error_switches_the_motor_off_and_is_told() -> None:
    async def main() -> None:
        async with rig("galil") as made:
            await made.table.enable()
            await made.table.jog("x", 30 * DEG, 30 * DEG)
            await asyncio.sleep(2.0)
            made.model.trip("x", "following error")
            fault = (await made.table.status("x")).fault
            assert (
                "axis x: its motor has switched off (SC 8, switched off because its following error was too large"
                in fault
            )

    virtually(main)


def test_a_fault_from_before_the_driver_came_is_told() -> None:
    async def main() -> None:
        async with rig("galil") as made:
            await made.table.enable()
            made.model.trip("x", "servo trip")
            await made.table.status("x")
            again = GalilTable(setup_of("galil", made.table._axes, 0.2), made.table._exchange._link)
            assert "SC 15, amplifier fault" in (await again.status("x")).fault
            await again.reset_fault()
            assert (await again.status("x")).fault == ""
            await again.enable()
            assert (await again.status("x")).enabled
            made.model.trip("x", "servo trip")  # and once more: the same code, a new fault
            assert "SC 15" in (await again.status("x")).fault

    virtually(main)


def test_a_ramp_gentler_than_the_controller_has_is_refused_where_the_axis_is_not_allowed_it() -> None:
    async def main() -> None:
        near, far = pair("table")
        model = model_of("x", 1000)
        controller = twin_on("galil", model, far.write, {"x": "A"})
        limits = AxisLimits(MAX_RATE, 50 * DEG)  # 139 counts/s2
        table = GalilTable(setup_of("galil", {"x": AxisSetup("A", 1000, limits)}, 0.2), near)
        carrier = asyncio.get_running_loop().create_task(carry(far, controller))
        await table.open()
        await table.enable()
        with pytest.raises(
            DeviceRefused, match=r"axis x: the slowest ramp of the controller is 1024 counts/s2, 368.6 deg/s2"
        ):
            await table.jog("x", 20 * DEG, 20 * DEG)
        table.close()
        carrier.cancel()

    virtually(main)


@pytest.mark.parametrize("letters", [("A", "A"), ("Q",)])
def test_letters_that_cannot_be_are_refused(letters: tuple[str, ...]) -> None:
    axes = {axis: AxisSetup(letter, 1000, LIMITS) for axis, letter in zip("xyz", letters, strict=False)}
    with pytest.raises(ValueError, match="axis letters"):
        GalilTable(setup_of("galil", axes, 0.2), MemoryLink("table"))


# Late answers


@pytest.mark.parametrize("noise", [0.0, 0.3])
@pytest.mark.parametrize("seed", range(4))
def test_every_reading_is_of_its_own_request_however_late_answers_come(seed: int, noise: float) -> None:
    read, lost = read_under_lateness("galil", seed, noise)
    assert read > (150 if noise == 0.0 else 60)
    assert lost > 5


@given(cut=st.integers(0, 40))
@settings(max_examples=41, deadline=None)
def test_answers_cut_at_any_place_read_alike(cut: int) -> None:
    framing = GalilFraming()
    whole = b"TPA\r\n -1234567\r\n:"
    pieces = (whole[:cut], whole[cut:])
    received = b""
    found = None
    for piece in pieces:
        received += piece
        found = found or framing.answer("TPA", received)
    assert found is not None
    assert NUMBER.fullmatch(found.text)
    assert found.text == "-1234567"
