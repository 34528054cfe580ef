"""A bench file made of answers: TOML with comments, as the built-in one has."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from station.bench_imu import ON_CAN
from station.bench_table import TWIN

ADDRESS_KEYS: Mapping[str, str] = {"modbus": "unit_id", "galil": "letter", "acutrol": "number"}
"""What the address of an axis is called, by protocol; an Aerosmith's one axis has none."""
COUNTING = ("modbus", "galil")
"""Protocols that must be told the encoder counts a turn."""
_COMMENT_COLUMN = 40


@dataclass(frozen=True, slots=True)
class AxisAnswer:
    """One axis of the table; ``address`` and ``counts_per_turn`` are empty where the protocol needs none.

    ``travel`` is empty for an axis that turns without end, ``link`` for one that has none of its own.
    """

    address: str
    counts_per_turn: str
    max_rate: str
    max_acceleration: str
    travel: tuple[str, ...] = ()
    link: str = ""


@dataclass(frozen=True, slots=True)
class TableAnswer:
    """The table; axes by name, outermost first."""

    protocol: str
    link: str
    profile: str
    axes: Mapping[str, AxisAnswer]


@dataclass(frozen=True, slots=True)
class ImuAnswer:
    """A device under test.

    Its name is a bare key of TOML. ``geometry`` are the keys of its array, values as TOML. Of gyros on CAN: a mapping,
    or ``channels``, the signals of the rate and (empty for none) of the temperature of each gyro in the DBC, the
    built-in one if ``dbc`` is empty.
    """

    name: str
    protocol: str
    link: str
    geometry: Mapping[str, str]
    rate: str
    arw: str
    bias_instability: str
    mapping: str = ""
    dbc: str = ""
    channels: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class BenchAnswer:
    """A whole bench; ``latitude`` is empty if Earth rate is to be left out, patterns are empty for anything."""

    name: str
    table: TableAnswer
    imus: Sequence[ImuAnswer]
    latitude: str = ""
    heading: str = "0 deg"
    limits: Mapping[str, str] = field(default_factory=dict)
    operator_pattern: str = ""
    serial_pattern: str = ""


def bench_text(bench: BenchAnswer) -> str:
    """Return the whole file."""
    lines = [
        "# A bench: the table, the gyros on it, and what counts as a pass. Every number has its unit.",
        "# What each key means is in drivers/README.md; `station check FILE` sees whether everything answers.",
        "",
        _line("name", bench.name),
        "",
        *_station(bench),
        *_site(bench),
        *table_text(bench.table).splitlines(),
        "",
    ]
    for imu in bench.imus:
        lines += [*imu_text(imu).splitlines(), ""]
    lines += ["[limits]                                # what PASS means; what is left out is not checked"]
    for key, value in bench.limits.items():
        comment = "beyond these the sigmas are off by a tenth" if key == "nis_low" else ""
        lines.append(_line(key, value, comment, bare=key.startswith("nis")))
    simulated = all(imu.link == TWIN for imu in bench.imus)
    lines += ["", "[undeclared]"]
    lines += [_line("effects", "none", "twins have none; take this line off when gyros are real")] if simulated else []
    lines += ['#excluded = ["earth_rate"]              # effects that are ruled out: they are then not in the sigmas']
    lines += ["", *_twins(bench)]
    return "\n".join(lines) + "\n"


def table_text(table: TableAnswer) -> str:
    """Return the section [table] and its axes."""
    lines = [
        "[table]",
        _line("protocol", table.protocol, "modbus, galil, acutrol or aerosmith"),
        _line("link", table.link, _link_comment(table.protocol, table.link)),
    ]
    if table.protocol == "modbus":
        lines.append(_line("profile", table.profile, "register map: kinco, lexium32, or the path of a .toml"))
    lines.append(f"{f'gimbals = {json.dumps(list(table.axes))}':<{_COMMENT_COLUMN - 1}} # outermost first")
    for name, axis in table.axes.items():
        lines += ["", f"[table.{name}]"]
        key = ADDRESS_KEYS.get(table.protocol)
        if key is not None:
            lines.append(_line(key, axis.address, bare=key != "letter"))
        if axis.counts_per_turn:
            lines.append(_line("counts_per_turn", axis.counts_per_turn, "encoder counts of one turn", bare=True))
        lines.append(_line("max_rate", axis.max_rate))
        lines.append(_line("max_acceleration", axis.max_acceleration))
        if axis.travel:
            comment = "from home; leave out if it turns without end"
            lines.append(_line("travel", json.dumps(axis.travel), comment, bare=True))
        if axis.link:
            lines.append(_line("link", axis.link, "of this drive alone"))
    lines += [
        "",
        "#[table.uncertainty]                    # what the table is good for, one standard deviation each; take off",
        '#rate = "2 ppm"                         # the #s and put in its certificate: it then goes into every sigma',
        '#wobble = "1 arcsec"',
        '#orthogonality = "2 arcsec"',
        '#timing = "50 us"',
    ]
    return "\n".join(lines)


