"""The correction of each device, by ``estimator.calibration.compensation``: what is undone, and what is not."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from estimator.calibration.compensation import Compensation, CompensationError, HeldEffect
from estimator.calibration.values import EffectValue, GyroCalibration
from estimator.effects.effect import Acts
from estimator.geometry.array import SensorArray
from station.report.recorded import Recorded
from station.report.traced import Traced, found_of


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """The correction of one device. ``axes_only``: its gyros do not tell a body rate, only rates about their own axes.

    ``not_applied``: effects that are not undone, with the reason.
    """

    device: str
    compensation: Compensation
    axes_only: bool
    not_applied: Mapping[str, str]

    @property
    def held(self) -> tuple[HeldEffect, ...]:
        """Effects that are undone."""
        return tuple(held for held in self.compensation.effects if held.known.called not in self.not_applied)


def corrections_of(recorded: Recorded, traced: Traced | None = None) -> list[Correction]:
    """Return one correction a device: of the calibration, or with the states and effects of an investigation."""
    assert recorded.calibration is not None
    gyros, model = list(recorded.calibration.gyros), recorded.calibration.model
    if traced is not None:
        assert traced.model is not None
        model = traced.model.text()
        labelled = [(gyro, recorded.label(gyro.source, gyro.name)) for gyro in gyros]
        gyros = [_augmented(gyro, label, traced) for gyro, label in labelled if label in traced.names]
    arrays = {name: data.array for name, data in recorded.recording.sources.items()}
    return [_correction(device, own, arrays, model) for device, own in _by_device(gyros).items()]


def _by_device(gyros: Sequence[GyroCalibration]) -> dict[str, list[GyroCalibration]]:
    found: dict[str, list[GyroCalibration]] = {}
    for gyro in gyros:
        found.setdefault(gyro.device or gyro.source, []).append(gyro)
    return found


def _augmented(gyro: GyroCalibration, label: str, traced: Traced) -> GyroCalibration:
    assert traced.model is not None
    values = found_of(traced, label)
    effects = tuple(
        EffectValue(known.called, size.name, value, 0.0, size.unit, size.sd, known.shared)
        for known in traced.model.effects
        for size, value in zip(known.sizes, values.get(known.called, [0.0] * len(known.sizes)), strict=True)
    )
    return replace(gyro, states=traced.states[traced.names.index(label)], effects=effects)


def _correction(device: str, gyros: list[GyroCalibration], arrays: Mapping[str, SensorArray], model: str) -> Correction:
    compensation = Compensation.of(gyros, arrays, model)
    try:
        axes_only = not compensation.solution.size
    except CompensationError:
        axes_only = True
    not_applied = dict(compensation.left_out)
    if axes_only:
        of_the_body = [h for h in compensation.effects if h.acts in (Acts.RATE, Acts.MOTION)]
        not_applied |= {held.known.called: "the rate of the body is not known" for held in of_the_body}
    return Correction(device, compensation, axes_only, not_applied)
