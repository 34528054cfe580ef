"""Facts of a certificate beside the measurement, by ISO/IEC 17025:2017, 7.8: from recording, bench, and a file."""

from base64 import b64encode
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from io import BytesIO
from itertools import combinations
from pathlib import Path
from typing import Any
from unicodedata import normalize

from estimator.untrusted import MOST_TEXT_BYTES, read_bytes, read_text
from station.errors import BenchError, UsageError
from station.report.recorded import Recorded
from station.schema.tables import Table, keys_of

_RECORDED = {"operator": "operator", "item_serial_told": "device_serial_told", "item_serial_reason": "serial_reason"}
_LEAST_BAND = 0.025  # probability of false acceptance with a guard band as wide as U, ILAC-G8:09/2019
_ORDER = ("item_received", "performed_date", "certificate_issued", "certificate_next_due")


@dataclass(frozen=True, slots=True)
class Equipment:
    """An instrument used, and the statements of its certificate.

    ``laboratory`` issued the ``certificate`` for a calibration on the day ``calibrated``, valid until ``due``;
    ``no_due`` says why there is no such day. ``uncertainty`` is quoted from the certificate.
    """

    name: str
    serial_number: str | None
    certificate: str | None
    due: date | None
    no_due: str | None = None
    laboratory: str | None = None
    calibrated: date | None = None
    uncertainty: str | None = None


_LEFT_OUT: Mapping[str, Any] = {
    f"{section.name}_{key.field or key.name}": () if key.kind == "texts" else None
    for section in keys_of("certificate.certificate_file")
    for key in keys_of(f"certificate.{section.name}")
} | {"equipment": (), "decision_rule": "simple"}


@dataclass(frozen=True, slots=True)
class Formal:
    """The formal facts, attributes by section and key of station/schema/certificate.toml; None: not stated.

    ``item_serial_told`` is the number that the device reports if it differs, with ``item_serial_reason`` as
    explanation. ``performed_date`` is that of the recording, UTC, unless stated. ``performed_humidity`` is a share of
    1. ``decision_false_accept`` is None for simple acceptance. ``operator`` made the run; ``approved_by_another``: the
    bench requires approval by somebody else.
    """

    stated: Mapping[str, Any]

    def __getattr__(self, fact: str) -> Any:
        if fact not in self.stated:
            raise AttributeError(fact)
        return self.stated[fact]

    @property
    def overdue(self) -> tuple[Equipment, ...]:
        """Instruments whose calibration had expired on the date of measurement, or states neither expiry nor why not.

        Without a date of measurement no stated date counts as expired.
        """
        day = self.performed_date
        late = (not one.no_due if one.due is None else bool(day) and one.due < day for one in self.equipment)
        return tuple(one for one, over in zip(self.equipment, late, strict=True) if over)

    @property
    def place(self) -> str:
        """Where it was calibrated (ISO/IEC 17025:2017, 7.8.2.1 c), empty if that is not known."""
        if self.performed_place:
            return str(self.performed_place)
        address = ", ".join(self.laboratory_address)
        return address and f"at the laboratory, {address}"

    @property
    def approved(self) -> bool:
        """Whether it is approved by another than the operator, if the bench requires that; else True."""
        names = (normalize("NFKC", who or "").casefold() for who in (self.certificate_approved_by, self.operator))
        by, made = ("".join(filter(str.isalpha, who)) for who in names)  # only the letters are compared
        return not self.approved_by_another or by not in ("", made)


def kept_facts(recording: Path) -> Path:
    """Return the file beside a recording in which the form on the screen stores its entries."""
    return recording.with_name(f"{recording.stem}-certificate.toml")


