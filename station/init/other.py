"""Questions about a device of a kind other than table and IMU."""

from collections.abc import Sequence
from pathlib import Path

from drivers.imus.kind import SPEC as IMU
from drivers.kind import DeviceKind
from drivers.kinds import KINDS
from drivers.specs import DeviceSpec
from drivers.tables.kind import SPEC as TABLE
from station.bench.device import read_device
from station.init.asking import Data, ask_key, read_data
from station.init.dialogue import Dialogue
from station.init.links import Links


def other_kinds() -> list[DeviceKind]:
    """Return the device kinds of installed packages; unusable ones are left out."""
    found = [kind for kind in KINDS.tried().values() if isinstance(kind, DeviceKind)]
    return [kind for kind in found if kind.name not in (TABLE.name, IMU.name)]


def ask_others(dialogue: Dialogue, links: Links, folder: Path, kind: DeviceKind, names: Sequence[str]) -> list[Data]:
    """Ask for the devices of a kind on this bench until there are no more; return them, none if nobody is asked.

    At most one if the kind is ``single``; their names are not in ``names``. Paths count from ``folder``. UsageError if
    one is invalid as a whole.
    """
    made: list[Data] = []
    while not (kind.single and made) and dialogue.agrees(f"\nIs {kind.what} on this bench?", False):
        taken = [*names, *(device["name"] for device in made)]
        made.append(_ask_other(dialogue, links, folder, kind, taken))
    return made


def _ask_other(dialogue: Dialogue, links: Links, folder: Path, kind: DeviceKind, names: Sequence[str]) -> Data:
    """Return one device with a name that is not in ``names``: protocol, link, then its required keys and those to ask
    for.

    The name is that of the kind, with a number if that is taken. Paths count from ``folder``. UsageError if the device
    is invalid as a whole.
    """
    known = {name: spec for name, spec in kind.protocols.tried().items() if isinstance(spec, DeviceSpec)}
    protocol = dialogue.choose("protocol", {name: spec.said for name, spec in known.items()}, next(iter(known), ""))
    spec = known[protocol]
    number = 1
    name = kind.name
    while name in names:
        number += 1
        name = f"{kind.name}_{number}"
    device: Data = {"name": name, "protocol": protocol, "link": links.ask(dialogue, spec, name)}
    for key in (*kind.keys, *spec.keys):
        if key.required or key.asked:
            usual = key.default if key.example is None else key.example
            device = ask_key(dialogue, device, key, proposed="" if usual is None else str(usual))
    read_data(device, lambda table: read_device(table, folder, kind, kind.protocols))
    return device
