"""station report: the report of a recording, as HTML, as PDF and as digital calibration certificate."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from estimator.untrusted import harmless
from station.atomic_write import check_new_file, free_path, write_whole
from station.errors import EXIT_USAGE, UsageError, sentence
from station.render.lines import tell

if TYPE_CHECKING:
    from station.report.document import Report
    from station.report.formal import Formal
    from station.report.recorded import Recorded
    from station.run.outcome import Verdict
    from station.screen.archive.register import Document


def command_report(arguments: argparse.Namespace) -> int:
    """Write a recording's report as HTML and, if asked for, PDF and digital certificate; print the result.

    Return 0, or 2 if PDF or certificate could not be made: the HTML is written all the same. Before, the document is
    entered into the user's register and the list of its folder. UsageError for wrong options, files that exist, and a
    number that is taken.
    """
    html, pdf, dcc = _outputs(arguments)
    keys = [Path(name) for name in (arguments.sign, arguments.certificate) if name]
    # numpy, h5py and matplotlib are slow to import: errors in the arguments were reported before.
    from station.exports.exported import raw_sha256
    from station.render.results.verdict import next_after_report
    from station.report.dcc import check_facts, make_dcc, read_key, sign
    from station.report.document import make_report
    from station.report.formal import read_formal
    from station.report.investigation_chapter import read_traced
    from station.run.outcome import ended_of
    from station.screen.archive.register import check_number, enter

    if keys:
        read_key(*keys)
    recorded = _recorded(arguments)
    formal = read_formal(recorded, Path(arguments.meta) if arguments.meta else None)
    if dcc is not None:
        check_facts(formal)
    investigation = Path(arguments.investigation) if arguments.investigation else None
    traced = None if recorded.joined else read_traced(investigation, recorded)
    if formal.certificate_number:
        check_number(formal.certificate_number, raw_sha256(recorded.path), recorded.path.absolute().parent)
    report = make_report(recorded, traced, formal)
    enter(_document(recorded, formal, report))
    write_whole(html, report.html)
    standing = report.standing
    verdict = standing.verdict
    if verdict is None and not recorded.joined:  # without limits it was not judged here
        verdict = ended_of(recorded.recording.attributes)
    problem, printed = "", None
    try:
        if pdf is not None:
            from station.report.pdf import print_pdf

            printed = print_pdf(report.html, pdf)
        if dcc is not None:
            xml = make_dcc(recorded, formal, report, printed)
            write_whole(dcc, sign(xml, *keys) if keys else xml)
    except UsageError as error:
        problem = str(error)
    made = [str(path) if path is not None and path.exists() else None for path in (pdf, dcc)]
    if arguments.json:
        files = {"html": str(html), "pdf": made[0], "dcc": made[1]}
        named = {"recording": arguments.recording, "joined": arguments.join}
        print(json.dumps({**_result_object(report, formal, verdict), **named, **files}))
    else:
        _print_result(recorded, verdict, details=arguments.details)
        _print_documents(report, html, made, next_after_report(verdict, recorded.path, arguments.join))
    if problem:
        tell(f"station: {problem}; the report is in {html}", sys.stderr)
        return EXIT_USAGE
    return 0


def _recorded(arguments: argparse.Namespace) -> "Recorded":
    """Return the recording with its calibration, or with that of all recordings with --join.

    RecordingError, and with --join UsageError, as ``read_recorded`` and ``read_joined``.
    """
    from station.report.recorded import read_joined, read_recorded

    path, others = Path(arguments.recording), [Path(name) for name in arguments.join]
    return read_joined(path, others) if others else read_recorded(path)


def _result_object(report: "Report", formal: "Formal", verdict: "Verdict | None") -> dict[str, Any]:
    """Return the report's own statements for --json: title, numbers of it and of what it replaces, outcome, reason.

    Also whether it is a certificate, whether the run was simulated, and the hashes. Outcome and reason are None without
    a verdict.
    """
    return {
        "title": report.standing.title,
        "number": report.number,
        "replaces": formal.certificate_replaces,
        "outcome": None if verdict is None else str(verdict.outcome),
        "reason": None if verdict is None else verdict.reason,
        "certificate": report.standing.certificate,
        "simulated": report.standing.simulated,
        "sha256": report.hashes,
    }


def _document(recorded: "Recorded", formal: "Formal", report: "Report") -> "Document":
    """Return the entry of a report for the register of documents."""
    from station.screen.archive.register import Document

    return Document(
        number=report.number,
        data_sha256=report.hashes["data"],
        recording=str(recorded.path.absolute()),
        title=report.standing.title,
        replaces=formal.certificate_replaces,
    )


def _print_result(recorded: "Recorded", verdict: "Verdict | None", *, details: bool) -> None:
    """Print the verdict, unless it is None, and the states of the gyros, unless there is no calibration.

    ``verdict`` is None for what nobody judged, such as imported data. ``details`` adds all broken limits and what
    ``print_calibration`` adds then.
    """
    from station.bench.units import Units
    from station.render.printing import print_calibration, print_verdict
    from station.report.document_status import limits_of
    from station.run.outcome import Outcome, Verdict

    limits = limits_of(recorded)
    if verdict is not None:
        print_verdict(verdict, details=details)
    if recorded.calibration is not None:
        judged = verdict or Verdict(Outcome.ESTIMATED, "")
        units = limits.units if limits is not None else Units()
        print_calibration(recorded.calibration, judged, units, details=details)


def _print_documents(report: "Report", html: Path, made: Sequence[str | None], steps: Sequence[str]) -> None:
    """Print title and number of the document, its warning if it has one, what was written, and the next ``steps``.

    ``made`` are the paths of PDF and digital certificate, None where missing.
    """
    standing = report.standing
    tell(harmless(f"{standing.title} No. {report.number}"))
    if standing.warning:
        tell(harmless(standing.warning))
    print(f"report: {html}")
    for document, path in zip(("PDF", "digital calibration certificate"), made, strict=True):
        if path:
            print(f"{document}: {path}")
    for step in steps:
        tell(f"next: {step}")


def refused(reason: str, arguments: argparse.Namespace) -> dict[str, str | None]:
    """Return the object for --json if there is no report."""
    return {"title": None, "reason": reason, "html": None, "pdf": None, "dcc": None}


def _outputs(arguments: argparse.Namespace) -> tuple[Path, Path | None, Path | None]:
    """Return the paths of HTML and, where wanted, PDF and XML, all without overwriting.

    Without --output they are named as the recording, with a number if need be. UsageError if a file exists, for another
    ending than .html or .pdf, for a signature without certificate or --dcc, and for --dcc or --investigation with
    --join.
    """
    if bool(arguments.sign) != bool(arguments.certificate) or (arguments.sign and not arguments.dcc):
        raise UsageError("--sign KEY.pem goes with --certificate CERTIFICATE.pem and --dcc")
    if arguments.join and arguments.dcc:
        raise UsageError(sentence("report.not_joined_dcc"))
    if arguments.join and arguments.investigation:
        raise UsageError(sentence("report.not_joined_investigation"))
    if arguments.output is None:
        wanted = [".pdf"] * arguments.pdf + [".xml"] * arguments.dcc
        recording = Path(arguments.recording)  # a folder is reported when it is read
        html = free_path(recording.parent / f"{recording.stem}.html", further_suffixes=wanted)
        pdf = html.with_suffix(".pdf") if arguments.pdf else None
    else:
        named = Path(arguments.output)
        if named.suffix.lower() not in (".html", ".htm", ".pdf"):
            raise UsageError(f"--output {named}: the name must end in .html or .pdf")
        as_pdf = named.suffix.lower() == ".pdf"
        html = named.with_suffix(".html") if as_pdf else named
        pdf = named if as_pdf else named.with_suffix(".pdf") if arguments.pdf else None
    dcc = html.with_suffix(".xml") if arguments.dcc else None
    for path in filter(None, (pdf, dcc, html)):
        check_new_file(path, "--output")
    return html, pdf, dcc
