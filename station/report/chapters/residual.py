"""What an investigation traced in the residual."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from estimator.effects.constructed import readable as words
from station.render.investigation_printed import verdict_lines
from station.report.figures import COVERAGE, worded
from station.report.recorded import Recorded
from station.views.investigation import InvestigationView
from station.views.words import probability


def file_names(paths: Sequence[str]) -> str:
    """Return the names of files."""
    return ", ".join(Path(path).name for path in paths)


def is_among(recorded: Recorded, what: Mapping[str, Any]) -> bool:
    """Return whether an investigation was made with a recording."""
    return recorded.path.name in {Path(path).name for key in ("recordings", "verification") for path in what[key]}


def added_rows(added: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, Markup, str]]:
    """Return the effects that were traced: name, parameter, value with its expanded uncertainty, probability."""
    return [
        (
            words(effect["effect"]),
            name,
            worded(_number(value), COVERAGE * _number(sd), unit),
            probability(_number(effect["probability"])),
        )
        for effect in added
        for name, (value, sd, unit) in effect["parameters"].items()
    ]


def findings(what: InvestigationView) -> list[str]:
    """Return what else an investigation says, in sentences."""
    return [sentence(said) for said in (*verdict_lines({**what, "added": []}), *what["notes"])]


def _number(value: float | None) -> float:
    """Return a number of JSON, in which null stands for what is not known."""
    return math.nan if value is None else float(value)


def sentence(text: str) -> str:
    """Return a text as a sentence, nothing if it is empty."""
    text = text.strip()
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith('.') else '.'}" if text else ""
