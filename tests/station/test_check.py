"""station check: what answers is told with its figures, what does not with what to do about it; nothing moves."""

from __future__ import annotations

import asyncio
import json
import math
import os
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
from support import TwinProcess, changed, station

from station.bench.bench import default_bench_text, load_bench
from station.cli import main
from station.opening import open_bench
from station.opening.checking import check_bench
from station.run.event_loop.loops import VirtualLoop
from station.views.answers.check import bench_check_of

BENCHES = Path(__file__).parents[1] / "data" / "benches"
SCALE = "2"

on_wires = pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX only")


def made(folder: Path, name: str, *changes: tuple[str, str], more: str = "") -> Path:
    """Return a bench like one of the shipped ones, with changes."""
    text = (BENCHES / f"{name}.toml").read_text() if name else default_bench_text()
    path = folder / f"{name or 'built_in'}.toml"
    path.write_text(changed(text, *changes) + more)
    return path


def checked(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, dict[str, dict[str, Any]]]:
    """Return the exit code, and what was printed of each device."""
    code = main(["check", "--json", *map(str, arguments)])
    return code, devices_in(capsys.readouterr().out)


def checked_on_wires(bench: Path, *links: str) -> dict[str, dict[str, Any]]:
    """Return what is printed of each device of a bench with something wrong, whose links lead elsewhere."""
    options = [word for link in links for word in ("--link", link)]
    done: subprocess.CompletedProcess[str] = station("check", bench, "--json", "--scale", SCALE, *options)
    assert done.returncode == 4, done.stderr
    return devices_in(done.stdout)


def devices_in(printed: str) -> dict[str, dict[str, Any]]:
    result = json.loads(printed)
    assert result["ok"] is not any(device["wrong"] for device in result["devices"])
    answer = bench_check_of(result)  # as the screen has it
    assert [device.device for device in answer.devices] == [device["device"] for device in result["devices"]]
    assert [list(device.wrong) for device in answer.devices] == [device["wrong"] for device in result["devices"]]
    return {device["device"]: device for device in result["devices"]}


def wrong(devices: dict[str, dict[str, Any]], device: str) -> str:
    """Return what is said to be wrong with a device, nothing being said of the others."""
    assert [name for name, found in devices.items() if found["wrong"]] == [device]
    return "\n".join(devices[device]["wrong"])


@pytest.mark.parametrize("name", ["", *sorted(path.stem for path in BENCHES.glob("*.toml"))])
def test_a_bench_in_order_answers_with_identity_limits_and_rates(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = made(tmp_path, name)
    bench = load_bench(path)
    code, devices = checked(capsys, path)
    assert code == 0
    table = devices["table"]
    assert table["kind"] == bench.table.protocol
    assert table["identity"]["model"]
    assert table["counts"]["opened"] >= 1
    assert min(table["counts"][way] for way in ("received", "sent")) > 100
    assert table["counts"]["timeouts"] == 0
    assert [axis["name"] for axis in table["axes"]] == list(bench.table.gimbals)
    for axis in table["axes"]:
        limits = bench.table.limits[axis["name"]]
        assert (axis["max_rate_rps"], axis["max_acceleration_rps2"]) == (limits.rate_rps, limits.acceleration_rps2)
        assert axis["text"]
    for imu in bench.imus:
        if not imu.used:
            assert imu.name not in devices
            continue
        sources, counts = devices[imu.name]["sources"], devices[imu.name]["counts"]
        assert counts["opened"] == 1
        assert counts["received"] > 2 * imu.rate_hz
        assert not any(n for what, n in counts.items() if what not in ("opened", "received", "sent"))
        assert sum(len(source["mean_rps"]) for source in sources) == len(imu.array)
        for source in sources:
            assert source["rate_hz"] == pytest.approx(imu.rate_hz, rel=2e-4)
            assert source["samples"] > 1.8 * imu.rate_hz
            assert source["lost"] == source["repeated"] == source["corrupt"] == 0
            assert 0 <= source["jitter_s"] < 0.01
            assert (source["temperature_c"] is None) is not imu.knows_temperature


def test_a_person_reads_a_table_with_a_line_for_each_device(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "--device", "stim300"]) == 0
    printed = capsys.readouterr()
    for text in (
        "STIM300 84167-440000-3321 rev K",
        "stim300: 500.0 Hz, 0 lost",
        "link: 1 opened, ",
        "up to 100 deg/s",
        "every device answers",
    ):
        assert text in printed.out
    assert "checking table" in printed.err


@pytest.mark.parametrize("name", ["rtu_stim300", "galil_xsens", "acutrol_vectornav"])
def test_nothing_moves_and_no_drive_gets_power(name: str) -> None:
    bench = load_bench(BENCHES / f"{name}.toml")

    async def look() -> None:
        async with open_bench(bench) as opened:
            moved = False

            async def watch() -> None:
                nonlocal moved
                while True:
                    moved = moved or not opened.at_rest()
                    await asyncio.sleep(0.001)

            watching = asyncio.get_running_loop().create_task(watch())
            found = await check_bench(opened)
            watching.cancel()
            assert not moved
            assert not any(check.wrong for check in found)
            await opened.table.open()
            for axis, before in zip(bench.table.gimbals, found[0].axes, strict=True):
                assert not (await opened.table.status(axis)).enabled
                assert (await opened.table.read(axis)).angle_rad == before.angle_rad
            opened.table.close()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(look())


