"""Questions about a device under test."""

import re
from collections.abc import Sequence
from pathlib import Path

from drivers.imus.registry import IMUS, USUAL_IMU
from station.bench.imu import read_imu
from station.bench.table import TWIN
from station.errors import UsageError
from station.init.asking import Data, ask_key, read_data
from station.init.dialogue import Dialogue
from station.init.gyros import GYROS, ask_description, ask_gyros, built_in_channels
from station.init.links import Links
from station.schema.tables import keys_of

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*\Z")
_KEYS = {key.name: key for section in ("bench.prior", "bench.imu", "bench.noise") for key in keys_of(section)}


def ask_imu(dialogue: Dialogue, links: Links, folder: Path, protocol: str, link: str, names: Sequence[str]) -> Data:
    """Return a device under test; asked are its protocol, name, link, gyros, rate and noise.

    Its name is not in ``names``. ``protocol`` and ``link`` are proposed if not empty; paths count from ``folder``.
    Gyros are asked for only if their signals come from a DBC or a description; else the array is the usual one of the
    protocol. UsageError if nobody is asked and a proposal is wrong.
    """

    def checked(made: Data) -> None:
        read_data({"imu": [made]}, lambda top: read_imu(top.tables("imu")[0], folder))

    dialogue.say("\nA device under test. What is it?")
    choices = {name: getattr(spec, "said", str(spec)) for name, spec in IMUS.tried().items()}
    protocol = dialogue.choose("device", choices, protocol or USUAL_IMU)
    spec = IMUS[protocol]
    usual = spec.proposed
    imu: Data = {"name": _free(usual.name, names), "protocol": protocol, "link": TWIN, "array": usual.array}
    imu["rate"] = usual.rate
    if spec.signals_of_dbc:
        imu["channels"] = built_in_channels(GYROS[usual.array])
    prior = {key.name: key.default for key in keys_of("bench.prior")}
    imu["datasheet"] = {"arw": usual.arw, "bias_instability": usual.bias_instability, **prior}
    if spec.described:
        imu = ask_description(dialogue, imu, folder)

    def check_name(made: Data) -> None:
        if not _NAME.match(made["name"]) or made["name"] in names:
            raise UsageError("give a name that is not in use: a letter, then letters, digits, _ and -")
        checked(made)

    imu = ask_key(dialogue, imu, _KEYS["name"], checked=check_name)
    imu["link"] = links.ask(dialogue, spec, imu["name"], link)
    if spec.signals_of_dbc and dialogue.asks:
        imu = ask_gyros(dialogue, imu, folder, checked)
    imu = ask_key(dialogue, imu, _KEYS["rate"], checked=checked)
    for name, meaning in (("arw", "angle random walk"), ("bias_instability", "bias instability")):
        imu["datasheet"] = ask_key(dialogue, imu["datasheet"], _KEYS[name], f"{meaning} of the data sheet")
    return imu


def _free(name: str, names: Sequence[str]) -> str:
    """Return a name, with the first number from 2 on that is free if it is in ``names``."""
    number, free = 1, name
    while free in names:
        number += 1
        free = f"{name}_{number}"
    return free
