"""The ACUTROL language by what open drivers show of it, and the driver where the language is its own."""

from __future__ import annotations

import asyncio
import itertools
import json
import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings, strategies as st
from late_wire import read_under_lateness
from setups import setup_of, twin_on
from turntable_rigs import COUNTS, DEG, LIMITS, MAX_RATE, MemoryWire, model_of, rig, settle, virtually
from wire_pair import pair

from drivers.errors import DeviceFault, DeviceRefused, LinkLost
from drivers.specs import AxisSetup
from drivers.tables.acutrol.language import NUMBER, OK, AcutrolFraming, absolute_limits, refusal
from drivers.tables.acutrol.table import AcutrolTable
from drivers.tables.unwrap import Unwrapper
from drivers.types import AxisLimits
from sims.physics.table import AxisData, TableModel
from sims.tables.acutrol_controller import AcutrolController

VECTORS = [
    vector
    for vector in json.loads(
        Path(__file__).parent.parent.joinpath("vectors/turntable_transcripts.json").read_text("utf-8")
    )["vectors"]
    if vector["protocol"] == "ACUTROL ACL"
]
BY_TX = {vector["tx"]: vector for vector in VECTORS}


def twin_at_rest(**options: Any) -> tuple[AcutrolController, list[bytes], TableModel]:
    """Return a twin of axes 1, 2, 3 at a clock that stands, and what it writes."""
    written: list[bytes] = []
    model = TableModel({axis: AxisData(MAX_RATE, LIMITS.acceleration_rps2, 36_000_000) for axis in "xyz"}, lambda: 0.0)
    return (
        twin_on("acutrol", model, written.append, dict(zip("xyz", (1, 2, 3), strict=True)), **options),
        written,
        model,
    )


def say(controller: AcutrolController, written: list[bytes], line: str, prefix: int = 8) -> str:
    """Return the answer to a line without its prefix and line end."""
    del written[:]
    controller.received(line.encode() + b"\r\n")
    reply = b"".join(written)
    assert reply.endswith(b"\r\n")
    return reply[prefix:-2].decode()


# The language


def test_the_transcripts_are_those_that_are_known() -> None:
    assert set(BY_TX) == {
        ":interlock:close 1",
        ":read:rate 1",
        ":read:pos? 1;rate? 1;acc? 1",
        ":mode? 1",
        ":interlock? 1",
        "*stb?",
        ":dem:rate 1,10",
    }


@pytest.mark.parametrize(
    ("text", "limits"), [("300.0,500.0", (300.0, 500.0)), ("300, 500, 20", (300.0, 500.0)), ("300", None)]
)
def test_limits_of_the_maker_are_the_first_two_values(text: str, limits: tuple[float, float] | None) -> None:
    assert absolute_limits(text) == limits


@pytest.mark.parametrize("prefix", [0, 8])
def test_a_number_beside_the_one_that_was_written_is_not_taken_for_it(prefix: int) -> None:
    token = AcutrolFraming(1, 50.0, prefix).token()
    written = float(token.request.split(b"synt,1,")[1].split()[0])
    start = b"." * prefix

    def told(rate_dps: float) -> bytes:
        return start + b"OK\r\n" + start + f"{rate_dps:.2f}\r\n".encode()

    answer = told(written)
    assert token.find(answer) == (0, len(answer))
    for before in (b"?", told(written + 0.01), told(written - 0.01)):
        assert token.find(before) is None
        assert token.find(before + answer) == (len(before), len(before + answer))


@pytest.mark.parametrize("prefix", [0, 8, 12])
@pytest.mark.parametrize(
    ("tx", "text"), [(":interlock:close 1", "OK"), (":read:rate 1", "-12.345"), (":mode? 1", "Rate"), ("*stb?", "65")]
)
def test_an_answer_is_what_stands_behind_the_prefix(tx: str, text: str, prefix: int) -> None:
    framing = AcutrolFraming(1, 100.0, prefix)
    assert framing.request(tx) == tx.encode() + b"\r\n"
    received = bytes(range(1, prefix + 1)).replace(b"\n", b"\x00") + text.encode() + b"\r\n"
    assert all(framing.answer(tx, received[:cut]) is None for cut in range(len(received)))
    answer = framing.answer(tx, received + b"beyond")
    assert answer is not None
    assert (answer.text, answer.refused, answer.length) == (text, False, len(received))


