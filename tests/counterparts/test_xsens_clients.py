"""Xsens' own library, as Debian's MRPT has it built in, opens, configures and reads the twin of an MTi."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest
from strangers import compiled
from support import TwinProcess

BENCH = Path(__file__).parents[1] / "data" / "benches" / "galil_xsens.toml"
LIBRARIES = ("hwdrivers", "obs", "config", "system", "core", "serialization", "rtti", "poses", "math", "containers")


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> str:
    headers = [f"-I{folder}" for folder in Path("/usr/include/mrpt").glob("*/include")]
    options = ["-std=c++17", "-O0", *headers, "-I/usr/include/eigen3", *(f"-lmrpt-{name}" for name in LIBRARIES)]
    header = "mrpt/config/CConfigFileMemory.h"
    folder = tmp_path_factory.mktemp("mti")
    return compiled(folder, "mti_reader", header, "libmrpt-hwdrivers-dev", *options, compiler="c++")


def test_the_makers_library_reads_the_twin(reader: str) -> None:
    """Its identity, its configuration, and then every sample: at rest, what the twin's biases are."""
    with TwinProcess("--bench", BENCH) as twin:
        port = twin.links["mti"].removeprefix("serial://")
        done = subprocess.run([reader, port, "115200", "100", "3"], capture_output=True, text=True, timeout=40)
    assert done.returncode == 0, done.stderr
    lines = (line.removeprefix("sample ").split() for line in done.stdout.splitlines() if line.startswith("sample "))
    rates_rps = np.array(list(lines), dtype=np.float64)
    assert 280 <= len(rates_rps) <= 310
    earth_dph = np.degrees(rates_rps.mean(axis=0)) * 3600 + (20, -35, 10)  # 10.6 deg/h north and up, tilted by 4 deg
    assert np.abs(earth_dph).max() < 60  # 3 s of its noise are 5 deg/h, one sigma
