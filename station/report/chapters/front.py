"""The calibrated device, by whom, when, under which conditions, and the table's motion."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date

import numpy as np
from markupsafe import Markup

from drivers.packaged import packaged_toml
from drivers.types import Floats
from estimator.observations.rows import observations
from estimator.recordings.recording import ImuData
from estimator.recordings.reference import AttitudeReadings, RateReadings, Turns
from station.exports.exported import file_sha256, raw_sha256
from station.opening.links import ends_here
from station.report.chapters.unobserved_effects import driven_step
from station.report.document_status import Standing
from station.report.figures import (
    CELSIUS,
    COVERAGE,
    DEG,
    DEG_PER_S,
    MICRORADIANS,
    PERCENT,
    SECONDS,
    Unit,
    fixed,
    hash_text,
    stated,
    typographic,
)
from station.report.formal import Formal
from station.report.pictures import Picture, rates_picture
from station.report.recorded import JoinedRun, Recorded, Step
from station.report.tables import Content, Fact, Table, facts_of, table_of
from station.scripts.steps.rotate import Rotate

_ELSEWHERE = {RateReadings: "body rates", AttitudeReadings: "attitudes", Turns: "turns of known angle"}
"""What was measured where there was no table."""
_NOT_STATED = "not stated"
_CERTIFICATE_FACTS: Mapping[str, str] = packaged_toml("station.report", "certificate.toml")["not_stated"]
_INDISTINCT = "the station cannot distinguish a device from a simulator"


@dataclass(kw_only=True, frozen=True, slots=True)
class EquipmentView:
    """The instruments, names of those whose calibration had ``expired`` on ``day`` or has no due date (``undated``).

    ``day`` is the date of measurement, None if it is not known; ``has_due_dates``: some instrument has one.
    """

    table: Table
    expired: str
    undated: str
    day: date | None
    has_due_dates: bool


@dataclass(kw_only=True, frozen=True, slots=True)
class FrontView:
    """The chapter on the device and the conditions; ``not_stated`` are facts that nobody stated."""

    device: Sequence[Fact]
    conditions: Sequence[Fact]
    equipment: EquipmentView | None
    not_stated: str


def front_view(recorded: Recorded, formal: Formal, standing: Standing, *, adjusted: bool) -> FrontView:
    """Return what was calibrated, by whom, when and where; ``adjusted``: the device was adjusted before this run.

    For imported data, which have no outcome, neither an adjustment nor what is not stated is given. ``equipment`` is
    None if none is stated.
    """
    measured = bool(recorded.text("outcome"))  # by a station, whose laboratory fills in what no file knows
    return FrontView(
        device=facts_of([*_device(recorded, formal), *_identities(recorded), *_origin(recorded, formal)]),
        conditions=facts_of(
            [
                *_when_and_where(recorded, formal, standing),
                *_reference(recorded),
                ("Adjustment", _adjustment(adjusted) if measured else None),
                *_approval(recorded, formal),
            ]
        ),
        equipment=_equipment(formal) if formal.equipment else None,
        not_stated=_unstated(formal) if measured else "",
    )


def _joined(parts: Iterable[str | None], between: str = ", ") -> str:
    """Return the parts that are known, with ``between`` between them."""
    return between.join(part for part in parts if part)


def _identity(model: str | None, serial: str | None, firmware: str | None) -> str:
    """Return what a device says that it is."""
    numbered = f"serial number {serial}" if serial else ""
    return _joined([model, numbered, f"firmware {firmware}" if firmware else ""])


def _device(recorded: Recorded, formal: Formal) -> list[tuple[str, Content]]:
    """Return customer, device under test, maker, serial number and condition, "" for those that are not stated.

    Device and serial number say "not stated" instead. The device is named by its links, else as in the recording.
    """
    names = ", ".join(name for name in links_of(recorded) if name != "table")
    received = str(formal.item_received) if formal.item_received else ""
    return [
        ("Customer", _joined([formal.customer_name, *formal.customer_address])),
        ("Device under test", names or recorded.text("device") or _NOT_STATED),
        ("Maker, model", _joined([formal.item_maker, formal.item_model])),
        ("Serial number", _serial_number(formal)),
        ("Received, condition", _joined([received, formal.item_condition])),
    ]


def _serial_number(formal: Formal) -> str:
    if formal.item_serial_told:
        reported = f"the device says {formal.item_serial_told}; confirmed: {formal.item_serial_reason}"
        return f"{formal.item_serial_number} ({reported})"
    return formal.item_serial_number or _NOT_STATED


def _identities(recorded: Recorded) -> list[tuple[str, Content]]:
    """Return a line for each identity that sources report, with the names of all that report it; silent ones have none.

    An identity is model, serial number and firmware, as far as the device reports them.
    """
    names: dict[str, list[str]] = {}
    for name, of_source in recorded.source_attributes.items():
        identity = _identity(of_source.get("model"), of_source.get("serial"), of_source.get("firmware"))
        if identity:
            names.setdefault(identity, []).append(name)
    return [(f"Identity of {', '.join(sources)}", identity) for identity, sources in names.items()]


def _origin(recorded: Recorded, formal: Formal) -> list[tuple[str, Content]]:
    """Return recording, station, operator, links, what an import states of its data, and the remark of the document.

    Lines that do not apply are empty or None; without an operator it says "not stated".
    """
    links = links_of(recorded)
    local = ", ".join(local_links(links))
    return [
        ("Recording", recorded.path.name),
        ("Station", recorded.text("station")),
        ("Operator", recorded.text("operator") or _NOT_STATED),
        ("Protocol and link", "; ".join(f"{name}: {link}" for name, link in links.items())),
        ("Links that end on this computer", f"{local}: {_INDISTINCT}" if local else None),
        ("Imported from", recorded.text("imported_from")),
        ("Source of the data", recorded.text("source")),
        ("Licence of the data", recorded.text("licence")),
        ("Factors applied to the outputs by the import", recorded.text("gyro_factor")),
        ("Notes of the import", recorded.text("imported")),
        ("Refused by the import", recorded.text("refused")),
        ("Remark", formal.certificate_remark),
    ]


def _when_and_where(recorded: Recorded, formal: Formal, standing: Standing) -> list[tuple[str, Content]]:
    """Return dates, place, ambient conditions and procedure; None where a line is to be left out.

    A date of calibration is given only if it is not that of the measurement. A place, and a date of measurement, that
    is not known is said to be so.
    """
    begun = recorded.begun_utc
    undated = "none: the run was in simulated time" if standing.simulated else _NOT_STATED
    on_another_day = begun is not None and formal.performed_date != begun.date()
    humidity = _ambient(formal.performed_humidity, PERCENT, formal.performed_humidity_from)
    return [
        ("Calibrated on", formal.performed_date if on_another_day else None),
        ("Date of measurement", f"{begun:%Y-%m-%d %H:%M:%S UTC}" if begun else formal.performed_date or undated),
        ("Place of calibration", formal.place or _NOT_STATED),
        ("Ambient temperature", _ambient(formal.performed_temperature_c, CELSIUS, formal.performed_temperature_from)),
        ("Relative humidity", humidity),
        ("Procedure", _joined([formal.procedure_name, formal.procedure_edition])),
    ]


def _ambient(value: float | None, unit: Unit, instrument: str | None) -> Content:
    """Return a condition of the room with the instrument that measured it, if that is stated; None without a value."""
    if value is None:
        return None
    by = f" ({instrument})" if instrument else ""
    return Markup("{} {}{}").format(stated(value, unit), unit.name, by)


def _reference(recorded: Recorded) -> list[tuple[str, Content]]:
    """Return the site, the table or what there was in its place, the script, how long it took, why it ended early."""
    duration = fixed((recorded.end_ns - recorded.start_ns) * 1e-9, SECONDS, 2)
    return [
        ("Site", _site(recorded)),
        ("Table", _table(recorded)),
        ("Script", recorded.text("script") or _NOT_STATED),
        ("Duration", Markup("{} s").format(duration)),
        ("Ended early", recorded.text("ended_early")),
    ]


def _site(recorded: Recorded) -> Content:
    """Return latitude and heading in words, or that no site is stated and Earth rate is therefore not in the model."""
    site = recorded.recording.site
    if site is None:
        return "not stated: Earth rate is not in the model"
    latitude = fixed(site.latitude_rad, DEG, 4, "@site_latitude_rad")
    heading = fixed(site.heading_rad, DEG, 4, "@site_heading_rad")
    words = Markup("latitude {}°, heading of the base x axis\n{}°; Earth rate is in the model")
    return words.format(latitude, heading)


def _table(recorded: Recorded) -> str:
    table = recorded.recording.table
    if table is None:
        return f"none: the reference is {_ELSEWHERE[type(recorded.recording.reference)]} measured elsewhere"
    identity = _identity(recorded.text("table_model"), recorded.text("table_serial"), recorded.text("table_firmware"))
    return f"{identity or 'not identified'}; axes {', '.join(table.gimbals)} (outermost first)"


def _adjustment(adjusted: bool) -> str:
    return "before this run: see “As found and as left”" if adjusted else "none: as found is as left"


def _approval(recorded: Recorded, formal: Formal) -> list[tuple[str, Content]]:
    """Return who approved and who accepted the calibration, and when the next one is due; None or "" if not stated.

    An instant of acceptance that is not a number of seconds is shown as it is in the recording.
    """
    accepted = recorded.utc("accepted_utc")
    when = f"{accepted:%Y-%m-%d %H:%M UTC}" if accepted else recorded.text("accepted_utc")
    return [
        ("Approved by", formal.certificate_approved_by),
        ("Next calibration due", formal.certificate_next_due),
        ("Calibration accepted by", _joined([recorded.text("accepted_by"), when], " on ")),
    ]


def _equipment(formal: Formal) -> EquipmentView:
    """Return the equipment that was used, and the names of what had expired or states neither due date nor why not.

    It had expired if it was due before the date of measurement.
    """
    rows = [
        [instrument.name, instrument.serial_number or _NOT_STATED, instrument.due or instrument.no_due or _NOT_STATED]
        for instrument in formal.equipment
    ]
    return EquipmentView(
        table=table_of(["equipment", "serial number", "calibration due"], "lll", rows),
        expired=", ".join(instrument.name for instrument in formal.overdue if instrument.due),
        undated=", ".join(instrument.name for instrument in formal.overdue if not instrument.due),
        day=formal.performed_date,
        has_due_dates=any(instrument.due for instrument in formal.equipment),
    )


def _unstated(formal: Formal) -> str:
    return ", ".join(words for fact, words in _CERTIFICATE_FACTS.items() if getattr(formal, fact) in (None, (), ""))


@dataclass(kw_only=True, frozen=True, slots=True)
class MotionView:
    """The motion of a run: ``turns`` of known angle, 0 if these were not the reference; its picture and its steps."""

    turns: int
    picture: Picture | None
    steps: Table | None


def motion_view(recorded: Recorded) -> MotionView:
    """Return the motion of a run: the number of turns of known angle, a picture of the rates, and the steps.

    Picture and steps are None if they are not known; steps are known on a table only.
    """
    driven = driven_steps(recorded)
    return MotionView(
        turns=turns(recorded),
        picture=motion_picture(recorded),
        steps=_steps_table(recorded, driven) if driven else None,
    )


@dataclass(kw_only=True, frozen=True, slots=True)
class MountingsView:
    """The runs of a joined calibration: how many, the name of the first, their mountings, and their files."""

    count: int
    first: str
    runs: Table
    files: Table


def mountings_view(recorded: Recorded) -> MountingsView:
    """Return the runs of a joined calibration, with the mounting of the device and its error in each, and file hashes.

    Each run's file is read for its hashes.
    """
    return MountingsView(
        count=len(recorded.joined),
        first=recorded.path.name,
        runs=_mountings_table(recorded.joined),
        files=table_of(
            ["recording", "begun", "SHA-256 of the file", "SHA-256 of the raw data"],
            "llll",
            [
                [run.path.name, _begun(run), hash_text(file_sha256(run.path)), hash_text(raw_sha256(run.path))]
                for run in recorded.joined
            ],
        ),
    )


def _begun(run: JoinedRun) -> str:
    return f"{run.begun_utc:%Y-%m-%d %H:%M:%S UTC}" if run.begun_utc else _NOT_STATED


def _mountings_table(runs: Sequence[JoinedRun]) -> Table:
    """Return a row for each run: the axes of the table along which x, y and z of the device lay, and the error.

    That is the mounting error about each axis, in µrad with its U.
    """
    heads = ["recording", "x, y, z along"]
    for axis in "xyz":
        heads += [f"error about {axis}, µrad", "U"]
    rows: list[list[Content]] = []
    for run in runs:
        row: list[Content] = [run.path.name, ", ".join(map(_along, run.axes))]
        for error_rad, sd_rad in zip(run.found.error_rad.tolist(), run.found.sd_rad.tolist(), strict=True):
            row += [fixed(error_rad, MICRORADIANS, 0), fixed(COVERAGE * sd_rad, MICRORADIANS, 0)]
        rows.append(row)
    return table_of(heads, "ll" + 6 * "r", rows)


def _along(direction: Floats) -> str:
    """Return the axis of the table along which a direction lies, with its sign."""
    number = int(np.argmax(np.abs(direction)))
    return typographic("-" if direction[number] < 0 else "") + "xyz"[number]


def _steps_table(recorded: Recorded, driven: Sequence[tuple[Step, Rotate | None]]) -> Table:
    """Return a row for each step that was driven: begin, duration, axis, steady rate and angle turned.

    Begins count from the first step. A step without a turn has "none" and zeros.
    """
    heads = ["step", "begins, s", "lasts, s", "axis", "steady rate, °/s", "turned by, °"]
    rows: list[list[Content]] = []
    for number, (step, turn) in enumerate(driven, start=1):
        begins = fixed((step.start_ns - recorded.start_ns) * 1e-9, SECONDS, 2)
        lasts = fixed((step.end_ns - step.start_ns) * 1e-9, SECONDS, 2)
        rows.append([f"{number} {step.label}", begins, lasts, *_turn(turn)])
    return table_of(heads, "lrrlrr", rows)


def _turn(turn: Rotate | None) -> list[Content]:
    """Return axis, rate in deg/s and angle in deg of a step; "none" and zeros without a turn."""
    if turn is None:
        return ["none", "0", "0"]
    return [turn.axis, fixed(turn.rate_rps, DEG_PER_S, 2), fixed(turn.turn_rad, DEG, 2)]


def links_of(recorded: Recorded) -> dict[str, str]:
    """Return protocol and link of each device by name, and of the table as "table"; those not recorded are left out."""
    devices = (text.partition(" (") for text in recorded.recording.attributes.get("devices", ()))
    links = {name: rest.rstrip(")") for name, _, rest in devices}
    return links | ({"table": recorded.text("table_link")} if recorded.text("table_link") else {})


def local_links(links: Mapping[str, str]) -> list[str]:
    """Return the names whose links end on this computer."""
    return [name for name, link in links.items() if ends_here(link)]


def rate_hz(data: ImuData) -> float:
    """Return the mean sampling rate, NaN if it is not known."""
    span_s = float(data.t_ns[-1] - data.t_ns[0]) * 1e-9 if len(data.t_ns) > 1 else math.nan
    return (len(data.t_ns) - 1) / span_s if span_s > 0 else math.nan


def turns(recorded: Recorded) -> int:
    """Return the number of turns of known angle, if these were the reference."""
    stated = recorded.recording.turns
    return 0 if stated is None else len(stated.sd_rad)


def motion_picture(recorded: Recorded) -> Picture | None:
    """Return a picture of the rates of the table axes, by name, or of the body if there was no table.

    None without a table if the reference are turns of known angle or nothing of the first source has times.
    """
    table = recorded.recording.table
    if table is not None:
        order = sorted(range(len(table.gimbals)), key=lambda column: table.gimbals[column])
        names = [table.gimbals[column] for column in order]
        t_s: Floats = np.asarray((table.t_ns - recorded.start_ns) * 1e-9, dtype=np.float64)
        return rates_picture(names, t_s, table.rate_rps[:, order], "rates of the axes of the table")
    data = next(iter(recorded.recording.sources.values()))
    rows = [part for part in observations(recorded.recording, data) if part.t_ns is not None]
    if recorded.recording.turns is not None or not rows:
        return None
    t_s = np.concatenate([part.t_ns for part in rows if part.t_ns is not None]) * 1e-9
    return rates_picture("xyz", t_s - t_s[0], np.vstack([part.w_rps for part in rows]), "rates of the body")


def driven_steps(recorded: Recorded) -> list[tuple[Step, Rotate | None]]:
    """Return the steps as they were driven on a table, each with its turn or None; [] without a table."""
    table = recorded.recording.table
    if table is None:
        return []
    return [(step, driven_step(table, step).turn) for step in recorded.steps]
