"""What becomes of the table when the station is killed: a guard process stops it and takes its power off."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import guard as bench
import pytest
from support import command

from station.bench.bench import load_bench
from station.opening import open_bench, with_links
from station.run.event_loop.loops import ScaledLoop
from station.run.guard.guard import Guard, guard_log_of

pytestmark = pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="looks for guards in /proc")


def killed(protocol: str, folder: Path, after_s: float = 0.3, *, how: str = "process") -> bench.Kill:
    async def main() -> bench.Kill:
        async with bench.twin_table(protocol, folder, 0.0) as table:
            return await bench.kill_once(protocol, table, folder, after_s, how=how)

    with asyncio.Runner(loop_factory=ScaledLoop) as runner:
        return runner.run(main())


@pytest.mark.parametrize(
    ("protocol", "how"), [("modbus", "stopped"), ("rtu", "group"), ("galil", "held"), ("acutrol", "forked")]
)
def test_a_table_whose_station_is_killed_in_motion_is_stopped_and_switched_off(
    protocol: str, how: str, tmp_path: Path
) -> None:
    kill = killed(protocol, tmp_path, how=how)
    assert kill.good, kill
    assert "the table is at rest, its power off" in kill.log
    assert kill.guard_mb < 30
    assert kill.guard_cpu_s < 1.5  # all of it for its start


@pytest.mark.parametrize("link", [os.symlink, os.link], ids=["symbolic", "hard"])
def test_a_guard_does_not_write_through_a_link_that_another_user_made(
    link: Callable[[Path, Path], None], tmp_path: Path
) -> None:
    precious = tmp_path / "precious"
    precious.write_text("calibrations of a year")
    link(precious, guard_log_of(tmp_path / "run.h5"))

    async def main() -> bench.Kill:
        async with bench.twin_table("modbus", tmp_path, 0.0) as table:
            return await bench.kill_once("modbus", table, tmp_path, 0.0, recording=tmp_path / "run.h5")

    with asyncio.Runner(loop_factory=ScaledLoop) as runner:
        kill = runner.run(main())
    assert kill.good, kill
    assert precious.read_text() == "calibrations of a year"


@pytest.mark.full
@pytest.mark.parametrize("protocol", ["modbus", "rtu", "galil", "acutrol", "aerosmith", "numbered"])
@pytest.mark.parametrize(("after_s", "how"), [(0.0, "process"), (3.3, "group"), (8.1, "hosted")])
def test_on_every_protocol_and_for_a_plugin(protocol: str, after_s: float, how: str, tmp_path: Path) -> None:
    kill = killed(protocol, tmp_path, after_s, how=how)
    assert kill.good, kill


@dataclass
class OneAtATime:
    """A controller's TCP port that takes one connection, and turns others away until 0.3 s after that has ended."""

    host: str
    port: int
    busy: bool = False
    turned_away: int = 0

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self.busy:
            self.turned_away += 1
            writer.close()
            return
        self.busy = True
        there, back = await asyncio.open_connection(self.host, self.port)
        answers = asyncio.ensure_future(self._pass_on(there, writer))
        await self._pass_on(reader, back)
        answers.cancel()
        back.close()
        writer.close()
        await asyncio.sleep(0.3)
        self.busy = False

    async def _pass_on(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError):
            while data := await reader.read(4096):
                writer.write(data)


@pytest.mark.full
@pytest.mark.parametrize("protocol", ["modbus", "acutrol"])
def test_a_controller_that_takes_one_connection_is_asked_until_it_is_free(protocol: str, tmp_path: Path) -> None:
    async def main() -> tuple[bench.Kill, int]:
        async with bench.twin_table(protocol, tmp_path, 0.0) as table:
            host, port = table.links["table"].removeprefix("tcp://").split(":")
            controller = OneAtATime(host, int(port))
            async with await asyncio.start_server(controller.serve, host, 0) as server:
                table.links["table"] = f"tcp://{host}:{server.sockets[0].getsockname()[1]}"
                kill = await bench.kill_once(protocol, table, tmp_path, 2.0)
                return kill, controller.turned_away

    with asyncio.Runner(loop_factory=ScaledLoop) as runner:
        kill, turned_away = runner.run(main())
    assert kill.rest_s <= kill.limit_s
    assert turned_away


