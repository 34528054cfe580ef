"""What several tests and benchmarks need: the paper's truth, runs from the physics, runs of the command."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import forks
import numpy as np
from motions import simulate

from estimator.geometry.array import SensorArray, tetrahedron
from estimator.geometry.kinematics import Site
from estimator.recordings.recording import Recording
from sims.physics.hidden import Hidden
from station.opening import DeviceTruth
from station.scripts.loop_scripts import exploration_script, verification_script
from station.scripts.script import Script, paper_script

SITE = Site(np.pi / 4, 0.0)
TABLE_1 = np.array([0.005, np.radians(0.1), np.radians(0.1), np.radians(-0.1)])
"""The paper's true states of every gyro: k, b, sigma_j, sigma_k."""


def direct_recording(
    seed: int,
    *,
    script: Script | None = None,
    kind: str | None = "tetrahedron",
    array: SensorArray | None = None,
    states: np.ndarray | None = None,
    arw_dps: float = 0.005,
    instability_dph: float = 0.0,
    walk_dph_rth: float = 0.0,
    rate_hz: float = 100.0,
) -> Recording:
    """Return a recording made straight from the physics of the twins."""
    array = array or tetrahedron()
    states = np.tile(TABLE_1, (len(array), 1)) if states is None else states
    device = DeviceTruth(
        array,
        states,
        float(np.radians(arw_dps)),
        float(np.radians(instability_dph / 3600)),
        float(np.radians(walk_dph_rth / 3600 / 60)),
        rate_hz,
        kind=kind,
    )
    return simulate(script or paper_script(), {"array": device}, seed, site=SITE)


ASYMMETRY = {"scale_asymmetry": {"size": ["2000 ppm", "-2000 ppm", "1500 ppm", "2000 ppm"]}}
"""What a twin may hide: gyros whose scale factors differ by direction."""


def tetrahedron_recording(script: Script, seed: int, hidden: Mapping[str, Any], started_s: float = 0.0) -> Recording:
    """Return a recording of the tetrahedron with a bias instability of 2 deg/h, and what is hidden in it."""
    noise = {"arw_rps_rthz": float(np.radians(0.005)), "bias_instability_rps": float(np.radians(2 / 3600))}
    device = DeviceTruth(tetrahedron(), np.tile(TABLE_1, (4, 1)), **noise, kind="tetrahedron")
    hides = Hidden.of(hidden) if hidden else None
    return simulate(script, {"array": device}, seed, site=SITE, hidden=hides, started_s=started_s)


def three_recordings(seed: int, hidden: Mapping[str, Any]) -> list[Recording]:
    """Return a calibration, an exploration and a verification recording of one session."""
    made, clock_s = [], 0.0
    for number, script in enumerate((paper_script(), exploration_script(), verification_script())):
        made.append(tetrahedron_recording(script, 10 * seed + number, hidden, clock_s))
        clock_s += script.least_s + 20
    return made


def first_gyros(count: int, *recordings: Recording) -> list[Recording]:
    """Return recordings of the first gyros of an array alone: what holds of each gyro is seen sooner with fewer."""
    found = []
    for recording in recordings:
        data = recording.sources["array"]
        few = replace(data, array=data.array.select(list(range(count))), rate_rps=data.rate_rps[:, :count])
        found.append(replace(recording, sources={"array": few}))
    return found


def changed(text: str, *changes: tuple[str, str], most: int = -1) -> str:
    """Return a text with other words in the place of some, at ``most`` so many of each; all of them must be there."""
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, most)
    return text


def station(*arguments: str | Path, cwd: Path | None = None, timeout: float = 100) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process of its own, a fork where there is a server of forks."""
    return subprocess.run(forked(*arguments), capture_output=True, text=True, cwd=cwd, timeout=timeout, check=False)


def command(*arguments: str | Path) -> list[str]:
    """Return the command line as a process would be started with."""
    return [forks.PYTHON, "-m", "station.cli", *map(str, arguments)]


def forked(*arguments: str | Path) -> list[str]:
    """Return the same for a fork, where there is a server of them: for what is not about starts, SIGKILL or SIGSTOP."""
    return [forks.interpreter(), *command(*arguments)[1:]]


@contextmanager
def ctrl_c_of_children(*, ignored: bool = False) -> Iterator[None]:
    """Start child processes here with the default action of SIGINT, or with SIGINT ignored.

    A shell starts a background job with SIGINT ignored, and every child inherits that.
    """
    action = signal.SIG_IGN if ignored else signal.default_int_handler  # a handler becomes the default on exec
    before = signal.signal(signal.SIGINT, action)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


class TwinProcess:
    """`station twin` in a process of its own; ``links`` by device as it printed them."""

    def __init__(self, *arguments: str | Path) -> None:
        """Start it and wait until it is ready."""
        self.process = subprocess.Popen(
            forked("twin", *arguments), stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONUNBUFFERED": "1"}
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
