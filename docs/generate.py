"""Writes what the reference pages take from the code: ``python docs/generate.py``; ``--check`` only names stale pages.

A page holds ``<!-- generated: NAME -->`` and ``<!-- end -->``; what stands between them is made by the function of that
name, of the words behind it. JSON Schemas for editors are made of the same declarations as the tables of keys.
Pictures of the screen are the pictures that the tests compare with, without the fonts that they would fetch.
"""

import argparse
import contextlib
import html
import importlib
import io
import json
import math
import re
import sys
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, fields, replace
from functools import cache
from pathlib import Path
from string import Formatter
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGES = ROOT / "docs/pages"
COMMAND = "python docs/generate.py"
_SHOTS = ROOT / "tests/station/screen/__snapshots__/test_pictures"
_PICTURES = {"run.svg": "test_a_run[80x24].svg", "run-wide.svg": "test_a_run[120x40].svg"}
_BLOCK = re.compile(r"(?<=<!-- generated: )([a-z_. ]+?)( -->\n).*?(?=<!-- end -->)", re.DOTALL)


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


def keys(*sections: str) -> str:
    """Keys of sections of a file that a person writes."""
    return _key_table((key, "") for section in sections for key in _keys_of(section))


def steps() -> str:
    """The kinds of steps, each with its keys."""
    parts = []
    for kind in _step_kinds():
        parts += [f"## {kind.name}\n", f"{kind.what[0].upper()}{kind.what[1:]}.\n"]
        parts.append(_key_table((key, "") for key in _step_keys(kind)[1:]))
    return "\n".join(parts)


def _step_kinds() -> list[Any]:
    """Records of the kinds of steps of the station itself."""
    from station.scripts.steps.registry import STEPS

    return [STEPS[name] for name in STEPS if not STEPS.origin(name)]


def _step_keys(kind: Any) -> list[Any]:
    """Return all keys of a step of a kind."""
    from station.scripts.steps.kind import LABEL

    return [*_keys_of("script.step"), *kind.keys, LABEL]


def device_keys(which: str) -> str:
    """Keys that only some protocols have: of "tables", of their "axes", or of "imus"."""
    rows: list[tuple[Any, list[str]]] = []
    for spec in _built_in("imus" if which == "imus" else "tables"):
        own = (*([spec.address] if spec.address else []), *spec.axis_keys) if which == "axes" else spec.keys
        for key in own:
            names = next((names for known, names in rows if known == key), [])
            if not names:
                rows.append((key, names))
            names.append(spec.name)
    return _key_table((key, f" ({', '.join(names)})") for key, names in rows)


def _key_table(rows: Iterable[tuple[Any, str]]) -> str:
    return table(
        ("key", "meaning", "is", "if left out"),
        ((f"`{key.name}`{of}", key.doc, _kind(key), _if_left_out(key)) for key, of in rows if key.name != "*"),
    )


def mapping_keys() -> str:
    """Plain keys of a mapping file."""
    from estimator.importing.mapping.columns import KEYS

    tables = ("device", "file", "gyro", "site")
    return table(
        ("where", "key", "if left out", "must be", "says"),
        (
            (f"`[{where}]`" if where in tables else where, f"`{key}`", _left_out(says), _bound(says), says["line"])
            for where, keys in KEYS.items()
            for key, says in keys.items()
        ),
    )


def _left_out(says: dict[str, Any]) -> str:
    default = says.get("default")
    if default is None:
        return "must be given"
    return (
        "nothing"
        if default in ("", math.inf)
        else str(default).lower()
        if says["kind"] == "flag"
        else f"{default:g}"
        if isinstance(default, float)
        else default
    )


def _bound(says: dict[str, Any]) -> str:
    if "one_of" in says:
        return " or ".join(f'"{text}"' for text in says["one_of"])
    if "most" in says:
        return f"{says['least']:g} to {says['most']:g}"
    kinds = {"text": "a text", "flag": "true or false"}
    return (
        "above 0"
        if says.get("positive")
        else f"{says['least']:g} or more"
        if "least" in says
        else kinds.get(says["kind"], "a number")
    )


