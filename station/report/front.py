"""What was calibrated, by whom, when and under what conditions, and what the table did."""

import math
import re
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime

import numpy as np

from estimator.recording import ImuData
from estimator.reference import AttitudeReadings, RateReadings, TableReadings, Turns
from estimator.rows import observations
from station.report.figures import CELSIUS, DEG, DEG_PER_S, ONE, SECONDS, Unit, figure, fixed, plain
from station.report.html import BLANK, Content, Markup, composed, element, facts, joined, paragraph, table
from station.report.pictures import rates_picture
from station.report.recorded import Recorded
from station.report.standing import begun_utc, is_simulated
from station.report.unseen import driven_step
from station.script import Rotate

HERTZ = Unit("Hz", 1.0)
_LOCAL = re.compile(r"//(?:127\.|localhost|\[::1\])|/dev/pts/|udp_multicast|can:virtual")


def identification(recorded: Recorded) -> Markup:
    """Return who and what: device, table, station, operator, recording."""
    devices = [text.partition(" (") for text in recorded.recording.attributes.get("devices", ())]
    measured = recorded.has("outcome")  # by a station, whose laboratory fills in what no file knows
    links = {name: rest.rstrip(")") for name, _, rest in devices}
    if recorded.has("table_link"):
        links["table"] = recorded.text("table_link")
    local = ", ".join(name for name, link in links.items() if _LOCAL.search(link))
    rows: list[tuple[str, Content]] = [
        ("Device under test", ", ".join(name for name, _, _ in devices) or recorded.text("device") or "not stated"),
        ("Serial number of the device", recorded.text("device_serial") or "not stated"),
        ("Protocol and link", "; ".join(f"{name}: {link}" for name, link in links.items())),
        ("Links that end on this computer", local and f"{local}: a device or a simulator, the station cannot tell"),
        *_identities(recorded),
        ("Table", _table(recorded)),
        ("Station", recorded.text("station")),
        ("Operator", recorded.text("operator") or "not stated"),
        ("Laboratory, its address", BLANK if measured else None),
        ("Customer", BLANK if measured else None),
        ("Recording", recorded.path.name),
        ("Imported from", recorded.text("imported_from")),
        ("Source of the data", recorded.text("source")),
        ("Licence of the data", recorded.text("licence")),
        ("Factors that the import put on the outputs", recorded.text("gyro_factor")),
        ("Notes of the import", recorded.text("imported")),
        ("Refused by the import", recorded.text("refused")),
    ]
    return facts(rows)


def _identities(recorded: Recorded) -> Iterator[tuple[str, Content]]:
    """Yield what the sources say that they are, sources that say the same together."""
    told: dict[str, list[str]] = {}
    for name, attributes in recorded.source_attributes.items():
        text = _identity(attributes.get("model"), attributes.get("serial"), attributes.get("firmware"))
        if text:
            told.setdefault(text, []).append(name)
    for text, names in told.items():
        yield f"Identity of {', '.join(names)}", text


def _identity(model: object, serial: object, firmware: object) -> str:
    words = ((model, "{}"), (serial, "serial number {}"), (firmware, "firmware {}"))
    return ", ".join(word.format(value) for value, word in words if value)


def _table(recorded: Recorded) -> str:
    reference = recorded.recording.reference
    if isinstance(reference, TableReadings):
        told = _identity(*(recorded.text(f"table_{key}") for key in ("model", "serial", "firmware")))
        axes = f"axes {', '.join(reference.gimbals)} (outermost first)"
        return f"{told or 'not identified'}; {axes}"
    kinds = {RateReadings: "body rates", AttitudeReadings: "attitudes", Turns: "turns of known angle"}
    return f"none: the reference are {kinds[type(reference)]} that were measured elsewhere"


