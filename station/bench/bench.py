"""The bench file: the devices of the lab, their limits, and the limits for a pass."""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from drivers.imus.registry import IMUS
from drivers.kinds import KINDS
from drivers.packaged import packaged_text
from drivers.plugins import PluginError, load_files, origin_of, records_of
from drivers.tables.registry import TABLES
from estimator.effects.catalogue import records, register
from estimator.effects.effect import EffectError, Kind, Record
from estimator.geometry.kinematics import Site
from estimator.untrusted import read_text
from station.bench.device import AnyDevice, DeviceConfig, read_device
from station.bench.imu import NOT_NAMES, ImuConfig, read_imu
from station.bench.table import TableConfig, read_table
from station.bench.units import USUAL, Units
from station.errors import BenchError, UsageError
from station.schema.tables import Table, keys_of

_LONGEST_NAME = 100  # characters of an operator's name or a serial number


@dataclass(frozen=True, slots=True, kw_only=True)
class ForceLimits:
    """The limits of accelerometers for PASS, in SI: sizes of the states and their sigmas, infinite where none is given.

    ``sd_arm_m`` is the largest sigma of a component of the lever arm, from where the axes of the table meet to the
    middle of the accelerometers. ``written`` has them as in the bench file, by their fields.
    """

    k: float = math.inf
    b_mps2: float = math.inf
    sigma_rad: float = math.inf
    sd_k: float = math.inf
    sd_b_mps2: float = math.inf
    sd_sigma_rad: float = math.inf
    sd_arm_m: float = math.inf
    written: Mapping[str, str] = field(default_factory=dict)

    @property
    def sds(self) -> tuple[float, ...]:
        """Largest sigmas of the four states."""
        return self.sd_k, self.sd_b_mps2, self.sd_sigma_rad, self.sd_sigma_rad

    @property
    def requires_sigmas(self) -> bool:
        """Whether any sigma is limited."""
        return any(map(math.isfinite, (*self.sds, self.sd_arm_m)))

    @property
    def stated(self) -> bool:
        """Whether any limit is given."""
        return any(map(math.isfinite, (self.k, self.b_mps2, self.sigma_rad, *self.sds, self.sd_arm_m)))

    def of_state(self, number: int) -> tuple[float, str, float, str]:
        """Return the largest size of a state as a number and as written, and the largest sigma likewise.

        Without a limit the number is infinite and the text "". ``number`` is that of the state.
        """
        key = ("k", "b_mps2", "sigma_rad", "sigma_rad")[number]
        size, sd = getattr(self, key), getattr(self, f"sd_{key}")
        return size, self.written.get(key, ""), sd, self.written.get(f"sd_{key}", "")


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits for PASS, in SI: sizes of the states, their sigmas, mean NIS, share of samples lost.

    ``written`` has sizes and sigmas as in the bench file, by their fields; ``units`` are those of comparisons.
    ``forces`` are the limits of accelerometers.
    """

    k: float
    b_rps: float
    sigma_rad: float
    sd_k: float
    sd_b_rps: float
    sd_sigma_rad: float
    nis_low: float
    nis_high: float
    lost: float
    written: Mapping[str, str] = field(default_factory=dict)
    units: Units = USUAL
    forces: ForceLimits = ForceLimits()

    @property
    def sizes(self) -> tuple[float, ...]:
        """Largest sizes of the four states, infinite where none is given."""
        return self.k, self.b_rps, self.sigma_rad, self.sigma_rad

    @property
    def sds(self) -> tuple[float, ...]:
        """Largest sigmas of the four states, likewise."""
        return self.sd_k, self.sd_b_rps, self.sd_sigma_rad, self.sd_sigma_rad

    @property
    def written_sizes(self) -> tuple[str, ...]:
        """``sizes`` as they were written, empty where that is not known."""
        return tuple(self.written.get(key, "") for key in ("k", "b_rps", "sigma_rad", "sigma_rad"))

    @property
    def written_sds(self) -> tuple[str, ...]:
        """``sds`` likewise."""
        return tuple(self.written.get(key, "") for key in ("sd_k", "sd_b_rps", "sd_sigma_rad", "sd_sigma_rad"))

    @property
    def stated(self) -> bool:
        """Whether any limit is given, of forces too. A least NIS of 0 and a loss of 1 are none, as any result meets
        them."""
        least = (self.nis_low, 1 - self.lost)
        return (
            any(map(math.isfinite, (*self.sizes, *self.sds)))
            or math.isfinite(self.nis_high)
            or any(v > 0 for v in least)
            or self.forces.stated
        )


@dataclass(frozen=True, slots=True)
class TwinConfig:
    """Settings for twins only: seed, watchdog, the table of truths (not read yet), and what is hidden from the station.

    ``drive_cycle_s`` is how often a CiA 402 drive samples its controlword. Temperature and hidden effects follow a
    clock that is at ``started_s`` when the loop's is at 0.
    """

    seed: int
    watchdog_s: float
    truths: Table
    hidden: Path | None = None
    started_s: float = 0.0
    drive_cycle_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Bench:
    """A complete bench, and the text of its file.

    ``station`` names the place; ``operator_pattern`` and ``serial_pattern`` are regular expressions that names of
    operators and serial numbers must match in full, empty for any; the screen asks again for the operator after
    ``shift_s``. ``excluded`` are effects of the catalogue that devices and table do not have; None for all of them.
    ``others`` are devices of kinds other than table and IMU. ``plugins`` are files and packages in use from outside,
    ``plugin_files`` the files that the bench names or that stand beside it. ``after_run`` is the program, with
    arguments, that gets the result of each run; empty for none.
    """

    name: str
    text: str
    site: Site | None
    table: TableConfig
    imus: tuple[ImuConfig, ...]
    limits: Limits
    twin: TwinConfig
    station: str
    operator_pattern: str
    serial_pattern: str
    shift_s: float
    others: tuple[DeviceConfig, ...] = ()
    excluded: frozenset[str] | None = None
    plugins: tuple[str, ...] = ()
    plugin_files: tuple[Path, ...] = ()
    after_run: tuple[str, ...] = ()

    @property
    def devices(self) -> dict[str, AnyDevice]:
        """All devices by name: the table first, then those under test, then others."""
        devices: tuple[AnyDevice, ...] = (self.table, *self.imus, *self.others)
        return {device.name: device for device in devices}

    @property
    def used(self) -> tuple[AnyDevice, ...]:
        """The devices that a run drives, in the same order."""
        return tuple(device for device in self.devices.values() if device.used)

    @property
    def units(self) -> Units:
        """In which units states are shown."""
        return self.limits.units

    def checked_operator(self, text: str) -> str:
        """Return an operator's name in the form to be stored; UsageError with the pattern if it does not match."""
        return _matched(text, self.operator_pattern, "--operator", "operator_pattern")

    def checked_serial(self, text: str) -> str:
        """Return a device's serial number in the form to be stored; UsageError with the pattern if it does not
        match.
        """
        return _matched(text, self.serial_pattern, "--serial-number", "serial_pattern")


