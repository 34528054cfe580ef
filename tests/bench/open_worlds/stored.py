"""Answers as JSON, and what changed from one set of them to another."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from open_worlds.answers import Addition, Answer
from open_worlds.cases import Case
from open_worlds.judging import Outcome, like_oracle, outcome_of, raised, stated


def store(path: Path, answers: Sequence[Answer]) -> None:
    """Write answers; they are judged when they are read, by the rules of that day."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps([asdict(answer) for answer in answers], indent=1))


def load(path: Path) -> list[Answer]:
    """Read answers that ``store`` wrote."""
    return [_answer(fields) for fields in json.loads(path.read_text())]


def compared(old: Sequence[Answer], new: Sequence[Answer]) -> list[str]:
    """Return, in lines, which cases that both have changed: first what was stated of them, then the error reached."""
    before = {answer.case: answer for answer in old}
    pairs = [(before[answer.case], answer) for answer in new if answer.case in before]
    moves = Counter((outcome_of(was), outcome_of(now)) for was, now in pairs)
    changed = [pair for pair in pairs if _states_of(pair[0]) != _states_of(pair[1])]
    lines = [f"in both: {len(pairs)} cases; only before {len(old) - len(pairs)}, only now {len(new) - len(pairs)}"]
    lines += [f"  {was} -> {now}: {count}" for (was, now), count in sorted(moves.items()) if was != now]
    for was, now in sorted(changed, key=lambda pair: (pair[1].case.kind, -pair[1].case.size, pair[1].case.seed)):
        case = now.case
        lines.append(f"{case.kind:30s} {case.size:4g} seed {case.seed}: {_told(was)}  ->  {_told(now)}")
    if pairs:
        medians = [float(np.median([answer.cpu_s for answer in side])) for side in zip(*pairs, strict=True)]
        lines.append(f"processor time, median: {medians[0]:.1f} s -> {medians[1]:.1f} s")
    return lines


def _states_of(answer: Answer) -> tuple[Outcome, bool, bool]:
    return outcome_of(answer), like_oracle(answer), raised(answer)


def _told(answer: Answer) -> str:
    names = ", ".join(added.expression or added.name for added in stated(answer))
    marks = [str(outcome_of(answer))]
    if like_oracle(answer):
        marks.append("as an oracle")
    if raised(answer):
        marks.append("RAISED")
    return " ".join(marks) + (f" ({names})" if names else "")


def _answer(fields: dict[str, Any]) -> Answer:
    fields["case"] = Case(**fields["case"])
    fields["added"] = tuple(Addition(**added) for added in fields["added"])
    fields["rivals"] = tuple(tuple(names) for names in fields["rivals"])
    return Answer(**fields)