@composed
def conditions(recorded: Recorded) -> Iterator[Content]:
    """Return when, where, how warm, how long, how fast sampled."""
    begun = begun_utc(recorded)
    site = recorded.recording.site
    place: Content = "not stated: Earth rate is not in the model"
    if site is not None:
        latitude = fixed(site.latitude_rad, DEG, 4, "@site_latitude_rad")
        heading = fixed(site.heading_rad, DEG, 4, "@site_heading_rad")
        place = Markup(f"latitude {latitude}°, heading of the base x axis {heading}°; Earth rate is in the model")
    duration_s = (recorded.end_ns - recorded.start_ns) * 1e-9
    rows: list[tuple[str, Content]] = [
        ("Date of measurement", f"{begun:%Y-%m-%d %H:%M:%S} UTC" if begun else _no_date(recorded)),
        ("Site", place),
        ("Duration", joined([fixed(duration_s, SECONDS, 2), " s"])),
        ("Script", recorded.text("script") or "not stated"),
        ("Ended early", recorded.text("ended_early")),
        ("Ambient temperature, humidity", joined(["not recorded by the station; by the laboratory: ", BLANK])),
        ("Adjustment", "none: the results are of the outputs as they came" if recorded.has("outcome") else None),
    ]
    sources = [_source(name, data) for name, data in recorded.recording.sources.items()]
    heads = ("source", "samples", "sampling rate, Hz", "lowest, °C", "mean, °C", "highest, °C")
    yield facts(rows)
    yield table("Sampling, and temperature as the gyros themselves tell it", heads, sources, align="lrrrrr")


def _no_date(recorded: Recorded) -> str:
    return "none: the run was in simulated time" if is_simulated(recorded) else "not stated"


def _source(name: str, data: ImuData) -> list[Content]:
    span_s = float(data.t_ns[-1] - data.t_ns[0]) * 1e-9 if len(data.t_ns) > 1 else math.nan
    rate_hz = (len(data.t_ns) - 1) / span_s if span_s > 0 else math.nan
    cells: list[Content] = [name, figure(len(data.t_ns), ONE, f"{len(data.t_ns)}"), plain(rate_hz, HERTZ, 5)]
    known = data.temperature_c[np.isfinite(data.temperature_c)] if data.temperature_c is not None else np.empty(0)
    if not len(known):
        return [*cells, "not recorded", None, None]
    return [*cells, *(fixed(float(f(known)), CELSIUS, 2) for f in (np.min, np.mean, np.max))]


@composed
def motion(recorded: Recorded) -> Iterator[Content]:
    """Return the profile of the axes, or of the body where there was no table, and the steps as they were driven."""
    reference = recorded.recording.reference
    if isinstance(reference, TableReadings):
        order = sorted(range(len(reference.gimbals)), key=lambda column: reference.gimbals[column])
        names = [reference.gimbals[column] for column in order]
        t_s = np.asarray((reference.t_ns - recorded.start_ns) * 1e-9, dtype=np.float64)
        yield rates_picture(names, t_s, reference.rate_rps[:, order], "rates of the axes of the table")
        if recorded.steps:
            yield _steps(recorded, reference)
    elif isinstance(reference, Turns):
        yield paragraph(f"{len(reference.sd_rad)} turns and rests of known angle.")
    else:
        source = next(iter(recorded.recording.sources))
        rows = [part for part in observations(recorded.recording, source) if part.t_ns is not None]
        if rows:
            t_s = np.concatenate([part.t_ns for part in rows if part.t_ns is not None]) * 1e-9
            w_rps = np.vstack([part.w_rps for part in rows])
            yield rates_picture("xyz", t_s - t_s[0], w_rps, "rates of the body")


def _steps(recorded: Recorded, reference: TableReadings) -> Markup:
    rows: list[list[Content]] = []
    for number, step in enumerate(recorded.steps):
        start, end = (at - recorded.start_ns for at in (step.start_ns, step.end_ns))
        row: list[Content] = [f"{number + 1} {step.label}"]
        row += [fixed(start * 1e-9, SECONDS, 2), fixed((end - start) * 1e-9, SECONDS, 2)]
        turn = next((part for part in driven_step(reference, step) if isinstance(part, Rotate)), None)
        if turn is None:
            rows.append([*row, "none", "0", "0"])
        else:
            rows.append([*row, turn.axis, fixed(turn.rate_rps, DEG_PER_S, 2), fixed(turn.turn_rad, DEG, 2)])
    heads = ("step", "begins, s", "lasts, s", "axis", "steady rate, °/s", "turned by, °")
    return table("Steps as they were driven", heads, rows, align="lrrlrr")


def accepted(recorded: Recorded) -> str:
    """Return who accepted the calibration and when, empty if nobody did."""
    who, when = recorded.text("accepted_by"), recorded.text("accepted_utc")
    if recorded.has("accepted_utc"):
        with suppress(ValueError, OverflowError, OSError):  # it may be a text already
            when = f"{datetime.fromtimestamp(float(when), UTC):%Y-%m-%d %H:%M} UTC"
    return " on ".join(filter(None, (who, when)))


def badge(text: str) -> Markup:
    """Return an outcome set apart, in words and not by colour alone."""
    return element("strong", text, class_=f"badge {text.lower().replace(' ', '-')}")