def test_the_twin_answers_as_the_transcripts_do() -> None:
    controller, written, model = twin_at_rest()
    assert say(controller, written, ":interlock:close 1") == BY_TX[":interlock:close 1"]["rx"].removeprefix("<8 chars>")
    assert NUMBER.fullmatch(say(controller, written, ":read:rate 1"))
    values = say(controller, written, ":read:pos? 1;rate? 1;acc? 1").split(";")
    assert len(values) == 3
    assert all(NUMBER.fullmatch(value) for value in values)
    assert say(controller, written, ":mode:rate 1") == "OK"
    assert say(controller, written, ":mode? 1") == BY_TX[":mode? 1"]["rx"]
    assert say(controller, written, ":dem:rate 1,10") == "OK"  # on TCP; on GPIB there is no answer
    model.trip("x", "fault input")
    assert say(controller, written, ":interlock? 1") == BY_TX[":interlock? 1"]["rx"]
    assert say(controller, written, "*stb?") == BY_TX["*stb?"]["rx"]


@pytest.mark.parametrize("form", [":demand:rate 1,5", ":dem:rate 1,5", ":D:R 1,5", ":DEMAND:RATE 1, 5"])
def test_words_may_be_long_or_short(form: str) -> None:
    controller, written, _ = twin_at_rest()
    for line in (":int:close 1", ":mode 1,rate", form):
        assert say(controller, written, line) == "OK"


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (":nonsense 1", "not recognized"),
        ("nonsense", "not recognized"),
        (":mode:rate 1", "Interlock not closed"),
        (":mode:rate 7", "Axis not available"),
        (":dem:delta 1,10", "Not in position mode"),
        (":lim:acc rate,1,1e9", "out of range"),
        (":dem:rate 1,fast", "Parameter error"),
        (":dem:rate 1", "Wrong number of arguments"),
        (":dem:rate 1,2,3", "Wrong number of arguments"),
        (":dem:rate? 1,2", "Wrong number of arguments"),
        (":dem:delta? 1", "not recognized"),
        (":read", "Axis missing"),
    ],
)
def test_what_the_twin_refuses_it_says(line: str, words: str) -> None:
    controller, written, _ = twin_at_rest()
    reply = say(controller, written, line)
    assert words in reply
    assert refusal(reply)


def test_a_query_of_a_demand_returns_it_and_moves_nothing() -> None:
    written: list[bytes] = []
    times_s = itertools.count()  # the clock is a second further whenever it is read
    model = TableModel({"x": AxisData(MAX_RATE, LIMITS.acceleration_rps2, 36_000_000)}, lambda: float(next(times_s)))
    controller = twin_on("acutrol", model, written.append, {"x": 1})
    for line in (":int:close 1", ":dem:rate 1,5", ":dem:acc 1,20", ":mode:pos 1"):
        assert say(controller, written, line) == "OK"
    for quantity, value in (("rate", 5.0), ("acceleration", 20.0), ("position", 0.0)):
        assert say(controller, written, f":demand:{quantity}? 1") == f"{value:.6f}"
    for _ in range(60):
        assert say(controller, written, ":read:pos? 1") == "0.000000"
    assert say(controller, written, ":dem:pos 1,-30") == "OK"
    assert say(controller, written, ":dem:pos? 1") == "330.000000"


def test_ok_and_values_are_no_refusals() -> None:
    assert not refusal("OK")
    assert not refusal("-12.5e+01")
    assert not refusal("\x80\x81")


def test_a_token_is_its_own_number_after_an_ok() -> None:
    framing = AcutrolFraming(1, 100.0, 8)
    token = framing.token()
    number = token.request.split(b"synt,1,")[1].split(b"\r")[0]
    answers = b"00000007OK\r\n00000008" + number + b"00\r\n"
    assert token.find(b"00000006 12.5\r\n" + answers) == (15, 15 + len(answers))
    assert token.find(b"00000008" + number + b"\r\n") is None  # no OK before it
    assert token.find(b"00000007OK\r\n00000008" + number) is None  # not complete
    other = framing.token().request.split(b"synt,1,")[1].split(b"\r")[0]
    assert other != number
    assert token.find(b"00000007OK\r\n00000008" + other + b"\r\n") is None


@pytest.mark.parametrize("most_dps", [0.05, 0.5, 1.0, 2.5])
def test_a_token_is_accepted_by_a_slow_axis(most_dps: float) -> None:
    written: list[bytes] = []
    model = TableModel({"x": AxisData(most_dps * DEG, LIMITS.acceleration_rps2, 36_000_000)}, lambda: 0.0)
    controller = twin_on("acutrol", model, written.append, {"x": 1})
    framing = AcutrolFraming(1, most_dps, 8)
    for _ in range(200):
        token = framing.token()
        del written[:]
        controller.received(token.request)
        assert token.find(b"".join(written)), (token.request, written)


