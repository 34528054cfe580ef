"""The Galil twin answers as a controller does the programs that open it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sims.physics.table import AxisData, TableModel
from sims.tables.galil_controller import GalilController
from sims.tables.registry import TableTwinSetup

VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "galil_exchanges.json").read_text())["vectors"]


def controller() -> tuple[GalilController, list[bytes]]:
    said: list[bytes] = []
    data = AxisData(1.0, 1.0, 1000)
    return GalilController(
        TableTwinSetup(
            TableModel({"x": data, "y": data}, lambda: 0.0), {"x": "A", "y": "B"}, {"velocity_window": 0.25}, 0.0
        ),
        said.append,
    ), said


@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: vector["why"])
def test_an_exchange_is_that_of_the_manual(vector: dict[str, str]) -> None:
    galil, said = controller()
    galil.received(vector["send"].encode())
    assert b"".join(said).decode() == vector["expect"]


def test_a_semicolon_is_obeyed_when_it_comes() -> None:
    galil, said = controller()
    galil.received(b"TPA")
    assert not said
    galil.received(b";")
    assert said == [b" 0\r\n:"]


def test_the_status_byte_says_that_echo_is_on() -> None:
    galil, said = controller()
    galil.received(b"EO 1\r")
    said.clear()
    galil.received(b"TB\r")
    assert b"".join(said) == b"TB\r\n 1\r\n:"


def test_handles_are_told_line_by_line() -> None:
    galil, said = controller()
    galil.received(b"TH\r")
    first, *handles = b"".join(said).decode().removesuffix("\r\n:").split("\r\n")
    assert first.startswith("CONTROLLER IP ADDRESS ")
    assert [line[:3] for line in handles] == ["IHA", "IHB", "IHC", "IHD", "IHE", "IHF", "IHG", "IHH"]