def _kind(key: Any) -> str:
    known = {"text": "text", "texts": "list of texts", "flag": "true or false", "integer": "whole number"}
    known |= {"number": "number", "path": "path", "pattern": "regular expression", "link": "[link](bench.md#links)"}
    known |= {"table": "table", "tables": "tables", "any": "see there", "date": "date"}
    kind = known.get(key.kind, f"[{key.kind}](units.md)")
    if key.one_of and len(key.one_of) < 13:
        kind = ("different ones of " if key.kind == "texts" else "") + ", ".join(f"`{one}`" for one in key.one_of)
    bound = {"above_zero": "above zero", "not_negative": "zero or more", "not_blank": ""}.get(key.bound, key.bound)
    return kind + (f", {bound}" if bound else "") + (", or a list of them" if key.each else "")


def _if_left_out(key: Any) -> str:
    if key.required:
        return "must be given"
    if key.default is None or key.default in ({}, ""):
        return ""
    if key.default == math.inf:
        return "not checked"
    return f"`{json.dumps(key.default)}`"


_ALTERNATIVES = ("array", "cone", "axes", "mapped", "listed", "described")
"""Sections of an [[imu]] of which others may stand in place, so that nothing of them is required."""


def json_schemas() -> dict[str, dict[str, Any]]:
    """Return a JSON Schema for each kind of file, which editors take for completion."""
    kinds = _step_kinds()
    steps = [_if("kind", kind.name, _object_of(_step_keys(kind))) for kind in kinds]
    script = _object("script.script")
    step = script["properties"]["step"]["items"]
    step["properties"]["kind"]["enum"] = [kind.name for kind in kinds]
    step |= {"additionalProperties": True, "allOf": steps}
    return {
        "bench": _object("bench.bench"),
        "script": script,
        "can_mapping": _object("can_mapping.can_mapping"),
        "profile": _object("profile.profile"),
        "hidden": _hidden(),
        "certificate": _object("certificate.certificate_file"),
        "description": _object("can_mapping.source", "description.description"),
        "mapping": _mapping(),
    }


_NUMBER, _TEXT = {"type": "number"}, {"type": "string"}
_ABOVE_0, _NOT_NEGATIVE = {"type": "number", "exclusiveMinimum": 0}, {"type": "number", "minimum": 0}
_TEXTS = {"anyOf": [_TEXT, {"type": "array", "minItems": 1, "items": _TEXT}]}
_AXIS = {"type": "string", "pattern": r"^\s*[+-]*[xyzXYZ]\s*$"}
_DIRECTION = {"anyOf": [_AXIS, {"type": "array", "minItems": 3, "maxItems": 3, "items": _NUMBER}]}