def imu_text(imu: ImuAnswer) -> str:
    """Return the section [[imu]] of a device."""
    lines = [
        "[[imu]]",
        _line("name", imu.name),
        _line("protocol", imu.protocol, "can, j1939, stim300, vectornav or xsens"),
        _line("link", imu.link, _link_comment(imu.protocol, imu.link)),
    ]
    lines += [_line(key, value, bare=True) for key, value in imu.geometry.items()]
    lines.append(_line("rate", imu.rate))
    if imu.mapping:
        lines.append(_line("mapping", imu.mapping, "which signals of its DBC the gyros are"))
    if imu.dbc:
        lines.append(_line("dbc", imu.dbc, "from the folder of this file"))
    if imu.channels:
        lines.append(f"{'channels = [':<{_COMMENT_COLUMN - 1}} # one a gyro, MESSAGE.Signal of the DBC")
        lines += [f"    {_channel(*signals)}," for signals in imu.channels]
        lines.append("]")
    return "\n".join(
        [
            *lines,
            "",
            "[imu.datasheet]                         # what the maker promises: see its data sheet",
            _line("arw", imu.arw, "angle random walk"),
            _line("bias_instability", imu.bias_instability),
            _line("bias", "1 deg/s", "how far off a gyro may be, one standard deviation"),
            _line("scale_factor_error", "5 %"),
            _line("misalignment", "20 mrad"),
        ]
    )


def _channel(rate: str, temperature: str) -> str:
    also = f", temperature = {json.dumps(temperature)}" if temperature else ""
    return f"{{ rate = {json.dumps(rate)}{also} }}"


def _station(bench: BenchAnswer) -> list[str]:
    patterns = {"operator_pattern": bench.operator_pattern, "serial_pattern": bench.serial_pattern}
    given = {key: value for key, value in patterns.items() if value}
    if not given:
        return []
    comment = "regular expressions that names of operators and serial numbers of devices must match"
    return ["[station]", *(_line(key, value) for key, value in given.items()), f"# {comment}", ""]


def _site(bench: BenchAnswer) -> list[str]:
    if bench.latitude:
        heading = _line("heading", bench.heading, "azimuth of the base x axis, clockwise from north")
        return ["[site]", _line("latitude", bench.latitude, "for Earth rate"), heading, ""]
    lines = [
        "#[site]                                 # without it Earth rate, 15 deg/h, is not in the model",
        '#latitude = "45 deg"',
        '#heading = "0 deg"                      # azimuth of the base x axis, clockwise from north',
    ]
    return [*lines, ""]


def _twins(bench: BenchAnswer) -> list[str]:
    """Return what the twins are: of all devices, since any of them may be served by `station twin`."""
    lines = [
        "# What only the twins read; it is not needed for hardware.",
        "[twin]",
        f"start = {json.dumps(['2 deg'] * len(bench.table.axes))}",
        "",
        "[twin.wires]                            # what `station twin` serves them on",
        _line("table", "tcp", "or serial"),
    ]
    for imu in bench.imus:
        wires = ("udp_multicast", "slcan, socketcand") if imu.protocol in ON_CAN else ("serial", "tcp")
        lines.append(_line(imu.name, wires[0], f"or {wires[1]}"))
    for imu in bench.imus:
        lines += [
            "",
            f"{f'[twin.{imu.name}]':<{_COMMENT_COLUMN - 1}} # its true errors",
            _line("k", "3000 ppm"),
            _line("b", "0.05 deg/s"),
            _line("sigma_j", "1 mrad"),
            _line("sigma_k", "-1 mrad"),
            _line("bias_instability", imu.bias_instability),
        ]
    return lines


def _link_comment(protocol: str, link: str) -> str:
    examples = {
        "modbus": "tcp://192.168.1.10:502 or serial:///dev/ttyUSB0?baud=115200&parity=E",
        "galil": "tcp://192.168.1.10 or serial:///dev/ttyUSB0?baud=115200",
        "acutrol": "tcp://192.168.1.10:9888",
        "aerosmith": "serial:///dev/ttyUSB0?baud=9600",
        "can": "can:socketcan:can0 or can:slcan:/dev/ttyACM0",
        "j1939": "can:socketcan:can0 or can:pcan:PCAN_USBBUS1?bitrate=250000",
        "stim300": "serial:///dev/ttyUSB0?baud=921600",
        "vectornav": "serial:///dev/ttyUSB0?baud=115200",
        "xsens": "serial:///dev/ttyUSB0?baud=921600",
    }
    return f"the twin; hardware: {examples[protocol]}" if link == TWIN else ""


def _line(key: str, value: str, comment: str = "", *, bare: bool = False) -> str:
    text = f"{key} = {value if bare else json.dumps(value, ensure_ascii=False)}"
    return f"{text:<{_COMMENT_COLUMN - 1}} # {comment}" if comment else text
