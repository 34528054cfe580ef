"""Recordings in which there is nothing but noise, against references of every kind: nothing may be added to them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from motions import simulate
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.importing.external_rows import external_reference
from estimator.importing.mapping.columns import Columns
from estimator.importing.mapping.reference import Measured
from estimator.recordings.recording import Recording
from estimator.recordings.reference import AttitudeReadings, RateReadings, Reference
from estimator.tracing.investigate import investigate
from open_worlds.answers import covered
from open_worlds.cases import ARRAY, STATES
from open_worlds.motion import DEG, SCRIPTS, SITE, motion_of
from station.opening import DeviceTruth

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]

REFERENCES = ("table", "rate", "attitude", "encoder", "rests")
_RATES_HZ = (100.0, 25.0, 50.0, 200.0, 100.0, 25.0, 1000.0, 50.0, 400.0, 100.0)
_INSTABILITIES_DPH = (0.0, 2.0, 5.0, 10.0)
_WALKS_DPH_RTH = (0.0, 3.0, 10.0)
_ARWS_DPS = (0.002, 0.005, 0.02)
_COUNTS = 4000
_REFERENCE_HZ = 100.0
_FEELS_MPS2 = 0.02
_G_MPS2 = 9.80665
_REST_RPS = 1e-9
_NAMES = {"encoder": "spindle ", "rests": "poses "}


@dataclass(frozen=True, slots=True)
class CleanCase:
    """A kind of reference and the seed of all else."""

    reference: str
    seed: int

    @property
    def rate_hz(self) -> float:
        """Samples a second of the gyros."""
        return _RATES_HZ[self.seed % len(_RATES_HZ)]

    @property
    def runs(self) -> tuple[int, int]:
        """How many recordings are fitted, and how many are held back."""
        return (2, 1) if self.seed % 3 == 0 else (1, 1) if self.seed % 3 == 1 else (1, 0)

    def random(self, *what: int) -> np.random.Generator:
        """Return random numbers of this case."""
        return np.random.default_rng([REFERENCES.index(self.reference), self.seed, 17, *what])


@dataclass(frozen=True, slots=True)
class CleanAnswer:
    """What was said of a recording of noise; ``states`` and ``held`` count intervals of states, those that hold."""

    case: CleanCase
    verdict: str
    added: tuple[tuple[str, float], ...]
    depends_on: str
    states: int
    held: int


def clean_cases(count: int) -> list[CleanCase]:
    """Return so many cases, every kind of reference in turn."""
    return [CleanCase(REFERENCES[i % len(REFERENCES)], i // len(REFERENCES)) for i in range(count)]


def clean_answer_of(case: CleanCase) -> CleanAnswer:
    """Return what the program answers to a clean case."""
    fitted, held_back = case.runs
    recordings = [clean_recording(case, number) for number in range(fitted + held_back)]
    found = investigate(recordings[:fitted], recordings[fitted:])
    states = held = 0
    if case.reference in ("table", "rate", "attitude"):  # the others do not show every state
        states, held = 3 * len(ARRAY), covered(found, STATES[:, [1, 1]])[0]
    depends_on = "" if found.unexplained is None else str(found.unexplained.depends_on)
    added = tuple((a.effect, a.probability) for a in found.added)
    return CleanAnswer(case, str(found.finding), added, depends_on, states, held)


def clean_recording(case: CleanCase, number: int) -> Recording:
    """Return run ``number`` of a case: the noise level is the case's, the walk is the run's."""
    of_case, of_run = case.random(), case.random(number)
    device = DeviceTruth(
        ARRAY,
        STATES,
        float(of_case.choice(_ARWS_DPS)) * DEG,
        float(of_case.choice(_INSTABILITIES_DPH)) * DEG / 3600,
        float(of_run.choice(_WALKS_DPH_RTH)) * DEG / 3600 / 60,
        rate_hz=case.rate_hz,
        kind="tetrahedron",
    )
    name = _NAMES.get(case.reference, "") + ("exploration", "calibration", "verification")[number]
    earth = case.reference != "attitude"  # which knows nothing of the Earth's turning
    seed = int(of_run.integers(2**31))
    recording = simulate(SCRIPTS[name], {"array": device}, seed, site=SITE, earth_turns=earth)
    if case.seed % 2:
        data = replace(recording.sources["array"], temperature_c=None)
        recording = replace(recording, sources={"array": data})
    return _REFERRED[case.reference](recording, name, of_run)


def _table(recording: Recording, name: str, random: np.random.Generator) -> Recording:
    return recording


def _rate(recording: Recording, name: str, random: np.random.Generator) -> Recording:
    """Another instrument, which feels the Earth, too: 0.003 deg/s/rtHz."""
    motion = motion_of(name, _REFERENCE_HZ)
    noise = 0.003 * DEG * np.sqrt(_REFERENCE_HZ) * random.standard_normal((len(motion.t_s), 3))
    return _with(recording, RateReadings(_ns(motion.t_s), motion.inertial_rps + noise))


def _attitude(recording: Recording, name: str, random: np.random.Generator) -> Recording:
    """Cameras: attitudes with 0.02 deg of noise."""
    motion = motion_of(name, _REFERENCE_HZ)
    jitter = Rotation.from_rotvec(0.02 * DEG * random.standard_normal((len(motion.t_s), 3)))
    x, y, z, w = (Rotation.from_matrix(motion.attitude) * jitter).as_quat().T
    return _with(recording, AttitudeReadings(_ns(motion.t_s), np.column_stack([w, x, y, z])))


def _encoder(recording: Recording, name: str, random: np.random.Generator) -> Recording:
    """The angle of z in 4000 counts a turn, as an import makes a reference of it."""
    motion = motion_of(name, _REFERENCE_HZ)
    count = 2 * np.pi / _COUNTS
    angle = np.floor(motion.angle_rad[:, 0] / count + random.uniform()) * count
    stated = Measured("angle", Columns(names=("angle",)), "z", earth_rate=True)
    return _with(recording, external_reference(stated, _ns(motion.t_s), angle[:, None]), keep_site=True)


def _rests(recording: Recording, name: str, random: np.random.Generator) -> Recording:
    """Poses by hand: at rest Earth rate is known and an accelerometer feels gravity, between them nothing is known."""
    data = recording.sources["array"]
    motion = motion_of(name, 1e9 / float(data.t_ns[1] - data.t_ns[0]))
    still = np.abs(motion.rate_rps).max(axis=1) < _REST_RPS
    known = np.where(still[:, None], motion.inertial_rps, np.nan)
    felt = _G_MPS2 * motion.up + _FEELS_MPS2 * random.standard_normal(motion.up.shape)
    recording = replace(recording, sources={"array": replace(data, accel_mps2=felt)})
    return _with(recording, RateReadings(data.t_ns, known), keep_site=True)


_REFERRED: dict[str, Callable[[Recording, str, np.random.Generator], Recording]] = {
    "table": _table,
    "rate": _rate,
    "attitude": _attitude,
    "encoder": _encoder,
    "rests": _rests,
}


def _with(recording: Recording, reference: Reference, *, keep_site: bool = False) -> Recording:
    return replace(recording, reference=reference, site=recording.site if keep_site else None)


def _ns(t_s: Floats) -> Stamps:
    return np.asarray(np.round(t_s * 1e9), dtype=np.int64)


def clean_score(answers: Sequence[CleanAnswer]) -> list[str]:
    """Return how many ended as they must, in lines."""
    added = [a for a in answers if a.added]
    wrong = [a for a in answers if a.verdict != "nothing to add"]
    states, held = (sum(values) for values in ([a.states for a in answers], [a.held for a in answers]))
    lines = [
        f"clean: {len(answers)}; something added in {len(added)}, another verdict than nothing to add in {len(wrong)}",
        f"95 % intervals of k and tilts hold: {100 * held / max(states, 1):.1f} % of {states}",
    ]
    for a in wrong:
        names = ", ".join(f"{name} {probability:.3f}" for name, probability in a.added)
        lines.append(f"  {a.case.reference} {a.case.seed} at {a.case.rate_hz:g} Hz: {a.verdict} {a.depends_on} {names}")
    return lines