def default_bench_text() -> str:
    """Return the bench file that ships with the station."""
    return packaged_text("station.bench", "default_bench.toml")


def load_bench(path: Path | None) -> Bench:
    """Return the bench of a file, or the built-in one for None; BenchError with line and key if it is invalid.

    Plug-ins in a folder ``plugins`` beside the file are imported, too.
    """
    if path is None:
        return read_bench(default_bench_text(), "built-in bench")
    text = read_text(path, BenchError, "a bench file. Give a .toml file")
    return read_bench(text, str(path), path.stem, path.parent, sorted((path.parent / "plugins").glob("*.py")))


def read_bench(
    text: str, file: str, called: str = "bench", folder: Path = Path(), plugins: Sequence[Path] = ()
) -> Bench:
    """Return the bench described by ``text``; BenchError with line and key if it is invalid.

    ``file`` names it in messages, ``called`` is the bench's name if the text has none; paths count from ``folder``.
    ``plugins`` are Python files with devices and effects, in addition to the text's; all are imported and registered.
    """
    top = Table.parse(text, file, BenchError)
    own = top.read("bench.bench", folder)
    name, place = own["name"] or called, own["station"].read_all("bench.station")
    decision = own["decision"].again().read_all("certificate.decision")
    if decision["false_accept"] is not None and decision["rule"] != "guard band":
        raise own["decision"].fail("false_accept", 'is for rule = "guard band"')
    for key in ("laboratory", "procedure", "decision", "equipment"):  # certificates read them in the recording
        for stated in own[key] if key == "equipment" else [own[key]]:
            stated.check(f"certificate.{key}")
    files = (*(folder / listed for listed in own["plugins"] or ()), *plugins)
    try:
        modules = load_files(files)
        kinds = KINDS.beside(modules)
        protocols = {name: kinds[name].protocols.beside(modules, name) for name in kinds if name in top.remaining()}
        imus, tables = IMUS.beside(modules, "imu"), TABLES.beside(modules, "table")
        for module in modules:
            register(*records_of(module, Record), origin=origin_of(module))
    except (PluginError, EffectError) as error:
        raise top.fail("plugins" if own["plugins"] else None, str(error)) from None
    others = [
        read_device(section, folder, kinds[name], known)
        for name, known in protocols.items()
        for section in ([top.table(name)] if kinds[name].single else top.tables(name))
    ]
    top.done()
    bench = Bench(
        name=name,
        text=text,
        site=Site(**own["site"].read_all("bench.site")) if own["site"] else None,
        table=read_table(own["table"], folder, tables),
        imus=_distinct([read_imu(table, folder, imus) for table in own["imu"]]),
        limits=_limits(own["limits"], own["units"]),
        twin=TwinConfig(truths=own["twin"], **own["twin"].read("bench.twin", folder)),
        station=place["name"] or name,
        operator_pattern=place["operator_pattern"],
        serial_pattern=place["serial_pattern"],
        shift_s=place["shift_s"],
        others=tuple(others),
        excluded=_excluded(own["undeclared"]),
        after_run=_command(place["after_run"] or (), folder),
    )
    names = [imu.name for imu in bench.imus]
    if not names or len(set(names)) != len(names):
        raise BenchError(f"{file}: it needs at least one [[imu]], each with a different name; it has {names}")
    for device in others:
        if device.name in NOT_NAMES or [*names, *(other.name for other in others)].count(device.name) > 1:
            raise BenchError(f"{file}: {device.name!r} is already used as a name. Give each device a different name")
    origins = {tables.origin(bench.table.protocol), *(imus.origin(imu.protocol) for imu in bench.imus)}
    origins |= {kinds.origin(device.kind.name) for device in others}
    origins |= {protocols[device.kind.name].origin(device.spec.name) for device in others}
    origins |= {*map(origin_of, modules), *(record.origin for record in records())}
    return replace(bench, plugins=tuple(sorted(origins - {""})), plugin_files=files)


