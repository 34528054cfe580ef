"""The bench file: what stands in the lab, what it may do, and what counts as a pass."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from drivers.registers import DriveProfile, ProfileError, load_profile
from drivers.seams import AxisLimits
from estimator.array import SensorArray, cone, dodecahedron, sensor_array, tetrahedron, triad
from estimator.errors import GeometryError
from estimator.kinematics import Site
from estimator.model import Prior
from estimator.noise import NoiseModel
from estimator.reference import TableUncertainty
from station.errors import BenchError
from station.tables import Table

STIM300_RATES_HZ = (125, 250, 500, 1000, 2000)


@dataclass(frozen=True, slots=True)
class AxisConfig:
    """One axis of the table: unit id on Modbus, encoder counts a turn, limits."""

    unit_id: int
    counts_per_turn: int
    limits: AxisLimits


@dataclass(frozen=True, slots=True)
class TableConfig:
    """The turntable: link, drive profile, gimbals outermost first, axes by name."""

    link: str
    profile: DriveProfile
    gimbals: tuple[str, ...]
    poll_rate_hz: float
    timeout_s: float
    axes: Mapping[str, AxisConfig]
    uncertainty: TableUncertainty | None

    @property
    def limits(self) -> dict[str, AxisLimits]:
        """Limits by axis."""
        return {name: axis.limits for name, axis in self.axes.items()}


@dataclass(frozen=True, slots=True, eq=False)
class ImuConfig:
    """A device under test: how to reach it, what it is made of, what its data sheet says.

    ``signals`` are the DBC names of rate and temperature of each gyro, for protocol can.
    """

    name: str
    protocol: str
    link: str
    array_name: str
    array: SensorArray
    rate_hz: float
    dbc: Path | None
    signals: tuple[tuple[str, str | None], ...]
    noise: NoiseModel
    prior: Prior
    used: bool

    @property
    def arw_rps_rthz(self) -> float:
        """Angle random walk that the data sheet states."""
        return self.noise.arw


@dataclass(frozen=True, slots=True)
class Limits:
    """What PASS means, in SI: sizes of the states, their sigmas, mean NIS, share of samples lost."""

    k: float
    b_rps: float
    sigma_rad: float
    sd_k: float
    sd_b_rps: float
    sd_sigma_rad: float
    nis_low: float
    nis_high: float
    lost: float


@dataclass(frozen=True, slots=True)
class TwinConfig:
    """What only twins read: seed, watchdog, the table of truths, unread; what is hidden from the station.

    Temperature and hidden effects follow a clock that stands at ``started_s`` when the loop's stands at 0.
    """

    seed: int
    watchdog_s: float
    truths: Table
    hidden: Path | None = None
    started_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Bench:
    """A whole bench, and the text of its file."""

    name: str
    text: str
    site: Site | None
    table: TableConfig
    imus: tuple[ImuConfig, ...]
    limits: Limits
    twin: TwinConfig


def default_bench_text() -> str:
    """Return the bench file that ships with the station."""
    return resources.files("station").joinpath("default_bench.toml").read_text(encoding="utf-8")


def load_bench(path: Path | None) -> Bench:
    """Read a bench file, or the built-in one; BenchError with line and key for what is wrong."""
    if path is None:
        text, file, folder = default_bench_text(), "built-in bench", Path()
    else:
        try:
            text, file, folder = path.read_text(encoding="utf-8"), str(path), path.parent
        except (OSError, UnicodeDecodeError) as error:
            raise BenchError(f"cannot read bench file {path}: {error}") from None
    top = Table.parse(text, file, BenchError)
    bench = Bench(
        name=top.string("name", path.stem if path else "bench"),
        text=text,
        site=_site(top),
        table=_table(top.table("table"), folder),
        imus=tuple(_imu(t, folder) for t in top.tables("imu")),
        limits=_limits(top.table("limits", optional=True)),
        twin=_twin(top.table("twin", optional=True), folder),
    )
    top.done()
    names = [imu.name for imu in bench.imus]
    if not names or len(set(names)) != len(names):
        raise BenchError(f"{file}: it needs one [[imu]] or more, each with a name of its own; it has {names}")
    return bench


def read_limits(text: str) -> Limits:
    """Return the limits of a bench file's text, for instance the one that a recording carries."""
    return _limits(Table.parse(text, "bench in the recording", BenchError).table("limits", optional=True))


