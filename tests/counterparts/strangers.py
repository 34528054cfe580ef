"""Programs that are not ours, built or found; what is missing is said by name."""

from __future__ import annotations

import mmap
import os
import shutil
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import pytest

HERE = Path(__file__).parent


def needs_python(module: str, package: str) -> pytest.MarkDecorator:
    """Return a mark: skip where a package of PyPI is not installed."""
    return pytest.mark.skipif(find_spec(module) is None, reason=f"{package} is not installed (pip install {package})")


def needs_program(program: str, package: str) -> pytest.MarkDecorator:
    """Return a mark: skip where a program of Debian is not installed."""
    missing = shutil.which(program) is None
    return pytest.mark.skipif(missing, reason=f"{program} is not installed (apt install {package})")


def compiled(folder: Path, name: str, header: str, package: str, *options: str, compiler: str = "cc") -> str:
    """Return the program that a source of this folder makes; skip without compiler or the header of a package."""
    source = next(HERE.glob(f"{name}.c*"))
    if shutil.which(compiler) is None:
        pytest.skip(f"no compiler ({compiler})")
    program = str(folder / name)
    built = subprocess.run([compiler, "-O2", "-o", program, source, *options], capture_output=True, text=True)
    if f"{header}:" in built.stderr and "No such file" in built.stderr:
        pytest.skip(f"{header} is not there (apt install {package})")
    assert built.returncode == 0, built.stderr
    return program


@dataclass
class RateTable:
    """The table that ``rate_table.c`` is: its TCP port, the terminal of its gyros, and what it really does."""

    port: int
    gyros: str
    _truth: mmap.mmap

    def truth(self) -> tuple[float, ...]:
        """Return angles (3) in rad, rates (3) in rad/s, the number of requests, the state of the first drive, 0."""
        return struct.unpack("9d", self._truth[:72])

    def at_rest(self) -> bool:
        """Return whether no axis turns."""
        return not any(self.truth()[3:6])


@contextmanager
def rate_table(program: str, folder: Path, *serial: str, cycle_s: float = 0.0) -> Iterator[RateTable]:
    """Start it, on TCP or with port, baud rate and unit id of a ``serial`` line.

    Its drives sample their controlwords every ``cycle_s``, in steps of 0.5 ms; 0: they act at once.
    """
    truth = folder / f"truth-{os.urandom(4).hex()}"
    words = [program, "rtu" if serial else "tcp", str(truth), *serial]
    surroundings = os.environ | {"CYCLE_S": str(cycle_s)}
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=surroundings)
    assert process.stdout is not None
    try:
        port, gyros = int(process.stdout.readline()), process.stdout.readline().strip()
        with truth.open("r+b") as file, mmap.mmap(file.fileno(), 72) as kept:
            yield RateTable(port, gyros, kept)
    finally:
        process.terminate()
        process.wait(10)
        process.stdout.close()
