"""The calibrated device, by whom, when, under which conditions, and the table's motion."""

import math
from collections.abc import Mapping

import numpy as np

from drivers.types import Floats
from estimator.observations.rows import observations
from estimator.recordings.recording import ImuData
from estimator.recordings.reference import AttitudeReadings, RateReadings, Turns
from station.opening.links import ends_here
from station.report.chapters.unobserved_effects import driven_step
from station.report.pictures import Picture, rates_picture
from station.report.recorded import Recorded, Step
from station.scripts.steps.rotate import Rotate

ELSEWHERE = {RateReadings: "body rates", AttitudeReadings: "attitudes", Turns: "turns of known angle"}
"""What was measured where there was no table."""


def links_of(recorded: Recorded) -> dict[str, str]:
    """Return protocol and link of each device and of the table."""
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
    """Return a picture of the rates of the table axes, or of the body if there was no table; None if they are not
    known.
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
    """Return the steps as they were driven on a table, each with its turn if it had one."""
    table = recorded.recording.table
    if table is None:
        return []
    return [(step, driven_step(table, step).turn) for step in recorded.steps]
