"""A bench file from answers: TOML with comments."""

from collections.abc import Iterable, Iterator

from drivers.imus.kind import SPEC as IMU
from drivers.kind import DeviceKind
from drivers.specs import Key
from drivers.tables.kind import SPEC as TABLE
from station.bench.table import TWIN
from station.init.asking import Data
from station.schema.writing import lines_of

_HEAD = """\
# A bench: the table, the gyros on it, and what counts as a pass. Every number has its unit.
# docs/pages/reference/bench.md explains the keys; `station check FILE` checks that everything answers.

"""


def bench_text(bench: Data, other_kinds: Iterable[DeviceKind] = ()) -> str:
    """Return the complete bench file with comments: what keys mean, the protocols there are, and links to hardware.

    ``other_kinds`` are the kinds of its devices besides table and IMU.
    """
    docs: dict[str, str] = {}
    for kind in (TABLE, IMU, *other_kinds):
        for path, device in _devices(bench, kind):
            spec = kind.protocols[device["protocol"]]
            docs |= {f"{path}{key.name}": key.doc for key in (*spec.keys, *kind.keys)}
            docs[f"{path}protocol"] = ", ".join(kind.protocols)
            docs[f"{path}link"] = f"the twin; hardware: {spec.link}" if device["link"] == TWIN else ""
    sections = [
        Key(kind.name, "table" if kind.single else "tables", kind.what, of=["bench.device"]) for kind in other_kinds
    ]
    return _HEAD + "\n".join(lines_of(bench, ["bench.bench"], docs, more=sections)) + "\n"


def _devices(bench: Data, kind: DeviceKind) -> Iterator[tuple[str, Data]]:
    """Yield the devices of a kind, each after the beginning of its keys' names; none if there are none.

    That is "imu.imu_a.", or "table." for a kind of which there is only one.
    """
    section = bench.get(kind.name, [])
    if kind.single and section:
        yield f"{kind.name}.", section
    elif not kind.single:
        yield from ((f"{kind.name}.{device['name']}.", device) for device in section)
