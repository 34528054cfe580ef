"""The VN-100 twin, spoken to in sentences: what it answers, what it refuses, and what it sends by itself."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import numpy as np
import pytest

from drivers.imus.vectornav.codec import Frames, Sentence, VectorNavDecoder, encode_sentence
from sims.imus.vectornav import VectorNavDevice
from sims.physics.body import Body
from sims.physics.geometry import along
from sims.physics.gyro import GyroArray, GyroTruth
from sims.wires.frames import ImuTwinSetup
from station.run.event_loop.loops import VirtualLoop

REQUESTS = json.loads((Path(__file__).parents[1] / "vectors" / "vectornav_requests.json").read_text())["vectors"]
RATES_RPS = np.array([0.1, -0.2, 0.3])
UP = np.array([0.0, -0.6, -0.8])  # it hangs, turned about x


class Talk:
    """A twin, and what it has sent."""

    def __init__(self, rate_hz: float = 800) -> None:
        body = Body(
            gimbals="z",
            angles=lambda _axis, t: 0.0 * t,
            revision=lambda: 0,
            latitude_rad=0.0,
            heading_rad=0.0,
            earth_turns=False,
        )
        none = np.zeros(3)
        truth = GyroTruth(none, -RATES_RPS, none, none, 0.0, 0.0, warming_c=0.0)
        gyros = GyroArray(
            mounting=along([[1, 0, 0], [0, 1, 0], [0, 0, 1]]), truth=truth, body=body, rate_hz=rate_hz, seed=(1,)
        )
        self.sent = bytearray()
        up = np.tile(UP, (100, 1))
        self.device = VectorNavDevice(
            ImuTwinSetup(gyros=gyros, rate_hz=rate_hz, up=lambda t: up[: len(t)]), self.sent.extend, baud=115200
        )

    def heard(self) -> list[Sentence | Frames]:
        """Return what it has sent since the last time."""
        data = bytes(self.sent)
        self.sent.clear()
        return VectorNavDecoder().feed(data)

    def said(self, commands: str) -> list[str]:
        """Return what it answers to commands, one a line, without check."""
        self.device.received(b"".join(f"${command}*XX\r\n".encode() for command in commands.splitlines()))
        return [item.text for item in self.heard() if isinstance(item, Sentence)]


def streamed(commands: str, duration_s: float, rate_hz: float = 800) -> list[Sentence | Frames]:
    """Return what it sends of itself after these commands, in the order sent."""
    talk = Talk(rate_hz)
    talk.said(commands)

    async def serve() -> None:
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(duration_s + 0.001):
                await talk.device.serve()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(serve())
    return talk.heard()


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        ("VNRRG,1", "VNRRG,01,VN-100S-CR"),
        ("VNRRG,02", "VNRRG,02,7"),
        ("VNRRG,03", "VNRRG,03,0100012345"),
        ("VNRRG,04", "VNRRG,04,2.1.0.0"),
        ("VNRRG,05", "VNRRG,05,115200"),
        ("VNRRG,06", "VNRRG,06,14"),
        ("VNRRG,07", "VNRRG,07,40"),
        ("VNRRG,76", "VNRRG,76,0,1,01,0001"),
        ("VNRRG,19", "VNRRG,19,+00.000000,+00.000000,+00.000000"),
        ("VNWRG,07,50", "VNWRG,07,50"),
        ("VNWRG,07,100", "VNERR,0C"),
        ("VNWRG,75,1,16,15,0001,000C,0014", "VNWRG,75,1,16,15,0001,000C,0014"),
        ("VNASY,0", "VNASY,0"),
        ("VNWNV", "VNWNV"),
        ("VNRST", "VNRST"),
        ("VNRFS", "VNRFS"),
        ("VNXYZ", "VNERR,04"),
        ("VNRRG", "VNERR,05"),
        ("VNASY", "VNERR,05"),
        ("VNWRG", "VNERR,05"),
        ("VNWRG,06", "VNERR,05"),
        ("VNWRG,75,1,8", "VNERR,05"),
        ("VNWRG,75,1,8,05,0001", "VNERR,05"),
        ("VNRRG,01,2", "VNERR,06"),
        ("VNWRG,07,40,1,1", "VNERR,06"),
        ("VNWRG,75,1,8,01,0001,0001", "VNERR,06"),
        ("VNRRG,x", "VNERR,07"),
        ("VNASY,2", "VNERR,07"),
        ("VNWRG,05,12345", "VNERR,07"),
        ("VNWRG,06,77", "VNERR,07"),
        ("VNWRG,07,300", "VNERR,07"),
        ("VNWRG,75,4,8,01,0001", "VNERR,07"),
        ("VNWRG,75,1,8,zz,0001", "VNERR,07"),
        ("VNWRG,75,1,8,08,0001", "VNERR,07"),
        ("VNWRG,75,1,8,02,8000", "VNERR,07"),
        ("VNRRG,999", "VNERR,08"),
        ("VNWRG,999,1", "VNERR,08"),
        ("VNWRG,03,1", "VNERR,09"),
        ("VNWRG,54,1", "VNERR,09"),
        ("VNWRG,75,1,1,05,0001,001C", "VNERR,0C"),
    ],
)
def test_each_command_has_its_reply(command: str, reply: str) -> None:
    assert Talk().said(command) == [reply]


def test_a_command_with_a_wrong_check_is_refused() -> None:
    talk = Talk()
    talk.device.received(b"$VNRRG,8*4C\r\n")
    assert bytes(talk.sent) == b"$VNERR,03*72\r\n"


def test_what_is_refused_changes_nothing() -> None:
    commands = "VNWRG,75,1,8,01,0001\nVNWRG,75,1,1,05,0001,001C\nVNRRG,75\nVNWRG,05,9600\nVNRRG,05"
    assert Talk().said(commands)[1:] == ["VNERR,0C", "VNRRG,75,1,8,01,0001", "VNERR,0C", "VNRRG,05,115200"]


def test_settings_outlast_a_reset_only_in_flash() -> None:
    talk = Talk()
    assert talk.said("VNWRG,07,50\nVNRST\nVNRRG,07")[-1] == "VNRRG,07,40"
    assert talk.said("VNWRG,07,50\nVNWNV\nVNRST\nVNRRG,07")[-1] == "VNRRG,07,50"
    assert talk.said("VNRFS\nVNRRG,07")[-1] == "VNRRG,07,40"


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (1, "VNYPR,+000.000,+000.000,+036.870"),
        (10, "VNMAG,+00.2200,+00.0000,+00.4300"),
        (11, "VNACC,+00.000,-05.884,-07.845"),
        (12, "VNGYR,+00.100000,-00.200000,+00.300000"),
        (
            14,
            "VNYMR,+000.000,+000.000,+036.870,+00.2200,+00.0000,+00.4300,+00.000,-05.884,-07.845,"
            "+00.100000,-00.200000,+00.300000",
        ),
        (
            19,
            "VNIMU,+00.2200,+00.0000,+00.4300,+00.000,-05.884,-07.845,+00.100000,-00.200000,+00.300000,+25.0,+101.325",
        ),
    ],
)
def test_every_kind_of_sentence_is_sent_at_its_rate(kind: int, text: str) -> None:
    found = streamed(f"VNWRG,06,{kind}\nVNWRG,07,50", 1.0)
    assert [item.text for item in found if isinstance(item, Sentence)] == 50 * [text]


def test_as_delivered_it_sends_vnymr_at_40_hz_until_paused() -> None:
    found = streamed("", 1.0)
    assert len(found) == 40
    assert {item.header for item in found if isinstance(item, Sentence)} == {"VNYMR"}
    assert streamed("VNASY,0", 1.0) == []
    assert len(streamed("VNASY,0\nVNASY,1", 1.0)) == 40


def test_frames_of_two_registers_and_sentences_come_in_the_order_of_their_instants() -> None:
    found = streamed("VNWRG,75,1,8,05,0001,0018\nVNWRG,76,3,16,11,0220,0002\nVNWRG,77,2,8,01,0001\nVNWRG,06,12", 1.0)
    first = [item for item in found if isinstance(item, Frames) and item.layout.masks == ((0, 1), (2, 0x18))]
    second = [item for item in found if isinstance(item, Frames) and item.layout.masks == ((0, 0x220), (4, 2))]
    assert sum(len(item.values) for item in first) == 100
    assert sum(len(item.values) for item in second) == 50
    assert len([item for item in found if isinstance(item, Sentence)]) == 40
    assert len(found) == len(first) + len(second) + 40
    stamps = np.concatenate([item.values["common.time_startup"] for item in first])
    np.testing.assert_array_equal(np.diff(stamps), 10_000_000)
    for item in first:
        np.testing.assert_array_equal(item.values["imu.uncomp_gyro"], np.float32(len(item.values) * [RATES_RPS]))
        np.testing.assert_array_equal(item.values["imu.temperature"], np.float32(25.0))
    for item in second:
        np.testing.assert_array_equal(item.values["common.angular_rate"][0], np.float32(RATES_RPS))
        np.testing.assert_array_equal(item.values["common.uncomp_accel_gyro"][0, 3:], np.float32(RATES_RPS))
        np.testing.assert_allclose(item.values["attitude.yaw_pitch_roll"][0], [0, 0, 36.8699], atol=1e-3)


def test_output_faster_than_the_gyros_repeats_their_last() -> None:
    found = streamed("VNWRG,06,0\nVNWRG,75,1,4,05,0001,0008", 1.0, rate_hz=100)
    (frames,) = [item for item in found if isinstance(item, Frames)]
    assert len(frames.values) == 200
    np.testing.assert_array_equal(np.diff(frames.values["common.time_startup"]), 5_000_000)


def test_gyros_at_a_rate_that_does_not_divide_are_refused() -> None:
    with pytest.raises(ValueError, match="not at 300 Hz"):
        Talk(300)


def test_commands_may_come_byte_by_byte() -> None:
    talk = Talk()
    for byte in encode_sentence(Sentence("VNRRG", ("03",)), "crc"):
        talk.device.received(bytes([byte]))
    assert talk.heard() == [Sentence("VNRRG", ("03", "0100012345"))]


@pytest.mark.parametrize("vector", REQUESTS, ids=lambda vector: vector["why"])
def test_what_programs_write_at_a_start_is_answered_as_the_device_does(vector: dict[str, str]) -> None:
    talk = Talk()
    talk.device.received(vector["send"].encode() + b"\r\n")
    assert bytes(talk.sent).decode() == vector["expect"] + "\r\n"


def test_a_binary_output_without_groups_is_off() -> None:
    on = "VNWRG,06,0\nVNWRG,75,1,8,01,0001\n"
    assert len(streamed(on, 0.1))
    assert not streamed(on + "VNWRG,75,0,8,00", 0.1)
    assert not streamed(on + "VNWRG,75,1,8,0", 0.1)


def test_settings_of_every_register_outlast_a_reset_in_flash() -> None:
    talk = Talk()
    assert talk.said("VNWRG,00,TABLE 7\nVNWRG,35,1,0,1,1\nVNWNV\nVNRST\nVNRRG,00\nVNRRG,35")[-2:] == [
        "VNRRG,00,TABLE 7",
        "VNRRG,35,1,0,1,1",
    ]
    assert talk.said("VNRFS\nVNRRG,35")[-1] == "VNRRG,35,1,1,1,1"


def test_a_binary_output_that_is_not_sent_by_itself_can_be_polled() -> None:
    talk = Talk()
    talk.said("VNWRG,76,0,8,04,0008")
    talk.device.received(b"$VNBOM,2*XX\r\n")
    (frames,) = talk.heard()
    assert isinstance(frames, Frames)
    assert frames.values.dtype.names == ("header", "imu.uncomp_gyro", "crc")
    assert talk.said("VNWRG,76,0,8,00\nVNBOM,2")[-1] == "VNERR,07"


def test_a_gyro_calibration_changes_the_compensated_rates_alone() -> None:
    both = "VNWRG,06,0\nVNWRG,75,1,8,05,0020,0008"
    calibrated = "VNWRG,84,2,0,0,0,1,0.5,0,0,1,0.01,0,0\n" + both
    (before,), (after,) = streamed(both, 0.02), streamed(calibrated, 0.02)
    assert isinstance(before, Frames)
    assert isinstance(after, Frames)
    np.testing.assert_array_equal(before.values["common.angular_rate"], before.values["imu.uncomp_gyro"])
    np.testing.assert_array_equal(after.values["imu.uncomp_gyro"], before.values["imu.uncomp_gyro"])
    x, y, z = (after.values["imu.uncomp_gyro"] - [0.01, 0.0, 0.0]).T
    expected = np.column_stack([2 * x, y + 0.5 * z, z])
    np.testing.assert_allclose(after.values["common.angular_rate"], expected, atol=1e-6)
