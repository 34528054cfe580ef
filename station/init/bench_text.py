"""A bench file made of answers: TOML with comments."""

from collections.abc import Mapping

from drivers.imus.registry import IMUS
from drivers.specs import ImuSpec, TableSpec
from drivers.tables.registry import TABLES
from station.bench.table import TWIN
from station.init.asking import Data
from station.schema.writing import lines_of

_HEAD = """\
# A bench: the table, the gyros on it, and what counts as a pass. Every number has its unit.
# docs/pages/reference/bench.md explains the keys; `station check FILE` checks that everything answers.

"""


def bench_text(bench: Data) -> str:
    """Return the whole file."""
    docs: dict[str, str] = {}
    for path, device in (("table.", bench["table"]), *((f"imu.{imu['name']}.", imu) for imu in bench["imu"])):
        known: Mapping[str, ImuSpec | TableSpec] = TABLES if path == "table." else IMUS
        spec = known[device["protocol"]]
        docs |= {f"{path}{key.name}": key.doc for key in spec.keys}
        docs[f"{path}protocol"] = ", ".join(known)
        docs[f"{path}link"] = f"the twin; hardware: {spec.link}" if device["link"] == TWIN else ""
    return _HEAD + "\n".join(lines_of(bench, ["bench.bench"], docs)) + "\n"
