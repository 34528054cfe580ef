"""Writes what the reference pages take from the code: ``python docs/generate.py``; ``--check`` only names stale pages.

A page holds ``<!-- generated: NAME -->`` and ``<!-- end -->``; what stands between them is made by the function of that
name. Pictures of the screen are the pictures that the tests compare with, without the fonts that they would fetch.
"""

import argparse
import contextlib
import importlib
import io
import json
import math
import re
import sys
import tomllib
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGES = ROOT / "docs/pages"
COMMAND = "python docs/generate.py"
_SHOTS = ROOT / "tests/station/screen/__snapshots__/test_pictures"
_PICTURES = {"run.svg": "test_a_run[80x24].svg", "run-wide.svg": "test_a_run[150x44].svg"}
_BLOCK = re.compile(r"(?<=<!-- generated: )([a-z_]+)( -->\n).*?(?=<!-- end -->)", re.DOTALL)


@cache
def packaged(name: str) -> dict[str, Any]:
    """Return the one TOML file of a name in the packages."""
    (path,) = (p for package in ("station", "drivers") for p in (ROOT / package).rglob(name))
    return tomllib.loads(path.read_text(encoding="utf-8"))


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; cells must not hold a bar."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines)


def commands() -> str:
    """Every command with what may be typed."""
    from station.cli import make_parser

    parser = make_parser()
    groups = packaged("commands.toml")["groups"]
    parts = [
        table(
            ("for", "commands"),
            ((title, ", ".join(f"[{n}](#station-{n})" for n in names)) for title, names in groups.items()),
        )
    ]
    found = _subcommands(parser)
    parts += [_command(f"station {name}", found[name], 2) for names in groups.values() for name in names]
    return "\n".join(parts)


def _subcommands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


def _command(name: str, parser: argparse.ArgumentParser, level: int) -> str:
    parts = [f"{'#' * level} {name}\n", f"{parser.description}\n"]
    rows: list[tuple[str, str]] = []
    for group in parser._action_groups:
        if group.description:
            parts.append(_options(rows))
            parts.append(f"{group.description}\n")
            rows = []
        rows += [
            (
                _typed(action),
                (action.help or "") % {**vars(action), "choices": ", ".join(map(str, action.choices or ()))},
            )
            for action in group._group_actions
            if not isinstance(action, argparse._HelpAction | argparse._SubParsersAction)
        ]
    parts.append(_options(rows))
    parts += [_command(f"{name} {sub}", below, level + 1) for sub, below in _subcommands(parser).items()]
    return "\n".join(parts)


def _options(rows: list[tuple[str, str]]) -> str:
    return table(("argument", "meaning"), rows) if rows else ""


def _typed(action: argparse.Action) -> str:
    value = action.metavar or (action.dest.upper() if action.nargs != 0 else "")
    value = f" {value}" if action.nargs != 0 and value else ""
    if not action.option_strings:
        return f"`{value.strip()}`" + (" ..." if action.nargs == "+" else "")
    return f"`{', '.join(action.option_strings)}{value}`" + (" ..." if action.nargs == "+" else "")


def effects() -> str:
    """The catalogue of effects."""
    from station.cli import main

    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        main(["effects", "--json"])
    return table(
        ("effect", "parameters, up to", "shown by", "looks like", "needs"),
        (
            (
                f"`{e['effect']}`" + (" (all gyros share it)" if e["shared"] else ""),
                "; ".join(_parameters(e)),
                e["shown_by"],
                ", ".join(f"`{other}`" for other in e["confused_with"]),
                ", ".join(e["needs"]),
            )
            for e in json.loads(said.getvalue())
        ),
    )


