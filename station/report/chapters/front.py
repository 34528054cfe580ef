"""What was calibrated, by whom, when and under what conditions, and what the table did."""

import math
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from datetime import UTC, datetime

import numpy as np

from drivers.types import Floats
from estimator.observations.rows import observations
from estimator.recordings.recording import ImuData
from estimator.recordings.reference import AttitudeReadings, RateReadings, TableReadings, Turns
from station.report.chapters.unseen import driven_step
from station.report.figures import CELSIUS, fixed
from station.report.pictures import Picture, rates_picture
from station.report.recorded import Recorded, Step
from station.report.standing import begun_utc, is_simulated
from station.scripts.script import Rotate
from station.views.seen import seen_by

_LOCAL = re.compile(r"//(?:127\.|localhost|\[::1\])|/dev/pts/|udp_multicast|can:virtual")


def devices_of(recorded: Recorded) -> list[str]:
    """Return the names of the devices under test."""
    return [text.partition(" (")[0] for text in recorded.recording.attributes.get("devices", ())]


def links_of(recorded: Recorded) -> dict[str, str]:
    """Return protocol and link of each device and of the table."""
    devices = (text.partition(" (") for text in recorded.recording.attributes.get("devices", ()))
    links = {name: rest.rstrip(")") for name, _, rest in devices}
    return links | ({"table": recorded.text("table_link")} if recorded.has("table_link") else {})


def serial_words(recorded: Recorded) -> str:
    """Return the serial number of the device under test, with what the device says if that is another."""
    serial, told = recorded.text("device_serial") or "not stated", recorded.text("device_serial_told")
    return f"{serial} (the device says {told}; confirmed: {recorded.text('serial_reason')})" if told else serial


def local_links(links: Mapping[str, str]) -> list[str]:
    """Return the names whose links end on this computer."""
    return [name for name, link in links.items() if _LOCAL.search(link)]


def identities(recorded: Recorded) -> list[tuple[str, str]]:
    """Return what the sources say that they are, sources that say the same together."""
    told: dict[str, list[str]] = {}
    for name, attributes in recorded.source_attributes.items():
        text = _identity(attributes.get(key) for key in ("model", "serial", "firmware"))
        if text:
            told.setdefault(text, []).append(name)
    return [(f"Identity of {', '.join(names)}", text) for text, names in told.items()]


def _identity(values: Iterable[object]) -> str:
    words = ("{}", "serial number {}", "firmware {}")
    return ", ".join(word.format(value) for value, word in zip(values, words, strict=True) if value)


def has_table(recorded: Recorded) -> bool:
    """Return whether a table was the reference."""
    return isinstance(recorded.recording.reference, TableReadings)


def table_words(recorded: Recorded) -> str:
    """Return what the table is, or what was the reference instead."""
    reference = recorded.recording.reference
    if isinstance(reference, TableReadings):
        told = _identity(recorded.text(f"table_{key}") for key in ("model", "serial", "firmware"))
        axes = f"axes {', '.join(reference.gimbals)} (outermost first)"
        return f"{told or 'not identified'}; {axes}"
    kinds = {RateReadings: "body rates", AttitudeReadings: "attitudes", Turns: "turns of known angle"}
    return f"none: the reference are {kinds[type(reference)]} that were measured elsewhere"


def date_words(recorded: Recorded) -> str:
    """Return when the measurement began."""
    begun = begun_utc(recorded)
    if begun:
        return f"{begun:%Y-%m-%d %H:%M:%S} UTC"
    return "none: the run was in simulated time" if is_simulated(recorded) else "not stated"


def rate_hz(data: ImuData) -> float:
    """Return the mean sampling rate, NaN if it is not known."""
    span_s = float(data.t_ns[-1] - data.t_ns[0]) * 1e-9 if len(data.t_ns) > 1 else math.nan
    return (len(data.t_ns) - 1) / span_s if span_s > 0 else math.nan


def temperatures(data: ImuData) -> list[str | None]:
    """Return the lowest, the mean and the highest temperature of a source."""
    span_c = seen_by([data]).temperature_c
    return ["not recorded", None, None] if math.isnan(span_c[1]) else [fixed(t, CELSIUS, 2) for t in span_c]


def turns(recorded: Recorded) -> int:
    """Return the number of turns of known angle, if these were the reference."""
    reference = recorded.recording.reference
    return len(reference.sd_rad) if isinstance(reference, Turns) else 0


def motion_picture(recorded: Recorded) -> Picture | None:
    """Return the rates of the axes, or of the body where there was no table."""
    reference = recorded.recording.reference
    if isinstance(reference, TableReadings):
        order = sorted(range(len(reference.gimbals)), key=lambda column: reference.gimbals[column])
        names = [reference.gimbals[column] for column in order]
        t_s: Floats = np.asarray((reference.t_ns - recorded.start_ns) * 1e-9, dtype=np.float64)
        return rates_picture(names, t_s, reference.rate_rps[:, order], "rates of the axes of the table")
    data = next(iter(recorded.recording.sources.values()))
    rows = [part for part in observations(recorded.recording, data) if part.t_ns is not None]
    if isinstance(reference, Turns) or not rows:
        return None
    t_s = np.concatenate([part.t_ns for part in rows if part.t_ns is not None]) * 1e-9
    return rates_picture("xyz", t_s - t_s[0], np.vstack([part.w_rps for part in rows]), "rates of the body")


def driven_steps(recorded: Recorded) -> list[tuple[Step, Rotate | None]]:
    """Return the steps as they were driven on a table, each with its turn if it had one."""
    table = recorded.recording.reference
    if not isinstance(table, TableReadings):
        return []
    turned = ([part for part in driven_step(table, step) if isinstance(part, Rotate)] for step in recorded.steps)
    return [(step, next(iter(turns), None)) for step, turns in zip(recorded.steps, turned, strict=True)]


def accepted(recorded: Recorded) -> str:
    """Return who accepted the calibration and when, empty if nobody did."""
    who, when = recorded.text("accepted_by"), recorded.text("accepted_utc")
    if recorded.has("accepted_utc"):
        with suppress(ValueError, OverflowError, OSError):  # it may be a text already
            when = f"{datetime.fromtimestamp(float(when), UTC):%Y-%m-%d %H:%M} UTC"
    return " on ".join(filter(None, (who, when)))
