"""Golden transcripts, each with its source: what our drivers send and our twins answer, byte by byte."""

from __future__ import annotations

import asyncio
import tomllib
from pathlib import Path
from typing import Any

import pytest
import turntable_rigs
from setups import twin_on
from turntable_rigs import COUNTS, DEG, LIMITS, MAX_RATE, rig, virtually

from drivers.tables.galil.language import GalilFraming
from sims.physics.table import AxisData, TableModel

VECTORS = Path(__file__).parents[1] / "vectors"
GOLDEN = {kind: tomllib.loads((VECTORS / f"golden_{kind}.toml").read_text()) for kind in ("galil", "acutrol")}
PREFIX = {"galil": 0, "acutrol": 8}
ADDRESSES: dict[str, dict[str, Any]] = {"galil": {"x": "A", "y": "B", "z": "C"}, "acutrol": {"x": 1, "y": 2, "z": 3}}
kinds = pytest.mark.parametrize("kind", GOLDEN)


@kinds
def test_the_twin_answers_as_the_sources_do(kind: str) -> None:
    written: list[bytes] = []
    model = TableModel(
        {axis: AxisData(MAX_RATE, LIMITS.acceleration_rps2, COUNTS[kind]) for axis in "xyz"}, lambda: 0.0
    )
    twin = twin_on(kind, model, lambda data: written.append(data[PREFIX[kind] :]), ADDRESSES[kind])
    twin.received(b"LZ0\r" if kind == "galil" else b"\r\n")
    for example in GOLDEN[kind]["example"]:
        del written[:]
        twin.received(example["to"].encode())
        assert b"".join(written).decode() == example["from"], example


def test_the_driver_understands_what_a_galil_answers_in_the_manuals() -> None:
    for example in GOLDEN["galil"]["example"]:
        answer = GalilFraming().answer(example["to"][:-1], example["from"].encode())
        assert answer is not None
        assert (answer.refused, answer.length) == (example["from"] == "?", len(example["from"])), example
        assert example["from"].startswith(answer.text)


@kinds
def test_driver_and_twin_say_what_is_written(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[list[str]] = []
    made = turntable_rigs.byte_pair

    def tapped(kind: str, link: Any, model: Any, write: Any, axes: str, **twin: Any) -> Any:
        def answered(data: bytes) -> None:
            said[-1][1] += data[PREFIX[kind] :].decode()
            write(data)

        table, controller = made(kind, link, model, answered, axes, **twin)
        received = controller.received

        def asked(data: bytes) -> None:
            said.append([data.decode(), ""])
            received(data)

        controller.received = asked  # type: ignore[method-assign]
        return table, controller

    monkeypatch.setattr(turntable_rigs, "byte_pair", tapped)

    async def main() -> None:
        async with rig(kind) as joined:
            table = joined.table
            given: dict[str, Any] = {"jog": ("x", 20 * DEG, 40 * DEG), "read": ("x",), "status": ("x",)}
            golden = {session["does"]: session["said"] for session in GOLDEN[kind]["session"]}
            for does in ("identify", "enable", "jog", "read", "status", "stop", "disable"):
                del said[:]
                await getattr(table, does)(*given.get(does, ()))
                if does in golden:
                    assert said[: len(golden[does])] == golden[does], does
                    assert does in ("jog", "stop") or len(said) == len(golden[does])
                if does == "jog":
                    await asyncio.sleep(1.0)

    virtually(main)