@pytest.mark.full
@pytest.mark.parametrize("protocol", ["modbus", "rtu", "galil", "acutrol"])
def test_the_watchdog_of_a_drive_stops_it_without_a_guard(protocol: str, tmp_path: Path) -> None:
    async def main(watchdog_s: float) -> bench.Kill:
        async with bench.twin_table(protocol, tmp_path, watchdog_s) as table:
            return await bench.kill_once(protocol, table, tmp_path, 4.0, guarded=False, watchdog_s=watchdog_s)

    with asyncio.Runner(loop_factory=ScaledLoop) as runner:
        kill = runner.run(main(1.0))
    assert kill.good, kill
    assert kill.log == ""


def test_a_guard_that_is_killed_is_told_and_another_takes_its_place(tmp_path: Path) -> None:
    async def main() -> str:
        async with bench.twin_table("galil", tmp_path, 0.0) as table:
            script = tmp_path / "script.toml"
            script.write_text(bench.script_of("z", 30.0))
            links = [word for name, link in table.links.items() for word in ("--link", f"{name}={link}")]
            run = await asyncio.create_subprocess_exec(
                *command("run", "--bench", table.bench, *links, "--script", script, "-o", tmp_path / "r.h5", "--json"),
                stdout=asyncio.subprocess.PIPE,
                stderr=asyncio.subprocess.PIPE,
            )
            while not table.turning():
                assert run.returncode is None
                await asyncio.sleep(0.01)
            (first,) = bench.guards_of(run.pid)
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                os.kill(first, number)  # none of which ends it
            await asyncio.sleep(0.1)
            assert bench.guards_of(run.pid) == [first]
            os.kill(first, signal.SIGKILL)
            while not (found := [pid for pid in bench.guards_of(run.pid) if pid != first]):
                await asyncio.sleep(0.01)
            (second,) = found
            await asyncio.sleep(0.2)
            assert table.turning()  # the run goes on
            run.send_signal(signal.SIGINT)
            _, said = await run.communicate()
            assert run.returncode == 3
            assert not table.turning()
            assert not bench.alive(second)
            assert not guard_log_of(tmp_path / "r.h5").exists()
            return said.decode()

    with asyncio.Runner(loop_factory=ScaledLoop) as runner:
        assert "the guard process has ended and is restarted" in runner.run(main())


@asynccontextmanager
async def guarded_listener(folder: Path) -> AsyncIterator[tuple[Guard, socket.socket]]:
    """Yield a guard of a Galil at a port that nobody should knock at."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.setblocking(False)
        path = folder / "galil.toml"
        path.write_text(bench.bench_text("galil", 0.0))
        link = f"tcp://127.0.0.1:{listener.getsockname()[1]}"
        async with open_bench(with_links(load_bench(path), {"table": link}, [])) as opened:
            yield Guard(opened.guarded, folder / "r.h5", 1.0, pytest.fail), listener


@pytest.mark.parametrize("armed", [True, False])
def test_a_guard_that_is_dismissed_does_not_touch_the_table(armed: bool, tmp_path: Path) -> None:
    async def main() -> None:
        async with guarded_listener(tmp_path) as (guard, listener):
            guard.start()
            if armed:
                await guard.arm()
            while not (started := bench.guards_of(os.getpid())):
                await asyncio.sleep(0.001)
            (process,) = started
            guard.dismiss()
            assert not bench.alive(process)
            with pytest.raises(BlockingIOError):
                listener.accept()

    with asyncio.Runner(loop_factory=ScaledLoop) as runner:
        runner.run(main())
    assert not guard_log_of(tmp_path / "r.h5").exists()
