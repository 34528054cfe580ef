"""Body rate, Earth rate and gravity in body axes for a chain of gimbals (frames: see the package docstring)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimator.errors import RecordingError
from estimator.types import Floats

EARTH_RATE_RPS = 7.292115e-5
"""Rotation rate of the Earth, 15.041 deg/h (WGS 84)."""
GRAVITY_MPS2 = 9.80665
"""Standard gravity."""
AXES = "xyz"


UNMEASURED_GRAVITY = 5e-5
"""Standard uncertainty of a gravity that is computed from the latitude, relative: anomalies of 50 to 100 mGal."""


UNKNOWN_GRAVITY = 1.5e-3
"""Standard uncertainty of standard gravity for a place that nobody states, relative: 9.780 m/s2 to 9.832 m/s2."""


@dataclass(kw_only=True, frozen=True, slots=True)
class Gravity:
    """Local gravity, its relative standard uncertainty (0 for a stated one), and where it comes from."""

    value_mps2: float
    sd: float
    source: str


def normal_gravity_mps2(latitude_rad: float, height_m: float = 0.0) -> float:
    """Return normal gravity on and above the ellipsoid of WGS 84: Somigliana's formula, and the free-air gradient."""
    square = np.sin(latitude_rad) ** 2
    at_sea_level = 9.7803253359 * (1 + 0.00193185265241 * square) / np.sqrt(1 - 0.00669437999013 * square)
    return float(at_sea_level - 3.086e-6 * height_m)


@dataclass(frozen=True, slots=True)
class Site:
    """Site of the table: geographic latitude, azimuth of the base x axis clockwise from north, height above sea level.

    ``gravity_mps2`` is the local gravity if it was measured or stated; None: normal gravity.
    """

    latitude_rad: float
    heading_rad: float
    height_m: float = 0.0
    gravity_mps2: float | None = None

    @property
    def local_gravity_mps2(self) -> float:
        """The stated local gravity, else normal gravity."""
        if self.gravity_mps2 is not None:
            return self.gravity_mps2
        return normal_gravity_mps2(self.latitude_rad, self.height_m)

    def earth_rate_rps(self) -> Floats:
        """Return Earth rate in the base frame, shape (3,)."""
        cos_lat, sin_lat = np.cos(self.latitude_rad), np.sin(self.latitude_rad)
        return EARTH_RATE_RPS * np.array(
            [cos_lat * np.cos(self.heading_rad), cos_lat * np.sin(self.heading_rad), sin_lat]
        )


def gravity_at(site: Site | None) -> Gravity:
    """Return the gravity of a site: stated, by latitude and height, or standard gravity without a site."""
    if site is None:
        return Gravity(value_mps2=GRAVITY_MPS2, sd=UNKNOWN_GRAVITY, source="standard gravity, no site stated")
    if site.gravity_mps2 is not None:
        return Gravity(value_mps2=site.gravity_mps2, sd=0.0, source="stated")
    return Gravity(value_mps2=site.local_gravity_mps2, sd=UNMEASURED_GRAVITY, source="by latitude and height")


Turn = tuple[int, Floats, Floats]
"""A frame turned about the axis of this number, by angles with these cosines and sines (k,)."""


def turns_of(angles_rad: Floats, gimbals: Sequence[str]) -> list[Turn]:
    """Return the turns of the gimbals at each row of ``angles_rad`` (k, gimbals), outermost first.

    To work out cosines and sines takes most of the time of what is turned by them: whatever is turned by the same
    angles shares them.
    """
    return [
        (AXES.index(axis), np.cos(angles_rad[:, column]), np.sin(angles_rad[:, column]))
        for column, axis in enumerate(gimbals)
    ]


def into_body(
    base_vector: Floats, angles_rad: Floats, gimbals: Sequence[str], turns: Sequence[Turn] | None = None
) -> Floats:
    """Return a base-frame vector (3,) in body axes at each row of ``angles_rad`` (k, gimbals): (k, 3).

    ``turns`` are those of the angles, if they are at hand.
    """
    v = np.broadcast_to(np.asarray(base_vector, dtype=np.float64), (len(angles_rad), 3))
    for turn in turns_of(angles_rad, gimbals) if turns is None else turns:
        v = turn_frame(v, turn)
    return v


def body_rate(
    angles_rad: Floats,
    rates_rps: Floats,
    gimbals: Sequence[str],
    site: Site | None = None,
    turns: Sequence[Turn] | None = None,
) -> Floats:
    """Return the inertial rate of the body in body axes, (k, 3).

    ``angles_rad`` and ``rates_rps`` are (k, gimbals), columns as in ``gimbals``, outermost first. Each gimbal turns the
    frame by its angle and then adds its rate about its own axis. Earth rate is included only if a site is given.
    ``turns`` are those of the angles, if they are at hand.
    """
    start = np.zeros(3) if site is None else site.earth_rate_rps()
    w = np.array(np.broadcast_to(start, (len(angles_rad), 3)))
    for column, turn in enumerate(turns_of(angles_rad, gimbals) if turns is None else turns):
        w = turn_frame(w, turn)
        w[:, turn[0]] += rates_rps[:, column]
    return w


def specific_force(angles_rad: Floats, gimbals: Sequence[str], turns: Sequence[Turn] | None = None) -> Floats:
    """Return the specific force of a table at rest, in body axes and m/s2, shape (k, 3); ``turns`` as for
    ``into_body``.
    """
    return into_body(np.array([0.0, 0.0, GRAVITY_MPS2]), angles_rad, gimbals, turns)


def check_gimbals(gimbals: Sequence[str]) -> tuple[str, ...]:
    """Return the gimbal names as a tuple; RecordingError unless each is x, y or z and none comes twice."""
    names = tuple(str(g) for g in gimbals)
    if not names or len(set(names)) != len(names) or any(g not in AXES or len(g) != 1 for g in names):
        raise RecordingError(f"gimbals must be different ones of x, y, z (outermost first), got {list(names)}")
    return names


def turn_frame(v: Floats, turn: Turn) -> Floats:
    """Return the components of v (k, 3) in a frame that is turned so: R'(angle) v."""
    a, cos, sin = turn
    b, c = (a + 1) % 3, (a + 2) % 3
    out = np.empty_like(v)
    out[:, a] = v[:, a]
    out[:, b] = cos * v[:, b] + sin * v[:, c]
    out[:, c] = cos * v[:, c] - sin * v[:, b]
    return out


def axis_text(direction: Floats | Sequence[float], near: float = 1 - 1e-6) -> str:
    """Return a direction (3,) of any length above 0 in the notation of a mapping file.

    It is ``"-z"``, with the quotes, if the cosine to an axis exceeds ``near``; else the three numbers of the unit
    vector in brackets, to six digits, or two if ``near`` is below 0.999.
    """
    v = np.asarray(direction, dtype=np.float64)
    v = v / np.linalg.norm(v)
    largest = int(np.argmax(np.abs(v)))
    if abs(v[largest]) > near:
        return f'"{"-" if v[largest] < 0 else ""}{"xyz"[largest]}"'
    return "[" + ", ".join(f"{x:{'.2g' if near < 0.999 else '.6g'}}" for x in v) + "]"
