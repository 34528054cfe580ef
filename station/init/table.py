"""What is asked about the table."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from drivers.specs import Key, TableSpec
from drivers.tables.registry import TABLES, USUAL_TABLE
from station.bench.table import TWIN, read_table
from station.errors import UsageError
from station.init.bench_text import AxisAnswer, TableAnswer, table_text
from station.init.checks import read_section, whole_number
from station.init.dialogue import Dialogue
from station.init.links import Links, check_link

_NUMBERS = ("address", "counts_per_turn")
_MOST = 2**40


def ask_table(dialogue: Dialogue, links: Links, folder: Path, protocol: str, link: str) -> TableAnswer:
    """Return the table; ``protocol`` and ``link`` are proposed, if given. Paths count from ``folder``."""

    def checked(made: TableAnswer) -> None:
        read_section(table_text(made), lambda top: read_table(top.table("table"), folder))

    dialogue.say("\nThe table. Which controller turns it?")
    choices = {name: getattr(spec, "what", str(spec)) for name, spec in TABLES.tried().items()}
    protocol = dialogue.choose("controller", choices, protocol or USUAL_TABLE)
    spec = TABLES[protocol]
    link = links.ask(dialogue, spec, "table", link)
    options = {key.name: str(key.default) for key in spec.keys if key.asked}
    answer = TableAnswer(protocol, link, options, _axes(spec, "zyx"[: spec.most_axes]))
    for key in spec.keys:
        if key.asked:
            answer = _ask_key(dialogue, answer, key, checked)
    gimbals = dialogue.ask(
        "axes, outermost first",
        " ".join(answer.axes),
        lambda text: checked(replace(answer, axes=_axes(spec, _names(text)))),
    )
    answer = replace(answer, axes=_axes(spec, _names(gimbals)))
    axes: dict[str, AxisAnswer] = {}
    for name, proposed in answer.axes.items():
        asked = replace(answer, axes=axes)
        axes = {**axes, name: _ask_axis(dialogue, asked, name, _proposed(asked, proposed), checked)}
    return replace(answer, axes=axes)


def _ask_key(
    dialogue: Dialogue, answer: TableAnswer, key: Key, checked: Callable[[TableAnswer], object]
) -> TableAnswer:
    def made(text: str) -> TableAnswer:
        return replace(answer, options={**answer.options, key.name: text})

    return made(dialogue.ask(key.doc, answer.options[key.name], lambda text: checked(made(text))))


def _names(text: str) -> list[str]:
    names = re.split(r"[\s,]+", text.strip())
    if len(set(names)) < len(names):
        raise UsageError("an axis is named twice")
    return names


def _proposed(asked: TableAnswer, usual: AxisAnswer) -> AxisAnswer:
    """Return what is proposed for the next axis: what was said of the one before, and an address that is free."""
    taken = [axis.address for axis in asked.axes.values()]
    free = [address for address in TABLES[asked.protocol].addresses if address not in taken]
    address = free[0] if usual.address in taken and free else usual.address
    before = next(reversed(list(asked.axes.values())), usual)
    return replace(before, address=address, link="")


def _axes(spec: TableSpec, names: Sequence[str]) -> dict[str, AxisAnswer]:
    """Return axes as they are proposed; their addresses go by their names, that of x first."""
    counts, addresses = str(spec.proposed_counts or ""), spec.addresses
    order = sorted(names)
    return {
        name: AxisAnswer(addresses[min(order.index(name), len(addresses) - 1)], counts, "100 deg/s", "50 deg/s2")
        for name in names
    }


def _ask_axis(
    dialogue: Dialogue, table: TableAnswer, name: str, axis: AxisAnswer, checked: Callable[[TableAnswer], object]
) -> AxisAnswer:
    """Return one axis, beside those that the table has already; ``axis`` is what is proposed."""

    spec = TABLES[table.protocol]

    def ask(key: str, question: str) -> AxisAnswer:
        def check(text: str) -> None:
            if key in _NUMBERS and not (key == "address" and spec.address and spec.address.kind == "text"):
                whole_number(1, _MOST)(text)
            checked(replace(table, axes={**table.axes, name: replace(axis, **{key: text})}))  # type: ignore[arg-type]

        return replace(axis, **{key: dialogue.ask(question, str(getattr(axis, key)), check)})  # type: ignore[arg-type]

    def check_travel(text: str) -> None:
        checked(replace(table, axes={**table.axes, name: replace(axis, travel=_travel(text))}))

    def check_own_link(text: str) -> None:
        if text:
            check_link(spec, text, f"axis {name}")

    dialogue.say(f"\nAxis {name}.")
    if table.options.get("profile") == "lexium32" and table.link != TWIN:  # each is at an address
        question = "link of this drive, if it has one of its own; - if not"
        axis = replace(axis, link=dialogue.ask(question, "", check_own_link))
    if spec.address is not None:
        axis = ask("address", f"its address at the controller ({spec.address.doc})")
    if axis.counts_per_turn:
        axis = ask("counts_per_turn", "encoder counts a turn (counts per degree x 360)")
    axis = ask("max_rate", "highest rate")
    axis = ask("max_acceleration", "highest acceleration")
    question = "how far it may turn from home, for instance -90 deg, 90 deg; - if it turns without end"
    axis = replace(axis, travel=_travel(dialogue.ask(question, ", ".join(axis.travel), check_travel)))
    return axis


def _travel(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(",")) if text else ()
