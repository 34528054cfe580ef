"""The whole document: one HTML file that needs nothing beside itself."""

import importlib.metadata
import platform
import re
from dataclasses import dataclass
from itertools import count

from markupsafe import Markup

from drivers.packaged import packaged_text
from estimator.calibration.budget import TYPE_A
from station.exports.exported import RAW_RULE, file_sha256, raw_sha256
from station.render.template import rendered
from station.report import figures, pictures
from station.report import traced as residual
from station.report.chapters import correction, front, results, unseen
from station.report.recorded import Recorded, laid_out
from station.report.standing import Standing, begun_utc, number_of, standing_of
from station.report.traced import Traced
from station.views.seen import seen_by

_PACKAGES = ("turntable-station", "numpy", "scipy", "h5py", "matplotlib")
_MADE_OF = {
    "begun_utc": begun_utc,
    "blind_spots": unseen,
    "correction": correction,
    "figures": figures,
    "front": front,
    "pictures": pictures,
    "raw_rule": RAW_RULE,
    "residual": residual,
    "results": results,
    "seen_by": seen_by,
    "type_a": TYPE_A,
}
"""What the templates ask for values."""


@dataclass(frozen=True, slots=True)
class Report:
    """A document and what identifies it; ``hashes`` are SHA-256 of the recording's "file" and "data"."""

    html: str
    standing: Standing
    number: str
    hashes: dict[str, str]


def make_report(recorded: Recorded, traced: Traced | None) -> Report:
    """Return the report of a recording, with an investigation if there is one.

    Raises BenchError if the bench text in the recording cannot be read, EstimatorError for an error model that is of
    another version.
    """
    hashes = {"file": file_sha256(recorded.path), "data": raw_sha256(recorded.path)}
    if traced is not None and traced.path != recorded.path:
        hashes["investigation"] = file_sha256(traced.path)
    standing = standing_of(recorded)
    number = number_of(recorded, tuple(hashes.values()))
    device = recorded.text("device_serial") or recorded.text("device")
    foot = f"{device}, {recorded.path.name}" if device else recorded.path.name
    versions = [f"{name} {importlib.metadata.version(name)}" for name in _PACKAGES]
    values = {
        "recorded": recorded,
        "found": recorded.calibration,
        "standing": standing,
        "unseen": unseen.unseen_of(recorded),
        "traced": traced,
        "hashes": hashes,
        "number": number,
        "device": device,
        "sheet": Markup(_sheet(standing.title, f"No. {number}", foot)),
        "made_with": ", ".join([*versions, f"Python {platform.python_version()}"]),
        "next_number": count(1).__next__,
    }
    with laid_out(recorded.path, "what it or its investigation holds cannot be reported ({})"):
        html = rendered("station.report", "report.html", _MADE_OF | values)
    return Report(html, standing, number, hashes)


def _sheet(head: str, number: str, foot: str) -> str:
    """Return the style sheet with what stands at the head and the foot of every printed page."""
    shown = {"HEAD": head, "NUMBER": number, "FOOT": foot}
    text = packaged_text("station.report", "report.css")
    return re.sub(r"\b(HEAD|NUMBER|FOOT)\b", lambda found: _quoted(shown[found.group()]), text)


def _quoted(text: str) -> str:
    """Return a text as CSS has it: whatever is in it, it ends neither the string nor the sheet."""
    return '"' + "".join(c if c.isalnum() or c in " .,:-" else f"\\{ord(c):x} " for c in text) + '"'
