"""All hidden effects of a table and its gyros, and the file that states them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

from sims.physics.hidden.converter import KINDS as CONVERTER
from sims.physics.hidden.fields import HiddenError, check, read, refuse_unknown
from sims.physics.hidden.outputs import KINDS as OUTPUTS
from sims.physics.hidden.table import KINDS as TABLE, OfTable, TableFaults
from sims.physics.hidden.temperature import Temperature
from sims.physics.hidden.timing import KINDS as TIMING

KINDS = OUTPUTS | TIMING | CONVERTER | TABLE
"""Effects by the name of their table in the file."""


@dataclass(frozen=True, slots=True, eq=False)
class Hidden:
    """The hidden errors, in SI: effects, and the temperature (None: that of the devices' truth).

    ``devices`` are those whose gyros have the effects, None for all. Effects of the table apply to all.
    """

    effects: tuple[object, ...] = ()
    temperature: Temperature | None = None
    devices: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        """Check effects and temperature; HiddenError for an invalid one, and for what is no hidden effect."""
        for effect in self.effects:
            if type(effect) not in KINDS.values():
                raise HiddenError(f"{effect!r} is no hidden effect")
            check(effect)
        if self.temperature is not None:
            check(self.temperature)

    @classmethod
    def of(cls, tables: Mapping[str, object]) -> Self:
        """Return the effects described by tables of texts with units, by name.

        HiddenError, which begins with table and key, for an invalid or unknown one. An effect that occurs several times
        is a list of tables, named in errors by its index: "tone.1". "devices" is a list of names, not a table.
        """
        refuse_unknown(tables, dict.fromkeys(("devices", Temperature.name, *KINDS)), "hidden effects")
        effects: list[object] = []
        for name, kind in KINDS.items():
            if name in tables:
                value = tables[name]
                several = enumerate(value) if isinstance(value, list | tuple) else [("", value)]
                effects.extend(read(kind, one, f"{name}.{place}".rstrip(".")) for place, one in several)
        temperature = read(Temperature, tables["temperature"], "temperature") if "temperature" in tables else None
        return cls(tuple(effects), temperature, _devices(tables.get("devices")))

    def of_device(self, name: str) -> Self:
        """Return the hidden effects of this device; those of gyros and temperature only if it is among the devices.

        Effects of the table are there in any case. Without a list of devices all are among them.
        """
        if self.devices is None or name in self.devices:
            return self
        return replace(self, effects=self.table.effects, temperature=None)

    @property
    def table(self) -> TableFaults:
        """The faults of the table."""
        return TableFaults(tuple(e for e in self.effects if isinstance(e, OfTable)))

    @property
    def of_gyros(self) -> tuple[object, ...]:
        """Effects of the gyros."""
        return tuple(e for e in self.effects if not isinstance(e, OfTable))


def _devices(stated: object) -> tuple[str, ...] | None:
    if stated is None:
        return None
    if not isinstance(stated, list | tuple) or not all(isinstance(name, str) for name in stated):
        raise HiddenError("devices: must be a list of names")
    return tuple(stated)
