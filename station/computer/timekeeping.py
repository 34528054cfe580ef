"""Disturbances of a run's timing: clock changes, power saving, other programs."""

import os
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from station.computer.finding import Finding

_STEP_S = 0.005
_PRIORITY_OF_A_RUN = 10


class ClockWatch:
    """Detects whether the system clock is set meanwhile. Kernels stamp CAN frames with that clock."""

    def __init__(self) -> None:
        self._began_s = time.monotonic()
        self._offset_s = time.time() - self._began_s

    def findings(self) -> Iterator[Finding]:
        """Yield by how much the system clock was set since this object was made; nothing up to 5 ms."""
        now_s = time.monotonic()
        step_s = time.time() - now_s - self._offset_s
        if abs(step_s) > _STEP_S:
            seconds = now_s - self._began_s
            text = (
                f"was set by {step_s * 1e3:+.0f} ms within {seconds:.0f} s: use a service that "
                "slews the clock, such as chrony"
            )
            yield Finding("system clock", text, "timedatectl timesync-status")


def look_at_power_saving(root: Path = Path("/")) -> Iterator[Finding]:
    """Yield that processors run at their lowest frequency, and that the computer is on battery; nothing if neither is
    so.

    Where intel_pstate is at work, powersave does not mean that. ``root`` is the root of the file system to look at.
    """
    governors = set()
    for path in sorted((root / "sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor")):
        with suppress(OSError):
            governors.add(path.read_text().strip())
    if "powersave" in governors and not (root / "sys/devices/system/cpu/intel_pstate").exists():
        text = "run at their lowest frequency (governor powersave)"
        yield Finding("processors", text, "sudo cpupower frequency-set -g performance")
    with suppress(OSError):
        if _on_battery(root):
            yield Finding("power", "this computer runs on battery: it saves power and may go to sleep during a run")


def _on_battery(root: Path) -> bool:
    """Return whether there are mains adapters but none is in use; OSError if the supplies cannot be read."""
    states = []
    for supply in (root / "sys/class/power_supply").iterdir():
        if (supply / "type").read_text().strip() == "Mains":
            states.append((supply / "online").read_text().strip() == "1")
    return bool(states) and not any(states)


def look_at_usb_suspend(port: str, root: Path = Path("/")) -> Iterator[Finding]:
    """Yield that the kernel may suspend the USB adapter of a serial port, with a remedy.

    Nothing if it may not, or for a port that is not on USB. ``root`` is the root of the file system to look at.
    """
    name = (root / port.lstrip("/")).resolve().name
    device = (root / "sys/class/tty" / name / "device").resolve()
    for folder in (device, *device.parents):
        if not folder.is_relative_to((root / "sys").resolve()):
            return
        if (folder / "idVendor").exists():
            control = folder / "power/control"
            with suppress(OSError):
                if control.read_text().strip() == "auto" and (folder / "power/autosuspend").read_text().strip() != "-1":
                    shown = "/" + str(control.relative_to(root.resolve()))
                    text = "its USB adapter may be suspended when idle"
                    yield Finding(port, text, f"echo on | sudo tee {shown}")
            return


def look_at_load(cores: int | None = None, load: float | None = None) -> Iterator[Finding]:
    """Yield that programs want more processors than there are, with what can be done; nothing if not.

    ``load`` is the mean number of programs that want one, by default that of the last minute; ``cores`` are by default
    those of this machine.
    """
    available = cores or os.cpu_count() or 1
    used = os.getloadavg()[0] if load is None else load
    if used > available:
        advice = _priority_advice()
        text = f"are busy: {used:.1f} programs wanted {available} in the last minute; close others{advice[0]}"
        yield Finding("processors", text, advice[1])


def _priority_advice() -> tuple[str, str]:
    """Return, as words to append and as a command, how to give a run real-time priority; both empty if it may not be.

    It may for root, or if the limit of this user allows for the priority.
    """
    import resource

    permitted, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
    if os.geteuid() == 0 or permitted == resource.RLIM_INFINITY or permitted >= _PRIORITY_OF_A_RUN:
        return ", or give the run priority", f"chrt --fifo {_PRIORITY_OF_A_RUN} station run ..."
    return "", ""
