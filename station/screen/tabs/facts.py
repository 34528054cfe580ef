"""The form for the facts of a certificate beside the measurement: filled in, checked, stored with the recording."""

import asyncio
import hashlib
import re
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from estimator.errors import MISSHAPEN
from estimator.untrusted import read_text
from station.atomic_write import write_whole
from station.errors import UsageError
from station.screen.archive.entries import ReadRecording
from station.screen.dialogs import AskDialog, AskTextDialog, ChooseDialog
from station.screen.memory import state_folder
from station.screen.panes.certificate_form import (
    BENCH_FILE,
    LAST_FORM,
    RECORDED,
    SECTIONS,
    Checked,
    Form,
    field_question,
    form_lines,
    form_question,
    form_toml,
)

if TYPE_CHECKING:
    from station.report.recorded import Recorded

_LIST = "equipment."
_LASTING = ("laboratory.", "customer.", _LIST, "procedure.", "decision.", "performed.place")  # from job to job
_RECORDED = {"item.serial_number": "device_serial", "certificate.approved_by": "accepted_by"}
_PLACE = re.compile(rf": ((?:{'|'.join(SECTIONS)})\.[\w.]+): (.*)", re.DOTALL)
_KEEP = "keep", "SAVE ALL next to the recording"
_LEAVE = "Your entries are not saved yet.", [("back", "Back to the form"), ("drop", "Leave without saving")]


class FactsDialog(ChooseDialog):
    """All facts, one a line, as large as the terminal."""


async def fill_in(app: Any, recording: ReadRecording) -> None:
    """Let the operator edit facts, named as "customer.name" or "equipment.0.due", until they are stored or given up.

    A fact begins as the first of its origins has it; lists are not mixed. They are stored beside the recording and, if
    that is possible, as the form of the bench. Nothing is stored while one is wrong: that field is asked for next.
    Facts that cannot be read or stored are reported. Leaving with changes has to be confirmed.
    """
    try:
        recorded, files, sources = await asyncio.to_thread(_stated, recording)
    except (UsageError, *MISSHAPEN) as error:
        app.notify(str(error), title="Known facts cannot be read", severity="error", markup=False)
        return
    begun: dict[str, str] = {}
    for facts in sources.values():  # the first source wins, and lists are not mixed
        listed = any(field.startswith(_LIST) for field in begun)
        begun |= {f: text for f, text in facts.items() if f not in begun and not (listed and f.startswith(_LIST))}
    entered = dict(begun)
    chosen = ""
    while True:
        form = Form(recording=recorded.path.name, entered=entered, sources=sources)
        toml = form_toml(form)
        checked = await asyncio.to_thread(_checked, recorded, files[0], toml)
        question = form_question(form, checked)
        answers = _answers(form, checked, app.size.width)
        chosen = await app.push_screen_wait(FactsDialog(question, answers, chosen)) or ""
        if "." in chosen:
            question = field_question(chosen, checked)
            text = await app.push_screen_wait(AskTextDialog(question, begun=entered.get(chosen, "")))
            entered = _edited(form, {} if text is None else {chosen: text})
        elif not chosen:
            if entered == begun or await app.push_screen_wait(AskDialog(*_LEAVE)) == "drop":
                return
        elif checked.formal is None:
            chosen = checked.place
        else:
            try:
                await asyncio.to_thread(write_whole, files[0], toml, replace=True)
                with suppress(UsageError):  # a failure to store entries does no harm
                    await asyncio.to_thread(write_whole, files[1], toml, replace=True)
                app.notify(f"{files[0]}: CTRL+P makes report, PDF and DCC with them", title="Kept", markup=False)
                return
            except (UsageError, *MISSHAPEN) as error:
                app.notify(str(error), title="NOT kept", severity="error", markup=False)


def _checked(recorded: "Recorded", file: Path, toml: str) -> Checked:
    """Return the facts in the TOML text for ``file``, read as those of a recording, or why that is impossible.

    The field of the fault is given where the error names one.
    """
    from station.report.formal import read_formal

    try:
        return Checked(formal=read_formal(recorded, file, toml))
    except UsageError as error:
        found = _PLACE.search(str(error))
        return Checked(wrong=str(error)) if found is None else Checked(place=found[1], wrong=found[2])


def _answers(form: Form, checked: Checked, width: int) -> list[tuple[str, str]]:
    """Return the lines to choose from, each a field and its words for ``width`` columns; the last one saves all."""
    answers = []
    table = ""
    for line in form_lines(form, checked):
        answers.append((line.field, line.words(width, first=line.table != table)))
        table = line.table
    return [*answers, _KEEP]


def _edited(form: Form, texts: Mapping[str, str]) -> dict[str, str]:
    """Return the facts entered with new ``texts``; without any instrument those of the bench file hold again."""
    entered = {**form.entered, **texts}
    if not any(entered[field] for field in entered if field.startswith(_LIST)):
        entered |= {field: text for field, text in form.sources[BENCH_FILE].items() if field.startswith(_LIST)}
    return entered


def _stated(recording: ReadRecording) -> tuple["Recorded", tuple[Path, Path], Mapping[str, Mapping[str, str]]]:
    """Return the recording without samples, the two files for facts, and the facts stated so far, by their origin.

    The files are that of this recording and that of the last form of this bench. The latter is looked at only if the
    former does not exist, for facts that last from job to job, and is ignored if it cannot be read. Origins that take
    precedence come first. UsageError, or an error of ``_texts``, if the former or the recorded bench file is wrong.
    """
    from estimator.recordings.recording import Recording
    from station.report.formal import kept_facts
    from station.report.recorded import Recorded, Step

    head = Recording({}, None, attributes=recording.attributes)  # type: ignore[arg-type]
    recorded = Recorded(
        path=recording.entry.path,
        recording=head,
        calibration=None,
        rest=None,
        courses={},
        source_attributes={},
        steps=(Step("", 0, 0),),
        events=(),
    )
    station = hashlib.sha256(recorded.text("station").encode()).hexdigest()
    kept, last = kept_facts(recorded.path), state_folder() / f"certificate-{station[:20]}.toml"
    recorded_facts = {field: recorded.text(name) for field, name in _RECORDED.items()}
    recorded_facts["performed.date"] = str(recorded.begun_utc.date()) if recorded.begun_utc else ""
    found = {RECORDED: {field: text for field, text in recorded_facts.items() if text}}
    found[BENCH_FILE] = _texts(recorded.text("bench"))
    if kept.is_file():
        return recorded, (kept, last), {"kept": _texts(read_text(kept, UsageError)), **found}
    with suppress(UsageError, *MISSHAPEN):
        facts = _texts(read_text(last, UsageError)) if recorded.text("station") else {}
        found[LAST_FORM] = {field: text for field, text in facts.items() if field.startswith(_LASTING)}
    return recorded, (kept, last), found


def _texts(toml: str) -> dict[str, str]:
    """Return the facts in a TOML text as they are entered, by names such as "equipment.0.due".

    Items of a list are joined by " | ". Tables other than ``SECTIONS`` are left out. TOMLDecodeError if it is no TOML,
    AttributeError if a section is no table, TypeError if a list holds other values than texts.
    """
    found = {}
    for name, facts in tomllib.loads(toml).items():
        for number, table in enumerate(facts if isinstance(facts, list) else [facts]):
            where = f"{name}.{number}" if isinstance(facts, list) else name
            for key, value in table.items() if name in SECTIONS else ():
                found[f"{where}.{key}"] = " | ".join(value) if isinstance(value, list) else str(value)
    return found
