"""What a certificate states beside the measurement, by ISO/IEC 17025:2017, 7.8: of the recording, its bench, a file."""

from base64 import b64encode
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date, datetime
from io import BytesIO
from pathlib import Path
from typing import Any, Protocol

from estimator.untrusted import MOST_TEXT_BYTES, read_bytes, read_text
from station.errors import BenchError, UsageError
from station.schema.tables import Table, keys_of

_RECORDED = {"operator": "operator", "item_serial_told": "device_serial_told", "item_serial_reason": "serial_reason"}
_LEAST_BAND = 0.025  # probability of false acceptance with a guard band as wide as U, ILAC-G8:09/2019
_DATED = {"performed_date": "the date of the calibration", "certificate_issued": "the date of issue"}
_ORDER = (
    ("item_received", "performed_date"),
    ("performed_date", "certificate_issued"),
    ("performed_date", "certificate_next_due"),
    ("certificate_issued", "certificate_next_due"),
)


class Told(Protocol):
    """What a recording tells of itself: attributes as texts, empty where it has none, and when it began."""

    @property
    def path(self) -> Path: ...
    @property
    def begun_utc(self) -> datetime | None: ...
    def text(self, name: str) -> str: ...


@dataclass(frozen=True, slots=True)
class Equipment:
    """An instrument that was used, the certificate of its own calibration, and until when that is good or why always."""

    name: str
    serial_number: str | None
    certificate: str | None
    due: date | None
    no_due: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Formal:
    """The formal facts, by section and key of station/schema/certificate.toml; None: not stated.

    ``item_serial_told`` is what the device says of itself where that is another number, with the reason why both are
    right. ``performed_date`` is that of the recording, UTC, unless somebody stated it. ``performed_humidity`` is a
    share of 1. ``decision_false_accept`` is None of simple acceptance. ``operator`` made the run;
    ``approved_by_another``: the bench wants the certificate approved by somebody else.
    """

    laboratory_name: str | None = None
    laboratory_address: tuple[str, ...] = ()
    laboratory_country: str | None = None
    laboratory_contact: str | None = None
    laboratory_accreditation: str | None = None
    laboratory_logo: Path | None = None
    customer_name: str | None = None
    customer_address: tuple[str, ...] = ()
    item_maker: str | None = None
    item_model: str | None = None
    item_serial_number: str | None = None
    item_serial_told: str | None = None
    item_serial_reason: str | None = None
    item_condition: str | None = None
    item_as_found: Path | None = None
    item_received: date | None = None
    performed_place: str | None = None
    performed_date: date | None = None
    performed_temperature_c: float | None = None
    performed_temperature_from: str | None = None
    performed_humidity: float | None = None
    performed_humidity_from: str | None = None
    equipment: tuple[Equipment, ...] = ()
    procedure_name: str | None = None
    procedure_edition: str | None = None
    decision_rule: str = "simple"
    decision_false_accept: float | None = None
    certificate_number: str | None = None
    certificate_issued: date | None = None
    certificate_approved_by: str | None = None
    certificate_remark: str | None = None
    certificate_next_due: date | None = None
    operator: str | None = None
    approved_by_another: bool = False

    @property
    def overdue(self) -> tuple[Equipment, ...]:
        """Instruments whose calibration was over at the time of this one, or nobody stated until when it is good."""
        day = self.performed_date
        late = (not one.no_due if one.due is None else day is not None and one.due < day for one in self.equipment)
        return tuple(one for one, over in zip(self.equipment, late, strict=True) if over)

    @property
    def approved(self) -> bool:
        """Whether it is approved as the bench wants it."""
        by, made = (" ".join((who or "").casefold().split()) for who in (self.certificate_approved_by, self.operator))
        return not self.approved_by_another or by not in ("", made)


def kept_facts(recording: Path) -> Path:
    """Return the file beside a recording in which the form on the screen keeps what was entered."""
    return recording.with_name(f"{recording.stem}-certificate.toml")


