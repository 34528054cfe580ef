"""A device as one record: what it is called, how it is reached, what a bench file says of it, how its driver is made.

Such a record stands in the folder of its device, plain facts in spec.toml, the rest beside its driver;
``drivers.imus.registry`` and ``drivers.tables.registry`` name them.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from drivers.packaged import packaged_toml
from drivers.protocols import ImuSource, Turntable
from drivers.types import AxisLimits


@dataclass(frozen=True, slots=True)
class Key:
    """A key of a file that a person writes, as of a device in a bench file, with a line that says what it means.

    ``kind`` is "text", "texts", "pattern", "path", "link", "date", "flag", "integer", "number", "table", "tables",
    "any", or what a quantity measures ("time", "angle"); its value is then in SI. Without a ``default`` it may be left
    out (None), unless it is ``required``. ``one_of`` are the values that it may have; ``bound`` of a number is
    "above_zero", "not_negative", or "0 to 253", of a text "not_blank"; ``told`` is said of others, with {} for them. Of
    an ``each`` there may be one for all, or a list of one each. ``read`` makes something else of a text, given the
    folder of the file; its ValueError is told. ``station init`` asks for the value of one that is ``asked``, and shows
    an ``example`` of one that it leaves out. It becomes the ``field``, if that has another name; a table has the
    sections that it is ``of``, and a .toml that a text names those of the ``file``, which is checked before it is read.
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
    """What ``station init`` proposes, quantities as in a bench file; the noise is typical of its kind."""

    name: str
    rate: str
    arw: str
    bias_instability: str
    array: str = "triad"


@dataclass(frozen=True, slots=True)
class ImuSetup:
    """What the bench says of one IMU, for its driver.

    ``options`` are the values of the protocol's keys, ``signals`` those on a CAN bus where a DBC describes them.
    ``timeout_s`` is for one try of a question, of which there are two.
    """

    name: str
    rate_hz: float
    timeout_s: float
    options: Mapping[str, Any] = field(default_factory=dict)
    signals: Any = None


def _said(spec: Any) -> str:
    return f"{'' if spec.checked_against else 'EXPERIMENTAL: '}{spec.what}"


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuSpec:
    """A protocol of devices under test.

    ``what`` says which devices speak it, ``link`` is an example of one. It is on a CAN bus, or on a byte link with
    this ``baud`` rate and ``tcp_port`` if the link states none. ``rates_hz`` are the legal rates, any if empty; where
    an option decides, they are by the value of the key ``rates_by``. ``gyros`` is how many it has, None if that is
    said by its signals: the bench file then maps those of a DBC (``signals_of_dbc``), or names a description
    (``described``). ``temperature`` says whether
    each sample has one. ``make`` gives the driver on a link, for CAN on a FrameLink, else on a ByteLink.

    ``twin`` makes the twin of a device from outside the station; those of its own are in ``sims.imus.registry``, by
    ``family`` if that is not the name. ``checked_against`` names what others made that driver and twin have met.
    """

    name: str
    what: str
    link: str
    make: Callable[[ImuSetup, Any], ImuSource]
    proposed: ProposedImu
    on_can: bool = False
    baud: int = 115_200
    tcp_port: int | None = None
    rates_hz: Sequence[float] | Mapping[str, Sequence[float]] = ()
    rates_by: str = ""
    gyros: int | None = 3
    signals_of_dbc: bool = False
    described: bool = False
    temperature: bool = True
    keys: tuple[Key, ...] = ()
    twin: Callable[[Any, Any], Any] | None = None
    family: str = ""
    checked_against: str = ""
    opens_links: ClassVar[bool] = False
    said = property(_said, doc="What it is; EXPERIMENTAL first, where it has met nothing that somebody else made.")

    def refused_rate(self, rate_hz: float, options: Mapping[str, Any]) -> str:
        """Return which rates a device with these options has, if this is none of them, else nothing."""
        chosen = [options[self.rates_by]] if isinstance(self.rates_hz, Mapping) else []
        legal_hz = self.rates_hz[chosen[0]] if isinstance(self.rates_hz, Mapping) else self.rates_hz
        if not legal_hz or rate_hz in legal_hz:
            return ""
        listed = ", ".join(f"{legal:g}" for legal in legal_hz) + " Hz"
        which = f"a whole number of Hz, up to {legal_hz[-1]}" if isinstance(legal_hz, range) else listed
        return " ".join(["protocol", self.name, "sends", *chosen, "at", which])


@dataclass(frozen=True, slots=True)
class AxisSetup:
    """One axis of a table: its ``address`` at the controller, encoder counts a turn, limits, values of its own keys.

    ``link`` is that of a drive with one of its own, else empty; a driver is given the Address that it means.
    """

    address: int | str
    counts_per_turn: int
    limits: AxisLimits
    link: Any = ""
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class TableSetup:
    """What the bench says of the table, for its driver: axes outermost first, values of the protocol's keys.

    A request is tried twice, each for ``timeout_s``.
    """

    axes: Mapping[str, AxisSetup]
    timeout_s: float
    options: Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class TableSpec:
    """A protocol of tables.

    ``what`` says which controllers speak it, ``link`` is an example of one; ``baud`` and ``tcp_port`` hold for links
    that state none. ``address`` is the key of an axis that says which it is at the controller, None where there is
    but one; ``station init`` proposes ``addresses`` and ``proposed_counts`` a turn, which must be given unless 0.
    ``keys`` stand in [table], ``axis_keys`` in the table of each axis. ``acceleration_step`` in counts/s2 is what
    accelerations are multiples of. ``make`` gives the driver on a ByteLink or, where it ``opens_links`` itself and an
    axis may have one of its own, at an Address: (host, port) or SerialPort. ``refused`` says what else cannot be.

    Of its twin: ``limits_trip`` says whether drives know a limit switch only as a reason to trip; ``twin`` makes one
    from outside the station, those of its own are in ``sims.tables.registry``. ``checked_against`` is as of an ImuSpec.
    """

    name: str
    what: str
    link: str
    make: Callable[[TableSetup, Any], Turntable]
    baud: int = 115_200
    tcp_port: int | None = None
    most_axes: int = 3
    address: Key | None = None
    addresses: Sequence[str | int] = ("",)
    proposed_counts: int = 0
    keys: tuple[Key, ...] = ()
    axis_keys: tuple[Key, ...] = ()
    acceleration_step: int = 0
    opens_links: bool = False
    refused: Callable[[AxisSetup, str], str] = lambda axis, link: ""
    limits_trip: bool = False
    checked_against: str = ""
    on_can: ClassVar[bool] = False
    said = property(_said, doc="As of an ImuSpec.")
    twin: Callable[[Any, Any], Any] | None = None


S = TypeVar("S", ImuSpec, TableSpec)


def described(kind: type[S], package: str, keys: Mapping[str, Any] | None = None, **more: Any) -> S:
    """Return the record whose plain facts are in spec.toml of a package; ``keys`` adds to those of its keys."""
    facts = {**packaged_toml(package, "spec.toml"), **more}
    for part in ("keys", "axis_keys") if kind is TableSpec else ("keys",):
        facts[part] = tuple(Key(**key, **(keys or {}).get(key["name"], {})) for key in facts.get(part, ()))
    if "address" in facts:
        facts["address"] = Key(**facts["address"], **(keys or {}).get(facts["address"]["name"], {}))
    if "proposed" in facts:
        facts["proposed"] = ProposedImu(**facts["proposed"])
    return kind(**facts)
