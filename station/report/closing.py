"""What stands at the end: software, hashes, signatures."""

import importlib.metadata
import platform
from collections.abc import Iterator

from station.report.front import accepted
from station.report.hashes import RAW_RULE
from station.report.html import BLANK, Content, Markup, composed, element, facts, joined, paragraph, table
from station.report.recorded import Recorded
from station.report.standing import is_simulated
from station.report.traced import Traced

_PACKAGES = ("turntable-station", "numpy", "scipy", "h5py", "matplotlib")


def software(recorded: Recorded, traced: Traced | None, hashes: dict[str, str]) -> Markup:
    """Return versions, and hashes by which the sources of this document can be known again."""
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in _PACKAGES)
    rows: list[tuple[str, Content]] = [
        ("Measured with", _version(recorded)),
        ("This document made with", f"{versions}, Python {platform.python_version()}"),
        ("Recording", recorded.path.name),
        ("SHA-256 of the file", _hash(hashes["file"])),
        ("SHA-256 of the raw data", _hash(hashes["data"])),
        ("SHA-256 of the bench file", _hash(recorded.text("bench_sha256")) if recorded.has("bench_sha256") else None),
        ("Investigation", traced.path.name if traced is not None and "investigation" in hashes else None),
        ("SHA-256 of the investigation", _hash(hashes["investigation"]) if "investigation" in hashes else None),
        ("Seed of the twins", recorded.text("seed") if is_simulated(recorded) else None),
    ]
    return joined([facts(rows), paragraph(f"Hash of the raw data: {RAW_RULE}.", class_="note")])


def _version(recorded: Recorded) -> str:
    version = recorded.text("software_version")
    return f"turntable-station {version}" if version else "not stated"


def _hash(text: str) -> Markup:
    return element("code", text, class_="hash")


@composed
def signatures(recorded: Recorded) -> Iterator[Content]:
    """Return the fields for those who answer for the document, filled in where the recording says who."""
    rows: list[list[Content]] = [
        ["Calibrated by", recorded.text("operator") or BLANK, BLANK, BLANK],
        ["Accepted by", accepted(recorded) or BLANK, BLANK, BLANK],
    ]
    yield paragraph(
        "The results relate only to the device that is identified above, at the time and under the conditions "
        "of this run. This document makes no claim of accreditation. It is issued when it is signed, and "
        "may be reproduced in full only."
    )
    yield table("Signatures", ("", "name", "date", "signature"), rows, align="llll")
