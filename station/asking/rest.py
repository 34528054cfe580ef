"""What is asked about the lab: where it is, what counts as a pass, what names look like."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

from station.asking.bench_text import BenchAnswer, ImuAnswer
from station.asking.checks import quantity_of
from station.asking.dialogue import Dialogue
from station.bench_table import TWIN
from station.errors import UsageError
from station.quantities import parse

_NOISE = ("0.005 deg/s/rtHz", "2 deg/h")  # angle random walk and bias instability that the limits below are for
_SIZES: Mapping[str, tuple[str, str, str]] = {
    "scale_factor_error": ("ratio", "scale factor error up to", "10000 ppm"),
    "bias": ("rate", "bias up to", "0.5 deg/s"),
    "misalignment": ("angle", "misalignment up to", "0.5 deg"),
}
_SIGMAS: Mapping[str, tuple[str, str, int, str]] = {
    "sd_scale_factor_error": ("ratio", "scale factor error known to, one sigma", 100, "ppm"),
    "sd_bias": ("rate", "bias known to, one sigma", 5, "deg/h"),
    "sd_misalignment": ("angle", "misalignments known to, one sigma", 100, "urad"),
}
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
    limits = {
        key: dialogue.ask(question, proposed, quantity_of(kind, optional=True))
        for key, (kind, question, proposed) in _SIZES.items()
    }
    for key, (kind, question, size, unit) in _SIGMAS.items():
        limits[key] = dialogue.ask(question, f"{size * factor} {unit}", quantity_of(kind, optional=True))
    dialogue.say("\nFor the record: a regular expression that names must match; - for anything.")
    operator = dialogue.ask("names of operators", "", _check_pattern)
    serial = dialogue.ask("serial numbers of devices", "", _check_pattern)
    kept = {key: limit for key, limit in limits.items() if limit} | _ALWAYS
    return replace(
        bench, latitude=latitude, heading=heading, limits=kept, operator_pattern=operator, serial_pattern=serial
    )


def _noise_factor(imus: Sequence[ImuAnswer]) -> int:
    """Return by how much the noisiest gyros are noisier than those that the limits are for; 1 at the least."""
    kinds = ("angle random walk", "rate")
    usual = [parse(text, kind) for text, kind in zip(_NOISE, kinds, strict=True)]
    worst = max(
        max(parse(imu.arw, kinds[0]) / usual[0], parse(imu.bias_instability, kinds[1]) / usual[1]) for imu in imus
    )
    return max(1, math.ceil(worst))


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
