"""What `station check` says of the computer: serial ports, CAN interfaces, clock, power, and what a system lacks."""

from __future__ import annotations

import grp
import json
import os
import pty
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from station.cli import main
from station.computer.can_interfaces import ask_kernel, look_at_can_interface
from station.computer.finding import Finding
from station.computer.look import look_at_computer
from station.computer.serial_ports import look_at_serial_port
from station.computer.timekeeping import ClockWatch, look_at_load, look_at_power_saving, look_at_usb_suspend

as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root makes device files and becomes another user")


def by_about(findings: list[Finding]) -> dict[str, Finding]:
    return {finding.about: finding for finding in findings}


@pytest.fixture
def terminal() -> Any:
    """Yield the path of a character device that this process may use."""
    master, slave = pty.openpty()
    yield os.ttyname(slave)
    os.close(master)
    os.close(slave)


@pytest.fixture
def adapter(tmp_path: Path, terminal: str) -> Path:
    """Return a root folder with an FTDI adapter as /dev/ttyUSB0, seen by its files alone."""
    (tmp_path / "dev/serial/by-id").mkdir(parents=True)
    (tmp_path / "dev/ttyUSB0").symlink_to(terminal)
    return tmp_path


def test_a_port_that_is_not_there_is_told_with_those_that_are(tmp_path: Path) -> None:
    (found,) = look_at_serial_port("/dev/ttyUSB7", tmp_path)
    assert found.wrong
    assert "plugged in" in found.text
    (tmp_path / "dev/serial/by-id").mkdir(parents=True)
    (tmp_path / "dev/serial/by-id/usb-FTDI_A1-if00-port0").touch()
    (found,) = look_at_serial_port("/dev/ttyUSB7", tmp_path)
    assert "/dev/serial/by-id/usb-FTDI_A1-if00-port0" in found.text


