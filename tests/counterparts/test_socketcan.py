"""SocketCAN of a real kernel: Debian's in QEMU, with vcan, slcan, the kernel's J1939, candump and slcand.

One guest serves all tests of this module, in order. It is 10 to 40 times slower than this machine: the clocks of
station and twin are slowed by as much as it needs, which is a scale below 1.
"""

from __future__ import annotations

import json
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

HERE = Path(__file__).parent / "qemu"
sys.path.insert(0, str(HERE))
import guest as machine  # noqa: E402

pytestmark = pytest.mark.timeout(900)
MODULES = [
    "station.cli",
    "station.commands.run",
    "station.commands.twin",
    "station.opening.serving",
    "station.run.session",
    "h5py",
    "cantools",
]
BENCH, SCRIPT, RESTS = HERE / "bench.toml", HERE / "script.toml", HERE / "rests.toml"
J1939 = Path(__file__).parents[1] / "data" / "benches" / "galil_j1939.toml"
KERNEL_J1939 = f"{sys.executable} {HERE / 'kernel_j1939.py'}"
LONG_S = 400.0
"""More than anything here takes on a machine with other work to do."""
_CALM_S = 8.0  # scale times what the imports take, for which the guest is fast enough with a margin of two or three
_TOO_SLOW = "this computer fell behind"


class Guest(machine.Guest):
    """The guest with the station's modules imported; ``scale`` is what it can bear."""

    scale = 1.0

    def prepare(self) -> None:
        """Import, and see how long that takes."""
        start = time.monotonic()
        self.load(MODULES, LONG_S)
        self.scale = round(min(_CALM_S / (time.monotonic() - start), 0.5), 2)
        self.run("ip link add vcan0 type vcan && ip link set vcan0 up")

    @contextmanager
    def twins(self, bench: Path | str, *, scale: float) -> Iterator[list[str]]:
        """Serve the twins of a bench; yield the options that lead a station to them."""
        job = self.start(["twin", "--bench", str(bench), "--scale", str(scale)])
        try:
            assert job.wait_for('"ready"', LONG_S), job.output
            said = [json.loads(line) for line in job.output.splitlines()]
            yield [word for one in said if "link" in one for word in ("--link", f"{one['device']}={one['link']}")]
        finally:
            self.stop(job)
        assert "Traceback" not in job.output, job.output


@pytest.fixture(scope="module")
def guest(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guest]:
    if missing := machine.missing():
        pytest.skip(f"needs Debian's {', '.join(missing)}")
    folder = tmp_path_factory.mktemp("guest")
    try:
        kernel = machine.fetch_kernel(folder)
        made = Guest(folder, kernel, machine.build_initramfs(kernel, folder))
    except machine.NoGuestError as error:
        pytest.skip(str(error))
    try:
        made.prepare()
        yield made
    finally:
        made.close()
        shutil.rmtree(kernel)


def run(guest: Guest, script: Path, name: str, links: list[str]) -> machine.Job:
    """Start a run in the guest; its recording is NAME.h5 in the guest's memory: files over 9p are slow to sync."""
    words = ["run", "--bench", str(BENCH), "--script", str(script), "--scale", str(guest.scale)]
    return guest.start([*words, "-o", f"/dev/shm/{name}.h5", *links])


@pytest.fixture(scope="module")
def j1939(guest: Guest) -> str:
    """Return the bench of a Galil and an OpenIMU at a rate that the guest can bear, as the guest names it."""
    text = J1939.read_text()
    assert 'rate = "100 Hz"' in text
    text = text.replace('rate = "100 Hz"', 'rate = "20 Hz"')
    (guest.shared / "j1939.toml").write_text(text)
    return str(machine.SHARED / "j1939.toml")


def checked(guest: Guest, bench: str, links: list[str]) -> dict[str, Any]:
    """Return what `station check` says of the IMU; the table's readings are too slow in a guest."""
    job = guest.start(["check", bench, "--scale", str(guest.scale), "--json", *links])
    job.wait(LONG_S)
    found: dict[str, Any] = json.loads(job.output.splitlines()[-1])
    return next(device for device in found["devices"] if device["device"] == "openimu")


def dumped(text: str) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Return stamps (s of the day, UTC) and numbers of each identifier of candump's log."""
    found: dict[int, tuple[list[float], list[int]]] = {}
    for stamp, identifier, data in re.findall(r"^\((\d+\.\d+)\) \S+ ([0-9A-F]+)#([0-9A-F]{4})\s", text, re.MULTILINE):
        stamps, numbers = found.setdefault(int(identifier, 16), ([], []))
        stamps.append(float(stamp))
        numbers.append(int.from_bytes(bytes.fromhex(data), "little", signed=True))
    return {key: (np.array(stamps), np.array(numbers)) for key, (stamps, numbers) in found.items()}


def patiently(attempt: Callable[[Guest], machine.Job], guest: Guest) -> machine.Job:
    """Return a run that did not end because the guest, by the run's own words, could not keep up."""
    job = attempt(guest)
    while _TOO_SLOW in job.output and guest.scale > 0.05:
        guest.scale = round(guest.scale / 2, 3)
        job = attempt(guest)
    return job


def verdict(guest: Guest) -> machine.Job:
    """Run to the verdict, with candump beside it; return the run."""
    with guest.twins(BENCH, scale=guest.scale) as links:
        dump = guest.start("rm -f /dev/shm/verdict.h5; exec candump -L vcan0 > /dev/shm/dump.log")
        job = run(guest, SCRIPT, "verdict", links)
        job.wait(LONG_S)
        guest.stop(dump)
    return job