@given(noise=st.binary(max_size=60))
@settings(max_examples=200, deadline=None)
def test_framing_of_any_bytes_never_raises(noise: bytes) -> None:
    framing = AcutrolFraming(1, 100.0, 8)
    answer = framing.answer(":read:rate 1", noise)
    assert answer is None or 0 < answer.length <= len(noise)
    framing.token().find(noise)


def feed_noise(count: int) -> None:
    dice = random.Random(6)
    controller, written, model = twin_at_rest()
    for _ in range(count // 1000):
        controller.received(dice.randbytes(1000))
        del written[:]
    assert len(controller._line) <= 256
    assert model.at_rest()
    controller.received(b"\r\n")
    assert say(controller, written, ":interlock? 1") == "Open"


def test_noise_does_not_trouble_the_twin() -> None:
    feed_noise(200_000)


@pytest.mark.full
def test_much_noise_does_not_trouble_the_twin() -> None:
    feed_noise(10_000_000)


# Angles within one turn


def test_turns_are_counted_by_the_rate() -> None:
    unwrapper = Unwrapper(360.0)
    assert unwrapper.place(0.0, 350.0, 100.0) == -10.0
    assert unwrapper.place(1.0, 90.0, 100.0) == 90.0
    assert unwrapper.place(5.0, 130.0, 100.0) == 490.0
    assert unwrapper.place(6.0, 80.0, -100.0) == 440.0
    unwrapper.restart()
    assert unwrapper.place(7.0, 200.0, 0.0) == -160.0


def test_a_table_that_tells_turns_is_believed() -> None:
    unwrapper = Unwrapper(360.0)
    assert unwrapper.place(0.0, 100.0, 0.0) == 100.0
    assert unwrapper.place(10.0, 730.0, 0.0) == 730.0
    assert unwrapper.place(20.0, -300.0, 0.0) == -300.0


@given(
    rates=st.lists(st.floats(-400.0, 400.0), min_size=1, max_size=40),
    start=st.floats(-170.0, 170.0),
    wraps_at=st.sampled_from([0.0, -180.0]),
)
def test_counted_turns_are_those_made(rates: list[float], start: float, wraps_at: float) -> None:
    unwrapper = Unwrapper(360.0)
    angle, rate = start, 0.0
    for step, following in enumerate([0.0, *rates]):
        angle += 0.1 * (rate + following) / 2
        rate = following
        told = (angle - wraps_at) % 360.0 + wraps_at
        assert unwrapper.place(0.1 * step, told, rate) == pytest.approx(angle, abs=1e-6)


@pytest.mark.parametrize("options", [{"wrapped": True}, {"wrapped": False}])
def test_angles_count_on_over_turns(options: dict[str, Any]) -> None:
    async def main() -> None:
        async with rig("acutrol", **options) as made:
            await made.table.enable()
            await made.table.home()
            await made.table.jog("y", -90 * DEG, 50 * DEG)
            await asyncio.sleep(60.0)  # nobody reads but the driver itself
            truth = made.model.motion["y"].at(made.model.clock())[0] / DEG
            assert truth < -5000.0
            assert (await made.table.read("y")).angle_rad / DEG == pytest.approx(truth, abs=2e-5)
            await made.table.move("y", 10 * DEG, 80 * DEG, 50 * DEG)
            await settle(made.table, "y", 200.0)
            assert made.model.motion["y"].at(made.model.clock())[0] / DEG == pytest.approx(10.0, abs=6e-4)

    virtually(main)


# The driver


@asynccontextmanager
async def lone_axis(
    limits: AxisLimits = LIMITS, counts_per_turn: int = COUNTS["acutrol"], **options: Any
) -> AsyncIterator[tuple[AcutrolTable, TableModel]]:
    """Join a driver of one axis with ``limits`` and a twin with options of its own."""
    model = model_of("x", counts_per_turn)
    near, far = pair("table")
    wire = MemoryWire(far)
    wire.controller = twin_on("acutrol", model, wire.write, {"x": 2}, **options)
    axes = {"x": AxisSetup(2, COUNTS["acutrol"], limits)}
    table = AcutrolTable(setup_of("acutrol", axes, 0.2, reply_prefix=options.get("reply_prefix", 8)), near)
    carrier = asyncio.get_running_loop().create_task(wire.carry())
    try:
        yield table, model
    finally:
        table.close()
        carrier.cancel()


@pytest.mark.parametrize("length", [0, 3, 20])
def test_the_length_of_the_prefix_is_an_option(length: int) -> None:
    async def main() -> None:
        async with lone_axis(reply_prefix=length) as (table, model):
            await table.open()
            await table.enable()
            await table.home()
            await table.move("x", 30 * DEG, 20 * DEG, 20 * DEG)
            await settle(table, "x")
            assert model.motion["x"].at(model.clock())[0] / DEG == pytest.approx(30.0, abs=6e-4)

    virtually(main)


def test_a_wrong_length_of_the_prefix_is_found_when_the_link_is_opened() -> None:
    async def main() -> None:
        model = model_of("x", COUNTS["acutrol"])
        near, far = pair("table")
        wire = MemoryWire(far)
        wire.controller = twin_on("acutrol", model, wire.write, {"x": 1}, reply_prefix=0)
        table = AcutrolTable(setup_of("acutrol", {"x": AxisSetup(1, COUNTS["acutrol"], LIMITS)}, 0.2), near)
        carrier = asyncio.get_running_loop().create_task(wire.carry())
        with pytest.raises(LinkLost, match="no answer within 0.4 s"):
            await table.open()
        table.close()
        carrier.cancel()

    virtually(main)


def test_a_bench_that_allows_more_than_the_maker_is_refused() -> None:
    async def main() -> None:
        async with lone_axis(AxisLimits(200 * DEG, 20 * DEG)) as (table, _):
            with pytest.raises(
                DeviceRefused, match=r"axis x has limits of 100 deg/s and 50 deg/s2, but the bench file allows 200"
            ):
                await table.open()

    virtually(main)


def test_the_controller_is_known_by_its_identity() -> None:
    async def main() -> None:
        async with rig("acutrol") as made:
            identity = await made.table.identify()
            assert (identity.model, identity.serial, identity.firmware) == ("Acutronic ACUTROL3000", "3117", "2.4")

    virtually(main)


def test_an_interlock_fault_is_told_with_the_status_byte() -> None:
    async def main() -> None:
        async with rig("acutrol") as made:
            await made.table.enable()
            made.model.trip("z", "servo trip")
            fault = (await made.table.status("z")).fault
            assert fault == "axis z: its interlock says Fault (status byte 65, interlock summary set)"

    virtually(main)


def test_a_limit_switch_opens_the_interlock() -> None:
    async def main() -> None:
        async with rig("acutrol") as made:
            await made.table.enable()
            await made.table.jog("y", 30 * DEG, 30 * DEG)
            await asyncio.sleep(2.0)
            made.model.press_limit("y", 1)
            with pytest.raises(DeviceFault, match="axis y: its interlock says Fault"):
                await made.table.enable()
            await asyncio.sleep(1.0)
            assert made.model.at_rest()

    virtually(main)


def test_a_rate_demand_of_long_ago_does_not_move_the_table() -> None:
    async def main() -> None:
        async with rig("acutrol") as made:
            await made.table.enable()
            await made.table.jog("x", 30 * DEG, 30 * DEG)
            await asyncio.sleep(2.0)
            await made.table.abort()
            await asyncio.sleep(1.0)
            await made.table.enable()
            await asyncio.sleep(1.0)
            assert made.model.at_rest()

    virtually(main)


def test_enabling_brings_an_axis_to_rest_that_was_enabled_and_turns() -> None:
    async def main() -> None:
        async with rig("acutrol") as made:
            await made.table.enable()
            await made.table.jog("x", 30 * DEG, 30 * DEG)
            await asyncio.sleep(2.0)
            assert not made.model.at_rest()
            await made.table.enable()
            await asyncio.sleep(2.0)
            assert made.model.at_rest()
            assert (await made.table.status("x")).enabled

    virtually(main)


def test_an_axis_that_does_not_get_to_its_target_is_told() -> None:
    async def main() -> None:
        async with lone_axis(counts_per_turn=100) as (table, _):  # a step of its encoder is 3.6 deg
            await table.open()
            await table.enable()
            await table.move("x", 20 * DEG, 20 * DEG, 20 * DEG)
            await asyncio.sleep(20.0)
            with pytest.raises(DeviceRefused, match=r"axis x remains at (18.0|21.6)000 deg instead of 20.0000 deg"):
                await table.status("x")

    virtually(main)


# Late answers


@pytest.mark.parametrize("seed", range(8))
def test_every_reading_is_of_its_own_request_however_late_answers_come(seed: int) -> None:
    read, lost = read_under_lateness("acutrol", seed, 0.0)
    assert read > 60
    assert lost > 5


def test_ok_is_no_value_and_a_value_no_ok() -> None:
    assert not OK.fullmatch("12.5")
    assert not NUMBER.fullmatch("OK")
