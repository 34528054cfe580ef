"""Scripts as TOML files."""

import json

from station.bench.bench import Bench
from station.render.template import rendered
from station.scripts.script import Script
from station.views.improved import Improved


def script_text(script: Script, origin: str) -> str:
    """Return a script as TOML that ``station.scripts.script.load_script`` reads; ``origin`` is its first comment.

    ``origin`` may have several lines, without ``#``. NotImplementedError for a step of a kind that cannot be written.
    """
    steps = []
    for timed in script.timeline():
        lines = (*timed.step.written(timed.span.least_s), f"label = {_quoted(timed.step.label)}")
        steps.append("\n".join(("[[step]]", *lines)))
    values = {"origin": origin.splitlines(), "name": _quoted(script.name), "steps": steps}
    return rendered("station.commands", "script.toml", values)


def _quoted(text: str) -> str:
    """Return a text as a TOML string: that of JSON, with one more character escaped."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def origin_of(improved: Improved, bench: Bench) -> str:
    """Return the comment at the top of the script: for which bench and goal it was found, its length and its rests.

    It has three lines, without ``#``.
    """
    wanted = improved.wanted
    aim = "shortest time to its sigmas"
    if wanted.total_s is not None:
        aim = f"smallest sigmas in {wanted.total_s:g} s"
    lines = [
        f"Found by station plan --improve for the bench {bench.name!r}, criterion {wanted.criterion}: {aim}.",
        f"{improved.found.script.least_s:.1f} s; {improved.before.name} takes {improved.before.least_s:.1f} s.",
        f"It rests {wanted.rest_s:g} s at both ends, to separate noise from motion.",
    ]
    return "\n".join(lines)
