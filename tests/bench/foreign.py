"""Sets of recordings as others make them, put through the commands: what is right, half right, wrong.

python tests/bench/foreign.py                      the half for development, all kinds
python tests/bench/foreign.py --half sealed        the half that stays untouched until the end
python tests/bench/foreign.py --only robot jitter  some kinds; --seeds 0 3; --keep FOLDER keeps the files

A set is right if every state that it shows is within three of its sigmas of the truth, that sigma small enough to tell
something, if what is wrong with it is named, and if nothing is named that is not there. It is half right if only a name
is missing. Files, truth and judging are of this folder's own: nothing of the estimator is in them.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import re
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("COLUMNS", "240")

import numpy as np
from foreign_sets.sets import HALVES, KINDS, ForeignSet, built

from station.cli import main as station


def run(*arguments: str | Path) -> tuple[int, str, str]:
    """Return exit code, stdout and stderr of a command, run in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = station([str(one) for one in arguments])
        except SystemExit as end:
            code = int(end.code or 0)
        except Exception:  # what a user would see as a traceback
            traceback.print_exc()
            code = 99
    return code, out.getvalue(), err.getvalue()


def judged(case: ForeignSet, folder: Path) -> tuple[str, list[str]]:
    """Return right, half or wrong, and what is not as it should be."""
    expected = case.expected
    recording = folder / (case.recording or "imported.h5")
    said = ""
    wrong: list[str] = []
    missing: list[str] = []
    if case.files:
        (folder / "mapping.toml").write_text(case.mapping)
        code, out, err = run(
            "import", folder / "mapping.toml", *(folder / name for name in case.files), "-o", recording
        )
        said += out + err
        if code:
            return "wrong", [f"import ends with {code}: {err.strip()[-300:]}"]
    code, out, err = run("calibrate", recording, "--details")
    if "--details" in err:  # before there was one, all was printed
        code, out, err = run("calibrate", recording)
    said += out + err
    _, printed, _ = run("calibrate", recording, "--json")
    found: dict[str, Any] = json.loads(printed) if printed.strip().startswith("{") else {}
    if not found.get("gyros") and expected.states:
        wrong.append(f"calibrate ends with {code}: {err.strip()[-300:]}")
    wrong += _states(case, found)
    code, out, err = run("investigate", recording)
    said += out + err
    code, printed, err = run("investigate", recording, "--json")
    if "Traceback" in err:
        wrong.append(f"investigate: {err.strip().splitlines()[-1]}")
    elif code == 2 and not expected.untraced:
        wrong.append(f"investigate refuses: {err.strip()[-200:]}")
    elif code != 2:
        traced = json.loads(printed)
        names = [added["effect"] for added in traced["added"]]
        if traced["verdict"] not in expected.verdicts:
            wrong.append(f"{traced['verdict']}: {traced['reason']}")
        if foreign := [name for name in names if name not in expected.added]:
            wrong.append(f"added {', '.join(foreign)}")
    missing += [f"not said: {one}" for one in expected.says if not re.search(one, said)]
    wrong += [f"said: {found[0]}" for one in expected.never if (found := re.search(one, said))]
    (folder / "said.txt").write_text(said)
    return ("wrong" if wrong else "half" if missing else "right"), wrong + missing


def _states(case: ForeignSet, found: dict[str, Any]) -> list[str]:
    wrong = []
    gyros = {gyro["name"]: gyro for gyro in found.get("gyros", [])}
    for name, (k, b_dps) in case.expected.states.items():
        if name not in gyros:
            wrong.append(f"{name} is not estimated")
            continue
        gyro, sd = gyros[name], gyros[name]["sd"]
        for state, true, unit, most in (
            ("k", k, 1.0, case.expected.k_sd),
            ("b_rps", np.radians(b_dps), float(np.degrees(1)), case.expected.b_sd_dps),
        ):
            if not np.isfinite(true):
                continue
            error = gyro[state] - true
            if not abs(error) < 3 * sd[state]:
                wrong.append(f"{state} of {name} {unit * error:+.4g} off, sigma {unit * sd[state]:.2g}")
            elif unit * sd[state] > most:
                wrong.append(f"{state} of {name}: a sigma of {unit * sd[state]:.2g} tells nothing")
    return wrong


def main() -> None:
    """Judge sets and print a line for each, and what they come to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--half", choices=tuple(HALVES), default="development")
    parser.add_argument("--only", nargs="+", choices=sorted(KINDS), default=sorted(KINDS))
    parser.add_argument("--seeds", nargs="+", type=int)
    parser.add_argument("--keep", type=Path)
    arguments = parser.parse_args()
    total: Counter[str] = Counter()
    for name in arguments.only:
        for seed in arguments.seeds or HALVES[arguments.half]:
            with tempfile.TemporaryDirectory() as made:
                folder = arguments.keep / f"{name}_{seed}" if arguments.keep else Path(made)
                folder.mkdir(parents=True, exist_ok=True)
                case = built(name, seed, folder)
                (folder / "imported.h5").unlink(missing_ok=True)
                began = time.process_time()
                verdict, why = judged(case, folder)
                total[verdict] += 1
                print(f"{name} {seed}: {verdict} ({time.process_time() - began:.0f} s)", flush=True)
                for line in why:
                    print(f"    {line}", flush=True)
    print(f"{sum(total.values())} sets: {dict(total)}")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
