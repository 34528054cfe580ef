"""Seeded cases of effects outside the catalogue: three recordings, and the verification run as it was without noise."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from motions import simulate
from numpy.typing import NDArray

from estimator.geometry.array import SensorArray, tetrahedron
from estimator.recordings.recording import ImuData, Recording
from open_worlds import (
    effects,
    fifth_sealed,
    fourth,
    fourth_sealed,
    fresh,
    fresh_sealed,
    sixth_sealed,
    third,
    third_sealed,
)
from open_worlds.effects import Kind, Scene
from open_worlds.motion import DEG, SCRIPTS, SITE, motion_of
from sims.physics.hidden.temperature import Temperature
from station.opening import DeviceTruth, Hidden

Floats = NDArray[np.float64]

ARRAY: SensorArray = tetrahedron()
STATES = np.tile([0.005, 0.1 * DEG, 0.1 * DEG, -0.1 * DEG], (4, 1))
"""True k, b, sigma_j, sigma_k of every gyro."""
RATE_HZ = 100.0
RISE_C = 8.0
INSTABILITY_DPH = 2.0
SHAPES = {
    "exponential": {"time_constant": "250 s"},
    "linear": {"shape": "linear", "over": "360 s"},
    "cycle": {"shape": "cycle", "over": "300 s"},
}
SHAPES_BY_RUN = (
    {"shape": "cycle", "over": "300 s"},
    {"time_constant": "90 s"},
    {"shape": "cycle", "over": "200 s"},
)
"""Courses of the temperature that differ between runs, so that what has a memory is no function of time alone."""

NEWER: dict[str, dict[str, Kind]] = {
    "fresh": fresh.KINDS,
    "fresh-sealed": fresh_sealed.KINDS,
    "third": third.KINDS,
    "third-sealed": third_sealed.KINDS,
    "fourth": fourth.KINDS,
    "fourth-sealed": fourth_sealed.KINDS,
    "fifth-sealed": fifth_sealed.KINDS,
    "sixth-sealed": sixth_sealed.KINDS,
}
"""Newer kinds by the half that they are in as a whole."""
OLDER = ("development", "sealed")
"""Halves of the older kinds, each case of which is in one of them by a hash."""
KINDS: dict[str, Kind] = effects.KINDS | {name: kind for kinds in NEWER.values() for name, kind in kinds.items()}
HALVES = (*OLDER, *NEWER)

_QUIET_DPS = 1e-7


@dataclass(frozen=True, slots=True)
class Case:
    """A kind of effect, its size over that which is as harmful as the catalogue's, and the seed of all else."""

    kind: str
    size: float
    seed: int

    @property
    def half(self) -> str:
        """The half it belongs to: of two successive seeds of an older kind, a hash takes one for each."""
        for half, kinds in NEWER.items():
            if self.kind in kinds:
                return half
        digest = hashlib.sha256(f"{self.kind}/{self.seed // 2}".encode()).digest()
        return OLDER[(digest[0] + self.seed) % 2]

    @property
    def law(self) -> Kind:
        """What is to be known of the kind."""
        return KINDS[self.kind]

    def numbers(self, *what: int) -> list[int]:
        """Return a seed for random numbers of this case."""
        return [int.from_bytes(hashlib.sha256(self.kind.encode()).digest()[:4], "big"), self.seed, *what]

    def temperature(self, number: int) -> dict[str, str]:
        """Return the course of the temperature in run ``number``, in words of the twin's hidden effects.

        A linear one equals time, so only kinds that are about temperature may have it.
        """
        if self.law.shape == "by run":
            shape = SHAPES_BY_RUN[number]
        else:
            choices = list(SHAPES) if self.law.thermal else ["exponential", "cycle"]
            shape = SHAPES[self.law.shape or choices[self.seed % len(choices)]]
        return {"rise": f"{RISE_C} degC", **shape}

    @property
    def has_temperature(self) -> bool:
        """Whether the temperature is in the recordings."""
        return self.law.thermal or self.seed % 2 == 0

    @property
    def scripts(self) -> tuple[str, str, str]:
        """Names of the scripts of calibration, exploration and verification."""
        tilted = "tilted " if self.law.tilted else ""
        return "calibration", f"{tilted}exploration", f"{tilted}verification"


