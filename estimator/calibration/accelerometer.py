"""Calibration of the accelerometers of a source: states, where each one sits, and what another laboratory compares."""

from dataclasses import dataclass, replace

import numpy as np

from estimator.calibration.budget import Contribution
from estimator.geometry.noise import NoiseFound
from estimator.observations.health import Excluded
from estimator.observations.timing import TimeOffset
from estimator.types import Floats

_STEP = 1e-6  # of derivatives: the parameters are smooth in the states


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class AccelerometerCalibration:
    """States of one accelerometer [k, b_mps2, sigma_j_rad, sigma_k_rad], their covariance, the noise of one sample.

    ``p``, ``j`` and ``k_axis`` (3,) are its nominal sense axis and tilt axes in the body. ``place_m`` (3,) is where it
    sits, from the point in which the axes of the table meet, with ``place_covariance_m2`` (3, 3). ``budget`` has the
    parts of ``covariance``: noise first, then each line of type B.
    """

    name: str
    source: str
    device: str
    p: Floats
    j: Floats
    k_axis: Floats
    states: Floats
    covariance: Floats
    noise_mps2: float
    place_m: Floats
    place_covariance_m2: Floats
    budget: tuple[Contribution, ...] = ()
    noise: NoiseFound | None = None

    @property
    def sd(self) -> Floats:
        """Standard deviations of the states (4,)."""
        return np.sqrt(np.diag(self.covariance))

    def line_u(self, name: str) -> Floats:
        """Return the standard uncertainties (4,) from a line of the budget, zero where it is missing."""
        return next((line.u for line in self.budget if line.name == name), np.zeros(4))

    def turned(self, axes: Floats) -> "AccelerometerCalibration":
        """Return it in another frame, in which its own frame has the axes x, y, z in the rows of ``axes`` (3, 3).

        Axes and place are turned; the states belong to the axes and stay.
        """
        return replace(
            self,
            p=self.p @ axes,
            j=self.j @ axes,
            k_axis=self.k_axis @ axes,
            place_m=self.place_m @ axes,
            place_covariance_m2=axes.T @ self.place_covariance_m2 @ axes,
        )

    @property
    def placed(self) -> bool:
        """Whether its place is known: a joined calibration of several mountings has none."""
        return bool(np.isfinite(self.place_m).all())

    @property
    def place_sd_m(self) -> Floats:
        """Standard deviations of the place (3,)."""
        return np.sqrt(np.diag(self.place_covariance_m2))


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class ForceEffectValues:
    """An effect of a model, estimated with the states: its parameters (a, p) by accelerometer, with their sigmas.

    ``parameters`` are their names, in ``unit``. ``about`` says at which temperature or instant the effect is zero, so
    that the states are those there; "" if it depends on neither.
    """

    name: str
    unit: str
    parameters: tuple[str, ...]
    values: Floats
    sd: Floats
    about: str = ""


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Intrinsic:
    """What does not depend on how a device is mounted: sensitivities (a,), offsets (a,), angles between the axes.

    ``pairs`` (q,) names the accelerometers of each angle. Offsets are outputs without force, in m/s2, angles in rad.
    ``sensitivity_sd``, ``offset_sd_mps2`` and ``angle_sd_rad`` are standard deviations. After Geist et al.,
    J. Res. NIST 122.032 (2017).
    """

    names: tuple[str, ...]
    sensitivity: Floats
    sensitivity_sd: Floats
    offset_mps2: Floats
    offset_sd_mps2: Floats
    pairs: tuple[tuple[str, str], ...]
    angle_rad: Floats
    angle_sd_rad: Floats


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class ForceCalibration:
    """The accelerometers of one source.

    ``covariance`` (4 a, 4 a) is that of all states, accelerometer by accelerometer. ``arm_m`` (3,) is the mean place,
    with ``arm_covariance_m2`` (3, 3). ``offset`` is by how much the accelerometers are later than the table's readings.
    ``gravity_mps2`` is the gravity that was assumed, ``gravity_from`` where it comes from. ``doubts`` are notes that
    question the sigmas. ``effects`` are those of the model that was given. ``rest_angle_share`` is how far the axes of
    the table stand off their readings, over how far they would be if they stood anywhere within a count: 0 to 1.
    """

    source: str
    device: str
    accelerometers: tuple[AccelerometerCalibration, ...]
    covariance: Floats
    arm_m: Floats
    arm_covariance_m2: Floats
    gravity_mps2: float
    gravity_from: str = ""
    offset: TimeOffset | None = None
    excluded: tuple[Excluded, ...] = ()
    notes: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    effects: tuple[ForceEffectValues, ...] = ()
    rest_angle_share: float = 0.0

    def turned(self, axes: Floats) -> "ForceCalibration":
        """Return it in another frame, in which its own frame has the axes x, y, z in the rows of ``axes`` (3, 3).

        The accelerometers and the lever arm are turned; states and their covariance stay.
        """
        return replace(
            self,
            accelerometers=tuple(one.turned(axes) for one in self.accelerometers),
            arm_m=self.arm_m @ axes,
            arm_covariance_m2=axes.T @ self.arm_covariance_m2 @ axes,
        )

    @property
    def placed(self) -> bool:
        """Whether it is known where the accelerometers sit."""
        return all(one.placed for one in self.accelerometers)

    @property
    def arm_sd_m(self) -> Floats:
        """Standard deviations of the lever arm (3,)."""
        return np.sqrt(np.diag(self.arm_covariance_m2))

    @property
    def intrinsic(self) -> Intrinsic:
        """Sensitivities (a,), offsets (a,) and angles of all pairs with sigmas, which another laboratory can reproduce.

        Offsets are in m/s2, angles in rad; pairs are first with second, first with third and so on. There must be at
        least one accelerometer.
        """
        states = np.concatenate([one.states for one in self.accelerometers])
        value = self._intrinsic_of(states)
        columns = []
        for place in range(len(states)):
            step = np.zeros(len(states))
            step[place] = _STEP
            columns.append((self._intrinsic_of(states + step) - self._intrinsic_of(states - step)) / (2 * _STEP))
        jacobian = np.column_stack(columns)
        sd = np.sqrt(np.maximum(np.diag(jacobian @ self.covariance @ jacobian.T), 0.0))
        names = tuple(one.name for one in self.accelerometers)
        count = len(names)
        return Intrinsic(
            names=names,
            sensitivity=value[:count],
            sensitivity_sd=sd[:count],
            offset_mps2=value[count : 2 * count],
            offset_sd_mps2=sd[count : 2 * count],
            pairs=tuple((names[i], names[j]) for i in range(count) for j in range(i + 1, count)),
            angle_rad=value[2 * count :],
            angle_sd_rad=sd[2 * count :],
        )

    def _intrinsic_of(self, states: Floats) -> Floats:
        """Return sensitivities, offsets and angles for states (4 a,), one after the other."""
        each = states.reshape(-1, 4)
        rows = np.array([_row(one, own) for one, own in zip(self.accelerometers, each, strict=True)])
        lengths = np.linalg.norm(rows, axis=1)
        angles = [
            np.arccos(np.clip(rows[i] @ rows[j] / (lengths[i] * lengths[j]), -1.0, 1.0))
            for i in range(len(rows))
            for j in range(i + 1, len(rows))
        ]
        return np.concatenate([lengths, -each[:, 1], angles])


def _row(accelerometer: AccelerometerCalibration, states: Floats) -> Floats:
    """Return the sensitivity (3,) of an accelerometer with some states to the force along the body axes."""
    k, _, sigma_j, sigma_k = states
    return np.asarray((1 - k) * (accelerometer.p - sigma_k * accelerometer.j + sigma_j * accelerometer.k_axis))