def _mapping() -> dict[str, Any]:
    """Return the schema of a mapping file: plain keys as they are declared, the others as they are read."""
    axes = {"anyOf": [_AXIS, {"type": "array", "minItems": 1, "items": _DIRECTION}]}
    file, time = _file(), _time({})
    own = _file({"name": _said("file beside the data; {stem} is that one's name without ending", _TEXT)}, ["name"])
    offset = {"anyOf": [_NUMBER, {"const": "from data"}]}
    beside = {
        "file": _said(
            "file that the reference is in; {stem} is the data file's name without ending", anyOf=[_TEXT, own]
        ),
        "time": _time({"offset_s": _said("seconds added to the stamps of the reference", offset)}),
    }
    cuts = {
        "section_list": _said("JSON beside the data: first and last row of each section", _TEXT),
        "section_column": _said("column of labels", _TEXT),
    }
    pose = {"up": _said("body axis that points up", _DIRECTION), "north": _said("... to the north", _DIRECTION)}
    turn = {
        "axis": _said("body axis of the turn", _TEXT),
        "angle_deg": _said("by which the body turns about it", _NUMBER),
    }
    limits = {"start_s": _said("seconds of the file", _NOT_NEGATIVE), "end_s": _said("likewise", _ABOVE_0)}
    rest = {
        "where": _said("where the samples are quiet, or all of them", enum=["found", "everywhere"]),
        "files": _said("poses by the names of files", type="object", additionalProperties=_table(pose)),
        "sections": _each(_table(pose | limits)),
    }
    by_gravity = {
        "accelerometer": _said("whether rests give its factors and offsets", enum=["from rests", "stated"]),
        "sd_deg": _said("doubt of a direction up, one sigma", _NOT_NEGATIVE),
    }
    local_gravity = {
        "gravity_mps2": _said(
            "local gravity; left out: of the site, or standard", type="number", minimum=9.7, maximum=9.9
        ),
        "gravity_ppm": _said("its standard uncertainty; left out: 50", _NOT_NEGATIVE),
        "height_m": _said("height of the site; left out: 0", _NUMBER),
    }
    file_name = _said("regular expression with the groups axis and angle_deg", _TEXT, format="regex")
    turns = _table(
        turn | cuts | {"sections": _each(_table(turn | limits, ["angle_deg"])), "file_name": file_name}, (), "turns"
    )
    kinds = {
        "attitude": _table({"columns": _TEXTS} | beside, ["columns"], "attitude"),
        "rate": _columns("rate", beside | {"axis": _said("body axis of one column", _DIRECTION)}),
        "angle": _columns("angle", beside | {"axis": _AXIS, "earth_rate": {"type": "boolean"}}, ["axis"], "column"),
        "turns": turns | {"anyOf": [{"required": [key]} for key in ("angle_deg", "file_name", "sections")]},
        "rest": _table(rest | pose | cuts, (), "rest"),
        "gravity": _table(rest | pose | cuts | by_gravity, (), "rest"),
        "poses": _by_poses(local_gravity | cuts | {"sections": _each(_table(pose | turn | limits))}),
    }
    for kind in kinds.values():
        kind["properties"] = {"kind": {}, **kind["properties"]}
    by_kind = [_if("kind", kind, schema) for kind, schema in kinds.items()]
    reference = {
        "type": "object",
        "required": ["kind"],
        "properties": {"kind": {"enum": list(kinds)}},
        "allOf": by_kind,
    }
    names = {"axes": _said("sense axis of each gyro", axes), "names": _said("of the gyros", _TEXTS)}
    square = _said("body axes of the columns", type="array", minItems=3, maxItems=3, items=_DIRECTION)
    accelerometer = _columns("acceleration", {"axes": square})
    sized = accelerometer.pop("allOf")
    by_poses = {"properties": {"reference": {"properties": {"kind": {"const": "poses"}}, "required": ["kind"]}}}
    imu = _table(
        {
            "name": _TEXT,
            "accelerometer": _columns("acceleration", {"axes": square}),
            "gyro": _columns("rate", names, where="gyro"),
        },
        ["name", "accelerometer", "gyro"],
    )
    others = {"required": ["time", "gyro"], "properties": {"imu": False, "accelerometer": {"allOf": sized}}}
    return _table(
        {
            "device": _table({}, (), "device"),
            "file": file,
            "time": time,
            "gyro": _columns("rate", names, where="gyro"),
            "accelerometer": accelerometer,
            "imu": _said("IMUs of one board", type="array", minItems=1, items=imu),
            "temperature": _columns("temperature", {}, key="column"),
            "site": _table({}, (), "site"),
            "reference": reference,
        },
        ["device", "file", "reference"],
    ) | {"if": by_poses, "then": {"anyOf": [{"required": [key]} for key in ("accelerometer", "imu")]}, "else": others}


