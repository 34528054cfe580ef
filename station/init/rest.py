"""What is asked about the lab: where it is, what counts as a pass, what names look like."""

import math
import re
from collections.abc import Sequence
from dataclasses import replace

from drivers.packaged import packaged_toml
from station.bench.table import TWIN
from station.errors import UsageError
from station.init.bench_text import BenchAnswer, ImuAnswer
from station.init.checks import quantity_of
from station.init.dialogue import Dialogue
from station.schema.quantities import parse

_KNOWN = packaged_toml("station.init", "devices.toml")
_ALWAYS = {"nis_low": "0.8", "nis_high": "1.2", "lost": "1 %"}


def ask_rest(dialogue: Dialogue, bench: BenchAnswer) -> BenchAnswer:
    """Return the bench with its site, its limits and its patterns."""
    dialogue.say("\nThe lab. With its latitude, Earth rate (15 deg/h) is taken off; - leaves it in the bias.")
    latitude = dialogue.ask("latitude, south negative", "45 deg" if bench.table.link == TWIN else "", _check_latitude)
    heading = bench.heading
    if latitude:
        question = "heading of the table's x axis when all axes are home, clockwise from north"
        heading = dialogue.ask(question, heading, quantity_of("angle"))
    dialogue.say("\nWhat counts as a pass; - for what is not to be checked.")
    factor = _noise_factor(bench.imus)
    limits = {}
    for key, (kind, question, size, *unit) in _KNOWN["limits"].items():
        proposed = f"{size * factor} {unit[0]}" if unit else size
        limits[key] = dialogue.ask(question, proposed, quantity_of(kind, optional=True))
    dialogue.say("\nFor the record: a regular expression that names must match; - for anything.")
    operator = dialogue.ask("names of operators", "", _check_pattern)
    serial = dialogue.ask("serial numbers of devices", "", _check_pattern)
    kept = {key: limit for key, limit in limits.items() if limit} | _ALWAYS
    return replace(
        bench, latitude=latitude, heading=heading, limits=kept, operator_pattern=operator, serial_pattern=serial
    )


def _noise_factor(imus: Sequence[ImuAnswer]) -> int:
    """Return by how much the noisiest gyros are noisier than those that the limits are for; 1 at the least."""
    own = ({"angle random walk": imu.arw, "rate": imu.bias_instability} for imu in imus)
    usual = {kind: parse(text, kind) for kind, text in _KNOWN["noise"].items()}
    return max(1, math.ceil(max(parse(noise[kind], kind) / usual[kind] for noise in own for kind in usual)))


def _check_latitude(text: str) -> None:
    if text and abs(_angle(text)) > math.pi / 2:
        raise UsageError("beyond the poles: give -90 deg to 90 deg")


def _angle(text: str) -> float:
    quantity_of("angle")(text)
    return parse(text, "angle")


def _check_pattern(text: str) -> None:
    try:
        re.compile(text)
    except re.error as error:
        raise UsageError(f"not a regular expression: {error}") from None
