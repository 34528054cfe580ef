"""A device as one record: what it is called, how it is reached, what a bench file says of it, how its driver is made.

Such a record stands in the folder of its device; ``drivers.imus.registry`` and ``drivers.tables.registry`` name them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from drivers.protocols import ImuSource


@dataclass(frozen=True, slots=True)
class Key:
    """A key of a device in a bench file, with a line that says what it means.

    ``kind`` is "text", "flag", "integer", "number", or what a quantity measures ("time", "angle"); its value is then
    in SI. Without a ``default`` it may be left out (None), unless it is ``required``. ``one_of`` are the values that it
    may have, ``low`` and ``high`` the bounds of an integer; ``noun`` is what such a number is called, ``unit`` what it
    is in. ``bound`` of a quantity is "above_zero" or "not_negative".
    """

    name: str
    kind: str
    doc: str
    default: Any = None
    required: bool = False
    one_of: Collection[Any] = ()
    low: int | None = None
    high: int | None = None
    noun: str = ""
    unit: str = ""
    bound: str = ""


CONFIGURE = Key("configure", "flag", "false: the station does not set it up; it must send as it should already", True)


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
    ``family`` if that is not the name.
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

    def refused_rate(self, rate_hz: float, options: Mapping[str, Any]) -> str:
        """Return which rates a device with these options has, if this is none of them, else nothing."""
        chosen = [options[self.rates_by]] if isinstance(self.rates_hz, Mapping) else []
        legal_hz = self.rates_hz[chosen[0]] if isinstance(self.rates_hz, Mapping) else self.rates_hz
        if not legal_hz or rate_hz in legal_hz:
            return ""
        listed = ", ".join(f"{legal:g}" for legal in legal_hz) + " Hz"
        which = f"a whole number of Hz, up to {legal_hz[-1]}" if isinstance(legal_hz, range) else listed
        return " ".join(["protocol", self.name, "sends", *chosen, "at", which])
