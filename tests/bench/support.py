"""What several tests and benchmarks need: the paper's truth, runs from the physics, runs of the command."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from estimator.array import SensorArray, tetrahedron
from estimator.kinematics import Site
from estimator.recording import ImuData, Recording
from estimator.reference import TableReadings
from sims.direct import TimedMove, direct_run
from sims.geometry import MOUNTS_DEG, mounted
from sims.gyro import GyroTruth
from station.script import Move, Rest, Script, paper_script

GIMBALS = ("z", "y", "x")
SITE = Site(np.pi / 4, 0.0)
TABLE_1 = np.array([0.005, np.radians(0.1), np.radians(0.1), np.radians(-0.1)])
"""The paper's true states of every gyro: k, b, sigma_j, sigma_k."""


def truth(states: np.ndarray, arw_dps: float = 0.005, instability_dph: float = 0.0) -> GyroTruth:
    """Return twin truths of states (n, 4)."""
    return GyroTruth(*np.asarray(states).T, float(np.radians(arw_dps)), float(np.radians(instability_dph / 3600)))


def timed(script: Script) -> list[TimedMove]:
    """Return the moves of a script with the instants at which they begin."""
    at, angles, moves = 0.0, dict.fromkeys(GIMBALS, 0.0), []
    for step, duration in zip(script.steps, script.durations_s(), strict=True):
        if not isinstance(step, Rest):
            angles[step.axis] = step.angle_rad if isinstance(step, Move) else angles[step.axis] + step.turn_rad
            moves.append(TimedMove(at, step.axis, angles[step.axis], abs(step.rate_rps), step.acceleration_rps2))
        at += duration
    return moves


def direct_recording(
    seed: int,
    *,
    script: Script | None = None,
    kind: str = "tetrahedron",
    array: SensorArray | None = None,
    states: np.ndarray | None = None,
    arw_dps: float = 0.005,
    instability_dph: float = 0.0,
    rate_hz: float = 100.0,
) -> Recording:
    """Return a recording made straight from the physics of the twins."""
    script, array = script or paper_script(), array or tetrahedron()
    states = np.tile(TABLE_1, (len(array), 1)) if states is None else states
    run = direct_run(
        timed(script),
        script.duration_s,
        mounted(MOUNTS_DEG[kind]),
        truth(states, arw_dps, instability_dph),
        seed,
        gimbals=GIMBALS,
        latitude_rad=SITE.latitude_rad,
        heading_rad=SITE.heading_rad,
        rate_hz=rate_hz,
    )
    reference = TableReadings(run.table_t_ns, run.angle_rad, run.rate_rps, GIMBALS)
    return Recording({"array": ImuData(array, run.t_ns, run.output_rps)}, reference, SITE)


def station(*arguments: str | Path, cwd: Path | None = None, timeout: float = 100) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process of its own."""
    return subprocess.run(command(*arguments), capture_output=True, text=True, cwd=cwd, timeout=timeout, check=False)


def command(*arguments: str | Path) -> list[str]:
    """Return the command line as a process would be started with."""
    return [sys.executable, "-m", "station.cli", *map(str, arguments)]


class TwinProcess:
    """`station twin` in a process of its own; ``links`` by device as it printed them."""

    def __init__(self, *arguments: str | Path) -> None:
        """Start it and wait until it is ready."""
        self.process = subprocess.Popen(
            command("twin", *arguments), stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONUNBUFFERED": "1"}
        )
        self.links: dict[str, str] = {}
        assert self.process.stdout is not None
        for line in self.process.stdout:
            said: dict[str, Any] = json.loads(line)
            if said.get("ready"):
                return
            self.links[said["device"]] = said["link"]
        raise RuntimeError(f"station twin ended with {self.process.wait()}")

    def options(self, *devices: str) -> list[str]:
        """Return the options that point `station run` at these devices."""
        return [word for device in devices for word in ("--link", f"{device}={self.links[device]}")]

    def __enter__(self) -> TwinProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        self.process.wait(10)
        if self.process.stdout is not None:
            self.process.stdout.close()