def _command(words: Sequence[str], folder: Path) -> tuple[str, ...]:
    """Return a program and its arguments; empty without one.

    A program whose name has a "/" and no absolute path counts from the folder of the bench file.
    """
    program, *arguments = words or ("",)
    if not program:
        return ()
    is_path = "/" in program and not Path(program).is_absolute()
    return (str((folder / program).absolute()) if is_path else program, *arguments)


def _distinct(imus: Sequence[ImuConfig]) -> tuple[ImuConfig, ...]:
    """Return the devices with sources of different names: a name that occurs twice gets the device's name as prefix.

    Sources that have the name of their device, and devices without stated signals, are left as they are.
    """
    seen = Counter(channel.name for imu in imus if imu.can is not None for channel in imu.can.channels)
    seen.update(imu.name for imu in imus)
    found = []
    for imu in imus:
        if imu.can is not None:
            channels = tuple(
                replace(c, name=f"{imu.name}.{c.name}") if seen[c.name] > 1 and c.name != imu.name else c
                for c in imu.can.channels
            )
            imu = replace(imu, can=replace(imu.can, channels=channels))
        found.append(imu)
    return tuple(found)


def read_limits(text: str) -> Limits:
    """Return the limits of a bench file's text, for instance the one that a recording carries."""
    return _limits(_recorded(text, "limits"), _recorded(text, "units"))


def _limits(table: Table, units: Table) -> Limits:
    """Return the limits of the section with this name, to be compared in the units of another."""
    texts = {key.field or key.name: text for key in keys_of("bench.limits") if (text := table.text_of(key.name))}
    shown = Units(**units.read_all("bench.units"))
    own = table.read_all("bench.limits")
    forces = own.pop("accelerometers")
    return Limits(**own, written=texts, units=shown, forces=_force_limits(forces) if forces else ForceLimits())


def _force_limits(table: Table) -> ForceLimits:
    """Return the limits of the section [limits.accelerometers]."""
    keys = keys_of("bench.force_limits")
    texts = {key.field or key.name: text for key in keys if (text := table.text_of(key.name))}
    return ForceLimits(**table.read_all("bench.force_limits"), written=texts)


def read_excluded(text: str, plugins: Sequence[str] = ()) -> frozenset[str] | None:
    """Return the effects that a bench file's text rules out, None if all; its run knew those of ``plugins``, too."""
    had = f"; the run used {', '.join(plugins) or 'no plug-ins'}; --plugin gives a file"
    return _excluded(_recorded(text, "undeclared"), had)


def excluded_by_file(path: Path) -> frozenset[str] | None:
    """Return the effects that a file rules out, None if all: one with a section undeclared, or with its keys alone.

    Raises BenchError for anything else.
    """
    table = Table.load(path, BenchError, "a file with the section undeclared")
    return _excluded(table.table("undeclared") if table.has("undeclared") else table)


def _recorded(text: str, section: str) -> Table:
    return Table.parse(text, "bench in the recording", BenchError).table(section, optional=True)


def _excluded(table: Table, more: str = "") -> frozenset[str] | None:
    own = table.read_all("bench.undeclared")
    laws = [record.name for record in records() if record.kind is Kind.LAW and record.listed(1.0)]
    excluded = frozenset(own["excluded"] or ())
    for unknown in sorted(excluded.difference(laws)):
        raise table.fail("excluded", f"{unknown!r} is none of {', '.join(laws)}{more}")
    return None if own["effects"] == "none" else excluded


def _matched(text: str, pattern: str, option: str, key: str) -> str:
    kept = text.strip()
    if not kept.isprintable() or not 0 < len(kept) <= _LONGEST_NAME:
        raise UsageError(f"{option} {text!r}: give 1 to {_LONGEST_NAME} printable characters")
    if pattern and not re.fullmatch(pattern, kept):
        raise UsageError(f"{option} {kept!r} does not match the pattern of this bench: {pattern} ({key} in [station])")
    return kept