@dataclass(frozen=True, slots=True, eq=False)
class Made:
    """What a case has become: recordings to fit and to verify on, the latter also without noise; true columns by run.

    ``columns`` (n, m) by run hold the effect for a size of 1; ``effect_rps`` is its rms over all gyros and runs.
    """

    fitted: tuple[Recording, Recording]
    verification: Recording
    clean: Recording
    columns: tuple[Floats, Floats, Floats]
    effect_rps: float


def cases_of(kinds: Sequence[str], sizes: Sequence[float], seeds: int, half: str = "all") -> list[Case]:
    """Return the cases of kinds; ``half`` is one of HALVES or "all"."""
    cases = [Case(kind, size, seed) for seed in range(seeds) for size in sizes for kind in kinds]
    return [case for case in cases if half in ("all", case.half)]


def made(case: Case) -> Made:
    """Return the recordings of a case."""
    recordings, columns = zip(*(_with_effect(case, number, quiet=False) for number in range(3)), strict=True)
    clean, _ = _with_effect(case, 2, quiet=True)
    sizes = sizes_of(case)
    effect_rps = float(np.sqrt(np.mean([np.mean(np.square(sizes * c)) for c in columns])))
    return Made((recordings[0], recordings[1]), recordings[2], clean, columns, effect_rps)


def sizes_of(case: Case) -> Floats:
    """Return by how much of its law each gyro (4,) has."""
    if case.law.sized:
        return np.ones(len(ARRAY))
    random = np.random.default_rng(case.numbers(1))
    if case.law.common:
        return np.full(len(ARRAY), case.size * random.uniform(0.7, 1.3) * random.choice([-1.0, 1.0]))
    return np.asarray(case.size * random.uniform(0.5, 1.5, len(ARRAY)) * random.choice([-1.0, 1.0], len(ARRAY)))


def _with_effect(case: Case, number: int, *, quiet: bool) -> tuple[Recording, Floats]:
    """Return the recording of run ``number`` and its column (n, m)."""
    recording = _simulated(case, number, quiet=quiet)
    data = recording.sources["array"]
    scene = scene_of(case, number, data.rate_rps, quiet=quiet)
    column = np.broadcast_to(case.law.law(scene), data.rate_rps.shape)
    kept = 0.0 if quiet and case.law.noise else 1.0
    data = replace(data, rate_rps=data.rate_rps + kept * sizes_of(case) * column)
    return replace(recording, sources={"array": _told(case, data)}), column


def scene_of(case: Case, number: int, output_rps: Floats, *, quiet: bool = False) -> Scene:
    """Return what the effect of a case sees of run ``number``."""
    motion = motion_of(case.scripts[number])
    return Scene(
        motion,
        ARRAY.p,
        ARRAY.j,
        ARRAY.k,
        _profile(case, number).above(motion.t_s),
        output_rps,
        number,
        np.random.default_rng(case.numbers(2)),
        np.random.default_rng(case.numbers(3, number)),
        case.size,
        case.law.arw_dps * DEG * math.sqrt(RATE_HZ),
        quiet,
    )


def _profile(case: Case, number: int) -> Temperature:
    profile = Hidden.of({"temperature": case.temperature(number)}).temperature
    assert profile is not None
    return profile


def _told(case: Case, data: ImuData) -> ImuData:
    return data if case.has_temperature else replace(data, temperature_c=None)


def _simulated(case: Case, number: int, *, quiet: bool) -> Recording:
    device = DeviceTruth(
        ARRAY,
        STATES,
        (_QUIET_DPS if quiet else case.law.arw_dps) * DEG,
        0.0 if quiet else INSTABILITY_DPH * DEG / 3600,
        rate_hz=RATE_HZ,
        kind="tetrahedron",
    )
    hidden = Hidden.of({"temperature": case.temperature(number)})
    noise = case.numbers(4, number)
    seed = int(np.random.default_rng(noise).integers(2**31))
    return simulate(SCRIPTS[case.scripts[number]], {"array": device}, seed, site=SITE, hidden=hidden)
