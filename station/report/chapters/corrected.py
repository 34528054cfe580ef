"""The chapter on the correction: nominal axes, and for each device its numbers, effects and code."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from markupsafe import Markup

from drivers.types import Floats
from estimator.calibration.values import Calibration
from estimator.effects.constructed import readable as words
from station.report.chapters.correction import Correction, corrections_of, formula_of, snippet, variables_of_laws
from station.report.chapters.results import States
from station.report.figures import MILLISECONDS, ONE, fixed, parameters, plain
from station.report.investigation_chapter import Traced
from station.report.recorded import Recorded
from station.report.tables import Content, Table, table_of

_AXES = ("sense axis <b>p</b>", "tilt axis <b>j</b>", "tilt axis <b>k</b>")
_SENSITIVITIES = tuple(Markup("<var>g</var><sub>{}</sub>").format(axis) for axis in "xyz")
_OWN_GAIN = Markup("1 − <var>k</var>")
_BIAS = 1  # number of the state


@dataclass(kw_only=True, frozen=True, slots=True)
class EffectsView:
    """The effects that a correction undoes, and the meanings of the variables in their laws."""

    table: Table
    variables: Sequence[str]


@dataclass(kw_only=True, frozen=True, slots=True)
class DeviceView:
    """The correction of one device.

    ``axes_only``: its gyros give only rates about their own axes. ``delay_ms`` is empty if the time stamps have no
    delay. ``not_undone`` are effects with the reason why.
    """

    device: str
    title: str
    axes_only: bool
    numbers: Table
    effects: EffectsView | None
    delay_ms: Markup
    not_undone: Sequence[tuple[str, str]]
    code: str


@dataclass(kw_only=True, frozen=True, slots=True)
class CorrectionView:
    """The corrections of a calibration; ``with_traced`` are those with the effects that an investigation added."""

    axes: Table
    devices: Sequence[DeviceView]
    with_traced: Sequence[DeviceView]


def correction_view(
    recorded: Recorded, calibration: Calibration, *, traced: Traced | None, states: States, data_sha256: str
) -> CorrectionView:
    """Return the axes of all gyros and the corrections of all devices; their code quotes the samples' ``data_sha256``.

    ``with_traced`` is empty unless the investigation added effects and its model has some. ``states`` has the unit of
    the bias.
    """
    origin = f"Recording {recorded.path.name}, SHA-256 of its samples\n{data_sha256}"
    if recorded.joined:
        origin += f"\nJoined with {', '.join(run.path.name for run in recorded.joined[1:])}"
    corrections = corrections_of(recorded)
    augmented = []
    if traced is not None and traced.added and traced.model is not None and traced.model.effects:
        augmented = corrections_of(recorded, traced)
    return CorrectionView(
        axes=_axes_table(recorded, calibration),
        devices=[_device(each, f"Device {each.device}", states, origin) for each in corrections],
        with_traced=[
            _device(each, f"Device {each.device} with the traced effects", states, origin) for each in augmented
        ],
    )


def _axes_table(recorded: Recorded, calibration: Calibration) -> Table:
    """Return a row for each gyro: the stated directions p, j and k of its axes, in the frame that the results refer to.

    That is the frame of the device for a joined calibration, else that in which the device was mounted.
    """
    rows: list[list[Content]] = []
    for gyro in calibration.gyros:
        data = recorded.recording.sources[gyro.source]
        array = data.own_array if recorded.joined else data.array
        number = array.names.index(gyro.name)
        directions = [_direction(axes[number]) for axes in (array.p, array.j, array.k)]
        rows.append([recorded.label(gyro.source, gyro.name), *directions])
    return table_of(["gyro", *map(Markup, _AXES)], "lrrr", rows)


def _direction(axis: Floats) -> Markup:
    """Return the components of an axis; what is nought but for rounding is shown without a sign."""
    components = (fixed(round(value, 9) + 0.0, ONE, 5) for value in axis)
    return Markup("").join(Markup(" &ensp;{}").format(component) for component in components)


def _device(correction: Correction, title: str, states: States, origin: str) -> DeviceView:
    """Return the correction of one device: its numbers, effects, delay, what it cannot undo, and its code in Python.

    ``origin`` and ``title`` stand at the top of the code. Effects are None if there are none; a delay of 0 is
    empty. An effect that is not undone has the reason beside it.
    """
    compensation = correction.compensation
    delay_s = compensation.delay_s
    return DeviceView(
        device=correction.device,
        title=title,
        axes_only=correction.axes_only,
        numbers=_numbers_table(correction, states),
        effects=_effects(correction) if correction.held else None,
        delay_ms=plain(delay_s, MILLISECONDS, 4) if delay_s else Markup(),
        not_undone=[(words(effect), why) for effect, why in correction.not_applied.items()],
        code=snippet(correction, f"{origin}\n{title}"),
    )


def _numbers_table(correction: Correction, states: States) -> Table:
    """Return a row for each gyro: bias, and sensitivities to rates about x, y, z.

    If the correction is ``axes_only``, 1 - k, the gain about its own axis, stands in place of the sensitivities.
    """
    compensation = correction.compensation
    symbol, unit = states[_BIAS]
    gains = [_OWN_GAIN] if correction.axes_only else _SENSITIVITIES
    rows: list[list[Content]] = []
    for row, name in enumerate(compensation.array.names):
        bias = plain(compensation.bias_rps[row], unit, 6)
        rows.append([name, bias, *(fixed(gain, ONE, 7) for gain in _gains(correction, row))])
    return table_of(["gyro", Markup("{}, {}").format(symbol, unit.name), *gains], "lrrrr", rows)


def _gains(correction: Correction, row: int) -> Iterator[float]:
    """Yield the three sensitivities of gyro number ``row``, or with ``axes_only`` its one gain about its axis."""
    compensation = correction.compensation
    if correction.axes_only:
        yield 1 - compensation.states[row, 0]
    else:
        yield from compensation.sensitivity[row]


def _effects(correction: Correction) -> EffectsView:
    rows = list(_effect_rows(correction))
    table = table_of(["effect", "adds to the output", "gyro", "parameters"], "lllr", rows)
    return EffectsView(table=table, variables=variables_of_laws(correction.held))


def _effect_rows(correction: Correction) -> Iterator[list[Content]]:
    for effect in correction.held:
        for row, gyro in enumerate(correction.compensation.array.names):
            values = parameters(effect.known.sizes, effect.values[row])
            yield [words(effect.known.called), formula_of(effect), gyro, values]
