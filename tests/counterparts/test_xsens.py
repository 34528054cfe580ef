"""Xsens' own library, as Debian's MRPT has it built in, opens, configures and reads the twin of an MTi."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest
from strangers import compiled
from support import TwinProcess, changed

BENCH = Path(__file__).parents[1] / "data" / "benches" / "galil_xsens.toml"
LIBRARIES = ("hwdrivers", "obs", "config", "system", "core", "serialization", "rtti", "poses", "math", "containers")


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> str:
    headers = [f"-I{folder}" for folder in Path("/usr/include/mrpt").glob("*/include")]
    options = ["-std=c++17", "-O0", *headers, "-I/usr/include/eigen3", *(f"-lmrpt-{name}" for name in LIBRARIES)]
    header = "mrpt/config/CConfigFileMemory.h"
    folder = tmp_path_factory.mktemp("mti")
    return compiled(folder, "mti_reader", header, "libmrpt-hwdrivers-dev", *options, compiler="c++")


def test_the_makers_library_reads_the_twin(reader: str, tmp_path: Path) -> None:
    """Its identity, its configuration, and then every sample: at rest, what the twin's bias is."""
    bench = tmp_path / "bench.toml"
    bench.write_text(changed(BENCH.read_text(), ('latitude = "45 deg"', 'latitude = "0 deg"')))
    with TwinProcess("--bench", bench) as twin:
        port = twin.links["mti"].removeprefix("serial://")
        done = subprocess.run([reader, port, "115200", "100", "3"], capture_output=True, text=True, timeout=40)
    assert done.returncode == 0, done.stderr
    rates_rps = np.array([line.split() for line in done.stdout.splitlines()], dtype=np.float64)
    assert 280 <= len(rates_rps) <= 310
    assert np.abs(rates_rps.mean(axis=0)).max() < 0.02
