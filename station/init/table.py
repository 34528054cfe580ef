"""Questions about the table."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from drivers.specs import Key, TableSpec
from drivers.tables.registry import TABLES, USUAL_TABLE
from station.bench.table import TWIN, read_table
from station.init.asking import Data, ask_key, read_data
from station.init.dialogue import Dialogue
from station.init.links import Links, check_link
from station.schema.tables import keys_of

_KEYS = {key.name: key for section in ("table", "encoder", "axis", "own_link") for key in keys_of(f"bench.{section}")}


def ask_table(dialogue: Dialogue, links: Links, folder: Path, protocol: str, link: str) -> Data:
    """Ask for the table, and return it: its protocol, link, options, "gimbals", and each of its axes by its name.

    Axes are outermost first. ``protocol`` and ``link`` are proposed if not empty. Paths count from ``folder``. Answers
    that make the table invalid are asked for again; UsageError if nobody is asked.
    """

    def checked(made: Data) -> None:
        read_data({"table": made}, lambda top: read_table(top.table("table"), folder))

    dialogue.say("\nThe table. Which controller turns it?")
    choices = {name: getattr(spec, "said", str(spec)) for name, spec in TABLES.tried().items()}
    protocol = dialogue.choose("controller", choices, protocol or USUAL_TABLE)
    spec = TABLES[protocol]
    table: Data = {"protocol": protocol, "link": links.ask(dialogue, spec, "table", link)}
    axes = _axes(spec, "zyx"[: spec.most_axes])
    for key in spec.keys:
        if key.asked:
            table[key.name] = key.default
            table = ask_key(dialogue, table, key, checked=lambda made: checked({**made, "gimbals": [*axes], **axes}))
    key, proposed = replace(_KEYS["gimbals"], default=None, required=True), " ".join(axes)
    table = ask_key(
        dialogue,
        table,
        key,
        "axes, outermost first",
        proposed,
        lambda made: checked({**made, **_axes(spec, made["gimbals"])}),
    )
    before: Data = {}
    for name, usual in _axes(spec, table["gimbals"]).items():
        asked = {**table, "gimbals": [axis for axis in table["gimbals"] if axis in table] + [name]}
        before = _ask_axis(dialogue, spec, asked, name, _proposed(spec, asked, usual, before), checked)
        table[name] = before
    return table


def _axes(spec: TableSpec, names: Sequence[str]) -> dict[str, Data]:
    """Return the proposed axes by name, with usual limits; addresses are assigned in the order of the names, x first.

    Axes beyond the protocol's addresses get the last one; without addresses all axes are the same object, which must
    not be changed. Counts per turn are there if the protocol proposes any; there is no travel.
    """
    order, last = sorted(names), len(spec.addresses) - 1
    usual: Data = {"counts_per_turn": spec.proposed_counts} if spec.proposed_counts else {}
    usual |= {"max_rate": "100 deg/s", "max_acceleration": "50 deg/s2"}
    if spec.address is None:
        return dict.fromkeys(names, usual)
    return {name: {spec.address.name: spec.addresses[min(order.index(name), last)], **usual} for name in names}


def _proposed(spec: TableSpec, asked: Data, usual: Data, before: Data) -> Data:
    """Return the proposal for the next axis of the table ``asked``: the answers for the one ``before``, or ``usual``.

    ``before`` is empty for the first axis. The address is the usual one, or the first free one if that is taken and any
    is free; a link of its own is not proposed again.
    """
    kept = {key: value for key, value in before.items() if key != "link"} or usual
    if spec.address is None:
        return kept
    name = spec.address.name
    taken = [axis[name] for axis in asked.values() if isinstance(axis, dict)]
    free = [address for address in spec.addresses if address not in taken]
    return {**kept, name: free[0] if usual[name] in taken and free else usual[name]}


def _ask_axis(
    dialogue: Dialogue, spec: TableSpec, table: Data, name: str, axis: Data, checked: Callable[[Data], object]
) -> Data:
    """Return the axis ``name``, given the ``table`` so far; ``axis`` is the proposal. Neither is changed.

    Asked are a link of its own where the protocol has one and the table's is TCP, the address where the protocol has
    one, counts if they are proposed, limits and travel. ``checked`` gets the whole table and raises UsageError if it is
    invalid; the question is then repeated.
    """

    def ask(key: Key, question: str = "") -> Data:
        return ask_key(dialogue, axis, key, question, checked=lambda made: checked({**table, name: made}))

    dialogue.say(f"\nAxis {name}.")
    if spec.opens_links and table["link"].startswith("tcp:"):
        axis = ask_key(
            dialogue,
            axis,
            _KEYS["link"],
            "link of this drive, if it has its own; - if not",
            "",
            lambda made: check_link(spec, made.get("link", TWIN), f"axis {name}"),
        )
    if spec.address is not None:
        axis = ask(spec.address, f"its address at the controller ({spec.address.doc})")
    if "counts_per_turn" in axis:
        axis = ask(_KEYS["counts_per_turn"])
    axis = ask(_KEYS["max_rate"])
    axis = ask(_KEYS["max_acceleration"])
    return ask(_KEYS["travel"], "range from home, for instance -90 deg, 90 deg; - if its rotation is unlimited")
