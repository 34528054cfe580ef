"""Effects that are not in the catalogue: what station investigate says of them, judged by the truth.

python tests/bench/open_world.py                           development half, sizes 1 and 0.3
python tests/bench/open_world.py --half fresh              ten newer kinds; third: six more; fourth: ten
python tests/bench/open_world.py --half all --kinds rate_sign chirp --sizes 1 --seeds 2
python tests/bench/open_world.py --half sealed             once, at the end; so is every half whose name ends in -sealed
python tests/bench/open_world.py --half fresh-sealed --oracle    whether the scripts show them: no investigation
python tests/bench/open_world.py --half fresh --json new.json --compare old.json    what a change has changed
python tests/bench/open_world.py --stored new.json --compare old.json    the same of answers that are there already
python tests/bench/open_world.py --clean 100               noise only: nothing may be added
python tests/bench/open_world.py --list                    kinds, and what may honestly be said of each
"""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import asdict
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from open_worlds.answers import answer_of
from open_worlds.cases import HALVES, KINDS, Case, cases_of, made
from open_worlds.clean import clean_answer_of, clean_cases, clean_score
from open_worlds.oracle import Oracle, oracle_of
from open_worlds.score import by_kind, excited, scored
from open_worlds.stored import compared, load, store

from station.campaigns.campaigns import Failure, run_all


def listed() -> None:
    for kind in KINDS.values():
        same = f"; the same here: {', '.join(sorted(kind.equivalents))}" if kind.equivalents else ""
        parts = f"; in part: {', '.join(sorted(kind.parts))}" if kind.parts else ""
        told = "measured" if kind.measured else "not measured"
        print(f"{kind.name:30s} {told}, depends on {', '.join(sorted(kind.depends_on))}{same}{parts}")


def foreign(arguments: argparse.Namespace) -> None:
    failures: list[Failure] = []
    if arguments.stored:
        answers = load(arguments.stored)
    else:
        cases = cases_of(arguments.kinds, arguments.sizes, arguments.seeds, arguments.half)[: arguments.most]
        ended, failures = run_all(answer_of, cases, label="cases", workers=arguments.workers)
        answers = [answer for answer in ended if answer is not None]
    print("\n".join([*by_kind(answers), "", *scored(answers)]))
    for failure in failures:
        print(f"failed: {failure.item}: {failure.reason}")
    if arguments.json:
        store(arguments.json, answers)
    if arguments.compare:
        print("\n".join(["", *compared(load(arguments.compare), answers)]))


def oracle_alone(case: Case) -> tuple[Case, Oracle]:
    """Return what who knows the law makes of a case."""
    return case, oracle_of(case, made(case))


def shown(arguments: argparse.Namespace) -> None:
    cases = cases_of(arguments.kinds, arguments.sizes, arguments.seeds, arguments.half)[: arguments.most]
    ended, failures = run_all(oracle_alone, cases, label="cases", workers=arguments.workers)
    print("\n".join(excited([pair for pair in ended if pair is not None])))
    for failure in failures:
        print(f"failed: {failure.item}: {failure.reason}")


def clean(arguments: argparse.Namespace) -> None:
    cases = clean_cases(arguments.clean)
    ended, failures = run_all(clean_answer_of, cases, label="clean cases", workers=arguments.workers)
    answers = [a for a in ended if a is not None]
    print("\n".join(clean_score(answers)))
    for failure in failures:
        print(f"failed: {failure.item}: {failure.reason}")
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(answer) for answer in answers], indent=1))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS), metavar="KIND")
    parser.add_argument("--sizes", nargs="+", type=float, default=[1.0, 0.3])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--half", choices=(*HALVES, "all"), default="development")
    parser.add_argument("--most", type=int, help="stop after so many cases")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--clean", type=int, metavar="COUNT", help="so many recordings of noise instead")
    parser.add_argument("--json", type=Path, help="every answer, as JSON")
    parser.add_argument("--stored", type=Path, metavar="JSON", help="judge these answers: no investigation")
    parser.add_argument("--compare", type=Path, metavar="JSON", help="earlier answers: print which cases changed")
    parser.add_argument("--oracle", action="store_true", help="errors of who knows the law, and of the states alone")
    parser.add_argument("--list", action="store_true")
    arguments = parser.parse_args()
    if arguments.list:
        listed()
    elif arguments.oracle:
        shown(arguments)
    elif arguments.clean:
        clean(arguments)
    else:
        foreign(arguments)
