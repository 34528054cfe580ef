"""How often the station finds what twins were given and it was not told: power, false alarms, error against an oracle.

Each case is three recordings of one device, made from the physics (the 360 s script, exploration, verification), with
an effect that only the twin knows. Signs and sizes vary by gyro and seed.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from known_effects import fit_known
from motions import simulate

from drivers.packaged import packaged_toml
from drivers.types import Floats
from estimator.effects.site import EARTH_RATE
from estimator.estimation.runs.build import runs_of
from estimator.geometry.array import tetrahedron
from estimator.geometry.kinematics import Site
from estimator.recordings.recording import Recording
from estimator.tracing.augmented import Augmented
from estimator.tracing.investigate import investigate
from estimator.tracing.search import CERTAIN
from station.campaigns.campaigns import Failure, run_all
from station.opening import DeviceTruth, Hidden
from station.scripts.loop_scripts import exploration_script, verification_script
from station.scripts.script import Script, paper_script

RISE_C = 8.0
SITE = Site(math.pi / 4, 0.0)
STATES = np.tile([0.005, math.radians(0.1), math.radians(0.1), math.radians(-0.1)], (4, 1))
AXES = "zyx"
_GIVEN = packaged_toml("detection_study", "detection.toml")
KNOWN = tuple(_GIVEN["known"])
UNKNOWN: Mapping[str, frozenset[str]] = {name: frozenset(on) for name, on in _GIVEN["unknown"].items()}
"""Effects that are not in the catalogue, and what the residual depends on."""
EQUIVALENT: Mapping[str, frozenset[str]] = {name: frozenset(same) for name, same in _GIVEN["equivalent"].items()}
"""Effects of the catalogue that say the same physics in other words: a lagging bias is a bias with its gradient."""


@dataclass(frozen=True, slots=True)
class Case:
    """What the twin is given: effects by name, their size over that of the issue's list, noise; and the seed."""

    effects: tuple[str, ...]
    size: float
    seed: int
    instability_dph: float = 2.0
    walk_dph_rth: float = 0.0
    shape: str = "exponential"
    rate_hz: float = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class Ended:
    """What came of a case. ``error``, ``oracle``, ``bare`` are true rms errors on the verification run, rad/s."""

    case: Case
    finding: str
    added: tuple[tuple[str, float], ...]
    rivals: tuple[tuple[str, ...], ...]
    depends_on: str
    error: float
    oracle: float
    bare: float
    coverage_before: float
    coverage_after: float

    @property
    def exact(self) -> bool:
        """Whether just what is there was named."""
        return sorted(name for name, _ in self.added) == sorted(self.case.effects) and self.finding == "added"

    @property
    def among_rivals(self) -> bool:
        """Whether it was said that causes cannot be told apart, the true ones among them or found."""
        named = {name for names in self.rivals for name in names} | {name for name, _ in self.added}
        return self.finding == "cannot tell" and set(self.case.effects) <= named


