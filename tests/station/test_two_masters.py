"""One master a table: the second is refused before it writes anything, and told who the first is."""

from __future__ import annotations

import asyncio
import json
import math
import os
import socket
import subprocess
import sys
from contextlib import AsyncExitStack
from pathlib import Path

import pytest
from support import TwinProcess, station

from drivers.errors import DeviceError, DeviceRefused
from drivers.links.lock import held
from drivers.specs import TableSetup
from drivers.tables.modbus.table import ModbusTable
from station.bench.bench import load_bench
from station.cli import main
from station.opening import open_bench, with_links
from station.run.event_loop.loops import ScaledLoop, VirtualLoop
from station.run.session import RunOptions, Session
from station.scripts.script import Rest, Script

pytestmark = pytest.mark.skipif(os.name != "posix", reason="locks by flock are POSIX only")
BENCHES = Path(__file__).parents[1] / "data" / "benches"
KINDS = ("rtu_stim300", "galil_xsens", "acutrol_vectornav")
HOLDER = """
import asyncio, sys
from drivers.links.lock import held
async def hold():
    async with held("table", sys.argv[1], 502, "bench of the others"):
        print("held", flush=True)
        await asyncio.to_thread(sys.stdin.readline)
asyncio.run(hold())
"""


async def taken(link: str) -> str:
    """Return why a link cannot be held, empty if it can."""
    try:
        async with held("table", link, 502, "a test"):
            return ""
    except DeviceRefused as error:
        return error.message


def test_a_link_is_one_by_whatever_name_and_free_once_its_holder_is_killed(tmp_path: Path) -> None:
    (tmp_path / "tty").symlink_to("/dev/null")
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, "tcp://localhost:50299"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"held\n"
        for same in (
            "tcp://127.0.0.1:50299",
            "socket://127.0.0.1:50299",
            "tcp://0.0.0.0:50299",
            "tcp://LOCALHOST:50299",
        ):
            reason = asyncio.run(taken(same))
            assert f"in use by process {other.pid} of " in reason
            assert "bench of the others" in reason
        assert asyncio.run(taken("tcp://127.0.0.1:50298")) == ""
        other.kill()
    assert asyncio.run(taken("tcp://127.0.0.1:50299")) == ""

    async def by_device() -> str:
        async with held("table", f"serial://{tmp_path / 'tty'}?baud=115200", None, "this test"):
            return await taken("serial:///dev/null")

    assert "this test" in asyncio.run(by_device())
    assert asyncio.run(taken("serial:///dev/null")) == ""


@pytest.mark.parametrize("kind", KINDS)
def test_whoever_comes_second_is_refused_by_every_command_before_anything_is_sent(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as table:
        table.setblocking(False)
        link = f"tcp://127.0.0.1:{table.getsockname()[1]}"

        async def hold() -> AsyncExitStack:
            async with AsyncExitStack() as stack:
                bench = with_links(load_bench(BENCHES / f"{kind}.toml"), {"table": link}, [])
                await stack.enter_async_context(open_bench(bench))
                return stack.pop_all()

        with asyncio.Runner(loop_factory=ScaledLoop) as runner:
            first = runner.run(hold())
            bench = str(BENCHES / f"{kind}.toml")
            for words in (["run", "-o", str(tmp_path / "r.h5")], ["check"]):
                place = ["--bench", bench] if words[0] == "run" else [bench]
                assert main([*words, *place, "--link", f"table={link}", "--json"]) == 4
                reason = json.loads(capsys.readouterr().out)["reason"]
                assert f"in use by process {os.getpid()} of" in reason
                assert load_bench(Path(bench)).name in reason
            runner.run(first.aclose())
        with pytest.raises(BlockingIOError):
            table.accept()  # nobody came
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", KINDS)
def test_a_table_that_turns_at_first_contact_is_left_alone_unless_it_is_taken_over(kind: str, tmp_path: Path) -> None:
    bench = load_bench(BENCHES / f"{kind}.toml")

    async def look() -> None:
        async with open_bench(bench) as opened:
            table = opened.table
            await table.open()
            await table.enable()
            await table.jog("z", math.radians(5.0), math.radians(20.0))
            await asyncio.sleep(1.0)
            table.close()
            script = Script("rest", (Rest(0.5),))
            refused = await Session(opened, script, tmp_path / "1.h5").run()
            assert str(refused.verdict.outcome) == "FAULT"
            assert "axis z is enabled and turns at 5.00 deg/s, and not by this station" in refused.verdict.reason
            assert not opened.at_rest()
            await Session(opened, script, tmp_path / "2.h5", RunOptions(reset_fault=True)).run()
            assert opened.at_rest()
            with pytest.raises(DeviceError):
                await table.read("z")  # closed

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(look())


WORDS = {"turns": "by this station: another master commands it", "tells": "was told something by another master"}


@pytest.mark.parametrize(
    "other_does",
    [pytest.param("turns", marks=pytest.mark.full), "tells", pytest.param("stands", marks=pytest.mark.full)],
)
def test_check_names_a_master_that_commands_the_table(other_does: str) -> None:
    bench = BENCHES / "two_triads.toml"

    async def main(link: str) -> list[str]:
        host, _, port = link.removeprefix("tcp://").partition(":")
        config = load_bench(bench).table
        setup = TableSetup(config.axes, config.timeout_s, config.options)
        other = ModbusTable(setup, (host, int(port)))
        await other.open()
        await other.enable()

        async def command() -> None:
            await other.jog("z", math.radians(5.0), math.radians(20.0))
            while other_does == "tells":
                for angle_deg in (0.0, 0.01):
                    await other.move("z", math.radians(angle_deg), math.radians(1.0), math.radians(20.0))
                    await asyncio.sleep(0.1)

        commanding = asyncio.ensure_future(command() if other_does != "stands" else asyncio.sleep(0))
        checked = await asyncio.to_thread(
            station, "check", bench, "--link", f"table={link}", "--json", "--device", "first"
        )
        commanding.cancel()
        await other.stop()
        other.close()
        return list(json.loads(checked.stdout)["devices"][0]["wrong"])

    with TwinProcess("--bench", bench) as twin:
        wrong = asyncio.run(main(twin.links["table"]))
    assert WORDS.get(other_does, "") in " ".join(wrong)
    assert wrong or other_does == "stands"
