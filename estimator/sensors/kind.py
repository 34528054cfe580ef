"""What the station has to know of a kind of sensor: its input, its output, its states."""

from dataclasses import dataclass


@dataclass(kw_only=True, frozen=True, slots=True)
class State:
    """One state of a sensor.

    ``key`` names it in files and in JSON, with the unit; ``symbol`` in tables and notes. ``meaning`` is the text that
    goes before the symbol in a sentence. ``unit`` is that of SI, "1" for a ratio.
    """

    key: str
    symbol: str
    meaning: str
    unit: str

    @property
    def text(self) -> str:
        """Its meaning and symbol: "bias b"."""
        return f"{self.meaning} {self.symbol}"


@dataclass(kw_only=True, frozen=True, slots=True)
class SensorKind:
    """A kind of sensor that has one sense axis.

    All kinds have one form of model (``estimator.geometry.model``): ``input`` is the vector that is sensed, in
    ``unit``, which is the unit of the output too. ``white_unit`` is that of its white noise.
    """

    name: str
    plural: str
    input: str
    unit: str
    white_unit: str
    states: tuple[State, ...]

    @property
    def keys(self) -> tuple[str, ...]:
        """Names of the states in files, in the order of every vector and matrix of states."""
        return tuple(state.key for state in self.states)

    @property
    def units(self) -> tuple[str, ...]:
        """SI units of the states."""
        return tuple(state.unit for state in self.states)