@as_root
def test_a_port_of_another_group_is_told_with_the_command_that_helps(terminal: str) -> None:
    dialout = grp.getgrnam("dialout").gr_gid
    os.chown(terminal, 0, dialout)
    os.chmod(terminal, 0o660)
    program = f"""
import os
from station.computer.serial_ports import look_at_serial_port
os.setgroups([]); os.setgid(65534); os.setuid(65534)
for found in look_at_serial_port({terminal!r}): print(found.wrong, found.text, found.command, sep="|")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    wrong, text, command = done.stdout.strip().split("|")
    assert wrong == "True"
    assert "group dialout" in text
    assert command == "sudo usermod -aG dialout nobody"


def test_a_slow_adapter_and_a_stable_name_are_told(adapter: Path) -> None:
    device = adapter / "dev/ttyUSB0"
    name = device.resolve().name
    timer = adapter / f"sys/bus/usb-serial/devices/{name}/latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text("16\n")
    found = list(look_at_serial_port("/dev/ttyUSB0", adapter))
    (slow,) = [each for each in found if "16 ms" in each.text]
    assert slow.command == f"echo 1 | sudo tee /sys/bus/usb-serial/devices/{name}/latency_timer"
    assert not slow.wrong
    timer.write_text("1\n")
    assert not list(look_at_serial_port("/dev/ttyUSB0", adapter))


@as_root
def test_a_number_that_may_change_is_told_with_the_name_that_does_not(tmp_path: Path, terminal: str) -> None:
    folder = tmp_path / "dev/serial/by-id"
    folder.mkdir(parents=True)
    os.mknod(tmp_path / "dev/ttyUSB0", 0o600 | 0o020000, os.stat(terminal).st_rdev)
    (folder / "usb-FTDI_A1-if00-port0").symlink_to("../../ttyUSB0")
    texts = [found.text for found in look_at_serial_port("/dev/ttyUSB0", tmp_path)]
    assert any("serial:///dev/serial/by-id/usb-FTDI_A1-if00-port0" in text for text in texts)
    assert not list(look_at_serial_port("/dev/serial/by-id/usb-FTDI_A1-if00-port0", tmp_path))


@as_root
def test_a_program_that_holds_a_port_is_named(tmp_path: Path, terminal: str) -> None:
    (tmp_path / "dev").mkdir()
    os.mknod(tmp_path / "dev/ttyS0", 0o600 | 0o020000, os.stat(terminal).st_rdev)
    (tmp_path / "proc").symlink_to("/proc")
    program = "import os, sys; os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); print(flush=True); sys.stdin.read()"
    command = [sys.executable, "-c", program, terminal]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        holder.stdout.readline()
        found = list(look_at_serial_port("/dev/ttyS0", tmp_path))
        holder.communicate()
    assert any(f"(process {holder.pid})" in each.text and each.wrong for each in found)


def _interface(kind: str, *flags: str, **data: Any) -> dict[str, Any]:
    return {"ifname": "can0", "flags": list(flags), "linkinfo": {"info_kind": kind, "info_data": data}}


@pytest.mark.parametrize(
    ("described", "text", "command"),
    [
        ({}, "does not exist", "ip -brief link show type can"),
        (_interface("bridge", "UP"), "is not a CAN interface", "ip -brief link show type can"),
        (_interface("can"), "has no bit rate", "sudo ip link set can0 up type can bitrate 500000 restart-ms 100"),
        (
            _interface("can", bittiming={"bitrate": 1000000}),
            "is down",
            "sudo ip link set can0 up type can bitrate 1000000 restart-ms 100",
        ),
        (_interface("vcan"), "is down", "sudo ip link set can0 up"),
        (_interface("can", "UP", state="BUS-OFF", bittiming={"bitrate": 250000}), "BUS-OFF", "bitrate 250000"),
    ],
)
def test_a_can_interface_that_cannot_be_used_is_told_with_the_line_that_helps(
    described: dict[str, Any], text: str, command: str
) -> None:
    (found,) = look_at_can_interface("can0", lambda interface: described)
    assert found.wrong
    assert text in found.text
    assert command in found.command


def test_a_can_interface_in_order_is_silent_and_a_strange_name_is_refused() -> None:
    in_order = _interface("can", "UP", state="ERROR-ACTIVE", bittiming={"bitrate": 500000})
    assert not list(look_at_can_interface("can0", lambda interface: in_order))
    (found,) = look_at_can_interface("can0; reboot", lambda interface: pytest.fail("asked"))
    assert found.wrong
    assert ask_kernel("lo") in (None, {}) or "flags" in (ask_kernel("lo") or {})


def test_a_clock_that_is_set_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    watch = ClockWatch()
    assert not list(watch.findings())
    true_time = time.time
    monkeypatch.setattr(time, "time", lambda: true_time() + 0.25)
    (found,) = watch.findings()
    assert "+250 ms" in found.text


def test_power_saving_and_load_are_told(tmp_path: Path) -> None:
    governor = tmp_path / "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor"
    governor.parent.mkdir(parents=True)
    governor.write_text("powersave\n")
    mains = tmp_path / "sys/class/power_supply/AC"
    mains.mkdir(parents=True)
    (mains / "type").write_text("Mains\n")
    (mains / "online").write_text("0\n")
    found = by_about(list(look_at_power_saving(tmp_path)))
    assert "cpupower" in found["processors"].command
    assert "battery" in found["power"].text
    governor.write_text("performance\n")
    (mains / "online").write_text("1\n")
    assert not list(look_at_power_saving(tmp_path))
    assert not list(look_at_load(cores=2, load=1.0))
    (busy,) = look_at_load(cores=2, load=5.5)
    assert "5.5 programs wanted 2" in busy.text


def test_an_adapter_that_may_be_suspended_is_told(tmp_path: Path) -> None:
    usb = tmp_path / "sys/devices/usb1/1-2"
    port = usb / "1-2:1.0/ttyUSB0"
    port.mkdir(parents=True)
    (usb / "idVendor").write_text("0403\n")
    (usb / "power").mkdir()
    (usb / "power/control").write_text("auto\n")
    (usb / "power/autosuspend").write_text("2\n")
    (tmp_path / "sys/class/tty/ttyUSB0").mkdir(parents=True)
    (tmp_path / "sys/class/tty/ttyUSB0/device").symlink_to(port)
    (found,) = look_at_usb_suspend("/dev/ttyUSB0", tmp_path)
    assert found.command == "echo on | sudo tee /sys/devices/usb1/1-2/power/control"
    (usb / "power/control").write_text("on\n")
    assert not list(look_at_usb_suspend("/dev/ttyUSB0", tmp_path))


def test_twins_ask_nothing_of_the_computer() -> None:
    assert look_at_computer(["twin:", "twin:"]) == []


def test_check_tells_of_the_computer_in_words_and_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    link = ["--link", "table=serial:///dev/ttyUSB97"]
    assert main(["check", *link, "--json"]) == 4
    computer = json.loads(capsys.readouterr().out)["computer"]
    assert [each["about"] for each in computer if each["wrong"]] == ["/dev/ttyUSB97"]
    assert main(["check", *link]) == 4
    assert "/dev/ttyUSB97 does not exist" in capsys.readouterr().out


@pytest.mark.parametrize("module", ["fcntl", "termios", "resource"])
@pytest.mark.parametrize("command", [["run"], ["ui"], ["check"]])
def test_a_facility_that_is_missing_is_one_line(module: str, command: list[str]) -> None:
    program = f"import sys; sys.modules[{module!r}] = None; from station.cli import main; sys.exit(main({command!r}))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert f"lacks {module}" in line


def test_help_needs_no_facility() -> None:
    blocked = "; ".join(f"sys.modules[{m!r}] = None" for m in ("fcntl", "termios", "resource"))
    program = f"import sys; {blocked}; from station.cli import main; main(['--help'])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_system_that_names_no_peers_runs_and_says_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delattr("socket.SO_PEERCRED")
    script = tmp_path / "script.toml"
    script.write_text('[[step]]\nkind = "rest"\nduration = "9 s"\n')
    output = str(tmp_path / "run.h5")
    assert main(["run", "--host", "--scale", "20", "--script", str(script), "-o", output]) in (0, 1)
    assert "does not identify the user" in capsys.readouterr().err
