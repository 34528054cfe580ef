"""The paper's experiment, to the letter and by this station's default, beside its Tables 2 and 3.

python tests/bench/paper.py                                            200 seeds
python tests/bench/paper.py --seeds 20 --plot convergence.png -o curves.h5
python tests/bench/paper.py --json
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from paper_study import printed, study

from station.atomic_write import check_new_file, check_picture


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--plot", type=Path, help="draw the convergence of every state (.png, .svg or .pdf)")
    parser.add_argument("--output", "-o", type=Path, help="write the curves and their recording (.h5)")
    parser.add_argument("--jobs", type=int, help="processes; default: one per core")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(argv)
    if given.plot is not None:
        check_picture(given.plot)
    if given.output is not None:
        check_new_file(given.output, "--output")
    found = study.run_study(given.seeds, workers=given.jobs, quiet=given.json)
    if given.plot is not None or given.output is not None:
        recording = study.our_recording(study.MEMS_NOISE, 0)
        ours = study.our_curve(recording)
        if given.plot is not None:
            printed.draw_convergence(given.plot, ours, found.letter)
        if given.output is not None:
            study.write_curves(given.output, recording, ours, found.letter)
    if given.json:
        print(json.dumps(printed.paper_object(found)))
    else:
        printed.print_paper(found)
    return 1 if found.failures else 0


if __name__ == "__main__":
    raise SystemExit(main())
