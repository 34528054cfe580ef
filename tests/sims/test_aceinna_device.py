"""The Aceinna twin answers requests as SAE J1939-21 has it, and refuses what it does not know."""

from __future__ import annotations

import json
from pathlib import Path

import can
import numpy as np
import pytest

from sims.imus.aceinna import AceinnaDevice
from sims.physics.body import Body
from sims.physics.geometry import MOUNTS_DEG, mounted
from sims.physics.gyro import GyroArray, GyroTruth
from sims.wires.frames import ImuTwinSetup

VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "j1939_requests.json").read_text())["vectors"]


class Bus:
    """Keeps what is sent."""

    def __init__(self) -> None:
        self.sent: list[list[str]] = []

    def send(self, msg: can.Message) -> None:
        self.sent.append([f"{msg.arbitration_id:08X}", bytes(msg.data).hex().upper()])


@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: vector["why"])
def test_a_request_is_answered_or_refused(vector: dict[str, str]) -> None:
    body = Body(gimbals="z", angles=lambda _axis, t: 0.0 * t, revision=lambda: 0, latitude_rad=0.0, heading_rad=0.0)
    none = np.zeros(3)
    gyros = GyroArray(
        mounting=mounted(MOUNTS_DEG["triad"]),
        truth=GyroTruth(none, none, none, none, 0.0, 0.0),
        body=body,
        rate_hz=100.0,
        seed=(1,),
    )
    bus = Bus()
    data = bytes.fromhex(vector["data"])
    AceinnaDevice(
        ImuTwinSetup(gyros=gyros, rate_hz=100.0, options={"model": "openimu300ri", "address": 0x80}), bus
    ).received(can.Message(arbitration_id=int(vector["id"], 16), is_extended_id=True, data=data))
    assert bus.sent == vector["answers"]
