"""One master a table: the second is refused before it writes anything, and told who the first is."""

from __future__ import annotations

import asyncio
import getpass
import json
import math
import os
import resource
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
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


needs_root = pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="only root can become another user")
STRANGER = 54321
"""Number of another user, of whom nothing else is known."""
HELD_BY_A_STRANGER = f"""
import asyncio, concurrent.futures.thread, encodings.idna, fcntl, os, pwd, sys  # while the files can be read
from drivers.links.lock import held
async def hold():
    os.setgroups([])
    os.setgid({STRANGER})
    os.setuid({STRANGER})
    async with held("table", sys.argv[1], 502, "bench of \x1b[31mothers"):
        print("held", flush=True)
        await asyncio.to_thread(sys.stdin.readline)
asyncio.run(hold())
"""


def lock_folder() -> Path:
    """Return the folder where locks are: the first that all users may write to."""
    return next(
        path for path in map(Path, ("/run/lock", "/var/lock", "/tmp")) if path.stat().st_mode & 0o1002 == 0o1002
    )


@pytest.fixture
def link_and_lock() -> Iterator[tuple[str, Path]]:
    """Return a link that nobody uses, and the file that a station locks for it, which is not there now."""
    with socket.create_server(("127.0.0.1", 0)) as table:
        port = table.getsockname()[1]
    mine = f"this%3A{port}"
    for path in lock_folder().glob(f"*{mine}*"):
        path.unlink()
    assert asyncio.run(taken(f"tcp://127.0.0.1:{port}")) == ""
    (lock,) = lock_folder().glob(f"*{mine}*")
    lock.unlink()
    yield f"tcp://127.0.0.1:{port}", lock
    for path in lock_folder().glob(f"*{mine}*"):
        path.unlink()


def as_stranger(*words: str | Path) -> None:
    """Run a command as another user, or as this one if only root could do that."""
    other = {"user": STRANGER, "group": STRANGER, "extra_groups": []} if os.geteuid() == 0 else {}
    subprocess.run(list(map(str, words)), check=True, **other)  # type: ignore[call-overload]


PLANTED = {
    "a symbolic link": lambda of, at: as_stranger("ln", "-s", of, at),
    "a symbolic link to nothing": lambda of, at: as_stranger("ln", "-s", of.with_name("missing"), at),
    "a hard link": os.link,
    "a folder": lambda of, at: as_stranger("mkdir", at),
    "a pipe": lambda of, at: as_stranger("mkfifo", at),
    "a file of another user": lambda of, at: as_stranger("cp", "/dev/null", at),
}


@pytest.mark.parametrize("what", PLANTED)
def test_what_another_user_puts_in_the_place_of_a_lock_costs_no_file_of_the_operator(
    what: str, link_and_lock: tuple[str, Path]
) -> None:
    link, lock = link_and_lock
    if "of another user" in what and os.geteuid() != 0:
        pytest.skip("only root can become another user")
    with tempfile.TemporaryDirectory(dir=lock.parent) as folder:  # on one disk with the lock, as hard links must be
        precious = Path(folder) / "precious"
        precious.write_text("calibrations of a year")
        PLANTED[what](precious, lock)
        reason = asyncio.run(taken(link))
        assert precious.read_text() == "calibrations of a year"
        assert os.listdir(folder) == ["precious"]
        if lock.is_dir():
            lock.rmdir()
        else:
            lock.unlink()
    assert str(lock) in reason
    assert "remove it" in reason
    assert asyncio.run(taken(link)) == ""


def test_a_link_is_held_where_nobody_can_write_who_holds_it(link_and_lock: tuple[str, Path]) -> None:
    link, _ = link_and_lock

    async def twice() -> str:
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))  # as on a full disk
        try:
            async with held("table", link, 502, "a test"):
                return await taken(link)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    assert f"in use by a program of {getpass.getuser()}" in asyncio.run(twice())


@needs_root
def test_two_users_are_not_master_of_one_table_and_the_second_is_told_the_first(
    link_and_lock: tuple[str, Path],
) -> None:
    link, _ = link_and_lock
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", HELD_BY_A_STRANGER, link], **pipes) as other:  # type: ignore[call-overload]
        assert other.stdout is not None
        assert other.stdout.readline() == b"held\n"
        reason = asyncio.run(taken(link))
        assert f"in use by process {other.pid} of the user with the number {STRANGER} (bench of ?[31mothers)" in reason
        other.kill()
    assert asyncio.run(taken(link)) == ""

    async def held_here() -> subprocess.CompletedProcess[str]:
        async with held("table", link, 502, "bench of root"):
            return await asyncio.to_thread(
                subprocess.run,
                [sys.executable, "-c", HELD_BY_A_STRANGER, link],
                capture_output=True,
                text=True,
                check=False,
            )

    refused = asyncio.run(held_here())
    assert f"in use by process {os.getpid()} of root (bench of root)" in refused.stderr
    assert "held" not in refused.stdout


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
            assert "axis z is enabled and turns at 5.00 deg/s, but this station does not" in refused.verdict.reason
            assert not opened.at_rest()
            await Session(opened, script, tmp_path / "2.h5", RunOptions(reset_fault=True)).run()
            assert opened.at_rest()
            with pytest.raises(DeviceError):
                await table.read("z")  # closed

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(look())


WORDS = {"turns": "does not drive it: another master does", "tells": "received a command from another master"}


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
