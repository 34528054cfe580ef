"""What is asked about a device under test."""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from drivers.imus.registry import IMUS, USUAL_IMU
from station.bench.imu import read_imu
from station.bench.table import TWIN
from station.errors import UsageError
from station.init.bench_text import ImuAnswer, imu_text
from station.init.checks import read_section
from station.init.dialogue import Dialogue
from station.init.gyros import GYROS, ask_description, ask_gyros, built_in_channels
from station.init.links import Links

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*\Z")


def ask_imu(
    dialogue: Dialogue, links: Links, folder: Path, protocol: str, link: str, names: Sequence[str]
) -> ImuAnswer:
    """Return a device under test whose name is not among ``names``; ``protocol``, ``link`` are proposed, if given."""

    def checked(made: ImuAnswer) -> None:
        read_section(imu_text(made), lambda top: read_imu(top.tables("imu")[0], folder))

    dialogue.say("\nA device under test. What is it?")
    choices = {name: getattr(spec, "what", str(spec)) for name, spec in IMUS.tried().items()}
    protocol = dialogue.choose("device", choices, protocol or USUAL_IMU)
    spec = IMUS[protocol]
    usual = spec.proposed
    channels = built_in_channels(GYROS[usual.array]) if spec.signals_of_dbc else ()
    noise = {"rate": usual.rate, "arw": usual.arw, "bias_instability": usual.bias_instability}
    geometry = {"array": json.dumps(usual.array)}
    answer = ImuAnswer(_free(usual.name, names), protocol, TWIN, geometry, **noise, channels=channels)
    if spec.described:
        answer = ask_description(dialogue, answer, folder)

    def check_name(text: str) -> None:
        if not _NAME.match(text) or text in names:
            raise UsageError("give a name that no other device has: a letter, then letters, digits, _ and -")
        checked(replace(answer, name=text))

    answer = replace(answer, name=dialogue.ask("its name on the bench", answer.name, check_name))
    answer = replace(answer, link=links.ask(dialogue, spec, answer.name, link))
    if spec.signals_of_dbc and dialogue.asks:
        answer = ask_gyros(dialogue, answer, folder, checked)
    answer = _ask_key(dialogue, answer, "rate", "samples a second", checked)
    answer = _ask_key(dialogue, answer, "arw", "angle random walk, by its data sheet", checked)
    return _ask_key(dialogue, answer, "bias_instability", "bias instability, by its data sheet", checked)


def _free(name: str, names: Sequence[str]) -> str:
    """Return a name, with a number if it is taken."""
    number, free = 1, name
    while free in names:
        number += 1
        free = f"{name}_{number}"
    return free


def _ask_key(
    dialogue: Dialogue, answer: ImuAnswer, key: str, question: str, checked: Callable[[ImuAnswer], object]
) -> ImuAnswer:
    def made(text: str) -> ImuAnswer:
        return replace(answer, **{key: text})  # type: ignore[arg-type]

    return made(dialogue.ask(question, str(getattr(answer, key)), lambda text: checked(made(text))))
