"""Answers counted: the lines that a release or a reader asks for."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from open_worlds.answers import Addition, Answer
from open_worlds.cases import Case
from open_worlds.judging import (
    STATED,
    by_error_alone,
    is_part,
    is_right,
    like_oracle,
    raised,
    raised_as_told,
    ratio_claims_too_much,
    ratio_holds,
    says_what_it_depends_on,
    stated,
)
from open_worlds.motion import DEG
from open_worlds.oracle import Oracle

_EXCITED = 3.0
"""By how much knowing a law has to lower the error, at size 1, for a case to show anything."""


def scored(answers: Sequence[Answer]) -> list[str]:
    """Return the score of cases of foreign effects, in lines."""
    said = [(answer, added) for answer in answers for added in stated(answer)]
    wrong = [(answer, added) for answer, added in said if not is_right(answer, added)]
    lucky = [(answer, added) for answer, added in said if by_error_alone(answer, added)]
    lines = [
        f"cases: {len(answers)} of {len({a.case.kind for a in answers})} kinds; verdicts: "
        + _counted(a.verdict for a in answers),
        f"additions stated at {STATED:g} and more, right or an honest equivalent: "
        + _share([is_right(a, d) for a, d in said]),
    ]
    for size in _sizes(answers):
        lines.append(f"  size {size:g}: " + _share([is_right(a, d) for a, d in said if a.case.size == size]))
    lines += [
        "  or a leading term of the law: " + _share([is_right(a, d) or is_part(a, d) for a, d in said]),
        "  constructed: " + _share([is_right(a, d) for a, d in said if d.constructed]),
        f"  right by the error alone, under another name of the catalogue: {len(lucky)}",
        "  wrong: " + _counted(d.expression or d.name for _, d in wrong),
        *_growth(answers),
        *_near_oracle(answers),
        *_improvement(answers),
        "95 % intervals of the states by verdict (k and tilts; b; b within the range of the true bias):",
    ]
    for verdict in sorted({a.verdict for a in answers}):
        own = [a for a in answers if a.verdict == verdict]
        lines.append(f"  {verdict:16s} {_states(own)}")
    lines.append(f"  {'all':16s} {_states(answers)}")
    return [*lines, *_cost(answers)]


def _growth(answers: Sequence[Answer]) -> list[str]:
    added = [a for a in answers if a.added]
    grown = [a for a in added if raised(a)]
    told = [a for a in added if raised_as_told(a)]
    return [
        f"something kept though the true error grew beyond chance: {len(grown)} of {len(added)}{_named(grown)}",
        f"  though the program's own figures grew: {len(told)} of {len(added)}{_named(told)}",
    ]


def _near_oracle(answers: Sequence[Answer]) -> list[str]:
    measured = [a for a in answers if a.case.law.measured]
    others = [a for a in measured if not like_oracle(a)]
    lines = ["measured kinds with an error below 1.5 x the oracle's: " + _share([like_oracle(a) for a in measured])]
    for size in _sizes(measured):
        lines.append(f"  size {size:g}: " + _share([like_oracle(a) for a in measured if a.case.size == size]))
    return [*lines, "  the others name what it depends on: " + _share([says_what_it_depends_on(a) for a in others])]


def _improvement(answers: Sequence[Answer]) -> list[str]:
    claims = [a for a in answers if ratio_holds(a) is not None]
    misses = [a for a in claims if not ratio_holds(a)]
    after = [a.told_after / a.true_after for a in claims]
    lines = [
        "interval of the improvement holds the true ratio: " + _share([ratio_holds(a) for a in claims]),
        "  of the misses claim too much: " + _share([ratio_claims_too_much(a) for a in misses]),
    ]
    if after:
        low, middle, high = np.percentile(after, [10, 50, 90])
        lines.append(f"  stated error after over the true one: {middle:.2f} (80 % from {low:.2f} to {high:.2f})")
    return lines


def _cost(answers: Sequence[Answer]) -> list[str]:
    if not answers:
        return []
    seconds = [a.cpu_s for a in answers]
    worst = max(answers, key=lambda a: a.cpu_s).case
    return [
        f"processor time of investigate: median {np.median(seconds):.1f} s, worst {max(seconds):.1f} s"
        f" ({worst.kind} {worst.size:g} seed {worst.seed}); peak memory {max(a.peak_mb for a in answers):.0f} MB"
    ]


def by_kind(answers: Sequence[Answer]) -> list[str]:
    """Return a line a kind and size: verdicts, names, errors over the oracle's, in deg/h."""
    lines = [f"{'kind':30s} size  before   after  oracle  verdicts and names"]
    for kind, size in sorted({(a.case.kind, a.case.size) for a in answers}):
        own = [a for a in answers if (a.case.kind, a.case.size) == (kind, size)]
        figures = [_median([in_dph(get(a)) for a in own]) for get in _FIGURES]
        lines.append(f"{kind:30s} {size:4g} " + " ".join(f"{f:7.1f}" for f in figures) + "  " + _told(own))
    return lines