def read_formal(recorded: Recorded, meta: Path | None = None, text: str | None = None) -> Formal:
    """Return the formal facts of a recording: its own, those of its bench, overridden by those of the file ``meta``.

    By default ``meta`` is the file kept by the form on the screen, if there is one; ``text`` is used in place of its
    content. Serial number, approver and date of measurement are by default those of the recording. A logo is read from
    the folder of the recording, unless a ``meta`` other than the form's file names it. A guard band has by default the
    probability of false acceptance 0.025. Without the rule "guard band" a stated one is an error, but that of the bench
    is dropped if the file has another rule. UsageError with line and key for a file that is invalid, of another device,
    with impossible dates, or of a document that replaces itself; BenchError for the bench text.
    """
    beside, kept = recorded.path.parent, kept_facts(recorded.path)
    text = read_text(meta or kept, UsageError) if text is None and (meta or kept.is_file()) else text or ""
    bench = Table.parse(recorded.text("bench"), "bench in the recording", BenchError)
    top = Table.parse(text, str(meta or kept), UsageError)
    decision = top.again().table("decision", optional=True)
    own = dict(_facts(top, (meta or kept).parent))
    top.done()
    stated = dict(_facts(bench, beside)) | own
    if logo := stated.get("laboratory_logo"):
        if meta in (None, kept) or "laboratory_logo" not in own:
            stated["laboratory_logo"] = logo = beside / logo.name  # no other file of this computer
        logo_of(logo)
    serial, begun = recorded.text("device_serial"), recorded.begun_utc
    if serial and stated.setdefault("item_serial_number", serial) != serial:
        raise top.fail_at(f"item.serial_number: {stated['item_serial_number']!r}: the recording is of {serial!r}")
    if stated.get("decision_rule") == "guard band":
        stated.setdefault("decision_false_accept", _LEAST_BAND)
    elif stated.pop("decision_false_accept", None) and (decision.has("false_accept") or not decision.has("rule")):
        where = decision if decision.has("false_accept") else bench.table("decision", optional=True)
        raise where.fail("false_accept", 'is for rule = "guard band"')
    if (replaced := stated.get("certificate_replaces")) and replaced == stated.get("certificate_number"):
        raise top.fail_at(
            f"certificate.replaces: {replaced!r} is the number of this document. Give this document another number"
        )
    stated.setdefault("certificate_approved_by", recorded.text("accepted_by") or None)
    stated.setdefault("performed_date", begun and begun.date())
    _check_dates(top, stated, begun)
    stated |= {field: recorded.text(name) or None for field, name in _RECORDED.items()}
    stated["approved_by_another"] = bench.table("station", optional=True).read("bench.station")["approved_by_another"]
    return Formal({**_LEFT_OUT, **stated})


def logo_of(path: Path) -> str:
    """Return a picture as a data URI; UsageError if it cannot be read or is not a complete SVG, PNG or JPEG.

    A file is taken as SVG by its suffix, as one of the others by its content. One that is too large cannot be read.
    """
    from lxml import etree
    from PIL import Image, ImageFile

    ImageFile.LOAD_TRUNCATED_IMAGES = False  # WeasyPrint sets it
    content = read_bytes(path, UsageError, MOST_TEXT_BYTES, f"laboratory.logo: {path}")
    try:
        if path.suffix.lower() == ".svg":
            root = etree.fromstring(content, etree.XMLParser(no_network=True, resolve_entities=False))
            if root.tag != "{http://www.w3.org/2000/svg}svg":
                raise ValueError
            kind = "svg+xml"
        else:
            with Image.open(BytesIO(content), formats=("PNG", "JPEG")) as picture:
                picture.load()  # to its end
                kind = str(picture.format).lower()
    except Exception:  # of each kind its own, for bytes that a stranger chose
        raise UsageError(
            f"laboratory.logo: {path} is not a picture, or incomplete. Give a .svg, .png or .jpg"
        ) from None
    return f"data:image/{kind};base64,{b64encode(content).decode()}"


def _check_dates(top: Table, stated: Mapping[str, Any], begun: datetime | None) -> None:
    """Check the order of all dates that are stated, those of the equipment too; the table's error if one is impossible.

    ``begun`` is the start of the recording, UTC, None if unknown; the date of measurement, in local time, may be 12 h
    behind to 14 h ahead of it, and one day out of order with the dates of the document.
    """
    day = stated["performed_date"]
    for one in stated.get("equipment", ()):
        if one.calibrated and one.due and one.due < one.calibrated:
            raise top.fail_at(
                f"equipment: {one.name} was calibrated on {one.calibrated} but was due before that. Correct one"
            )
        if one.calibrated and day and one.calibrated > day:
            raise top.fail_at(
                f"equipment: {one.name} was calibrated on {one.calibrated}, after this measurement of {day}: "
                "name the certificate that was valid then"
            )
    if begun and day and not (begun - timedelta(hours=12)).date() <= day <= (begun + timedelta(hours=14)).date():
        raise top.fail_at(
            f"performed.date: {day} is impossible, since the run began on {begun:%Y-%m-%d} UTC. "
            "Correct it, or leave it out"
        )
    for first, then in combinations((field for field in _ORDER if stated.get(field)), 2):
        if (stated[first] - stated[then]).days > ("performed_date" in (first, then)):
            own, other = (first, then) if then == "performed_date" else (then, first)
            dates = [
                f"{field.replace('_', '.', 1)}{sign} {stated[field]}" for field, sign in ((own, ":"), (other, ","))
            ]
            raise top.fail_at(f"{' and '.join(dates)}, are in the wrong order. Correct one")


def _facts(top: Table, folder: Path) -> Iterator[tuple[str, Any]]:
    """Yield (field, value) of the facts stated in a file; missing ones are left out.

    A field is "section_key"; "equipment" is a tuple of all its instruments. Paths are relative to ``folder``.
    """
    for section in keys_of("certificate.certificate_file"):
        own = f"certificate.{section.name}"
        if section.kind == "tables":
            listed = tuple(Equipment(**table.read_all(own)) for table in top.tables(section.name))
            yield from [(section.name, listed)] * bool(listed)
        else:
            facts = top.table(section.name, optional=True).read_all(own, folder)
            yield from ((f"{section.name}_{key}", value) for key, value in facts.items() if value is not None)
