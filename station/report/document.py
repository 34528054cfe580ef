"""The whole document: one HTML file without other files."""

import importlib.metadata
import platform
from dataclasses import dataclass
from os.path import basename
from pathlib import Path
from typing import Any

from drivers.packaged import packaged_toml
from estimator.calibration.budget import TYPE_A
from estimator.untrusted import harmless
from station.bench.units import Units
from station.errors import UsageError
from station.exports.exported import RAW_RULE, file_sha256, raw_sha256
from station.render.investigation_printed import verdict_lines
from station.render.template import rendered
from station.report import figures, investigation_chapter as residual, pictures
from station.report.chapters import correction, forces, front, results, unobserved_effects
from station.report.document_status import Standing, limits_of, number_of, standing_of
from station.report.formal import Formal, logo_of
from station.report.investigation_chapter import Traced
from station.report.recorded import Recorded, laid_out, read_recorded
from station.views.plan import combination
from station.views.seen import seen_by

_PACKAGES = ("turntable-station", "numpy", "scipy", "h5py", "matplotlib")
_MADE_OF = {
    "asked_for": packaged_toml("station.report", "certificate.toml")["not_stated"],
    "basename": basename,
    "blind_spots": unobserved_effects,
    "combination": combination,
    "correction": correction,
    "figures": figures,
    "forces": forces,
    "front": front,
    "pictures": pictures,
    "raw_rule": RAW_RULE,
    "residual": residual,
    "results": results,
    "seen_by": seen_by,
    "type_a": TYPE_A,
    "verdict_lines": verdict_lines,
}
"""What the templates ask for values."""


@dataclass(kw_only=True, frozen=True, slots=True)
class Report:
    """A document, SHA-256 of its sources ("file", "data" of the recording), the device as found, what was not seen."""

    html: str
    standing: Standing
    number: str
    hashes: dict[str, str]
    before: Recorded | None = None
    not_seen: unobserved_effects.Unseen | None = None


def make_report(recorded: Recorded, traced: Traced | None, formal: Formal) -> Report:
    """Return the report of a recording with its formal facts, and with an investigation if there is one.

    BenchError if the bench text in the recording cannot be read, EstimatorError for an error model of another version,
    UsageError if the recording as found does not match.
    """
    hashes = {"file": file_sha256(recorded.path), "data": raw_sha256(recorded.path)}
    if traced is not None and traced.path != recorded.path:
        hashes["investigation"] = file_sha256(traced.path)
    before = None if formal.item_as_found is None else _as_found(recorded, formal.item_as_found)
    if before is not None:
        hashes["as_found"] = file_sha256(before.path)
    standing = standing_of(recorded, formal)
    number = formal.certificate_number or number_of(recorded, tuple(hashes.values()), formal.certificate_replaces or "")
    device = formal.item_serial_number or recorded.text("device")
    versions = [f"{name} {importlib.metadata.version(name)}" for name in _PACKAGES]
    not_seen = unobserved_effects.unseen_of(recorded)
    values: dict[str, Any] = {
        "recorded": recorded,
        "on_table": recorded.recording.table is not None,
        "formal": formal,
        "logo": logo_of(formal.laboratory_logo) if formal.laboratory_logo else "",
        "before": before,
        "found": recorded.calibration,
        "summary": results.summary(recorded, standing),
        "states": figures.states_in(limits.units if (limits := limits_of(recorded)) is not None else Units()),
        "standing": standing,
        "unseen": not_seen,
        "traced": traced,
        "hashes": hashes,
        "number": number,
        "device": device,
        "foot": ", ".join(filter(None, (device, recorded.path.name))),
        "made_with": ", ".join([*versions, f"Python {platform.python_version()}"]),
        "titles": [],
    }
    with laid_out(recorded.path, "its content or its investigation cannot be reported ({})"):
        html = rendered("station.report", "report.html", _MADE_OF | values)
    # Names and texts of recordings, sources and files must not change the document's structure or direction.
    return Report(
        html=harmless(html), standing=standing, number=number, hashes=hashes, before=before, not_seen=not_seen
    )


def _as_found(recorded: Recorded, path: Path) -> Recorded:
    """Return the recording of the device as found; UsageError unless it is an earlier calibration of the same gyros."""
    before = read_recorded(path)
    serials = {before.text("device_serial"), recorded.text("device_serial"), ""}
    later = recorded.begun_utc and not (before.begun_utc and before.begun_utc <= recorded.begun_utc)
    if later or not before.labels or before.labels != recorded.labels or len(serials) > 2:
        raise UsageError(f"{path}: item.as_found must be an earlier calibration of the same gyros of the same device")
    return before