def _parameters(effect: dict[str, Any]) -> list[str]:
    units = packaged("units.toml")["effects"]
    sizes = []
    for parameter in effect["parameters"]:
        unit, factor, power = units.get(parameter["unit"], (parameter["unit"], 1, 0))
        size = f"{parameter['largest'] * factor * math.degrees(1) ** power:.4g} {unit}"
        sizes.append(
            (parameter["name"], "all of it" if parameter["unit"] == "1" and parameter["largest"] == 1 else size)
        )
    if len(sizes) > 2 and len({size for _, size in sizes}) == 1:
        lines = [f"{len(sizes)} of {sizes[0][1]} each"]
    else:
        lines = [f"{name} {size}" for name, size in sizes]
    free = ", ".join(one["name"] for one in effect["non_linear"])
    return [*lines, f"found in the data: {free}"] if free else lines


def _keys(section: str) -> str:
    bounds = {"above_zero": "above zero", "not_negative": "zero or more"}
    kinds = {0.05: "5 %", 0.02: "20 mrad", math.inf: "not checked", 1.0: "not checked"}
    return table(
        ("key", "measures", "if left out", "must be"),
        (
            (
                f"`{key}`",
                f"[{says['kind']}](units.md)",
                "must be given" if "default" not in says else str(kinds.get(says["default"], says["default"])),
                bounds.get(says.get("bound", ""), ""),
            )
            for key, says in packaged("keys.toml")[section].items()
        ),
    )


def limit_keys() -> str:
    """Quantities of [limits]."""
    return _keys("limits")


def prior_keys() -> str:
    """Quantities of [imu.datasheet] that are the prior."""
    return _keys("prior")


def noise_keys() -> str:
    """Quantities of [imu.datasheet] that are noise."""
    return _keys("noise")


def axis_keys() -> str:
    """Quantities of an axis."""
    return _keys("axis")


def uncertainty_keys() -> str:
    """Quantities of [table.uncertainty]."""
    return _keys("uncertainty")


def units() -> str:
    """Units by what they measure."""
    (path,) = (ROOT / "station").rglob("quantities.py")
    module = importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
    rows = ((kind, ", ".join(f"`{unit}`" for unit in known)) for kind, known in module.UNITS.items())
    return table(("measures", "units"), rows)


def _built_in(kind: str) -> list[Any]:
    """Records of the devices of the station itself."""
    registry = importlib.import_module(f"drivers.{kind}.registry").__dict__[kind.upper()]
    return [registry[name] for name in registry if not registry.origin(name)]


def _devices(kind: str, heads: Sequence[str], more: Callable[[Any], Sequence[str]]) -> str:
    return table(
        ("`protocol`", "what it is", "link, for instance", *heads),
        (
            (f"`{spec.name}`", spec.what, ", ".join(f"`{link}`" for link in spec.link.split(" or ")), *more(spec))
            for spec in _built_in(kind)
        ),
    )


def tables() -> str:
    """Protocols of turntables."""
    return _devices(
        "tables",
        ("TCP port; baud rate, if the link states none", "an axis has"),
        lambda spec: (
            f"{spec.tcp_port or 'none'}; {spec.baud}",
            f"`{spec.address.name}`, {spec.address.doc.removeprefix(f'{spec.address.name}, ')}" if spec.address else "",
        ),
    )


def imus() -> str:
    """Protocols of IMUs."""
    return _devices(
        "imus",
        ("baud rate, if the link states none", "`rate`"),
        lambda spec: ("" if spec.on_can else str(spec.baud), _rates(spec.rates_hz)),
    )


def _rates(rates_hz: Any) -> str:
    if isinstance(rates_hz, range):
        return f"whole Hz up to {rates_hz[-1]} that the device has"
    if isinstance(rates_hz, dict):
        return "; ".join(f"{chosen}: {_rates(its)}" for chosen, its in rates_hz.items())
    return ", ".join(f"{rate:g}" for rate in rates_hz) + " Hz" if rates_hz else "what it sends"