def read_formal(recorded: Told, meta: Path | None = None, text: str | None = None) -> Formal:
    """Return the formal facts of a recording: its own, those of its bench, and before these of the file for --meta.

    Without ``meta`` it is the file that the form on the screen kept, if there is one; ``text`` is what a file is to hold.
    Raises UsageError with line and key for a file that is wrong or of another device, BenchError for the bench text.
    """
    beside, kept = recorded.path.parent, kept_facts(recorded.path)
    if text is None:
        text = read_text(meta or kept, UsageError) if meta or kept.is_file() else ""
    bench = Table.parse(recorded.text("bench"), "bench in the recording", BenchError)
    top = Table.parse(text, str(meta or kept), UsageError)
    decision = top.again().table("decision", optional=True)
    own = dict(_facts(top, (meta or kept).parent))
    top.done()
    stated = dict(_facts(bench, beside)) | own
    if logo := stated.get("laboratory_logo"):
        if meta in (None, kept) or "laboratory_logo" not in own:
            stated["laboratory_logo"] = logo = beside / logo.name  # no other file of this computer, whoever made these
        logo_of(logo)
    serial, begun = recorded.text("device_serial"), recorded.begun_utc
    if serial and stated.setdefault("item_serial_number", serial) != serial:
        raise _wrong(top, "item_serial_number", f"{stated['item_serial_number']!r}: the recording is of {serial!r}")
    if stated.get("decision_rule") == "guard band":
        stated.setdefault("decision_false_accept", _LEAST_BAND)
    elif stated.pop("decision_false_accept", None) and (decision.has("false_accept") or not decision.has("rule")):
        where = decision if decision.has("false_accept") else bench.table("decision", optional=True)
        raise where.fail("false_accept", 'is for rule = "guard band"')
    stated.setdefault("certificate_approved_by", recorded.text("accepted_by") or None)
    stated.setdefault("performed_date", begun and begun.date())
    _check_dates(top, stated, begun and begun.date(), "performed_date" in own)
    stated |= {field: recorded.text(name) or None for field, name in _RECORDED.items()}
    stated["approved_by_another"] = bench.table("station", optional=True).read("bench.station")["approved_by_another"]
    return Formal(**stated)


def logo_of(path: Path) -> str:
    """Return a picture as a data URI; UsageError if it cannot be read, or holds none, whatever its name."""
    from lxml import etree
    from PIL import Image

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
        told = "is no picture, or not a whole one: give a .svg, .png or .jpg"
        raise UsageError(f"laboratory.logo: {path} {told}") from None
    return f"data:image/{kind};base64,{b64encode(content).decode()}"


def _check_dates(top: Table, stated: dict[str, Any], begun: date | None, is_stated: bool) -> None:
    """See that dates are in their order; ``begun`` is that of the recording, UTC, a day beside that of some places."""
    day = stated["performed_date"]
    if begun is not None and day is not None and abs((day - begun).days) > 1:
        told = f"{day} cannot be, since the recording began on {begun} UTC: correct it, or leave it out"
        raise _wrong(top, "performed_date", told)
    for first, then in _ORDER:
        early, late = stated.get(first), stated.get(then)
        if early and late and (early - late).days > ("performed_date" in (first, then) and not is_stated):
            if first in _DATED:
                raise _wrong(top, then, f"{late} is before {early}, {_DATED[first]}")
            raise _wrong(top, first, f"{early} is after {late}, {_DATED[then]}")


def _wrong(top: Table, field: str, message: str) -> Exception:
    section, _, key = field.partition("_")
    return top.table(section, optional=True).fail(key, message)


def _facts(top: Table, folder: Path) -> Iterator[tuple[str, Any]]:
    """Yield what a file states, by field."""
    for section in keys_of("certificate.certificate_file"):
        own = f"certificate.{section.name}"
        if section.kind == "tables":
            listed = tuple(_equipment(table, own) for table in top.tables(section.name))
            yield from [(section.name, listed)] * bool(listed)
        else:
            facts = top.table(section.name, optional=True).read_all(own, folder)
            yield from ((f"{section.name}_{key}", value) for key, value in facts.items() if value is not None)


def _equipment(table: Table, section: str) -> Equipment:
    found = Equipment(**table.read_all(section))
    if found.due is not None and found.no_due is not None:
        raise table.fail("no_due", "key due says until when: leave out one of both")
    return found