def _site(top: Table) -> Site | None:
    if not top.has("site"):
        return None
    table = top.table("site")
    site = Site(table.quantity("latitude", "angle"), table.quantity("heading", "angle", 0.0))
    if abs(site.latitude_rad) > math.pi / 2:
        raise table.fail("latitude", "beyond the poles: give -90 deg to 90 deg")
    table.done()
    return site


def _table(table: Table, folder: Path) -> TableConfig:
    try:
        name = table.string("profile", "kinco")
        profile = load_profile(str(folder / name) if name.endswith(".toml") else name)
    except ProfileError as error:
        raise table.fail("profile", str(error)) from None
    gimbals = table.value("gimbals", ["z", "y", "x"])
    if (
        not isinstance(gimbals, list)
        or not gimbals
        or len(set(map(str, gimbals))) != len(gimbals)
        or not all(g in ("x", "y", "z") for g in gimbals)
    ):
        raise table.fail("gimbals", f"must list different ones of x, y, z, outermost first; got {gimbals}")
    config = TableConfig(
        link=table.string("link", "twin:"),
        profile=profile,
        gimbals=tuple(gimbals),
        poll_rate_hz=table.quantity("poll_rate", "frequency", 20.0),
        timeout_s=table.quantity("timeout", "time", 0.2),
        axes={axis: _axis(table.table(axis)) for axis in gimbals},
        uncertainty=_uncertainty(table.table("uncertainty")) if table.has("uncertainty") else None,
    )
    if not 1 <= config.poll_rate_hz <= 1000:
        raise table.fail("poll_rate", f"{config.poll_rate_hz:g} Hz; give 1 Hz to 1000 Hz")
    if config.timeout_s <= 0:
        raise table.fail("timeout", "must be above zero")
    table.done()
    return config


def _uncertainty(table: Table) -> TableUncertainty:
    found = TableUncertainty(
        rate=table.quantity("rate", "ratio", 0.0),
        wobble_rad=table.quantity("wobble", "angle", 0.0),
        orthogonality_rad=table.quantity("orthogonality", "angle", 0.0),
        timing_s=table.quantity("timing", "time", 0.0),
    )
    if min(found.rate, found.wobble_rad, found.orthogonality_rad, found.timing_s) < 0:
        raise table.fail(None, "a standard uncertainty is not negative")
    table.done()
    return found


def _axis(table: Table) -> AxisConfig:
    axis = AxisConfig(
        unit_id=table.integer("unit_id"),
        counts_per_turn=table.integer("counts_per_turn"),
        limits=AxisLimits(table.quantity("max_rate", "rate"), table.quantity("max_acceleration", "acceleration")),
    )
    if not 1 <= axis.unit_id <= 247:
        raise table.fail("unit_id", f"{axis.unit_id} is no Modbus unit id: give 1 to 247")
    if axis.counts_per_turn < 1:
        raise table.fail("counts_per_turn", "must be 1 or more")
    if axis.limits.rate_rps <= 0 or axis.limits.acceleration_rps2 <= 0:
        raise table.fail(None, "max_rate and max_acceleration must be above zero")
    table.done()
    return axis


