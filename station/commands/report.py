"""station report: the report of a recording, as HTML and as PDF."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from station.atomic_write import check_new_file, free_path, write_whole
from station.errors import EXIT_USAGE, UsageError


def command_report(arguments: argparse.Namespace) -> int:
    """Write the report of a recording; 0 if it is written, whatever it says."""
    html, pdf = _outputs(arguments)
    said = _write(arguments, html)
    problem = ""
    if pdf is not None:
        from station.report.browser import print_pdf

        try:
            print_pdf(html, pdf)
        except UsageError as error:
            problem = str(error)
    if arguments.json:
        print(json.dumps({**said, "html": str(html), "pdf": None if problem or pdf is None else str(pdf)}))
    else:
        print(f"{said['title']} No. {said['number']}")
        print(f"report: {html}")
        if pdf is not None and not problem:
            print(f"PDF: {pdf}")
    if problem:
        print(f"station: {problem}; the report is kept in {html}", file=sys.stderr)
        return EXIT_USAGE
    return 0


def refused(reason: str, arguments: argparse.Namespace) -> dict[str, str | None]:
    """Return what --json prints when there is no report."""
    return {"title": None, "reason": reason, "html": None, "pdf": None}


def _outputs(arguments: argparse.Namespace) -> tuple[Path, Path | None]:
    """Return the files to write, HTML and, where it is wanted, PDF, seen to be free before any long work."""
    if arguments.output is None:
        html = free_path(Path(arguments.recording).with_suffix(".html"), beside=[".pdf"] if arguments.pdf else [])
        pdf = html.with_suffix(".pdf") if arguments.pdf else None
    else:
        named = Path(arguments.output)
        if named.suffix.lower() not in (".html", ".htm", ".pdf"):
            raise UsageError(f"--output {named}: the name must end in .html or .pdf")
        as_pdf = named.suffix.lower() == ".pdf"
        html = named.with_suffix(".html") if as_pdf else named
        pdf = named if as_pdf else named.with_suffix(".pdf") if arguments.pdf else None
    for path in filter(None, (pdf, html)):
        check_new_file(path, "--output")
    return html, pdf


def _write(arguments: argparse.Namespace, html: Path) -> dict[str, Any]:
    # numpy, h5py and matplotlib are slow to import: what is wrong with the arguments was said before.
    from station.report.document import make_report
    from station.report.formal import read_formal
    from station.report.recorded import read_recorded
    from station.report.traced import read_traced

    path = Path(arguments.recording)
    recorded = read_recorded(path)
    formal = read_formal(recorded, Path(arguments.meta) if arguments.meta else None)
    traced = read_traced(Path(arguments.investigation) if arguments.investigation else None, recorded)
    report = make_report(recorded, traced, formal)
    write_whole(html, report.html)
    standing = report.standing
    return {
        "title": standing.title,
        "number": report.number,
        "outcome": None if standing.verdict is None else str(standing.verdict.outcome),
        "reason": None if standing.verdict is None else standing.verdict.reason,
        "certificate": standing.certificate,
        "simulated": standing.simulated,
        "recording": str(path),
        "sha256": report.hashes,
    }
