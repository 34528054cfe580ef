"""How often effects that only the twin knows are found: recordings made from the physics, many seeds on all cores.

python tests/bench/detection.py                                        single effects and clean cases, 20 seeds
python tests/bench/detection.py --effects pairs,triples,unknown --sizes 1 --seeds 12
python tests/bench/detection.py --json
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence

from detection_study import study
from rich.table import Table

from station.render.terminal import rich_table, stdout
from station.views.figures import number
from station.views.json_values import json_object

TITLE = "What is found of effects that only the twin knows, % of seeds"
HEADS = (
    "effect",
    "size",
    "seeds",
    "right",
    "or told\nas rivals",
    "wrong\nname",
    "error over\noracle's",
    "before :\nafter",
    "coverage\nbefore",
    "\nafter",
)


def table_of(lines: Sequence[study.Summary]) -> Table:
    """Return the table of the study."""
    rows = [
        [
            line.name.replace("_", " "),
            f"{line.size:g}" if line.size else "-",
            str(line.seeds),
            number(100 * line.right, 0),
            number(100 * line.told, 0),
            number(100 * line.wrong, 0),
            number(line.over_oracle, 3),
            number(line.gain, 1),
            number(100 * line.coverage_before, 0),
            number(100 * line.coverage_after, 0),
        ]
        for line in lines
    ]
    return rich_table(TITLE, HEADS, "lr", rows, centred=True)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = {*study.GROUPS, *study.KNOWN, *study.UNKNOWN}
    parser.add_argument("--effects", default="clean,single", help=f"from {', '.join(sorted(known))}")
    parser.add_argument("--sizes", default="1,0.3,0.1", help="1 is plain to see")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--jobs", type=int, help="processes; default: one per core")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(argv)
    if unknown := set(given.effects.split(",")) - known:
        parser.error(f"there is no {', '.join(sorted(unknown))}; choose from {', '.join(sorted(known))}")
    sizes = [float(size) for size in given.sizes.split(",")]
    found = study.run_study(given.effects.split(","), sizes, given.seeds, workers=given.jobs, quiet=given.json)
    if given.json:
        print(json.dumps({"study": "detection", "lines": json_object(found.lines)}))
    else:
        stdout().print(table_of(found.lines))
    for failure in found.failures:
        print(f"seed {failure.item} failed: {failure.reason}", file=sys.stderr)
    return 1 if found.failures else 0


if __name__ == "__main__":
    sys.exit(main())
