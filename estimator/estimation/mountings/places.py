"""The gravity of the places at which runs of one device were made."""

from collections.abc import Sequence
from dataclasses import dataclass

from estimator.geometry.kinematics import Gravity, Site, gravity_at
from estimator.packaged import sentence
from estimator.recordings.recording import Recording


@dataclass(kw_only=True, frozen=True, slots=True)
class Places:
    """The gravity of each place; ``of_run`` is the number of the place of each run."""

    gravity: tuple[Gravity, ...]
    of_run: tuple[int, ...]

    @property
    def source(self) -> str:
        """Where gravity comes from, at all places."""
        return ", ".join(dict.fromkeys(gravity.source for gravity in self.gravity))


def places_of(sites: Sequence[Site | None]) -> Places:
    """Return the places of runs: the errors of gravity at one place are one error.

    The first site of a place stands for it; ``of_run`` has the number of each run's place. Sites are one place if their
    gravity has the same source, and differs by no more than its standard uncertainty.
    """
    gravity: list[Gravity] = []
    of_run: list[int] = []
    for site in sites:
        own = gravity_at(site)
        same = (number for number, other in enumerate(gravity) if _one_place(own, other))
        place = next(same, len(gravity))
        if place == len(gravity):
            gravity.append(own)
        of_run.append(place)
    return Places(gravity=tuple(gravity), of_run=tuple(of_run))


def gravity_notes(recordings: Sequence[Recording]) -> list[str]:
    """Return a sentence that names gravity by recording; an empty list if all have the same, to five decimals."""
    names: dict[str, list[str]] = {}
    for one in recordings:
        names.setdefault(f"{gravity_at(one.site).value_mps2:.5f} m/s2", []).append(one.name)
    if len(names) < 2:
        return []
    values = ", ".join(f"{value} ({', '.join(own)})" for value, own in names.items())
    return [sentence("estimation.joined_gravity", values=values)]


def _one_place(one: Gravity, other: Gravity) -> bool:
    """Return whether two gravities have the same error."""
    return one.source == other.source and abs(one.value_mps2 - other.value_mps2) <= one.sd * other.value_mps2
