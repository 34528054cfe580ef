"""Answers counted: the lines that an issue, a release or a reader asks for."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from open_worlds.answers import Addition, Answer, in_dph
from open_worlds.cases import Case
from open_worlds.oracle import Oracle

_STATED = 0.95
_EXCITED = 3.0
"""By how much knowing a law has to lower the error, at size 1, for a case to show anything."""


def scored(answers: Sequence[Answer]) -> list[str]:
    """Return the score of cases of foreign effects, in lines."""
    said = [(a, d) for a in answers for d in a.added if d.probability >= _STATED]
    measured = [a for a in answers if a.case.law.measured]
    open_ended = [a for a in measured if not a.like_oracle]
    ratios = [a.ratio_holds for a in answers if a.ratio_holds is not None]
    lines = [
        f"cases: {len(answers)} of {len({a.case.kind for a in answers})} kinds; verdicts: "
        + _counted(a.verdict for a in answers),
        "additions stated at 0.95 and more, right or an honest equivalent: " + _share([d.right for _, d in said]),
        "  or a leading term of the law: " + _share([d.right or d.part for _, d in said]),
        "  constructed: " + _share([d.right for _, d in said if d.constructed]),
        "  wrong names: " + _counted(d.name for _, d in said if not d.right),
        f"  wrong, with an error below 1.5 x the oracle's: {sum(a.like_oracle and not d.right for a, d in said)}",
        f"additions kept that raise the true error beyond chance: {sum(a.raised for a in answers)}",
        f"  and by the program's own figures: {sum(bool(a.added) and a.told_after > a.told_before for a in answers)}",
        "measured kinds with an error below 1.5 x the oracle's: " + _share([a.like_oracle for a in measured]),
        "  the others name what it depends on: " + _share([a.says_what_it_depends_on for a in open_ended]),
        "interval of the improvement holds the true ratio: " + _share(ratios),
        "95 % intervals of the states by verdict (k and tilts; b; b within the range of the true bias):",
    ]
    for verdict in sorted({a.verdict for a in answers}):
        own = [a for a in answers if a.verdict == verdict]
        lines.append(f"  {verdict:16s} {_states(own)}")
    return [*lines, f"  {'all':16s} {_states(answers)}"]


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
    names = _counted(d.name + _judgement(d) for a in answers for d in a.added)
    return f"{verdicts}; {names}" if names else verdicts


def _judgement(addition: Addition) -> str:
    return "" if addition.right else " (part)" if addition.part else " (WRONG)"


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