def excited(cases: Sequence[tuple[Case, Oracle]]) -> list[str]:
    """Return a line for each case: errors in deg/h of the states alone and of the oracle, and their ratio."""
    lines = [f"{'kind':30s} size seed  states  oracle   ratio"]
    for case, oracle in sorted(cases, key=lambda pair: (pair[0].kind, -pair[0].size, pair[0].seed)):
        errors = f"{in_dph(oracle.states_rps):7.1f} {in_dph(oracle.error_rps):7.1f} {oracle.gain:7.1f}"
        hidden = "  hardly shown" if oracle.gain < _EXCITED else ""
        lines.append(f"{case.kind:30s} {case.size:4g} {case.seed:4d} {errors}{hidden}")
    known = [(case, oracle) for case, oracle in cases if np.isfinite(oracle.gain)]
    for size in sorted({case.size for case, _ in known}, reverse=True):
        shown = [oracle.gain >= _EXCITED for case, oracle in known if case.size == size]
        lines.append(f"size {size:g}: the law lowers the error {_EXCITED:g} times and more in {_share(shown)}")
    return lines


_FIGURES: tuple[Callable[[Answer], float], ...] = (lambda a: a.true_before, lambda a: a.true_after, lambda a: a.oracle)


def _told(answers: Sequence[Answer]) -> str:
    verdicts = _counted(a.verdict + (f" ({a.depends_on})" if a.depends_on else "") for a in answers)
    names = _counted((d.expression or d.name) + _judgement(a, d) for a in answers for d in a.added)
    return f"{verdicts}; {names}" if names else verdicts


def _judgement(answer: Answer, added: Addition) -> str:
    weak = "" if added.probability >= STATED else f" at {added.probability:.2f}"
    if is_right(answer, added):
        return weak
    return weak + (" (part)" if is_part(answer, added) else " (WRONG)")


def _named(answers: Sequence[Answer]) -> str:
    cases = ", ".join(f"{a.case.kind} {a.case.size:g} seed {a.case.seed}" for a in answers)
    return f": {cases}" if cases else ""


def _sizes(answers: Sequence[Answer]) -> list[float]:
    return sorted({a.case.size for a in answers}, reverse=True)


def _states(answers: Sequence[Answer]) -> str:
    count = len(answers)
    parts = ((12, [a.scales for a in answers]), (4, [a.biases for a in answers]), (4, [a.biases_met for a in answers]))
    return "  ".join(f"{100 * sum(held) / max(each * count, 1):5.1f} %" for each, held in parts) + f"  of {count}"


def _share(flags: Iterable[bool | None]) -> str:
    known = [bool(flag) for flag in flags]
    return f"{sum(known)} of {len(known)}" + (f" ({100 * np.mean(known):.0f} %)" if known else "")


def _counted(names: Iterable[str]) -> str:
    return ", ".join(f"{name} {count}" if count > 1 else name for name, count in Counter(names).most_common())


def _median(values: Sequence[float]) -> float:
    known = [v for v in values if np.isfinite(v)]
    return float(np.median(known)) if known else float("nan")


def in_dph(rate_rps: float) -> float:
    """Return a rate in deg/h."""
    return rate_rps / DEG * 3600
