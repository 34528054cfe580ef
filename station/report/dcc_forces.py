"""Accelerometers of a digital calibration certificate: results as lists of quantities with D-SI units."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from estimator.calibration.accelerometer import AccelerometerCalibration, ForceCalibration, Intrinsic
from estimator.calibration.gyro import GyroCalibration
from estimator.estimation.accelerometers.force_effects import BY_NAME
from estimator.sensors.accelerometers import ACCELEROMETER
from estimator.types import Floats
from station.errors import sentence
from station.report.figures import COVERAGE
from station.report.recorded import Recorded

_ACCELERATION = r"\metre\second\tothe{-2}"
_STATES = {
    "k": ("scale factor error k", r"\one"),
    "b_mps2": ("bias b", _ACCELERATION),
    "sigma_j_rad": ("misalignment sigma_j", r"\radian"),
    "sigma_k_rad": ("misalignment sigma_k", r"\radian"),
}


@dataclass(kw_only=True, frozen=True, slots=True)
class Quantity:
    """A value with its expanded uncertainty, both in ``unit`` of D-SI; where that has none, ``words`` state both."""

    name: str
    value: float
    unit: str
    expanded: float
    words: str = ""


@dataclass(kw_only=True, frozen=True, slots=True)
class QuantityList:
    """Quantities that belong together; ``description`` says how they are defined, if their names do not."""

    name: str
    quantities: tuple[Quantity, ...]
    description: str = ""


@dataclass(kw_only=True, frozen=True, slots=True)
class ForceResult:
    """One result of a certificate; ``id`` is unique within it, ``description`` says what signs and axes mean."""

    id: str
    name: str
    lists: tuple[QuantityList, ...]
    description: str = ""


def force_results(forces: tuple[ForceCalibration, ...], before: str, dsi: Mapping[str, str]) -> list[ForceResult]:
    """Return the results of the accelerometers, source by source: one for each of them, then one for the triad.

    That of an accelerometer lists its states, its place, and its effects if it has any; that of the triad see
    ``_triad``. Sources without a calibrated accelerometer are left out. ``before`` begins the ids. ``dsi`` has the
    units of effects in D-SI by their SI names.
    """
    found = []
    for number, one in enumerate(forces):
        if not one.accelerometers:
            continue
        device = one.device or one.source
        for place, accelerometer in enumerate(one.accelerometers):
            lists = [_states(accelerometer), _place(accelerometer)]
            lists += _effects(one, place, dsi)
            name = f"Accelerometer {accelerometer.name} of {device}"
            p, j, k = _components(accelerometer.p, accelerometer.j, accelerometer.k_axis)
            found.append(
                ForceResult(
                    id=f"{before}Force{number}x{place}",
                    name=name,
                    lists=tuple(lists),
                    description=sentence("report.dcc_accelerometer", p=p, j=j, k=k),
                )
            )
        name = f"Accelerometers of {device}, independent of the mounting"
        found.append(ForceResult(id=f"{before}Triad{number}", name=name, lists=tuple(_triad(one))))
    return found


def gyro_definition(recorded: Recorded, gyro: GyroCalibration) -> str:
    """Return what the signs of the states of a gyro mean, and its nominal axes in the body."""
    array = recorded.recording.sources[gyro.source].array
    place = array.names.index(gyro.name)
    p, j, k = _components(array.p[place], array.j[place], array.k[place])
    return sentence("report.dcc_gyro", p=p, j=j, k=k)


def _components(*axes: Floats) -> list[str]:
    """Return the components of each axis (3,) as a text in parentheses."""
    return ["(" + ", ".join(f"{round(x, 9) + 0.0:.9g}" for x in axis.tolist()) + ")" for axis in axes]


def _quantity(name: str, value: float, unit: str, sd: float) -> Quantity:
    return Quantity(name=name, value=float(value), unit=unit, expanded=COVERAGE * float(sd))


def _states(accelerometer: AccelerometerCalibration) -> QuantityList:
    """Return the states of an accelerometer: k, b, sigma_j and sigma_k."""
    rows = zip(ACCELEROMETER.keys, accelerometer.states, accelerometer.sd, strict=True)
    return QuantityList(
        name="States", quantities=tuple(_quantity(_STATES[key][0], x, _STATES[key][1], sd) for key, x, sd in rows)
    )


def _place(accelerometer: AccelerometerCalibration) -> QuantityList:
    """Return where an accelerometer sits, in m along x, y and z."""
    rows = zip("xyz", accelerometer.place_m, accelerometer.place_sd_m, strict=True)
    return QuantityList(
        name="Place, from the point in which the axes of the table meet",
        quantities=tuple(_quantity(axis, x, r"\metre", sd) for axis, x, sd in rows),
    )


def _effects(calibration: ForceCalibration, place: int, dsi: Mapping[str, str]) -> Iterator[QuantityList]:
    """Yield the parameters of the effects of accelerometer number ``place``, as one list; nothing if there are none.

    ``dsi`` has the D-SI name of each unit. A parameter whose unit is not in it gets an empty unit, and its ``words``
    state value, SI unit and expanded uncertainty. The description says what each parameter adds to the output.
    """
    quantities: list[Quantity] = []
    for effect in calibration.effects:
        called = effect.name.replace("_", " ") + (f" ({effect.about})" if effect.about else "")
        for name, x, sd in zip(effect.parameters, effect.values[place], effect.sd[place], strict=True):
            own = _quantity(f"{called}, {name}", x, dsi.get(effect.unit, ""), sd)
            words = f"{own.value} {effect.unit}, expanded uncertainty (k = {COVERAGE:g}) {own.expanded} {effect.unit}"
            quantities.append(own if own.unit else replace(own, words=words))
    if quantities:
        adds = "; ".join(
            f"{effect.name.replace('_', ' ')}, {name}: {added}"
            for effect in calibration.effects
            for name, added in zip(effect.parameters, BY_NAME[effect.name].adds, strict=True)
        )
        description = sentence("report.dcc_effects", adds=adds)
        yield QuantityList(name="Effects", quantities=tuple(quantities), description=description)


def _triad(calibration: ForceCalibration) -> Iterator[QuantityList]:
    """Yield a list each of sensitivities, offsets and angles (Geist et al. 2017), and of the delay if it is known.

    The delay is that of the outputs after the readings of the table, in s.
    """
    found: Intrinsic = calibration.intrinsic
    sensitivities = zip(found.names, found.sensitivity, found.sensitivity_sd, strict=True)
    offsets = zip(found.names, found.offset_mps2, found.offset_sd_mps2, strict=True)
    angles = zip(found.pairs, found.angle_rad, found.angle_sd_rad, strict=True)
    yield QuantityList(
        name="Sensitivities", quantities=tuple(_quantity(name, x, r"\one", sd) for name, x, sd in sensitivities)
    )
    yield QuantityList(
        name="Offsets",
        quantities=tuple(_quantity(name, x, _ACCELERATION, sd) for name, x, sd in offsets),
        description=sentence("report.dcc_offset"),
    )
    yield QuantityList(
        name="Angles between the axes",
        quantities=tuple(_quantity(f"{first} to {second}", x, r"\radian", sd) for (first, second), x, sd in angles),
    )
    if calibration.offset is not None:
        delay = _quantity(
            "after the readings of the table", calibration.offset.offset_s, r"\second", calibration.offset.sd_s
        )
        yield QuantityList(name="Delay of the outputs", quantities=(delay,))