def _device_keys(kind: str, which: str) -> str:
    si = {"time": " s", "angle": " rad", "rate": " rad/s"}
    rows = [
        (
            f"`{key.name}`",
            spec.name,
            key.doc,
            "" if key.default is None else json.dumps(key.default) + si.get(key.kind, ""),
        )
        for spec in _built_in(kind)
        for key in getattr(spec, which)
    ]
    return table(("key", "`protocol`", "meaning", "if left out"), rows)


def table_keys() -> str:
    """Keys that protocols of tables add to [table]."""
    return _device_keys("tables", "keys")


def table_axis_keys() -> str:
    """Keys that protocols of tables add to an axis."""
    return _device_keys("tables", "axis_keys")


def imu_keys() -> str:
    """Keys that protocols of IMUs add to [[imu]]."""
    return _device_keys("imus", "keys")


def exports() -> str:
    """Forms of station export."""
    from station.cli import main

    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        main(["export", "--list", "--json"])
    return table(
        ("`--format`", "holds", "does not hold"),
        ((f"`{form}`", its["holds"], its["lacks"]) for form, its in json.loads(said.getvalue()).items()),
    )


def vectornav_fields() -> str:
    """Fields of VectorNav's binary output, as a mapping file names them."""
    groups = packaged("layouts.toml")["vectornav"]
    return table(
        ("group", "fields"),
        (
            (f"`{group}`", ", ".join(f"`{f.split()[0]}`" for f in listed.split(",") if "reserved" not in f))
            for group, listed in groups.items()
            if isinstance(listed, str)
        ),
    )


def xsens_packets() -> str:
    """Packets of MTData2 by the maker's names."""
    return table(("packet", "unit"), ((f"`{p[0]}`", p[1]) for p in packaged("layouts.toml")["mtdata2"].values()))


def decisions() -> str:
    """The records, by number."""
    rows = []
    for path in sorted((PAGES / "decisions").glob("0*.md")):
        text = path.read_text(encoding="utf-8")
        title = re.search(r"^# \d+\. (.+)$", text, re.MULTILINE)
        date, area = re.search(r"^Date: (\S+)\. Area: (.+)\.$", text, re.MULTILINE).groups()  # type: ignore[union-attr]
        rows.append((path.name[:4], f"[{title.group(1)}]({path.name})", area, date))  # type: ignore[union-attr]
    return table(("no.", "decision", "area", "date"), rows)


MADE: dict[str, Callable[[], str]] = {
    made.__name__: made
    for made in (
        *(commands, effects, units, tables, imus, exports, vectornav_fields, xsens_packets, decisions),
        *(table_keys, table_axis_keys, imu_keys),
        *(limit_keys, prior_keys, noise_keys, axis_keys, uncertainty_keys),
    )
}
"""What can stand between the marks of a page."""


def made_pages() -> dict[Path, str]:
    """Return every page that takes something from the code, and the pictures, as they should be."""
    pages = {}
    for path in sorted(PAGES.rglob("*.md")):
        text = path.read_text(encoding="utf-8")
        made = _BLOCK.sub(lambda mark: f"{mark[1]}{mark[2]}\n{MADE[mark[1]]().strip()}\n\n", text)
        if made != text or _BLOCK.search(text):
            pages[path] = made
    for name, shot in _PICTURES.items():
        svg = (_SHOTS / shot).read_text(encoding="utf-8")
        pages[PAGES / "pictures" / name] = re.sub(r"@font-face \{.*?\}\s*", "", svg, flags=re.DOTALL)
    return pages


def stale() -> list[str]:
    """Return the pages that are not as they should be."""
    return [
        str(path.relative_to(ROOT))
        for path, text in made_pages().items()
        if not path.exists() or path.read_text(encoding="utf-8") != text
    ]


if __name__ == "__main__":
    old = stale()
    if "--check" not in sys.argv[1:]:
        for path, text in made_pages().items():
            path.write_text(text, encoding="utf-8")
    print("\n".join(old) or "all pages are up to date")
    sys.exit(bool(old) and "--check" in sys.argv[1:])
