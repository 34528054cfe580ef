"""A device as one record: its name, its links, its keys in a bench file, and how its driver is made.

Such a record stands in the folder of its device, plain facts in spec.toml, the rest beside its driver. The kind of the
device (``drivers.kind.DeviceKind``) has a registry that names them.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

from drivers.packaged import packaged_toml
from drivers.protocols import ImuSource, Turntable
from drivers.types import AxisLimits


@dataclass(frozen=True, slots=True)
class Key:
    """A key in a file written by a person, such as a device's section of a bench file, with a line that explains it.

    - ``kind`` is "text", "texts", "pattern", "path", "link", "date", "flag", "integer", "number", "table", "tables",
      "any", or the quantity measured ("time", "angle"), whose value is then in SI.
    - Without a ``default`` the key may be left out (None), unless it is ``required``.
    - ``one_of`` lists the allowed values; ``bound`` of a number is "above_zero", "not_negative" or "0 to 253", of a
      text "not_blank"; ``told`` is the message for any other value, with {} for it.
    - ``each``: one value for all, or a list with one for each.
    - ``read(text, folder)`` converts a text; the message of its ValueError is shown.
    - ``station init`` asks for the value if ``asked``, and writes ``example`` as a comment for one it leaves out.
    - ``field`` is the name of the attribute, if it differs from ``name``. A table has the sections ``of``; a .toml file
      that a text names has those of ``file``, and is checked before it is read.
    """

    name: str
    kind: str
    doc: str
    default: Any = None
    required: bool = False
    one_of: Collection[Any] = ()
    bound: str = ""
    told: str = ""
    read: Callable[[str, Path], Any] | None = None
    asked: bool = False
    each: bool = False
    field: str = ""
    example: Any = None
    of: Sequence[str] = ()
    file: str = ""


@dataclass(frozen=True, slots=True)
class ProposedImu:
    """Values that ``station init`` proposes, quantities as in a bench file; the noise is typical of the kind."""

    name: str
    rate: str
    arw: str
    bias_instability: str
    array: str = "triad"


@dataclass(frozen=True, slots=True)
class ImuSetup:
    """The bench file's settings of one IMU, for its driver.

    ``options`` are the values of the protocol's keys, ``signals`` those on a CAN bus where a DBC describes them. A
    request is tried twice, each time for ``timeout_s``.
    """

    name: str
    rate_hz: float
    timeout_s: float
    options: Mapping[str, Any] = field(default_factory=dict)
    signals: Any = None


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceSetup:
    """The bench file's settings of one device, for its driver and its twin.

    ``options`` are the values of the protocol's keys, ``settings`` those of the kind's. A request is tried twice, each
    time for ``timeout_s``.
    """

    name: str
    timeout_s: float
    options: Mapping[str, Any] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceSpec:
    """A protocol of devices of one ``kind``.

    ``what`` says which devices speak it, ``link`` is an example of one. It runs on a CAN bus (``on_can``), or on a byte
    link with the ``baud`` rate and ``tcp_port`` that hold if the link states none. ``keys`` stand in the device's
    section of the bench file. ``make(setup, link)`` returns the driver on a FrameLink or ByteLink; a protocol that
    ``opens_links`` itself gets an address instead: (host, port) or SerialPort.

    ``twin(setup, write)`` makes the twin of a device from outside the station; twins of the station's own devices are
    in ``sims``. ``checked_against`` names independent programs or captures that driver and twin were tested with.
    """

    name: str
    kind: str
    what: str
    link: str
    make: Callable[[Any, Any], Any]
    on_can: bool = False
    baud: int = 115_200
    tcp_port: int | None = None
    opens_links: bool = False
    keys: tuple[Key, ...] = ()
    twin: Callable[[Any, Any], Any] | None = None
    checked_against: str = ""

    @property
    def said(self) -> str:
        """What the device is; EXPERIMENTAL first if it was never checked against anything made by others."""
        return f"{'' if self.checked_against else 'EXPERIMENTAL: '}{self.what}"


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuSpec(DeviceSpec):
    """A protocol of devices under test.

    ``rates_hz`` are the legal rates, any if empty; where an option decides, a mapping by the value of the key
    ``rates_by``. ``gyros`` is the number of gyros, None if the signals decide: the bench file then maps signals of a
    DBC (``signals_of_dbc``) or names a description (``described``). ``temperature`` says whether each sample has one.
    ``sims.imus.registry`` has its twin by ``family``, if that is not the name.
    """

    kind: str = "imu"
    make: Callable[[ImuSetup, Any], ImuSource]
    proposed: ProposedImu
    rates_hz: Sequence[float] | Mapping[str, Sequence[float]] = ()
    rates_by: str = ""
    gyros: int | None = 3
    signals_of_dbc: bool = False
    described: bool = False
    temperature: bool = True
    family: str = ""

    def refused_rate(self, rate_hz: float, options: Mapping[str, Any]) -> str:
        """Return a sentence with the legal rates if ``rate_hz`` is none of them, else ""; "" too if any rate is legal.

        ``options`` are those of the device, of which one may decide what is legal.
        """
        chosen = [options[self.rates_by]] if isinstance(self.rates_hz, Mapping) else []
        legal_hz = self.rates_hz[chosen[0]] if isinstance(self.rates_hz, Mapping) else self.rates_hz
        if not legal_hz or rate_hz in legal_hz:
            return ""
        listed = ", ".join(f"{legal:g}" for legal in legal_hz) + " Hz"
        which = f"a whole number of Hz, up to {legal_hz[-1]}" if isinstance(legal_hz, range) else listed
        return " ".join(["protocol", self.name, "sends", *chosen, "at", which])


@dataclass(frozen=True, slots=True)
class AxisSetup:
    """One axis of a table: ``address`` at the controller, encoder counts per turn, limits, values of its own keys.

    ``link`` is that of a drive with its own link, else empty; a driver gets the resolved Address.
    """

    address: int | str
    counts_per_turn: int
    limits: AxisLimits
    link: Any = ""
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class TableSetup:
    """The bench file's settings of the table, for its driver: axes outermost first, values of the protocol's keys.

    A request is tried twice, each time for ``timeout_s``.
    """

    axes: Mapping[str, AxisSetup]
    timeout_s: float
    options: Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class TableSpec(DeviceSpec):
    """A protocol of tables.

    ``address`` is the key of an axis with its address at the controller, None where there is a single one; ``station
    init`` proposes ``addresses`` and ``proposed_counts`` per turn, which must be given unless 0. ``axis_keys`` stand in
    the table of each axis. ``acceleration_step`` (counts/s2) is the unit of which accelerations are multiples. Where
    the protocol ``opens_links`` itself, an axis may have its own link. ``refused(axis, link)`` says why an axis cannot
    be as described, empty if it can. ``limits_trip`` is about its twin: whether drives treat a limit switch as a reason
    to trip.
    """

    kind: str = "table"
    make: Callable[[TableSetup, Any], Turntable]
    most_axes: int = 3
    address: Key | None = None
    addresses: Sequence[str | int] = ("",)
    proposed_counts: int = 0
    axis_keys: tuple[Key, ...] = ()
    acceleration_step: int = 0
    refused: Callable[[AxisSetup, str], str] = lambda axis, link: ""
    limits_trip: bool = False


S = TypeVar("S", bound=DeviceSpec)


def described(kind: type[S], package: str, keys: Mapping[str, Any] | None = None, **more: Any) -> S:
    """Return the record of type ``kind`` from spec.toml of a package; values in ``more`` override those of the file.

    ``keys`` maps names of options (keys of the bench file), the address among them, to further fields of these, such as
    functions that a file cannot hold.
    """
    facts = {**packaged_toml(package, "spec.toml"), **more}
    for part in {"keys", "axis_keys"}.intersection(column.name for column in fields(kind)):
        facts[part] = tuple(Key(**key, **(keys or {}).get(key["name"], {})) for key in facts.get(part, ()))
    if "address" in facts:
        facts["address"] = Key(**facts["address"], **(keys or {}).get(facts["address"]["name"], {}))
    if "proposed" in facts:
        facts["proposed"] = ProposedImu(**facts["proposed"])
    return kind(**facts)
