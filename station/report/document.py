"""The whole document: one HTML file that needs nothing beside itself."""

from dataclasses import dataclass

from station.report import course, front, results
from station.report.blind_spots import blind_spots
from station.report.closing import signatures, software
from station.report.corrected import correction
from station.report.hashes import file_sha256, raw_sha256
from station.report.html import Content, Markup, element, joined, paragraph
from station.report.recorded import Recorded
from station.report.residual import residual, verification
from station.report.standing import Kind, Standing, number_of, standing_of
from station.report.style import sheet
from station.report.traced import Traced
from station.report.unseen import unseen_of

_METHOD = (
    "The outputs of the gyros are compared with the rate of the body at the same instants, which follows from the "
    "measured angles and rates of the reference, and from the rate of the Earth where the site is known. The four "
    "states of each gyro are estimated by generalised least squares under the expectation of the data sheet; the noise "
    "is found from the same data. The error model is that of Li, Guo, Ge and Cheng, Navigation Positioning and Timing "
    "7(1), 2020, doi:10.19306/j.cnki.2095-8110.2020.01.020, without its linearisation."
)


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
    chapters = _chapters(recorded, traced, standing, hashes)
    device = recorded.text("device_serial") or recorded.text("device")
    name = recorded.path.name
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("title", " ".join(filter(None, (standing.title, number, device)))),
        element("style", Markup(sheet(standing.title, f"No. {number}", f"{device}, {name}" if device else name))),
    )
    body = [
        element("div", "SPECIMEN", class_="watermark", aria_hidden="true") if standing.kind is Kind.SPECIMEN else None,
        element("main", _title(recorded, standing, number), *(_chapter(n, *c) for n, c in enumerate(chapters, 1))),
    ]
    whole = element("html", head, element("body", *body), lang="en")
    return Report(f"<!DOCTYPE html>\n{whole}\n", standing, number, hashes)


def _chapters(
    recorded: Recorded, traced: Traced | None, standing: Standing, hashes: dict[str, str]
) -> list[tuple[str, Content]]:
    found = recorded.calibration
    unseen = unseen_of(recorded)
    chapters: list[tuple[str, Content]] = [
        ("Identification", front.identification(recorded)),
        ("Conditions", front.conditions(recorded)),
        ("Method and motion", joined([paragraph(_METHOD) if found else None, front.motion(recorded)])),
    ]
    if found is not None:
        chapters += [
            ("Results", results.states(recorded, found, unseen, traced)),
            ("Limits", results.compliance(standing)),
            ("Uncertainty budget", results.budget(recorded, found)),
            ("Traceability", results.traceability(recorded)),
            ("Correction", correction(recorded, traced, hashes["data"])),
            ("Convergence", course.convergence(recorded)),
            ("Innovations", course.innovations(recorded)),
            ("Residual", residual(recorded, traced)),
            ("Verification", verification(traced)),
            ("What this run could not see", blind_spots(recorded, unseen)),
            ("Noise", course.noise(recorded, found)),
        ]
    return [
        *chapters,
        ("Clocks and losses", course.clocks(recorded)),
        ("Events", course.events(recorded)),
        ("Software and hashes", software(recorded, traced, hashes)),
        ("Signatures", signatures(recorded)),
    ]


def _title(recorded: Recorded, standing: Standing, number: str) -> Markup:
    verdict = standing.verdict
    outcome = front.badge(str(verdict.outcome)) if verdict is not None else front.badge("NOT JUDGED")
    reason = f" {verdict.reason}" if verdict is not None else None
    return element(
        "header",
        paragraph(recorded.text("station") or "Turntable calibration station", class_="laboratory"),
        element("h1", standing.title),
        paragraph(f"No. {number}", class_="number"),
        paragraph(standing.warning, class_="warning") if standing.warning else None,
        paragraph(outcome, reason, class_="outcome"),
    )


def _chapter(number: int, title: str, content: Content) -> Markup:
    name = f"chapter-{number}"
    return element("section", element("h2", f"{number} {title}", id=name), content, aria_labelledby=name)
