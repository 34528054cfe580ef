"""Questions about the lab: its site, its limits for a pass, its patterns for names."""

import math
from collections.abc import Sequence
from dataclasses import replace

from drivers.imus.registry import IMUS
from drivers.packaged import packaged_toml
from station.bench.table import TWIN
from station.init.asking import Data, ask_key
from station.init.dialogue import Dialogue
from station.schema.quantities import parse
from station.schema.tables import keys_of

_KNOWN = packaged_toml("station.init", "devices.toml")


def ask_rest(dialogue: Dialogue, bench: Data, other_sections: Sequence[str] = ()) -> Data:
    """Return the complete bench: site, limits, place and twins in addition to name and devices in ``bench``.

    If all devices under test are twins, it also states that no effects are undeclared. ``other_sections`` are the
    sections of devices of other kinds in it. Answers that are left empty are left out; without a latitude there is no
    heading either. The limits proposed are wider for noisier gyros.
    """
    dialogue.say("\nThe lab. Its latitude is needed to remove Earth rate (15 deg/h); - leaves it in the bias.")
    latitude, heading = (key for key in keys_of("bench.site") if key.name in ("latitude", "heading"))
    latitude = replace(latitude, required=False)
    proposed = "45 deg" if bench["table"]["link"] == TWIN else ""
    site = ask_key(dialogue, {}, latitude, "latitude, south negative", proposed)
    if site:
        question = "heading of the table's x axis when all axes are home, clockwise from north"
        site = ask_key(dialogue, site, heading, question, heading.default)
    dialogue.say("\nThe limits for a pass; - for a limit that is not checked.")
    limits: Data = {}
    for key in keys_of("bench.limits"):
        if key.name in _KNOWN["limits"]:
            size, *unit = _KNOWN["limits"][key.name]
            proposed = f"{size * _noise_factor(bench['imu'])} {unit[0]}" if unit else size
            limits = ask_key(dialogue, limits, key, proposed=proposed)
    dialogue.say("\nFor the record: a regular expression that names must match; - for any name.")
    _, operator, serial, *_ = keys_of("bench.station")
    place = ask_key(dialogue, {}, operator, "names of operators")
    place = ask_key(dialogue, place, serial, "serial numbers of devices")
    stated = {"station": place, "site": site, "table": bench["table"], "imu": bench["imu"]}
    stated |= {section: bench[section] for section in other_sections}
    simulated = all(imu["link"] == TWIN for imu in bench["imu"])
    return {
        "name": bench["name"],
        **{key: value for key, value in stated.items() if value},
        "limits": limits | _KNOWN["always"],
        "undeclared": {"effects": "none"} if simulated else {},
        "twin": _twin(bench),
    }


def _twin(bench: Data) -> Data:
    """Return the twin settings of all devices, since any of them may be served by `station twin`."""
    wires = {imu["name"]: "udp_multicast" if IMUS[imu["protocol"]].on_can else "serial" for imu in bench["imu"]}
    truths = {imu["name"]: _KNOWN["truth"] | _stated(imu, "bias_instability") for imu in bench["imu"]}
    return {"start": ["2 deg"] * len(bench["table"]["gimbals"]), "wires": {"table": "tcp", **wires}, **truths}


def _stated(imu: Data, *names: str) -> Data:
    """Return the values that the data sheet states for these keys."""
    return {name: imu["datasheet"][name] for name in names if name in imu["datasheet"]}


def _noise_factor(imus: Sequence[Data]) -> int:
    """Return by how much the noisiest gyros are noisier than those that the limits are for; 1 at the least."""
    kinds = {key.name: key.kind for key in keys_of("bench.noise")}
    usual = {name: parse(text, kinds[name]) for name, text in _KNOWN["noise"].items()}
    stated = [item for imu in imus for item in _stated(imu, *usual).items()]
    return max(1, math.ceil(max(parse(text, kinds[name]) / usual[name] for name, text in stated)))
