"""The Ideal Aerosmith language as far as public programs show it; experimental, like the driver."""

from __future__ import annotations

import asyncio
import json
import random
from pathlib import Path

import pytest
from hypothesis import given, settings, strategies as st
from setups import twin_on
from turntable_rigs import DEG, MAX_RATE, rig, settle, virtually

from drivers.errors import DeviceRefused, LinkLost
from drivers.tables.aerosmith import table as aerosmith
from drivers.tables.aerosmith.table import NUMBER, AerosmithFraming
from sims.physics.table import AxisData, TableModel
from sims.tables.aerosmith_controller import STA_FAULT, STA_SERVO_OFF, AerosmithController

VECTORS = {
    vector["tx"]: vector
    for vector in json.loads(
        Path(__file__).parent.parent.joinpath("vectors/turntable_transcripts.json").read_text("utf-8")
    )["vectors"]
    if vector["protocol"] == "Ideal Aerosmith ATL"
}


def twin_at_rest() -> tuple[AerosmithController, list[bytes], TableModel]:
    written: list[bytes] = []
    model = TableModel({"x": AxisData(MAX_RATE, 50 * DEG, 3_600_000)}, lambda: 0.0)
    return twin_on("aerosmith", model, written.append, {"x": ""}), written, model


def say(controller: AerosmithController, written: list[bytes], line: str) -> str:
    del written[:]
    controller.received(line.encode() + b"\r")
    return b"".join(written).decode()


def test_the_driver_says_that_it_is_experimental() -> None:
    assert aerosmith.__doc__ is not None
    assert aerosmith.__doc__.startswith("EXPERIMENTAL")


@pytest.mark.parametrize("tx", sorted(VECTORS))
def test_each_transcript_decodes_to_what_it_says(tx: str) -> None:
    framing, vector = AerosmithFraming(0.03), VECTORS[tx]
    assert framing.request(tx) == tx.encode() + b"\r"
    received = vector["rx"].split(" (")[0].replace("<value>", "-12.5").encode()
    answer = framing.answer(tx, received)
    assert answer is not None
    assert answer.length == len(received)
    assert answer.refused == ("error" in vector["decoded"])
    if tx == "PPO":
        assert answer.text == "-12.5"
    elif not answer.refused:
        assert answer.text == ""


@pytest.mark.parametrize("text", ["12.5", "PPO12.5", "PPO 12.5", "+12.50"])
def test_a_value_may_be_told_with_its_command(text: str) -> None:
    found = NUMBER.fullmatch(text)
    assert found is not None
    assert float(found[1]) == 12.5


def test_the_twin_answers_as_the_transcripts_do() -> None:
    controller, written, _ = twin_at_rest()
    assert say(controller, written, "PPO") == "0.0000\r\n>"
    assert say(controller, written, "STO") == VECTORS["STO"]["rx"]
    assert "?" in say(controller, written, "BAD")
    assert say(controller, written, "SRV1") == ">"
    assert say(controller, written, "JOG60") == ""  # the prompt is held back
    assert say(controller, written, "STO").startswith(VECTORS["JOG60"]["rx"].split(" (")[0])


def test_what_a_table_without_power_is_told_it_refuses() -> None:
    controller, written, model = twin_at_rest()
    for line in ("JOG10", "MOV10", "HOM", "RMO5"):
        assert "?" in say(controller, written, line)
    assert say(controller, written, "STA") == f"{STA_SERVO_OFF}\r\n>"
    assert model.at_rest()


@given(noise=st.binary(max_size=60))
@settings(max_examples=200, deadline=None)
def test_framing_of_any_bytes_never_raises(noise: bytes) -> None:
    framing = AerosmithFraming(0.03)
    answer = framing.answer("PPO", noise)
    assert answer is None or 0 < answer.length <= len(noise)
    framing.token().find(noise)


def feed_noise(count: int) -> None:
    dice = random.Random(7)
    controller, written, _ = twin_at_rest()
    for _ in range(count // 1000):
        controller.received(dice.randbytes(1000))
        del written[:]
    assert len(controller._line) <= 80
    controller.received(b"\r")
    assert say(controller, written, "PPO").endswith("0.0000\r\n>")


def test_noise_does_not_trouble_the_twin() -> None:
    feed_noise(200_000)


@pytest.mark.full
def test_much_noise_does_not_trouble_the_twin() -> None:
    feed_noise(10_000_000)


def test_the_prompt_that_a_jog_holds_back_answers_nothing_else() -> None:
    async def main() -> None:
        async with rig("aerosmith") as made:
            await made.table.enable()
            await made.table.jog("x", 10 * DEG, 20 * DEG)
            await asyncio.sleep(2.0)
            for _ in range(20):
                state = await made.table.read("x")
                truth = made.model.motion["x"].at(state.angle_t_ns * 1e-9)[0] - made.model._zero["x"]
                assert state.angle_rad / DEG == pytest.approx(truth / DEG, abs=2e-4)
            assert made.table.counts.malformed == 0

    virtually(main)


def test_a_fault_is_told_only_where_its_bits_are_known() -> None:
    async def main() -> None:
        async with rig("aerosmith") as made:
            await made.table.enable()
            made.model.trip("x", "servo trip")
            status = await made.table.status("x")
            assert status.fault == (
                f"axis x reports a fault (STA {STA_FAULT + STA_SERVO_OFF}, where {STA_FAULT} means fault)"
            )
            assert "experimental" in status.text
            made.table._fault_mask = 0
            assert (await made.table.status("x")).fault == ""

    virtually(main)


def test_a_refused_motion_is_told() -> None:
    async def main() -> None:
        async with rig("aerosmith") as made:
            with pytest.raises(DeviceRefused, match=r"axis x refuses 'MOV10.0000'"):
                await made.table.move("x", 10 * DEG, 20 * DEG, 20 * DEG)

    virtually(main)


def test_a_table_that_was_silent_for_a_while_is_in_step_again() -> None:
    async def main() -> None:
        async with rig("aerosmith") as made:
            await made.table.enable()
            await made.table.home()
            await made.table.move("x", 30 * DEG, 20 * DEG, 20 * DEG)
            await settle(made.table, "x")
            await made.silence()
            with pytest.raises(LinkLost):
                await made.table.read("x")
            made.speak()
            assert (await made.table.read("x")).angle_rad / DEG == pytest.approx(30.0, abs=1e-3)

    virtually(main)


def test_ramps_and_rates_are_whole_numbers() -> None:
    async def main() -> None:
        async with rig("aerosmith") as made:
            await made.table.enable()
            with pytest.raises(DeviceRefused, match="slowest ramp of this controller is 1 deg/s2"):
                await made.table.jog("x", 10 * DEG, 0.5 * DEG)
            with pytest.raises(DeviceRefused, match=r"only accepts whole deg/s, not 10.5"):
                await made.table.move("x", 10 * DEG, 10.5 * DEG, 5 * DEG)
            assert made.model.at_rest()

    virtually(main)