def hidden_of(effects: Sequence[str], size: float, seed: int, shape: str = "exponential") -> Hidden:
    """Return what the twin is given: size 1 is that of METHOD 3, gyros from 0.5 to 1.5 of it with either sign."""
    random = np.random.default_rng([seed, 4711])
    tables: dict[str, Any] = {"temperature": {"rise": f"{RISE_C} degC", **_GIVEN["temperatures"][shape]}}

    def each(value: float) -> Floats:
        return np.asarray(value * size * random.uniform(0.5, 1.5, 4) * random.choice([-1.0, 1.0], 4))

    def drawn(given: Any) -> Any:
        match given:
            case [value, unit]:
                return [f"{one:.9g} {unit}" for one in each(value)]
            case {"positive": value, "unit": unit}:
                return [f"{abs(one):.9g} {unit}" for one in each(value)]
            case {"any_of": values}:
                return str(random.choice(list(values)))
            case {"common": value, "unit": unit}:
                return f"{value * size * random.uniform(0.5, 1.5):.9g} {unit}"
            case {"scaled": value, "unit": unit}:
                return f"{value * size:.9g} {unit}"
            case {"from": low, "to": high, "gyros": gyros, "unit": unit}:
                return [f"{one:.9g} {unit}" for one in random.uniform(low, high, gyros)]
            case {"from": low, "to": high, "unit": unit}:
                return f"{random.uniform(low, high):.9g} {unit}"
        return given

    for effect in effects:
        match _GIVEN["sizes"][effect]:
            case {"turned": value, "unit": unit}:
                axis, order = random.choice(list(AXES)), int(random.choice([1, 2, 4]))
                turned = random.uniform(0, 2 * math.pi, 4)
                tables[effect] = {
                    "axis": str(axis),
                    "order": order,
                    "cosine": [f"{value * size * math.cos(a):.9g} {unit}" for a in turned],
                    "sine": [f"{value * size * math.sin(a):.9g} {unit}" for a in turned],
                }
            case {**parts} if parts:
                tables[effect] = {key: drawn(value) for key, value in parts.items()}
    return Hidden.of(tables)


def recordings_of(case: Case) -> tuple[Recording, Recording, Recording]:
    """Return the calibration, exploration and verification recordings of a case."""
    scripts = (paper_script(), exploration_script(), verification_script())
    made = [_record(case, script, number) for number, script in enumerate(scripts)]
    return made[0], made[1], made[2]


def _record(case: Case, script: Script, number: int, quiet: bool = False) -> Recording:
    device = DeviceTruth(
        tetrahedron(),
        STATES,
        math.radians(1e-7 if quiet else 0.005),
        0.0 if quiet else math.radians(case.instability_dph / 3600),
        0.0 if quiet else math.radians(case.walk_dph_rth / 3600 / 60),
        rate_hz=case.rate_hz,
        kind="tetrahedron",
    )
    hidden = hidden_of(case.effects, case.size, case.seed, case.shape)
    made = simulate(script, {"array": device}, 10 * case.seed + number, site=SITE, hidden=hidden)
    return replace(made, site=None) if EARTH_RATE.name in case.effects else made


def end_of(case: Case) -> Ended:
    """Return what the station finds in a case, and how wrong its compensated rates then truly are."""
    calibration, exploration, verification = recordings_of(case)
    found = investigate([calibration, exploration], [verification])
    clean = _record(case, verification_script(), 2, quiet=True)
    known = [e for e in case.effects if e in KNOWN]
    oracle = fit_known([calibration, exploration], known)
    bare = fit_known([calibration, exploration], [])
    assert found.model is not None
    return Ended(
        case,
        str(found.finding),
        tuple((a.effect, a.probability) for a in found.added),
        found.rivals,
        found.unexplained.depends_on if found.unexplained else "",
        true_error(found.model, clean),
        true_error(oracle, clean),
        true_error(bare, clean),
        found.before.coverage95,
        found.after.coverage95,
    )


def true_error(model: Augmented, clean: Recording) -> float:
    """Return the rms over a recording without noise of what a model leaves of the output errors, rad/s."""
    (run,) = runs_of(clean, 1 / 100)[0]  # every sample: short enough for tones
    left = [run.z_rps[:, i] - model.predict(run, 99, i)[0] for i in range(len(run.array))]
    return float(np.sqrt(np.mean(np.square(left))))


@dataclass(frozen=True, slots=True)
class Summary:
    """All seeds of one line of the study: shares of them, means over those named exactly; NaN where there are none.

    ``right`` is what the line is about: the exact set, or for clean cases nothing, or for what is not in the catalogue
    the right dependence without a cause that is not there. ``told`` adds sets that cannot be told apart, true ones in.
    """

    name: str
    size: float
    seeds: int
    right: float
    told: float
    wrong: float
    over_oracle: float
    gain: float
    coverage_before: float
    coverage_after: float


