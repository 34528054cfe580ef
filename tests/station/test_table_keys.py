"""What a bench file says of its table reaches drivers and scripts: travel, error limit, addresses, fault bits."""

from __future__ import annotations

import asyncio
import json
import math
import socket
from pathlib import Path

import pytest
from support import TwinProcess, changed

from drivers.errors import LinkLost
from drivers.links.memory_link import MemoryLink
from drivers.specs import TableSetup
from sims.physics.table import AxisData, TableModel
from sims.tables.galil_controller import GalilController
from sims.tables.registry import TableTwinSetup
from station.bench.bench import load_bench
from station.cli import main
from station.errors import BenchError
from station.opening import open_bench, with_links
from station.run.event_loop.loops import VirtualLoop
from station.scripts.script import paper_script

BENCHES = Path(__file__).parents[1] / "data" / "benches"
DEG = math.pi / 180
AEROSMITH = """
[table]
protocol = "aerosmith"
gimbals = ["z"]
{keys}

[table.z]
max_rate = "100 deg/s"
max_acceleration = "50 deg/s2"
"""


def made(folder: Path, name: str, *changes: tuple[str, str], more: str = "") -> Path:
    """Return a bench like one of the shipped ones, with changes."""
    path = folder / "bench.toml"
    path.write_text(changed((BENCHES / f"{name}.toml").read_text(), *changes) + more)
    return path


def axis(name: str, more: str) -> tuple[str, str]:
    return f"[table.{name}]\n", f"[table.{name}]\n{more}\n"


