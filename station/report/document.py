"""The whole document: one HTML file without other files."""

import importlib.metadata
import platform
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from estimator.calibration.values import Calibration
from estimator.untrusted import harmless
from station.bench.units import Units
from station.errors import UsageError
from station.exports.exported import file_sha256, raw_sha256
from station.render.template import rendered
from station.report import figures
from station.report.chapters import forces, unobserved_effects
from station.report.chapters.closing import closing_view
from station.report.chapters.corrected import correction_view
from station.report.chapters.front import front_view, motion_view, mountings_view
from station.report.chapters.limits import limits_view
from station.report.chapters.live import live_view
from station.report.chapters.noise import noise_view
from station.report.chapters.residual import residual_view
from station.report.chapters.results import as_found_view, badge, results_view
from station.report.chapters.traceability import budget_view, traceability_view
from station.report.document_status import Kind, Standing, limits_of, number_of, standing_of
from station.report.formal import Formal, logo_of
from station.report.investigation_chapter import Traced
from station.report.recorded import Recorded, laid_out, read_recorded

_PACKAGES = ("turntable-station", "numpy", "scipy", "h5py", "matplotlib")
_CHAPTERS = {
    "identification": "Identification and conditions",
    "method": "Method and motion",
    "results": "Results",
    "as_found": "As found and as left",
    "limits": "Limits",
    "traceability": "Traceability",
    "budget": "Uncertainty budget",
    "accelerometers": "Accelerometers",
    "correction": "Correction",
    "residual": "Residual and verification",
    "verification": "Verification",
    "unseen": "What this run could not see",
    "convergence": "Convergence",
    "innovations": "Innovations",
    "noise": "Noise",
    "clocks": "Clocks and losses",
    "events": "Events",
    "software": "Software and hashes",
    "signatures": "Signatures",
}
"""The titles of all chapters, in order."""
_OF_ONE_RUN = ("residual", "verification", "unseen", "convergence", "innovations", "noise")
"""The chapters that the report of a joined calibration does not have."""
_STORED_FIGURE = re.compile(r' data-h5="calibration[^"]*"')
"""Where a figure of a calibration stands in its recording."""
_ALWAYS = ("identification", "method", "clocks", "events", "software", "signatures")
"""The chapters of a report without a calibration."""


@dataclass(kw_only=True, frozen=True, slots=True)
class Heading:
    """The heading of a chapter."""

    number: int
    title: str


@dataclass(kw_only=True, frozen=True, slots=True)
class HeadView:
    """What stands above the chapters; ``laboratory`` is empty if nobody states one, ``warning`` for a certificate."""

    page_title: str
    title: str
    number: str
    laboratory: str
    logo: str
    is_specimen: bool
    warning: str
    outcome: Markup
    foot: str


@dataclass(kw_only=True, frozen=True, slots=True)
class Report:
    """A document, the device as found, and what was not seen; ``not_seen`` is None for a joined calibration.

    ``hashes`` are SHA-256 of its sources: "file" of the recording and "data" in it, and as far as there are such files
    "investigation" (if not in the recording), "as_found", and "joined_2" and on, of the further joined recordings.
    """

    html: str
    standing: Standing
    number: str
    hashes: dict[str, str]
    before: Recorded | None = None
    not_seen: unobserved_effects.Unseen | None = None


def make_report(recorded: Recorded, traced: Traced | None, formal: Formal) -> Report:
    """Return the report of a recording with its formal facts, and with an investigation if there is one.

    Without a stated number it has that of ``number_of``. Characters that could change the structure or direction of the
    text are made harmless. A joined calibration has no unseen effects, and its figures do not say where they stand, as
    no recording holds them. BenchError if the bench text in the recording cannot be read, EstimatorError for an error
    model of another version, UsageError if the recording as found does not match or a logo cannot be read,
    RecordingError for content that cannot be laid out.
    """
    hashes = {"file": file_sha256(recorded.path), "data": raw_sha256(recorded.path)}
    if traced is not None and traced.path != recorded.path:
        hashes["investigation"] = file_sha256(traced.path)
    before = None if formal.item_as_found is None else _as_found(recorded, formal.item_as_found)
    if before is not None:
        hashes["as_found"] = file_sha256(before.path)
    hashes |= {f"joined_{number}": file_sha256(one.path) for number, one in enumerate(recorded.joined[1:], start=2)}
    standing = standing_of(recorded, formal)
    number = formal.certificate_number or number_of(recorded, tuple(hashes.values()), formal.certificate_replaces or "")
    not_seen = None if recorded.joined else unobserved_effects.unseen_of(recorded)
    with laid_out(recorded.path, "its content or its investigation cannot be reported ({})"):
        sources = _Sources(
            recorded=recorded,
            traced=traced,
            formal=formal,
            standing=standing,
            before=before,
            unseen=not_seen,
            hashes=hashes,
            number=number,
        )
        html = rendered("station.report", "report.html", _values(sources))
        if recorded.joined:  # in no recording
            html = _STORED_FIGURE.sub("", html)
    # Names and texts of recordings, sources and files must not change the document's structure or direction.
    return Report(
        html=harmless(html), standing=standing, number=number, hashes=hashes, before=before, not_seen=not_seen
    )


@dataclass(kw_only=True, frozen=True, slots=True)
class _Sources:
    """What a report is made of."""

    recorded: Recorded
    traced: Traced | None
    formal: Formal
    standing: Standing
    before: Recorded | None
    unseen: unobserved_effects.Unseen | None
    hashes: Mapping[str, str]
    number: str