def test_a_run_over_socketcan_gives_a_verdict_and_holds_what_candump_saw(guest: Guest) -> None:
    job = patiently(verdict, guest)
    assert job.wait(LONG_S) == 0, job.output
    guest.run(f"cp /dev/shm/verdict.h5 /dev/shm/dump.log {machine.SHARED}")
    seen = dumped((guest.shared / "dump.log").read_text())
    with h5py.File(guest.shared / "verdict.h5") as file:
        assert (file.attrs["outcome"], file.attrs["time_scale"]) == ("PASS", guest.scale)
        for number in range(1, 5):
            source = file[f"imu/gyro{number}"]
            stamps_s, raw = seen[0x100 + number]
            ours = np.round(np.degrees(source["rate_rps"][:, 0]) / 0.005).astype(int)
            starts = [i for i in range(len(raw) - len(ours) + 1) if np.array_equal(raw[i : i + len(ours)], ours)]
            assert len(starts) == 1, f"gyro{number}: {len(ours)} samples are not among {len(raw)} frames in one piece"
            arrived_s = source["arrival_ns"][()] * 1e-9 / guest.scale + file.attrs["clock_zero_utc_s"]
            late_s = arrived_s - stamps_s[starts[0] :][: len(ours)]
            assert np.abs(np.median(late_s)) < 1e-3  # both tell the kernel's stamp; the guest may pause in between
            assert np.abs(late_s).max() < 1.0


def interrupted(guest: Guest) -> machine.Job:
    """Run while the interface goes down and up in the first rest, and down in the motion after it; return the run."""
    with guest.twins(BENCH, scale=guest.scale) as links:
        guest.run("rm -f /dev/shm/down.h5")
        job = run(guest, RESTS, "down", links)
        if job.wait_for(" rest ", LONG_S):
            guest.run(f"ip link set vcan0 down; sleep {1 / guest.scale:.1f}; ip link set vcan0 up")
        if job.wait_for("z at 20 deg/s", LONG_S):
            guest.run(f"sleep {2 / guest.scale:.1f}; ip link set vcan0 down")
        job.wait(LONG_S)
        guest.run("ip link set vcan0 up")
    return job


def test_an_interface_down_at_rest_is_opened_again_and_in_a_motion_ends_the_run(guest: Guest) -> None:
    job = patiently(interrupted, guest)
    assert job.wait(LONG_S) == 4, job.output
    guest.run(f"cp /dev/shm/down.h5 {machine.SHARED}")
    with h5py.File(guest.shared / "down.h5") as file:
        assert file.attrs["outcome"] == "FAULT"
        reason = str(file.attrs["reason"])
        assert re.match(r"array: CAN bus socketcan:vcan0 .*down", reason)
        events = [text.decode() for text in file["events/text"][()]]
        assert len(file["imu/gyro1/t_ns"]) > 100
    begun, lost, again, doubt, rest = events
    assert (begun, rest) == ("script begins", "table at rest")
    assert re.fullmatch(r"array: CAN bus socketcan:vcan0 .* is down\); no axis turns, so the link is reopened", lost)
    assert re.fullmatch(r"array: reopened after \d+ (try|tries)", again)
    assert doubt == "array reports no serial number, so it may have been exchanged while its link was lost"
    assert "not seen to come to rest" not in reason


def test_slcand_joins_our_adapter_to_the_kernel_both_ways(guest: Guest, j1939: str) -> None:
    """The station asks the twin through the kernel who it is; the kernel's J1939 asks the same."""
    with guest.twins(j1939, scale=guest.scale) as links:
        port = next(link for link in links if "slcan" in link).rpartition(":")[2]
        guest.run(f"slcand -o -s5 {port} slcan0 && sleep 1 && ip link set slcan0 up")
        links = [link.replace(f"slcan:{port}", "socketcan:slcan0") for link in links]
        said = checked(guest, j1939, links)
        asked = json.loads(guest.run(f"{KERNEL_J1939} ask slcan0"))
        guest.run("pkill slcand")
    assert said["identity"]["model"] == "J1939 manufacturer 823, function 131"
    assert (said["identity"]["serial"], said["identity"]["firmware"]) == ("305001", "19.1.51 stage 2 build 1")
    assert (said["wrong"], said["sources"][0]["lost"]) == ([], 0)
    name = 131 << 40 | 823 << 21 | 305_001
    assert (asked["claim"], asked["name"], asked["version"]) == (name, name, [19, 1, 51, 2, 1])
    assert asked["samples"] > 0


def test_the_kernels_j1939_is_named_and_read_as_a_device(guest: Guest, j1939: str) -> None:
    """It sends as fast as the station's slower clock has it."""
    guest.run("ip link add vcan1 type vcan && ip link set vcan1 up")
    device = guest.start(f"exec {KERNEL_J1939} be vcan1 {20 * guest.scale}")
    assert device.wait_for("ready", LONG_S), device.output
    said = checked(guest, j1939, ["--link", "openimu=can:socketcan:vcan1"])
    guest.stop(device)
    assert said["identity"]["model"] == "J1939 manufacturer 299, function 130"
    assert (said["identity"]["serial"], said["identity"]["firmware"]) == ("123456", "2.7.18 stage 1 build 44")
    (source,) = said["sources"]
    assert (said["wrong"], source["lost"]) == ([], 0)
    assert np.degrees(source["mean_rps"]) == pytest.approx([1, -2, 3], abs=1 / 256)