@dataclass(frozen=True, slots=True, eq=False)
class DetectionStudy:
    """Every line, and the cases that failed."""

    lines: tuple[Summary, ...]
    failures: tuple[Failure, ...]


GROUPS = ("clean", "single", "pairs", "triples", "unknown")
_CLEAN_NOISE = {"clean": (2.0, 0.0), "clean, 10 deg/h": (10.0, 0.0), "clean, 10 deg/h, 10 deg/h/rth": (10.0, 10.0)}


def cases_of(groups: Sequence[str], sizes: Sequence[float], seeds: int) -> dict[tuple[str, float], list[Case]]:
    """Return the cases of each line by its name and size. Groups are those of GROUPS, or names of effects."""
    lines: dict[tuple[str, float], list[Case]] = {}
    for group in groups:
        if group == "clean":
            for name, (instability, walk) in _CLEAN_NOISE.items():
                lines[name, 0.0] = [Case((), 0.0, seed, instability, walk) for seed in range(seeds)]
        elif group in ("pairs", "triples"):
            count = 2 if group == "pairs" else 3
            for size in sizes:
                lines[group, size] = [Case(_drawn(count, seed), size, seed) for seed in range(seeds)]
        else:
            names = {"single": KNOWN, "unknown": tuple(UNKNOWN)}.get(group, (group,))
            for name in names:
                for size in sizes:
                    lines[name, size] = [Case((name,), size, seed) for seed in range(seeds)]
    return lines


def _drawn(count: int, seed: int) -> tuple[str, ...]:
    random = np.random.default_rng([seed, count])
    return tuple(sorted(random.choice(list(KNOWN), count, replace=False).tolist()))


def run_study(groups: Sequence[str], sizes: Sequence[float], seeds: int, **where: Any) -> DetectionStudy:
    """Return what was found in every case. ``where`` is that of ``run_all``."""
    lines = cases_of(groups, sizes, seeds)
    made, failures = run_all(end_of, [case for cases in lines.values() for case in cases], label="cases", **where)
    by_case = {e.case: e for e in made if e is not None}
    summaries = [
        _summary(name, size, [by_case[case] for case in cases if case in by_case])
        for (name, size), cases in lines.items()
    ]
    return DetectionStudy(tuple(s for s in summaries if s.seeds), tuple(failures))


def _right(ended: Ended) -> bool:
    case = ended.case
    if not case.effects:
        return ended.finding == "nothing to add"
    unknown = next((e for e in case.effects if e in UNKNOWN), None)
    if unknown is None:
        return ended.exact
    named = {name for name, _ in ended.added}
    same = EQUIVALENT.get(unknown, frozenset())
    if ended.finding == "unexplained":
        return ended.depends_on in UNKNOWN[unknown] and named <= same
    if ended.finding == "cannot tell":
        return all(set(rivals) & same for rivals in ended.rivals) and named <= same
    return bool(named) and named <= same


def _wrong(ended: Ended) -> bool:
    true = set(ended.case.effects).union(*(EQUIVALENT.get(e, frozenset()) for e in ended.case.effects))
    return any(name not in true and probability > CERTAIN for name, probability in ended.added)


def _summary(name: str, size: float, ended: Sequence[Ended]) -> Summary:
    exact = [e for e in ended if e.exact]

    def mean(values: Sequence[float]) -> float:
        return float(np.mean(values)) if len(values) else float("nan")

    return Summary(
        name,
        size,
        len(ended),
        mean([_right(e) for e in ended]),
        mean([_right(e) or e.among_rivals for e in ended]),
        mean([_wrong(e) for e in ended]),
        mean([e.error / e.oracle for e in exact]),
        mean([e.bare / e.error for e in exact]),
        mean([e.coverage_before for e in exact]),
        mean([e.coverage_after for e in exact or ended]),
    )
