"""Prints a report: a browser that is on the machine makes the PDF of the HTML."""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from drivers.packaged import packaged_toml
from station.atomic_write import write_whole
from station.errors import UsageError

_KNOWN = packaged_toml("station.report", "browser.toml")
VARIABLE = "STATION_BROWSER"
_LIMIT_S = 60.0


def find_browser() -> str:
    """Return the browser to print with: $STATION_BROWSER, else the first that is found; UsageError if there is none."""
    wanted = os.environ.get(VARIABLE)
    if wanted:
        found = shutil.which(wanted)
        if found is None:
            raise UsageError(f"${VARIABLE} is {wanted}, which is no program: give the path of Chromium, Chrome or Edge")
        return found
    for name in map(str, _KNOWN["names"]):
        found = shutil.which(name)
        if found is not None:
            return found
    raise UsageError(
        "no browser was found to print a PDF with: install Chromium (apt install chromium), Chrome or Edge, or name "
        f"one in ${VARIABLE}; or open the HTML file and print it"
    )


def print_pdf(html: Path, pdf: Path) -> None:
    """Print an HTML file; UsageError if there is no browser, or it does not make a PDF."""
    browser = find_browser()
    with tempfile.TemporaryDirectory(prefix="station-print-") as folder:
        made = Path(folder) / "report.pdf"
        options = [*_KNOWN["options"], f"--user-data-dir={folder}/profile", f"--print-to-pdf={made}"]
        # As root, as in a container, Chromium starts without its sandbox or not at all; the page has no scripts.
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            options.append("--no-sandbox")
        try:
            done = subprocess.run(
                [browser, *options, html.resolve().as_uri()], capture_output=True, timeout=_LIMIT_S, check=False
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise UsageError(f"{browser} could not print {html}: {error}; open it and print it") from None
        if not made.is_file() or not made.read_bytes().startswith(b"%PDF"):
            said = done.stderr.decode(errors="replace").strip().splitlines()
            last = f": {said[-1]}" if said else ""
            raise UsageError(f"{browser} made no PDF of {html}{last}; open it and print it")
        write_whole(pdf, made.read_bytes())
