"""A machine with Debian's kernel in QEMU, for what needs kernel modules: the host's files, and commands that are run.

Nothing is installed: the kernel's package is fetched from Debian's archive and unpacked in a folder that goes with the
test. No KVM is needed; without it the guest is some 10 to 20 times slower than its host.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent
SHARED = Path("/mnt")
"""Where the guest has the folder that host and guest share."""

MODULES = ("virtio_pci", "9pnet_virtio", "9p", "can", "can_raw", "can_gw", "vcan", "can_dev", "slcan", "can_j1939")
PROGRAMS = {
    "qemu-system-x86_64": "qemu-system-x86",
    "busybox": "busybox-static",
    "cpio": "cpio",
    "depmod": "kmod",
    "dpkg-deb": "dpkg",
    "ip": "iproute2",
    "candump": "can-utils",
}
"""What the host must have, and the Debian package that has it."""

_BOOT_S = 120.0
_PATH = os.environ.get("PATH", "") + ":/usr/sbin:/sbin"  # where depmod and ip are, also for people


class NoGuestError(Exception):
    """This machine cannot have a guest; says what is missing."""


def missing() -> list[str]:
    """Return the Debian packages that the host lacks."""
    return [package for name, package in PROGRAMS.items() if shutil.which(name, path=_PATH) is None]


def fetch_kernel(folder: Path) -> Path:
    """Unpack the kernel of linux-image-amd64; return the folder that it is in, NoGuestError if that cannot be."""
    depends = _run("apt-cache", "depends", "linux-image-amd64")
    names = [line.split()[-1] for line in depends.splitlines() if "Depends: linux-image" in line]
    if not names:
        raise NoGuestError("apt knows no linux-image-amd64: is this Debian, and `apt-get update` done?")
    _run("apt-get", "download", names[0], folder=folder)
    (package,) = folder.glob("linux-image-*.deb")
    _run("dpkg-deb", "-x", str(package), str(folder / "kernel"))
    package.unlink()
    return folder / "kernel"


def build_initramfs(kernel: Path, folder: Path) -> Path:
    """Put busybox, the modules with what they need, and ``init`` in an archive; return its path."""
    (modules,) = (kernel / "lib" / "modules").iterdir()
    _run("depmod", "-b", str(kernel), modules.name)
    needs = {}
    for line in (modules / "modules.dep").read_text().splitlines():
        path, _, others = line.partition(":")
        needs[Path(path).name.removesuffix(".ko").replace("-", "_")] = [path, *others.split()]
    root = folder / "initramfs"
    wanted = {path for name in MODULES for path in needs[name]}
    for path in sorted(wanted):
        target = root / "lib" / "modules" / modules.name / path
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(modules / path, target)
    for table in ("modules.order", "modules.builtin"):
        shutil.copy(modules / table, root / "lib" / "modules" / modules.name / table)
    _run("depmod", "-b", str(root), modules.name)
    (root / "bin").mkdir()
    shutil.copy(shutil.which("busybox") or "", root / "bin" / "busybox")
    shutil.copy(HERE / "init", root / "init")
    (root / "init").chmod(0o755)
    (root / "modules").write_text("\n".join(MODULES))
    (root / "agent").write_text(f"{sys.executable} {HERE / 'agent.py'}\n")
    archive = folder / "initramfs.cpio"
    names = "\n".join(str(path.relative_to(root)) for path in sorted(root.rglob("*")))
    with archive.open("wb") as out:
        subprocess.run(["cpio", "-o", "-H", "newc", "--quiet"], input=names.encode(), stdout=out, cwd=root, check=True)
    return archive


@dataclass(slots=True)
class Job:
    """A command in the guest."""

    guest: Guest
    name: str

    @property
    def output(self) -> str:
        """Get what it has printed so far."""
        path = self.guest.shared / f"{self.name}.out"
        return path.read_text(errors="replace") if path.exists() else ""

    def wait(self, timeout_s: float) -> int:
        """Return its exit code; TimeoutError if it does not end."""
        return self.guest.exit_code(self.name, timeout_s)

    def wait_for(self, text: str, timeout_s: float) -> bool:
        """Return whether it prints this text before it ends; AssertionError if it does neither in time."""
        ends = time.monotonic() + timeout_s
        while text not in self.output:
            assert time.monotonic() < ends, f"no {text!r} within {timeout_s:g} s:\n{self.output}"
            if self.guest.ended(self.name):
                return text in self.output
            time.sleep(0.1)
        return True


class Guest:
    """A running guest; ``shared`` is the folder that both see."""

    def __init__(self, folder: Path, kernel: Path, initramfs: Path, *, cores: int = 2) -> None:
        """Boot it; NoGuestError with the end of its console if it does not come up."""
        self.shared = folder / "shared"
        self.shared.mkdir()
        self._folder, self._jobs, self._codes, self._rest = folder, 0, dict[str, int](), b""
        (image,) = (kernel / "boot").glob("vmlinuz-*")
        self._console = folder / "console"
        control = Path(tempfile.mkdtemp(prefix="guest-")) / "control"
        share = "local,security_model=none,multidevs=remap"
        command = [
            "qemu-system-x86_64", "-accel", "tcg,thread=multi", "-cpu", "max", "-smp", str(cores), "-m", "2048",
            "-nodefaults", "-no-reboot", "-display", "none", "-nic", "none",
            "-kernel", str(image), "-initrd", str(initramfs), "-append", "console=ttyS0 quiet mitigations=off panic=-1",
            "-serial", f"file:{self._console}", "-serial", f"unix:{control},server=on,wait=off",
            "-virtfs", f"{share},path=/,mount_tag=root,readonly=on",
            "-virtfs", f"{share},path={self.shared},mount_tag=shared",
        ]  # fmt: skip
        self._machine = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        self._control = socket.socket(socket.AF_UNIX)
        try:
            self._connect(control)
            self._until(lambda: "ready" in self._codes, _BOOT_S)
        except (OSError, TimeoutError):
            self.close()
            console = self._console.read_text(errors="replace") if self._console.exists() else ""
            raise NoGuestError(f"the guest did not come up:\n{console[-2000:]}") from None
        finally:
            shutil.rmtree(control.parent, ignore_errors=True)

    def start(self, command: str | list[str]) -> Job:
        """Run the shell's text, or station's words, in the background: host's files, guest's kernel."""
        return self._ask("start", command)

    def load(self, modules: list[str], timeout_s: float) -> None:
        """Import modules before station's commands are forked, so that they need not."""
        self._ask("import", modules).wait(timeout_s)

    def stop(self, job: Job, timeout_s: float = 30.0) -> int:
        """Interrupt a command, as Ctrl-C does; return its exit code."""
        self._control.sendall(f"stop {job.name}\n".encode())
        return job.wait(timeout_s)

    def run(self, command: str | list[str], timeout_s: float = 60.0) -> str:
        """Run a command to its end; return what it printed. AssertionError if it fails."""
        job = self.start(command)
        code = job.wait(timeout_s)
        assert code == 0, f"{command}: exit code {code}\n{job.output}"
        return job.output

    def ended(self, name: str) -> bool:
        """Return whether a job is over."""
        self._hear(0.0)
        return name in self._codes

    def exit_code(self, name: str, timeout_s: float) -> int:
        """Wait for a job's end."""
        self._until(lambda: name in self._codes, timeout_s)
        return self._codes[name]

    def close(self) -> None:
        """Switch it off."""
        self._control.close()
        self._machine.kill()
        self._machine.wait()

    def _ask(self, verb: str, what: object) -> Job:
        self._jobs += 1
        name = f"job{self._jobs}"
        (self.shared / f"{name}.json").write_text(json.dumps(what))
        self._control.sendall(f"{verb} {name}\n".encode())
        return Job(self, name)

    def _connect(self, control: Path) -> None:
        ends = time.monotonic() + 10.0
        while True:
            try:
                self._control.connect(str(control))
            except OSError:
                if time.monotonic() > ends or self._machine.poll() is not None:
                    raise
                time.sleep(0.05)
            else:
                return

    def _until(self, done: Callable[[], bool], timeout_s: float) -> None:
        ends = time.monotonic() + timeout_s
        while not done():
            if self._machine.poll() is not None or time.monotonic() > ends:
                raise TimeoutError(f"nothing heard of the guest for {timeout_s:g} s")
            self._hear(0.2)

    def _hear(self, timeout_s: float) -> None:
        self._control.settimeout(timeout_s or 0.001)
        try:
            self._rest += self._control.recv(4096)
        except (TimeoutError, BlockingIOError):
            return
        *lines, self._rest = self._rest.split(b"\n")
        for line in lines:
            name, _, code = line.decode("ascii", "replace").strip().partition(" ")
            self._codes[name] = int(code or 0)


def _run(*command: str, folder: Path | None = None) -> str:
    try:
        paths = {**os.environ, "PATH": _PATH}
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120, check=True, env=paths)
    except (OSError, subprocess.SubprocessError) as error:
        said = getattr(error, "stderr", "") or str(error)
        raise NoGuestError(f"{' '.join(command)}: {said.strip()[-500:]}") from None
    return done.stdout