def test_a_script_that_leaves_an_axis_travel_is_refused_before_motion(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = made(tmp_path, "acutrol_vectornav", axis("y", 'travel = ["-90 deg", "90 deg"]'))
    assert main(["run", "--bench", str(bench), "-o", str(tmp_path / "r.h5")]) == 2
    assert "axis y would reach 1440 deg from home, outside its travel of -90 to 90 deg" in capsys.readouterr().err
    assert not (tmp_path / "r.h5").exists()


def test_a_script_to_the_ends_of_the_travel_is_planned(tmp_path: Path) -> None:
    bench = made(tmp_path, "acutrol_vectornav", axis("y", 'travel = ["-1440 deg", "1440 deg"]'))
    assert load_bench(bench).table.limits["y"].travel_rad == pytest.approx((-8 * math.pi, 8 * math.pi))
    assert paper_script().least_s == pytest.approx(360.0)
    assert main(["plan", "--bench", str(bench), "--json"]) in (0, 1)


def test_a_galil_is_told_its_error_limit_in_counts_before_its_motor_is_on(tmp_path: Path) -> None:
    config = load_bench(made(tmp_path, "galil_xsens", axis("x", 'error_limit = "0.5 deg"'))).table
    heard = bytearray()

    async def drive() -> None:
        def hear(data: bytes) -> None:
            heard.extend(data)
            controller.received(data)

        link = MemoryLink("table", hear)
        axes = dict.fromkeys(config.axes, AxisData(100 * DEG, 50 * DEG, 65536, 0.0))
        model = TableModel(axes, asyncio.get_running_loop().time)
        letters = {name: str(own.address) for name, own in config.axes.items()}
        controller = GalilController(TableTwinSetup(model, letters, {"velocity_window": 0.25}, 0.0), link.deliver)
        table = config.spec.make(TableSetup(config.axes, config.timeout_s, config.options), link)
        await table.open()
        await table.enable()
        table.close()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(drive())
    assert b"ERA=91\r" in heard  # of 65536 a turn
    assert heard.index(b"ERA=91\r") < heard.index(b"SHA\r")
    assert heard.count(b"ER") == 1  # of the axes without, it stays what it is


def test_a_galil_stops_at_the_end_of_its_travel(tmp_path: Path) -> None:
    bench = load_bench(made(tmp_path, "galil_xsens", axis("x", 'travel = ["-30 deg", "45 deg"]')))

    async def drive() -> None:
        async with open_bench(bench) as opened:
            table = opened.table
            await table.open()
            await table.enable()
            await table.home()
            await table.jog("x", 20 * DEG, 20 * DEG)
            await asyncio.sleep(0.5)
            while not opened.at_rest():
                await table.read("x")
                await asyncio.sleep(0.1)
            assert (await table.read("x")).angle_rad == pytest.approx(45 * DEG, abs=0.01 * DEG)
            assert "it ran into a limit" in (await table.status("x")).fault
            table.close()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(drive())


def test_a_galil_velocity_is_the_mean_of_the_stated_time(tmp_path: Path) -> None:
    stated = ('protocol = "galil"', 'protocol = "galil"\nvelocity_window = "0.5 s"')
    bench = load_bench(made(tmp_path, "galil_xsens", stated))

    async def drive() -> None:
        async with open_bench(bench) as opened:
            table = opened.table
            await table.open()
            await table.enable()
            await table.jog("x", 45 * DEG, 22.5 * DEG)  # a multiple of the controller's 1024 counts/s2
            await asyncio.sleep(1.0)
            state = await table.read("x")  # on the ramp: the mean is the rate in the middle of its time
            assert state.rate_window_ns == 500_000_000
            assert state.angle_t_ns - state.rate_t_ns == pytest.approx(250e6, abs=5e6)
            assert state.rate_rps == pytest.approx(0.75 * 22.5 * DEG, rel=0.02)
            table.close()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(drive())


@pytest.mark.parametrize(("keys", "seen"), [("fault_mask = 2", True), ("", False)])
def test_an_aerosmith_fault_is_seen_where_its_bits_are_stated(
    keys: str, seen: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (BENCHES / "acutrol_vectornav.toml").read_text().replace('["3 deg", "-2 deg", "1.5 deg"]', '"0 deg"')
    before, after = text.index("[table]"), text.index("[[imu]]")
    text = text[:before] + AEROSMITH.format(keys=keys) + text[after:]
    bench = tmp_path / "bench.toml"
    bench.write_text(text + '\n[twin.fault]\naxis = "z"\nat = "0 s"\n')
    assert main(["check", "--json", str(bench)]) == (4 if seen else 0)
    (wrong, _) = (device["wrong"] for device in json.loads(capsys.readouterr().out)["devices"])
    assert bool(wrong) is seen
    assert all("where 2 means fault" in line for line in wrong)


def test_drives_with_an_address_each_are_asked_at_it(tmp_path: Path) -> None:
    other = made(tmp_path, "two_triads", ("unit_id = 2", "unit_id = 12"), ("unit_id = 3", "unit_id = 13"))
    with (
        TwinProcess("--bench", BENCHES / "two_triads.toml") as first,
        TwinProcess("--bench", other) as second,
        socket.socket() as unheard,  # a port at which nobody listens
    ):
        unheard.bind(("127.0.0.1", 0))
        nobody = f"127.0.0.1:{unheard.getsockname()[1]}"
        here, there = first.links["table"], second.links["table"]
        table = ("[table]\n", f'[table]\nlink = "{here}"\ntimeout = "1 s"\n')
        y = axis("y", f'link = "{there}"')

        async def read(bench: Path) -> None:
            async with open_bench(load_bench(bench)) as opened:
                try:
                    await opened.table.open()
                    for name in "xyz":
                        assert (await opened.table.read(name)).angle_rad == 0.0
                finally:
                    opened.table.close()

        with asyncio.Runner() as runner:
            runner.run(read(made(tmp_path, "two_triads", table, y, ("unit_id = 2", "unit_id = 12"))))
            with pytest.raises(LinkLost, match=f"nothing answers at {nobody}"):
                runner.run(read(made(tmp_path, "two_triads", table, y, axis("z", f'link = "tcp://{nobody}"'))))


def test_drives_with_an_address_each_may_all_be_unit_1(tmp_path: Path) -> None:
    units = ("unit_id = 2", "unit_id = 1"), ("unit_id = 3", "unit_id = 1")
    links = [axis(name, f'link = "tcp://10.0.0.{i}"') for i, name in enumerate("yz", 2)]
    link = ("[table]\n", '[table]\nlink = "tcp://10.0.0.1"\n')
    bench = load_bench(made(tmp_path, "two_triads", link, *units, *links))
    assert [axis.address for axis in bench.table.axes.values()] == [1, 1, 1]
    with pytest.raises(BenchError, match="two axes have the same address at the controller"):
        load_bench(made(tmp_path, "two_triads", link, *units, links[0]))


def test_another_link_of_the_table_is_that_of_all_its_axes(tmp_path: Path) -> None:
    own = axis("y", 'link = "tcp://10.0.0.2:502"')
    bench = load_bench(made(tmp_path, "two_triads", ("[table]\n", '[table]\nlink = "tcp://10.0.0.1:502"\n'), own))
    assert bench.table.links == ("tcp://10.0.0.1:502", "tcp://10.0.0.2:502")
    assert with_links(bench, {"table": "twin:"}, []).table.links == ("twin:",)


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        (
            "galil_xsens",
            axis("x", 'travel = ["10 deg", "90 deg"]'),
            r"line 13: table.x.travel: must go from a negative",
        ),
        ("galil_xsens", axis("x", 'travel = ["-90 deg"]'), r"travel: 1 values instead of 2"),
        ("galil_xsens", axis("x", 'error_limit = "0 deg"'), "table.x.error_limit: must be above zero"),
        ("galil_xsens", axis("x", 'link = "tcp://10.0.0.1"'), "table.x.link: unknown key"),
        ("two_triads", axis("x", 'error_limit = "1 deg"'), "table.x.error_limit: unknown key"),
        ("two_triads", axis("x", 'link = "tcp://10.0.0.1:502"'), "table.link: must also be given"),
        ("two_triads", ("[table]\n", '[table]\nvelocity_window = "1 s"\n'), "table.velocity_window: unknown key"),
        ("two_triads", ("[table]\n", "[table]\nfault_mask = 1\n"), "table.fault_mask: unknown key"),
        ("galil_xsens", ('"galil"', '"galil"\nvelocity_window = "0 s"'), "table.velocity_window: must be above zero"),
        ("two_triads", ("[table]\n", '[table]\nlink = "tcp://[::1"\n'), r"line \d+: table.link: 'tcp://\[::1' is no"),
        ("two_triads", ("[table]\n", '[table]\nlink = "tcp://1.2.3.4:99999"\n'), r"line \d+: table.link: .* is no"),
        ("two_triads", axis("x", 'link = "tcp://[::1"'), r"line \d+: table.x.link: 'tcp://\[::1' is not a link"),
        ("galil_xsens", ("[[imu]]\n", '[[imu]]\nlink = "rfc2217://a:b"\n'), r"line \d+: imu.0.link: .* is not a link"),
        ("galil_xsens", ('sd_bias = "5 deg/h"', 'sd_bias = "-5 deg/h"'), "limits.sd_bias: must be above zero"),
        (
            "full_imu",
            ("[limits]\n", '[limits.accelerometers]\nsd_lever_arm = "0 mm"\n\n[limits]\n'),
            "limits.accelerometers.sd_lever_arm: must be above zero",
        ),
    ],
)
def test_what_a_bench_cannot_have_is_told_with_its_key(
    name: str, change: tuple[str, str], said: str, tmp_path: Path
) -> None:
    with pytest.raises(BenchError, match=said):
        load_bench(made(tmp_path, name, change))