def _values(sources: _Sources) -> dict[str, object]:
    """Return the chapters by the names that the templates have for them.

    Those on a calibration are missing if there is none; ``mountings`` is None unless the calibration is joined.
    """
    recorded = sources.recorded
    headings = _headings(sources)
    values: dict[str, object] = {
        "head": _head(sources),
        "headings": list(headings.values()),
        "contents": headings,
        "formal": sources.formal,
        "found": recorded.calibration is not None,
        "front": front_view(recorded, sources.formal, sources.standing, adjusted=sources.before is not None),
        "motion": motion_view(recorded),
        "mountings": mountings_view(recorded) if recorded.joined else None,
        "closing": closing_view(
            recorded,
            sources.formal,
            traced=sources.traced,
            hashes=sources.hashes,
            made_with=_made_with(),
            simulated=sources.standing.simulated,
        ),
    }
    if recorded.calibration is not None:
        values |= _calibrated(sources, recorded.calibration)
    return values


def _calibrated(sources: _Sources, calibration: Calibration) -> dict[str, object]:
    """Return the chapters on a calibration, by the names that the templates have for them.

    States are in the units of the limits in the recording, else in those used by default. Some chapters are None where
    there is nothing to show, such as ``as_found`` without a recording of that.
    """
    recorded, traced, before = sources.recorded, sources.traced, sources.before
    limits = limits_of(recorded)
    states = figures.states_in(limits.units if limits is not None else Units())
    return {
        "results": results_view(
            recorded, calibration, states=states, standing=sources.standing, unseen=sources.unseen, traced=traced
        ),
        "as_found": before and as_found_view(recorded, calibration, before, sources.hashes, states),
        "limits": limits_view(sources.standing, sources.formal.decision_false_accept),
        "traceability": traceability_view(recorded, sources.formal.equipment),
        "budget": budget_view(recorded, calibration, states),
        "accelerometers": forces.chapters(recorded),
        "correction": correction_view(
            recorded, calibration, traced=traced, states=states, data_sha256=sources.hashes["data"]
        ),
        "residual": residual_view(traced, recorded),
        "unseen": unobserved_effects.unseen_view(recorded, sources.unseen),
        "live": live_view(recorded, calibration, states),
        "noise": noise_view(recorded, calibration),
    }


def _headings(sources: _Sources) -> dict[str, Heading]:
    """Return the headings of the chapters that the report has, numbered without gaps.

    Chapters of a calibration, as found, of accelerometers and of verification are left out where there is none. A
    joined calibration has no chapters on one run alone. With an investigation the verification has a chapter, so the
    one before it is only "Residual".
    """
    titles = dict(_CHAPTERS)
    if sources.recorded.calibration is None:
        titles = {key: titles[key] for key in _ALWAYS}
    if sources.before is None:
        titles.pop("as_found", None)
    if sources.recorded.calibration is not None and not sources.recorded.calibration.forces:
        titles.pop("accelerometers")
    if sources.recorded.joined:
        titles = {key: title for key, title in titles.items() if key not in _OF_ONE_RUN}
    if sources.traced is None:
        titles.pop("verification", None)
    elif "residual" in titles:
        titles["residual"] = "Residual"
    return {key: Heading(number=number, title=title) for number, (key, title) in enumerate(titles.items(), start=1)}


def _head(sources: _Sources) -> HeadView:
    """Return title, number, laboratory, logo, warning, outcome and foot of the document.

    Without a laboratory it is the station; the device is its serial number, else its name; the logo is empty if none is
    stated. UsageError for a logo that cannot be read.
    """
    recorded, formal, standing = sources.recorded, sources.formal, sources.standing
    device = formal.item_serial_number or recorded.text("device")
    return HeadView(
        page_title=" ".join(filter(None, (standing.title, sources.number, device))),
        title=standing.title,
        number=sources.number,
        laboratory=formal.laboratory_name or recorded.text("station"),
        logo=logo_of(formal.laboratory_logo) if formal.laboratory_logo else "",
        is_specimen=standing.kind is Kind.SPECIMEN,
        warning=standing.warning,
        outcome=_outcome(standing),
        foot=", ".join(filter(None, (device, recorded.path.name))),
    )


def _outcome(standing: Standing) -> Markup:
    """Return the verdict with its reason."""
    if standing.verdict is None:
        return badge("NOT JUDGED")
    return Markup("{} {}").format(badge(str(standing.verdict.outcome)), standing.verdict.reason)


def _made_with() -> str:
    versions = [f"{name} {importlib.metadata.version(name)}" for name in _PACKAGES]
    return ", ".join([*versions, f"Python {platform.python_version()}"])


def _as_found(recorded: Recorded, path: Path) -> Recorded:
    """Return the recording of the device as found; UsageError unless it is an earlier calibration of the same gyros.

    The order is not checked if the start of ``recorded`` is unknown; an unknown start of the other counts as later.
    Serial numbers must not differ; one that is unknown fits all. RecordingError for a file that cannot be read.
    """
    before = read_recorded(path)
    serials = {before.text("device_serial"), recorded.text("device_serial"), ""}
    later = recorded.begun_utc and not (before.begun_utc and before.begun_utc <= recorded.begun_utc)
    if later or not before.labels or before.labels != recorded.labels or len(serials) > 2:
        raise UsageError(f"{path}: item.as_found must be an earlier calibration of the same gyros of the same device")
    return before