def _imu(table: Table, folder: Path) -> ImuConfig:
    name = table.string("name")
    if name in ("table", "seed", "watchdog", "start", "fault", "hidden", "started"):
        raise table.fail("name", f"{name!r} means something else on a bench: take another name")
    protocol = table.string("protocol", one_of=("can", "stim300"))
    array_name, array = _array(table, name)
    rate_hz = table.quantity("rate", "frequency")
    if rate_hz <= 0:
        raise table.fail("rate", "must be above zero")
    dbc, signals = None, ()  # type: tuple[Path | None, tuple[tuple[str, str | None], ...]]
    if protocol == "can":
        if table.has("dbc"):
            dbc = folder / table.string("dbc")
        signals = _signals(table, len(array))
    else:
        if rate_hz not in STIM300_RATES_HZ:
            raise table.fail("rate", f"a STIM300 sends at {', '.join(map(str, STIM300_RATES_HZ))} Hz")
        if len(array) != 3:
            raise table.fail("array", f"a STIM300 has three gyros, this array {len(array)}")
    sheet = table.table("datasheet")
    prior = Prior(
        k=sheet.quantity("scale_factor_error", "ratio", 0.05),
        b_rps=sheet.quantity("bias", "rate", math.radians(1.0)),
        sigma_rad=sheet.quantity("misalignment", "angle", 0.02),
    )
    noise = NoiseModel(
        sheet.quantity("arw", "angle random walk"),
        sheet.quantity("bias_instability", "rate", 0.0),
        sheet.quantity("rate_random_walk", "rate random walk", 0.0),
    )
    if min(prior.k, prior.b_rps, prior.sigma_rad, noise.arw) <= 0 or min(noise.instability, noise.walk) < 0:
        raise sheet.fail(None, "every value must be above zero")
    sheet.done()
    config = ImuConfig(
        name,
        protocol,
        table.string("link", "twin:"),
        array_name,
        array,
        rate_hz,
        dbc,
        signals,
        noise,
        prior,
        table.flag("used", True),
    )
    table.done()
    return config


def _array(table: Table, device: str) -> tuple[str, SensorArray]:
    explicit = table.has("p")
    try:
        if explicit:
            p, j, k = table.value("p"), table.value("j"), table.value("k")
            names = [f"gyro{i + 1}" for i in range(len(p) if isinstance(p, list) else 0)]
            return "explicit", sensor_array(p, j, k, names=names)
        kind = table.string("array", one_of=("triad", "tetrahedron", "dodecahedron", "cone"))
        if kind == "cone":
            return kind, cone(table.integer("gyros"), table.quantity("half_angle", "angle"))
        return kind, {"triad": triad, "tetrahedron": tetrahedron, "dodecahedron": dodecahedron}[kind]()
    except GeometryError as error:
        raise table.fail("p" if explicit else "array", f"{device}: {error}") from None


def _signals(table: Table, count: int) -> tuple[tuple[str, str | None], ...]:
    signals: list[tuple[str, str | None]] = []
    for channel in table.tables("channels"):
        rate = channel.string("rate")
        temperature = channel.string("temperature") if channel.has("temperature") else None
        channel.done()
        signals.append((rate, temperature))
    if len(signals) != count:
        raise table.fail("channels", f"{len(signals)} channels for an array of {count} gyros")
    return tuple(signals)


def _limits(table: Table) -> Limits:
    limits = Limits(
        k=table.quantity("scale_factor_error", "ratio", math.inf),
        b_rps=table.quantity("bias", "rate", math.inf),
        sigma_rad=table.quantity("misalignment", "angle", math.inf),
        sd_k=table.quantity("sd_scale_factor_error", "ratio", math.inf),
        sd_b_rps=table.quantity("sd_bias", "rate", math.inf),
        sd_sigma_rad=table.quantity("sd_misalignment", "angle", math.inf),
        nis_low=table.number("nis_low", 0.0),
        nis_high=table.number("nis_high", math.inf),
        lost=table.quantity("lost", "ratio", 1.0),
    )
    table.done()
    return limits


def _twin(table: Table, folder: Path) -> TwinConfig:
    seed = table.integer("seed", 0)
    if seed < 0:
        raise table.fail("seed", "must not be negative")
    watchdog_s = table.quantity("watchdog", "time", 1.0)
    hidden = folder / table.string("hidden") if table.has("hidden") else None
    return TwinConfig(seed, watchdog_s, table, hidden, table.quantity("started", "time", 0.0))