def _by_poses(properties: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of [reference] of kind poses; the accuracy of stated poses goes with sections."""
    known = _table({}, (), "known_poses")["properties"]
    sections = {"dependencies": {key: ["sections"] for key in known}}
    return _table(properties | known, (), "poses") | sections


def _said(line: str, schema: Mapping[str, Any] | None = None, **more: Any) -> dict[str, Any]:
    return {"description": line, **(schema or {}), **more}


def _each(within: dict[str, Any]) -> dict[str, Any]:
    return _said("sections by their names", type="object", minProperties=1, additionalProperties=within)


def _if(key: str, value: str, then: dict[str, Any]) -> dict[str, Any]:
    return {"if": {"properties": {key: {"const": value}}, "required": [key]}, "then": then}


def _table(properties: Mapping[str, Any], required: Sequence[str] = (), where: str = "") -> dict[str, Any]:
    """Return the schema of a table of a mapping file with these keys, and the plain ones that are declared of it."""
    from estimator.importing.mapping.columns import KEYS

    kinds = {"text": _TEXT, "flag": {"type": "boolean"}, "choice": {}}
    bounds = {"positive": "exclusiveMinimum", "least": "minimum", "most": "maximum"}
    plain = {}
    for key, says in KEYS.get(where, {}).items():
        left_out = "" if says.get("default", "") in ("", math.inf) else f"; left out: {json.dumps(says['default'])}"
        bound = {name: float(says[word] if word != "positive" else 0) for word, name in bounds.items() if word in says}
        one_of = {"enum": list(says["one_of"])} if "one_of" in says else {}
        plain[key] = _said(says["line"] + left_out, {**kinds.get(says["kind"], _NUMBER), **bound, **one_of})
    needed = [*required, *(key for key in plain if "default" not in KEYS[where][key])]
    return {"type": "object", "properties": {**properties, **plain}, "required": needed, "additionalProperties": False}


def _columns(
    quantity: str, more: Mapping[str, Any], required: Sequence[str] = (), key: str = "columns", where: str = ""
) -> dict[str, Any]:
    """Return the schema of a table with columns of a quantity; counts have a size, but where the data may tell it."""
    from estimator.importing.mapping.columns import UNITS

    units = list(UNITS[quantity])
    stated = {
        key: _said("columns of the file, by name", _TEXTS),
        "unit": _said("of the columns; raw: counts", enum=[*units, "raw"]),
        "count": _said("size of one count", _ABOVE_0),
        "count_unit": _said("unit of that size", enum=units),
        "offset": _said("value that stands for zero, in the unit of the column; left out: 0", _NUMBER),
    }
    sized = _if("unit", "raw", {"required": ["count", "count_unit"]})
    if where == "gyro":
        sized = {"if": {"properties": {"scale": {"const": "from data"}}, "required": ["scale"]}, "else": sized}
    return _table({**stated, **more}, [key, "unit", *required], where) | {"allOf": [sized]}


def _file(more: Mapping[str, Any] | None = None, required: Sequence[str] = ()) -> dict[str, Any]:
    """Return the schema of a format, with the keys that only some formats have."""
    from estimator.importing.mapping.columns import KEYS
    from station.opening.captures import PROTOCOLS

    text = {
        "delimiter": _said("one character, tab or space", _TEXT),
        "decimal": _said("mark of decimals", enum=[".", ","]),
        "columns": _said("names, if the file has no heading", _TEXTS),
    }
    binary = {
        "record": _said('name and type of each column, "t f8", "gyro 3i2" or "pad 4V"', _TEXTS),
        "byte_order": _said("left out: little", enum=["little", "big"]),
        "header_bytes": _said("left out: 0", _NOT_NEGATIVE),
    }
    stim300 = {
        "gyro_output": _said("if the device did not send its configuration", _TEXT),
        "accel_range_g": _said("likewise; left out: 10", type="integer"),
    }
    candump = {"dbc": _said("name of one that ships with the station, or a path from the mapping", _TEXT)}
    galil = {"sample_us": _said("time from one record to the next", _ABOVE_0)}
    own = {"csv": text, "tsv": text, "mat": {}, "binary": binary, **{name: {} for name in PROTOCOLS}}
    own |= {"stim300": stim300, "candump": candump, "galil": galil}
    formats = {"format": _said("of the file", enum=list(own))}
    whole = _table(
        {**(more or {}), **formats, **{k: v for keys in own.values() for k, v in keys.items()}},
        ["format", *required],
        "file",
    )
    shared = [*(more or {}), "format", *KEYS["file"]]
    needed = {"binary": ["record"], "candump": ["dbc"]}
    limits = [
        _if("format", name, {"propertyNames": {"enum": [*shared, *keys]}, "required": needed.get(name, [])})
        for name, keys in own.items()
    ]
    return whole | {"allOf": limits}


def _time(more: Mapping[str, Any]) -> dict[str, Any]:
    """Return the schema of what gives the samples their times: a rate, or stamps."""
    stamps = _columns("time", {"wraps_at": _said("at which a counter wraps, in its own unit", _ABOVE_0)}, key="column")
    rates = {
        "rate_hz": _said("samples a second", _ABOVE_0),
        "rate_variable": _said("variable of a .mat file that holds the rate", _TEXT),
    }
    ways: list[dict[str, Any]] = [
        {"required": ["column", "unit"], "not": {"anyOf": [{"required": [k]} for k in rates]}}
    ]
    ways += [{"required": [key], "propertyNames": {"enum": [key, *more]}} for key in rates]
    ways += [{"propertyNames": {"enum": list(more)}}] if more else []  # in another file as in the first
    return _table({**stamps["properties"], **rates, **more}) | {"allOf": stamps["allOf"], "oneOf": ways}


def _hidden() -> dict[str, Any]:
    """Return the schema of a file of hidden effects: a table for each, or several of a kind."""
    from sims.physics.hidden import KINDS, Temperature
    from sims.physics.hidden.fields import key_of

    def effect(kind: Any) -> dict[str, Any]:
        stated = [one for one in fields(kind) if one.metadata]
        properties = {key_of(one): _field(one) for one in stated}
        required = [key_of(one) for one in stated if one.default is MISSING]
        said = {"description": (kind.__doc__ or "").splitlines()[0], "type": "object", "properties": properties}
        return said | {"required": required, "additionalProperties": False}

    several = {name: effect(kind) for name, kind in KINDS.items()}
    properties = {name: {"anyOf": [one, {"type": "array", "items": one}]} for name, one in several.items()}
    devices = {"type": "array", "items": {"type": "string"}}
    devices["description"] = "devices whose gyros have the effects; left out: all"
    properties |= {"devices": devices, "temperature": effect(Temperature)}
    return {"type": "object", "properties": properties, "additionalProperties": False}


def _faults() -> dict[str, Any]:
    """Return the schema of [twin.fault] and [twin.NAME.fault]: of table, device and wire."""
    from sims.physics.hidden.fields import key_of
    from sims.wires.faults import DeviceFaults, TableFault, WireFaults

    stated = [one for kind in (TableFault, DeviceFaults, WireFaults) for one in fields(kind) if one.metadata]
    properties = {key_of(one): _field(one) for one in stated}
    return {"type": "object", "properties": properties, "additionalProperties": False}


def _field(one: Any) -> dict[str, Any]:
    if one.metadata.get("flag"):
        return {"type": "boolean"}
    if one.metadata.get("whole"):
        return {"type": "integer", "minimum": 1}
    if "choices" in one.metadata:
        return {"enum": list(one.metadata["choices"])}
    number = {"type": "string", "pattern": r"^\s*[+-]?\.?\d", "examples": [f"1 {one.metadata['like']}"]}
    return {"anyOf": [number, {"type": "array", "items": number}]} if one.metadata.get("each") else number


def _keys_of(section: str) -> Sequence[Any]:
    from station.schema.tables import keys_of

    return keys_of(section)


def _object(*sections: str) -> dict[str, Any]:
    """Return the schema of a table with these sections, and of the tables within it."""
    keys = []
    for section in sections:
        name = section.partition(".")[2]
        for key in (*_keys_of(section), *_device_keys(name)):
            keys.append(replace(key, required=False) if name in _ALTERNATIVES else key)
    return _object_of(keys)


def _object_of(keys: Iterable[Any]) -> dict[str, Any]:
    """Return the schema of a table with these keys."""
    properties: dict[str, Any] = {}
    required, others = [], False
    for key in keys:
        if key.name == "*":
            others = _property(key)
        else:
            properties[key.name] = _property(key)
            required += [key.name] if key.required else []
    return {"type": "object", "properties": properties, "required": required, "additionalProperties": others}


def _device_keys(section: str) -> list[Any]:
    """Return the keys that only some protocols have in a section; any of them may be absent."""
    tables, imus = _built_in("tables"), _built_in("imus")
    found = {
        "table": [key for spec in tables for key in spec.keys],
        "axis": [key for spec in tables for key in (*([spec.address] if spec.address else []), *spec.axis_keys)],
        "imu": [key for spec in imus for key in spec.keys],
    }
    return [replace(key, required=False) for key in found.get(section, ())]


def _property(key: Any) -> dict[str, Any]:
    from station.schema.quantities import UNITS

    left_out = (
        "" if key.required or key.default in (None, math.inf, {}, []) else f"; left out: {json.dumps(key.default)}"
    )
    schema: dict[str, Any] = {"description": f"{key.doc}{left_out}"}
    one: dict[str, Any] = {"type": "string"}
    if key.kind in UNITS:
        units = "|".join(re.escape(unit) for unit in UNITS[key.kind])
        one["pattern"] = rf"^\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*({units})\s*$"
    elif key.kind in ("integer", "number", "flag"):
        one["type"] = {"flag": "boolean"}.get(key.kind, key.kind)
        low, _, high = key.bound.partition(" to ")
        one |= {"above_zero": {"exclusiveMinimum": 0}, "not_negative": {"minimum": 0}}.get(low, {})
        one |= {"minimum": float(low), "maximum": float(high)} if high else {}
    elif key.kind == "date":  # of TOML, or as a text: editors differ in what they see of the first
        one = {}
    elif key.name == "fault":
        one = _faults()
    elif key.kind in ("table", "tables", "any"):
        within = _object(*key.of) if key.of else {"type": "object"}
        one = {"table": within, "tables": {"type": "array", "items": within}}.get(key.kind, {})
    if key.one_of:
        one["enum"] = list(key.one_of)
    if key.name == "protocol":  # a plug-in may bring another
        names = [spec.name for spec in _built_in("tables" if key.default else "imus")]
        one = {"anyOf": [{"enum": names}, one]}
    if key.kind == "texts" or key.each:
        one = {"anyOf": [one, {"type": "array", "items": one}]}
    return schema | one | ({"examples": [key.example]} if key.example is not None else {})


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
            (f"`{spec.name}`", spec.said, ", ".join(f"`{link}`" for link in spec.link.split(" or ")), *more(spec))
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
    if isinstance(rates_hz, Mapping):
        return "; ".join(f"{chosen}: {_rates(its)}" for chosen, its in rates_hz.items())
    return ", ".join(f"{rate:g}" for rate in rates_hz) + " Hz" if rates_hz else "what it sends"


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


def messages() -> str:
    """Sentences of advice, by the area that they are about."""
    rows = []
    for package in ("station", "drivers", "estimator"):
        listed = tomllib.loads((ROOT / package / "sentences.toml").read_text(encoding="utf-8"))
        rows += [(area, _shown(text)) for area, texts in listed.items() for text in texts.values()]
    return table(("about", "message"), rows)


def _shown(sentence: str) -> str:
    """Return a sentence with its fields as <name>; what stands between backquotes needs no escapes."""
    parts = Formatter().parse(" ".join(sentence.split()))
    pieces = "".join(f"{text}<{field}>" if field else text for text, field, _, _ in parts).split("`")
    return "`".join(piece if i % 2 else html.escape(piece, quote=False) for i, piece in enumerate(pieces))


def decisions() -> str:
    """The records, by number."""
    rows = []
    for path in sorted((PAGES / "decisions").glob("0*.md")):
        text = path.read_text(encoding="utf-8")
        title = re.search(r"^# \d+\. (.+)$", text, re.MULTILINE)
        date, area = re.search(r"^Date: (\S+)\. Area: (.+)\.$", text, re.MULTILINE).groups()  # type: ignore[union-attr]
        rows.append((path.name[:4], f"[{title.group(1)}]({path.name})", area, date))  # type: ignore[union-attr]
    return table(("no.", "decision", "area", "date"), rows)


MADE: dict[str, Callable[..., str]] = {
    made.__name__: made
    for made in (
        *(commands, effects, units, tables, imus, exports, vectornav_fields, xsens_packets, messages, decisions),
        *(keys, steps, device_keys, mapping_keys),
    )
}
"""What can stand between the marks of a page."""


def _made(name: str, *what: str) -> str:
    return MADE[name](*what)


def made_pages() -> dict[Path, str]:
    """Return every page that takes something from the code, and the pictures, as they should be."""
    pages = {}
    for path in sorted(PAGES.rglob("*.md")):
        text = path.read_text(encoding="utf-8")
        made = _BLOCK.sub(lambda mark: f"{mark[1]}{mark[2]}\n{_made(*mark[1].split()).strip()}\n\n", text)
        if made != text or _BLOCK.search(text):
            pages[path] = made
    for kind, schema in json_schemas().items():
        named = {"$schema": "http://json-schema.org/draft-07/schema#", "title": kind.replace("_", " "), **schema}
        pages[PAGES / f"reference/schemas/{kind}.json"] = json.dumps(named, indent=1) + "\n"
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
            path.parent.mkdir(exist_ok=True)
            path.write_text(text, encoding="utf-8")
    print("\n".join(old) or "all pages are up to date")
    sys.exit(bool(old) and "--check" in sys.argv[1:])
