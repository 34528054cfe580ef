"""The command `station study`: which study, what is checked before the long work, what is printed."""

import argparse
import json
import math
import sys

from station.errors import UsageError
from station.render.terminal import print_rendered, stdout
from station.studies import detection
from station.views.json_values import json_object

EXIT_INCOMPLETE = 1


def command_study(arguments: argparse.Namespace) -> int:
    """Run a study; 0 if all of it ran, 1 if some seeds failed, 2 for wrong usage."""
    groups = [name.strip() for name in arguments.effects.split(",")]
    known = {*detection.GROUPS, *detection.KNOWN, *detection.UNKNOWN}
    for group in groups:
        if group not in known:
            raise UsageError(f"--effects: there is no {group}; choose from {', '.join(sorted(known))}")
    try:
        sizes = [float(size) for size in arguments.sizes.split(",")]
    except ValueError:
        raise UsageError(f"--sizes takes numbers, for instance 1,0.3,0.1, not {arguments.sizes}") from None
    where = {"scheduler": arguments.scheduler, "workers": arguments.jobs, "quiet": arguments.json}
    study = detection.run_study(groups, sizes, arguments.seeds, **where)
    if arguments.json:
        print(json.dumps({"study": "detection", "lines": json_object(study.lines)}))
    else:
        print_rendered(stdout(), "station.studies", "detection.rich", {"lines": study.lines, "isnan": math.isnan})
    for failure in study.failures:
        print(f"station: seed {failure.item} failed: {failure.reason}", file=sys.stderr)
    return EXIT_INCOMPLETE if study.failures else 0
