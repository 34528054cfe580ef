"""The form for the facts of a certificate: its question, its lines, and the file that it is stored in."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from drivers.packaged import packaged_toml
from drivers.specs import Key
from station.schema.tables import keys_of

if TYPE_CHECKING:
    from station.report.formal import Formal

SECTIONS: Mapping[str, Key] = {section.name: section for section in keys_of("certificate.certificate_file")}
RECORDED, BENCH_FILE, LAST_FORM = "recording", "bench file", "LAST FORM, this bench"
"""Origins of facts that are stated already."""
_NOT_STATED: Mapping[str, str] = packaged_toml("station.report", "certificate.toml")["not_stated"]
_MANDATORY: Sequence[str] = packaged_toml("station.report", "dcc.toml")["mandatory"]
_TIES_TO_DEVICE = "item.serial_number"
_CUSTOMER = "customer.name"
_WIDE, _WIDEST = 120, 160
_ORIGIN = "# What the certificate of the recording beside this file states, as the form on the screen kept it."


@dataclass(kw_only=True, frozen=True, slots=True)
class Form:
    """The facts that were entered, by names such as "customer.name" or "equipment.0.due", and those known by origin.

    ``sources`` has the texts by name for RECORDED and BENCH_FILE, and for LAST_FORM if there was one. Of several with
    the same text the first counts.
    """

    recording: str
    entered: Mapping[str, str]
    sources: Mapping[str, Mapping[str, str]]


@dataclass(kw_only=True, frozen=True, slots=True)
class Checked:
    """Whether the facts of a form can be read: ``formal`` is None if ``wrong`` says why not, at the field ``place``."""

    formal: "Formal | None" = None
    place: str = ""
    wrong: str = ""


@dataclass(kw_only=True, frozen=True, slots=True)
class FormLine:
    """One line of the form: the field, its text, and a remark: where the text is from, or that it lacks."""

    field: str
    table: str
    key: Key
    text: str
    remark: str
    wrong: bool

    def words(self, width: int, *, first: bool) -> str:
        """Return key, text and remark for a terminal of ``width`` columns; the ``first`` line of a table names it.

        In a wide one the meaning of the key follows, unless the fact is wrong. The line is not cut to the width.
        """
        table = self.table if first else ""
        text = self.text.ljust(34 if width >= _WIDE else 21)
        begin = f"{table:11} {self.key.name.replace('_', ' '):16} {text}  "
        if width < _WIDEST or self.wrong:
            return begin + self.remark
        return f"{begin}{self.remark:23} {self.key.doc}"


def form_lines(form: Form, checked: Checked) -> Iterator[FormLine]:
    """Yield the lines of the form, table by table."""
    for table in _tables(form.entered):
        for key in keys_of(f"certificate.{_section(table)}"):
            yield _form_line(form, checked, table, key)


def _tables(entered: Mapping[str, str]) -> Iterator[str]:
    """Yield the tables of the form, such as "customer" or "equipment.0"; a list has one after its last with a text."""
    for name, section in SECTIONS.items():
        if section.kind != "tables":
            yield name
            continue
        fields = [field for field, text in entered.items() if text and field.startswith(f"{name}.")]
        numbers = [_number(field) for field in fields]
        for number in range(max(numbers, default=-1) + 2):
            yield f"{name}.{number}"


def _number(field: str) -> int:
    """Return the number of the table that a field of a list is in; 0 if a file names a list without numbers."""
    number = field.split(".")[1]
    return int(number) if number.isdecimal() else 0


def _section(table: str) -> str:
    return table.split(".")[0]


def _form_line(form: Form, checked: Checked, table: str, key: Key) -> FormLine:
    """Return the line of a field: its text, and where that comes from, what is wrong with it, or that it is missing.

    Entered text goes before that of the recording, and that before the bench file; a field of a list, in a ``table``
    such as "equipment.0", never takes that of the bench file. The remark is what is wrong, else the first origin with
    the same text, "entered" if no origin has it, else what is lacking.
    """
    field = f"{table}.{key.name}"
    # A list of the bench file is taken over as a whole, or not at all.
    of_bench = "" if "." in table else form.sources[BENCH_FILE].get(field, "")
    text = form.entered.get(field) or form.sources[RECORDED].get(field) or of_bench
    wrong = field == checked.place
    if wrong:
        remark = f"WRONG: {checked.wrong}"
    elif text:
        remark = next((where for where, known in form.sources.items() if known.get(field) == text), "entered")
    else:
        remark = _lacking(field, key)
    return FormLine(field=field, table=table, key=key, text=text, remark=remark, wrong=wrong)


def _lacking(field: str, key: Key) -> str:
    """Return what a fact without a text is needed for."""
    if field in _MANDATORY:
        return "needed for a DCC"
    fact = "equipment" if field == "equipment.0.name" else f"{_section(field)}_{key.field or key.name}"
    return "not stated" if fact in _NOT_STATED else ""


def form_question(form: Form, checked: Checked) -> str:
    """Return the text above the form: its keys, what is wrong, and what a certificate lacks."""
    lines = [f"{form.recording}   ENTER edits a line   END the last line saves all   ESC leaves"]
    if checked.formal is None:
        lines.append(f"WRONG  {checked.place}: {checked.wrong}")
    else:
        lines += _remarks(form, checked.formal)
    return "".join(f"{line}\n" for line in lines)


def _remarks(form: Form, formal: "Formal") -> list[str]:
    """Return what the operator should check: a customer of the last form, what prevents a certificate, missing facts.

    The last line is always there: how many facts are not stated, and how many a digital certificate needs.
    """
    lines = []
    last_customer = form.sources.get(LAST_FORM, {}).get(_CUSTOMER)
    if last_customer and form.entered.get(_CUSTOMER) == last_customer:
        lines.append(f"CUSTOMER of the last form: {last_customer}. Is it the same?")
    if formal.overdue:
        names = ", ".join(instrument.name for instrument in formal.overdue)
        lines.append(f"NO CERTIFICATE  overdue, or without a due date: {names}")
    elif not formal.approved:
        lines.append("NO CERTIFICATE  the bench file requires approval by someone other than the operator")
    unstated = sum(getattr(formal, fact) in (None, ()) for fact in _NOT_STATED)
    needed = sum(not getattr(formal, fact.replace(".", "_")) for fact in _MANDATORY)
    paper = f"{unstated} of ISO/IEC 17025, 7.8, not stated" if unstated else "complete"
    digital = f"{needed} needed" if needed else "complete"
    lines.append(f"Certificate: {paper}   Digital (DCC): {digital}")
    return lines


def field_question(field: str, checked: Checked) -> str:
    """Return the question for the text of one field: what it means, how it is written, and what is wrong with it."""
    section, *_, name = field.split(".")
    key = next(key for key in keys_of(f"certificate.{section}") if key.name == name)
    question = f"{field}: {key.doc}{_how_written(key)}"
    return f"{question}\nWRONG: {checked.wrong}\n" if field == checked.place else question


def _how_written(key: Key) -> str:
    if key.kind == "texts":
        return "; lines with | between them"
    if key.kind == "date":
        return "; as 2026-11-23"
    return f"; {' or '.join(key.one_of)}" if len(key.one_of) in (2, 3) else ""


def form_toml(form: Form) -> str:
    """Return the facts that were entered as a TOML file; those that the recording states itself are left out."""
    tables = [_ORIGIN + "\n"]
    for table in _tables(form.entered):
        lines = list(_toml_lines(form, table))
        if lines:
            section = _section(table)
            heading = f"[{table}]" if table == section else f"[[{section}]]"
            tables.append("\n".join(["", heading, *lines, ""]))
    return "".join(tables)


def _toml_lines(form: Form, table: str) -> Iterator[str]:
    """Yield the TOML lines of a table's entered fields that differ from the recording, without the table's heading.

    The serial number has a line in any case if it was entered; empty fields have none.
    """
    for key in keys_of(f"certificate.{_section(table)}"):
        field = f"{table}.{key.name}"
        text = form.entered.get(field)
        # The serial number ties the file to the device.
        if text and (text != form.sources[RECORDED].get(field) or field == _TIES_TO_DEVICE):
            parts = [part.strip() for part in text.split("|") if part.strip()]
            yield f"{key.name} = {_as_toml(parts if key.kind == 'texts' else text)}"


def _as_toml(value: Any) -> str:
    """Return a text or a list of texts as TOML has it."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
