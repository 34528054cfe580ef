"""The form for what a certificate states beside the measurement: filled in, checked, kept beside the recording."""

import asyncio
import hashlib
import json
import re
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from drivers.packaged import packaged_toml
from drivers.specs import Key
from estimator.errors import MISSHAPEN
from estimator.untrusted import read_text
from station.atomic_write import write_whole
from station.errors import UsageError
from station.render.template import rendered
from station.report.formal import Formal, kept_facts, read_formal
from station.schema.tables import keys_of
from station.screen.archive.entries import Whole
from station.screen.dialogs import AskDialog, AskTextDialog, ChooseDialog
from station.screen.memory import state_folder

_SECTIONS = {section.name: section for section in keys_of("certificate.certificate_file")}
_KEEP, _LIST = "keep", "equipment."
_LASTING = ("laboratory.", "customer.", _LIST, "procedure.", "decision.", "performed.place")  # from job to job
_RECORDED = {"item.serial_number": "device_serial", "certificate.approved_by": "accepted_by"}
_PLACE = re.compile(rf": ((?:{'|'.join(_SECTIONS)})\.[\w.]+): (.*)", re.DOTALL)
_ASKED = {name: packaged_toml("station.report", f"{name}.toml") for name in ("certificate", "dcc")}
_LEAVE = [("back", "Back to the form"), ("drop", "Leave, keep nothing")]


class FactsDialog(ChooseDialog):
    """All facts, one a line, as large as the terminal is."""


async def fill_in(app: Any, whole: Whole) -> None:
    """Ask for facts, by names as "customer.name" and "equipment.0.due", until they are kept or given up."""
    kept, last = kept_facts(whole.path), _last_form(whole)
    try:
        sources = await asyncio.to_thread(_sources, whole, kept, last)
    except UsageError as error:
        app.notify(str(error), title="What was kept cannot be read", severity="error", markup=False)
        return
    begun: dict[str, str] = {}
    for facts in sources.values():  # what comes first goes before, and lists are not mixed
        listed = any(field.startswith(_LIST) for field in begun)
        begun |= {f: text for f, text in facts.items() if f not in begun and not (listed and f.startswith(_LIST))}
    entered, chosen = {**begun}, None
    while True:
        values: dict[str, Any] = {"keys": _keys(entered), "facts": entered, "sources": sources, "whole": whole}
        toml = rendered("station.screen", "facts.toml", {**values, "toml": json.dumps})
        formal, place, wrong = await asyncio.to_thread(_checked, whole, kept, toml)
        values |= {**_ASKED, "formal": formal, "place": place, "wrong": wrong}
        question, lines = (rendered("station.screen", f"{name}.txt", values) for name in ("facts", "fact_lines"))
        dialog = FactsDialog(question, [*zip((*values["keys"], _KEEP), lines.splitlines(), strict=True)], chosen)
        chosen = await app.push_screen_wait(dialog)
        if chosen in values["keys"]:
            question = rendered("station.screen", "fact.txt", {**values, "field": chosen})
            text = await app.push_screen_wait(AskTextDialog(question, entered.get(chosen, "")))
            entered |= {} if text is None else {chosen: text}
        elif chosen is None:
            lost = "What was entered is not kept yet."
            if entered == begun or await app.push_screen_wait(AskDialog(lost, _LEAVE)) == "drop":
                return
        else:
            try:
                if wrong:
                    raise UsageError(f"{place}: {wrong}")
                for file in (kept, last):
                    await asyncio.to_thread(write_whole, file, toml, replace=True)
            except UsageError as error:
                app.notify(str(error), title="NOT kept", severity="error", markup=False)
                chosen = place
            else:
                app.notify(f"{kept}; CTRL+P makes report, PDF and DCC with them", title="Kept", markup=False)
                return


def _sources(whole: Whole, kept: Path, last: Path) -> Mapping[str, Mapping[str, str]]:
    """Return the facts that are stated already, by where; what comes first goes before."""
    told = {field: whole.text(name) for field, name in _RECORDED.items()}
    told["performed.date"] = str(whole.begun_utc.date()) if whole.begun_utc else ""
    recorded = {"recording": {field: text for field, text in told.items() if text}}
    found = recorded | {"bench file": _texts(whole.bench, "bench in the recording")}
    if kept.is_file():
        return {"kept": _texts(read_text(kept, UsageError), str(kept)), **found}
    with suppress(UsageError):
        texts = _texts(read_text(last, UsageError), str(last))
        found["LAST FORM on this bench"] = {f: text for f, text in texts.items() if f.startswith(_LASTING)}
    return found


def _texts(text: str, file: str) -> dict[str, str]:
    """Return the facts in the text of a file as they are entered; UsageError if there are none."""
    try:
        found = {}
        for name, facts in tomllib.loads(text).items():
            for number, table in enumerate(facts if isinstance(facts, list) else [facts]):
                where = f"{name}.{number}" if isinstance(facts, list) else name
                for key, value in table.items() if name in _SECTIONS else ():
                    found[f"{where}.{key}"] = "; ".join(value) if isinstance(value, list) else str(value)
        return found
    except MISSHAPEN as error:
        raise UsageError(f"{file}: {error}") from None


def _keys(facts: Mapping[str, str]) -> dict[str, Key]:
    """Return all facts that there may be, in their order, with one more table of each list."""
    more = 1 + max((int(field.split(".")[1]) for field, text in facts.items() if text and _LIST in field), default=-1)
    tables = [
        (f"{name}.{number}" if section.kind == "tables" else name, section.of[0])
        for name, section in _SECTIONS.items()
        for number in range(more + 1 if section.kind == "tables" else 1)
    ]
    return {f"{table}.{key.name}": key for table, section in tables for key in keys_of(section)}


def _checked(whole: Whole, kept: Path, toml: str) -> tuple[Formal | None, str, str]:
    """Return what a report would state; or None, the fact that is wrong (empty: none alone), and what is wrong."""
    try:
        return read_formal(whole, kept, toml), "", ""
    except UsageError as error:
        place = _PLACE.search(str(error))
        return (None, place[1], place[2]) if place else (None, "", str(error))


def _last_form(whole: Whole) -> Path:
    """Return where the last form that was kept on a bench is."""
    return state_folder() / f"certificate-{hashlib.sha256(whole.text('station').encode()).hexdigest()[:20]}.toml"
