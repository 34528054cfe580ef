"""What a certificate states beside the measurement, by ISO/IEC 17025:2017, 7.8: of the recording, its bench, a file."""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from station.errors import BenchError, UsageError
from station.report.recorded import Recorded
from station.schema.tables import Table, keys_of

_RECORDED = {"operator": "operator", "item_serial_told": "device_serial_told", "item_serial_reason": "serial_reason"}
_LEAST_BAND = 0.025  # probability of false acceptance with a guard band as wide as U, ILAC-G8:09/2019


@dataclass(frozen=True, slots=True)
class Equipment:
    """An instrument that was used, the certificate of its own calibration, and until when that is good."""

    name: str
    serial_number: str | None
    certificate: str | None
    due: date | None


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
        """Instruments whose calibration was over at the time of this one."""
        day = self.performed_date
        return tuple(one for one in self.equipment if day is not None and one.due is not None and one.due < day)

    @property
    def approved(self) -> bool:
        """Whether it is approved as the bench wants it."""
        by, made = (" ".join((who or "").casefold().split()) for who in (self.certificate_approved_by, self.operator))
        return not self.approved_by_another or by not in ("", made)


def read_formal(recorded: Recorded, meta: Path | None = None) -> Formal:
    """Return the formal facts of a recording: its own, those of its bench, and before these of the file for --meta.

    Raises UsageError with line and key for a file that is wrong or of another device, BenchError for the bench text.
    """
    beside = recorded.path.parent
    bench = Table.parse(recorded.text("bench"), "bench in the recording", BenchError)
    top = Table.parse("", "", UsageError) if meta is None else Table.load(meta, UsageError)
    item, performed, decision = (top.again().table(name, optional=True) for name in ("item", "performed", "decision"))
    stated = dict(_facts(bench, beside))
    if logo := stated.get("laboratory_logo"):
        stated["laboratory_logo"] = beside / logo.name  # no other file of this computer, whoever made the recording
    stated |= dict(_facts(top, beside if meta is None else meta.parent))
    top.done()
    serial, begun = recorded.text("device_serial"), recorded.begun_utc
    if serial and stated.setdefault("item_serial_number", serial) != serial:
        raise item.fail("serial_number", f"{stated['item_serial_number']!r}: the recording is of {serial!r}")
    if stated.get("decision_rule") == "guard band":
        stated.setdefault("decision_false_accept", _LEAST_BAND)
    elif stated.pop("decision_false_accept", None) and (decision.has("false_accept") or not decision.has("rule")):
        where = decision if decision.has("false_accept") else bench.table("decision", optional=True)
        raise where.fail("false_accept", 'is for rule = "guard band"')
    stated.setdefault("certificate_approved_by", recorded.text("accepted_by") or None)
    day = stated.setdefault("performed_date", begun and begun.date())
    if begun is not None and day is not None and abs((day - begun.date()).days) > 1:  # but for the time of the place
        raise performed.fail("date", f"'{day}': the recording began on {begun.date()} UTC")
    for first, then in (("item_received", "performed_date"), ("performed_date", "certificate_issued")):
        if (early := stated.get(first)) and (late := stated.get(then)) and (early - late).days > 1:  # likewise
            raise UsageError(f"{meta}: {first.replace('_', '.')} {early} is after {then.replace('_', '.')} {late}")
    stated |= {field: recorded.text(name) or None for field, name in _RECORDED.items()}
    stated["approved_by_another"] = bench.table("station", optional=True).read("bench.station")["approved_by_another"]
    return Formal(**stated)


def _facts(top: Table, folder: Path) -> Iterator[tuple[str, Any]]:
    """Yield what a file states, by field."""
    for section in keys_of("certificate.certificate_file"):
        own = f"certificate.{section.name}"
        if section.kind == "tables":
            listed = tuple(Equipment(**table.read_all(own)) for table in top.tables(section.name))
            yield from [(section.name, listed)] * bool(listed)
        else:
            facts = top.table(section.name, optional=True).read_all(own, folder)
            yield from ((f"{section.name}_{key}", value) for key, value in facts.items() if value is not None)