def test_a_table_that_turns_is_told_of_and_left_alone(tmp_path: Path) -> None:
    bench = load_bench(made(tmp_path, "acutrol_vectornav"))

    async def look() -> None:
        async with open_bench(bench) as opened:
            table = opened.table
            await table.open()
            await table.enable()
            await table.home()
            await table.jog("y", math.radians(5.0), math.radians(20.0))
            await asyncio.sleep(1.0)
            found = await check_bench(opened)
            (wrong,) = found[0].wrong
            assert wrong.startswith("axis y is enabled and turns at 5.00 deg/s, but this station does not drive it")
            assert not opened.at_rest()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(look())


def test_a_silent_table_is_named_and_the_devices_are_looked_at_nevertheless(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = made(tmp_path, "rtu_stim300", more='\n[twin.fault]\nsilent_from = "0 s"\n')
    code, devices = checked(capsys, bench)
    assert code == 4
    assert devices["table"]["axes"] == []
    assert devices["stim300"]["sources"]
    said = wrong(devices, "table")
    assert "axis z (unit id 3) does not answer within 0.4 s" in said
    assert "Do protocol, link, baud rate, parity and axis addresses match the controller?" in said
    assert "exchanged" not in said


@pytest.mark.parametrize("name", ["rtu_stim300", "galil_xsens", "acutrol_vectornav", "galil_j1939"])
def test_a_silent_device_is_named_with_what_to_look_at(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    device = load_bench(BENCHES / f"{name}.toml").imus[0].name
    code, devices = checked(capsys, made(tmp_path, name, more=f'\n[twin.{device}.fault]\nsilent_from = "0 s"\n'))
    assert code == 4
    assert devices[device]["sources"] == []
    assert "powered" in wrong(devices, device)
    assert "Do protocol, link, baud rate or channel match the device?" in wrong(devices, device)


def test_a_faulty_axis_is_told_of_with_its_code_and_the_way_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, devices = checked(capsys, made(tmp_path, "rtu_stim300", more='\n[twin.fault]\naxis = "y"\nat = "0 s"\n'))
    assert code == 4
    assert "axis y is in fault (statusword 0x" in wrong(devices, "table")
    assert "clear the cause, then run with --reset-fault" in wrong(devices, "table")


@pytest.mark.parametrize(
    ("name", "device", "rate_hz"), [("", "array", 100), ("rtu_stim300", "stim300", 500), ("galil_xsens", "mti", 400)]
)
def test_a_source_at_another_rate_than_the_bench_file_says_is_told_of(
    name: str, device: str, rate_hz: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = f'\n[twin.{device}.fault]\nclock = "50000 ppm"\n'
    code, devices = checked(capsys, made(tmp_path, name, more=more))
    assert code == 4
    for source in devices[device]["sources"]:
        assert source["rate_hz"] == pytest.approx(1.05 * rate_hz, rel=0.015)
    said = wrong(devices, device)
    assert f"Hz, but the bench file says {rate_hz} Hz. Correct one" in said


def test_lost_samples_are_counted_and_the_cable_is_pointed_to(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = made(tmp_path, "rtu_stim300", more='\n[twin.stim300.fault]\ndropped = "1 %"\n')
    code, devices = checked(capsys, bench)
    assert code == 4
    (source,) = devices["stim300"]["sources"]
    assert 1 <= source["lost"] <= 40
    assert f"{source['lost']} of {source['samples'] + source['lost']} samples lost" in wrong(devices, "stim300")
    assert "check cable" in wrong(devices, "stim300")


@on_wires
def test_exchanged_links_are_suspected() -> None:
    bench = BENCHES / "rtu_stim300.toml"
    with TwinProcess("--bench", bench, "--scale", SCALE) as twin:
        table, device = twin.links["table"], twin.links["stim300"]
        devices = checked_on_wires(bench, f"table={device}", f"stim300={table}")
    assert "stim300 sends unknown data, too. Are their links swapped?" in devices["table"]["wrong"]
    assert "table sends unknown data, too. Are their links swapped?" in devices["stim300"]["wrong"]


@on_wires
@pytest.mark.full  # the short form is the one above
def test_another_protocol_at_the_other_end_is_suspected(tmp_path: Path) -> None:
    bench = BENCHES / "galil_xsens.toml"
    with TwinProcess("--bench", BENCHES / "acutrol_vectornav.toml", "--scale", SCALE) as twin:
        devices = checked_on_wires(bench, f"table={twin.links['table']}", f"mti={twin.links['vn100']}")
    for name in ("table", "mti"):
        assert any("Do protocol, link, baud rate" in line for line in devices[name]["wrong"])
    assert any("the received data are not Xbus" in line for line in devices["mti"]["wrong"])


@on_wires
@pytest.mark.parametrize(
    ("name", "device", "rate"),
    [("rtu_stim300", "stim300", "500 Hz"), pytest.param("", "array", "100 Hz", marks=pytest.mark.full)],
)
def test_a_device_set_to_another_rate_is_told_of_on_its_wire(name: str, device: str, rate: str, tmp_path: Path) -> None:
    slower = f"{float(rate.split()[0]) / 2:g} Hz"
    wires = "" if name else '\n[twin.wires]\narray = "slcan"\n'
    bench = made(tmp_path, name, more=wires)
    with TwinProcess("--bench", bench, "--scale", SCALE) as twin:
        stated = made(tmp_path, name, (f'rate = "{rate}"', f'rate = "{slower}"'), more=wires)
        devices = checked_on_wires(stated, *(f"{at}={twin.links[at]}" for at in ("table", device)))
    said = "\n".join(devices[device]["wrong"])
    assert f"the bench file says {'rate ' if name else ''}{slower}" in said
    # Where nothing counts, samples that do not fit the stated rate at all are dropped before they can be counted.
    for sent_hz in re.findall(r"sends at ([0-9.]+) Hz", said):
        assert float(sent_hz) == pytest.approx(float(rate.split()[0]), rel=0.2)
