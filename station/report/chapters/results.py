"""The results: states with their uncertainties, effects beside them, the device as found and as left."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from estimator.calibration.gyro import GyroCalibration
from estimator.calibration.values import Calibration
from estimator.effects.constructed import readable as words
from station.report.chapters.unobserved_effects import Unseen
from station.report.document_status import Standing
from station.report.figures import COVERAGE, ONE, Unit, plain, with_uncertainty, worded
from station.report.investigation_chapter import Traced
from station.report.recorded import Recorded
from station.report.tables import Content, Table, grouped_table, table_of
from station.run.outcome import Outcome

States = Sequence[tuple[Markup, Unit]]
"""Symbol and unit of each state."""
_BADGE = Markup('<strong class="badge {}">{}</strong>')


@dataclass(frozen=True, slots=True)
class DeviceSummary:
    """The largest error of each state among the gyros of one device.

    ``largest`` has a gyro and its row in the calibration for each of the four states. ``verdict`` is PASS or FAIL by
    the limits of the device and of the run, or how the run ended otherwise; empty if nothing was judged.
    """

    name: str
    largest: tuple[tuple[GyroCalibration, int], ...]
    verdict: str


@dataclass(kw_only=True, frozen=True, slots=True)
class ResultsView:
    """The chapter of results.

    ``unnoticed`` are effects that the run could not show. ``added`` are effects that an investigation added, empty if
    there was none, or if they are in the model; ``moved_by`` is how far the states move with them.
    """

    coverage: str
    has_budget: bool
    summary: Table | None
    states: Table
    effects: Table | None
    unnoticed: str
    added: str
    moved_by: Markup
    notes: Sequence[str]


@dataclass(kw_only=True, frozen=True, slots=True)
class AsFoundView:
    """The device as found: the recording, its hash and date, and its states beside those as left."""

    recording: str
    sha256: str
    begun: str
    states: Table


def results_view(
    recorded: Recorded,
    calibration: Calibration,
    *,
    states: States,
    standing: Standing,
    unseen: Unseen | None,
    traced: Traced | None,
) -> ResultsView:
    """Return the results of a calibration, with what an investigation added if there is one.

    That is left out if the calibration has effects of a model itself. The summary has a row for each device, also for
    a single one.
    """
    several = summary(recorded, standing)
    corrected = any(gyro.effects for gyro in calibration.gyros)
    added = traced.added if traced is not None and not corrected else []
    return ResultsView(
        coverage=f"{COVERAGE:g}",
        has_budget=any(gyro.budget for gyro in calibration.gyros),
        summary=_summary_table(several, states) if several else None,
        states=_states_table(recorded, calibration, states),
        effects=_effects_table(recorded, calibration),
        unnoticed=", ".join(unseen.unnoticed) if unseen is not None else "",
        added=", ".join(added),
        moved_by=plain(moved_by(recorded, calibration, traced), ONE, 2) if traced is not None and added else Markup(),
        notes=calibration.notes,
    )


def summary(recorded: Recorded, standing: Standing) -> list[DeviceSummary]:
    """Return a summary of each source with gyros, in the order of these; none without a calibration."""
    if recorded.calibration is None:
        return []
    rows: dict[str, list[int]] = {}
    for row, gyro in enumerate(recorded.calibration.gyros):
        rows.setdefault(gyro.source, []).append(row)
    return [_device_summary(recorded, standing, name, own) for name, own in rows.items()]


def _device_summary(recorded: Recorded, standing: Standing, name: str, rows: Sequence[int]) -> DeviceSummary:
    """Return the summary of the device ``name``, whose gyros are ``rows`` of the calibration.

    For each state it has the gyro with the largest value by size, with its row. Its verdict is that of the run, "" if
    that has none; if the run failed, it is PASS nevertheless when only limits of other devices are broken.
    """
    assert recorded.calibration is not None
    gyros = recorded.calibration.gyros
    largest = [max(rows, key=lambda row: abs(float(gyros[row].states[state]))) for state in range(4)]
    verdict = "" if standing.verdict is None else str(standing.verdict.outcome)
    own = all(line.within for line in standing.lines if line.row is None or line.row in rows)
    if verdict == Outcome.FAIL and own and not all(line.within for line in standing.lines):
        verdict = str(Outcome.PASS)  # it is another device that failed
    return DeviceSummary(name, tuple((gyros[row], row) for row in largest), verdict)


def _summary_table(devices: Sequence[DeviceSummary], states: States) -> Table:
    largest = [Markup("largest {} ± U, {}").format(symbol, unit.name) for symbol, unit in states]
    rows = [[device.name, *_largest(device, states), _verdict(device)] for device in devices]
    return table_of(["device", *largest, "verdict"], "lrrrrl", rows)


def _largest(device: DeviceSummary, states: States) -> Iterator[Markup]:
    """Yield the largest value of each state with its expanded uncertainty."""
    for state, ((gyro, row), (_, unit)) in enumerate(zip(device.largest, states, strict=True)):
        value, _, expanded = _figures(gyro, row, state, unit)
        yield Markup("{} ± {}").format(value, expanded)


def _verdict(device: DeviceSummary) -> Content:
    return badge(device.verdict) if device.verdict else "not judged"


def badge(text: str) -> Markup:
    """Return an outcome as a coloured word."""
    return _BADGE.format(text.lower().replace(" ", "-"), text)


def _figures(gyro: GyroCalibration, row: int, state: int, unit: Unit) -> list[Markup]:
    """Return a state of a gyro of the calibration: value, standard and expanded uncertainty."""
    place = f"[{row},{state}]"
    value, sd = float(gyro.states[state]), float(gyro.sd[state])
    return with_uncertainty(value, sd, unit, f"calibration/states{place}", f"calibration/sd{place}")


def _states_table(recorded: Recorded, calibration: Calibration, states: States) -> Table:
    """Return a group of rows for each gyro, a row for each state: value, standard and expanded uncertainty, unit."""
    heads = [
        "gyro",
        "quantity",
        "value",
        "standard uncertainty u",
        f"expanded uncertainty U = {COVERAGE:g} u",
        "unit",
    ]
    groups = [
        (recorded.label(gyro.source, gyro.name), _state_rows(gyro, row, states))
        for row, gyro in enumerate(calibration.gyros)
    ]
    return grouped_table(heads, "llrrrl", groups)


def _state_rows(gyro: GyroCalibration, row: int, states: States) -> Iterator[list[Content]]:
    for state, (symbol, unit) in enumerate(states):
        yield [symbol, *_figures(gyro, row, state, unit), unit.name]


def _effects_table(recorded: Recorded, calibration: Calibration) -> Table | None:
    """Return the effects that were estimated with the states, None if there are none; a shared effect has one row."""
    gyros = calibration.gyros
    if not gyros[0].effects:
        return None
    rows: list[list[Content]] = []
    for column, effect in enumerate(gyros[0].effects):
        for row, gyro in enumerate(gyros[:1] if effect.shared else gyros):
            value = gyro.effects[column]
            place = f"calibration/effects[{row},{column}]"
            whose = "all gyros" if effect.shared else recorded.label(gyro.source, gyro.name)
            shown = worded(value.value, COVERAGE * value.sd, value.unit, place)
            rows.append([f"{words(effect.effect)}, {effect.parameter}", whose, shown])
    heads = ["effect", "gyro", "value ± U"]
    return table_of(heads, "llr", rows, length=len(gyros[0].effects) * len(gyros))


def moved_by(recorded: Recorded, calibration: Calibration, traced: Traced) -> float:
    """Return the largest shift of a state by an investigation, in sigmas of the calibration; 0 without common gyros."""
    moved = [
        np.abs(traced.states[traced.names.index(label)] - gyro.states) / gyro.sd
        for gyro, label in zip(calibration.gyros, recorded.labels, strict=True)
        if label in traced.names
    ]
    return float(np.max(moved, initial=0.0))


def as_found_view(
    recorded: Recorded, calibration: Calibration, before: Recorded, hashes: Mapping[str, str], states: States
) -> AsFoundView:
    """Return the states before an adjustment, as recorded in ``before``, beside those after it, with U for both.

    Both must have the same gyros in one order. ``hashes`` has that of the earlier file as "as_found".
    """
    assert before.calibration is not None
    begun = before.begun_utc
    heads = ["gyro", "quantity", "as found", "U as found", "as left", "U as left", "unit"]
    groups = [
        (recorded.label(left.source, left.name), _adjusted_rows(then, left, row, states))
        for row, (then, left) in enumerate(zip(before.calibration.gyros, calibration.gyros, strict=True))
    ]
    return AsFoundView(
        recording=before.path.name,
        sha256=hashes["as_found"],
        begun=f"{begun:%Y-%m-%d %H:%M UTC}" if begun is not None else "",
        states=grouped_table(heads, "llrrrrl", groups),
    )


def _adjusted_rows(
    as_found: GyroCalibration, as_left: GyroCalibration, row: int, states: States
) -> Iterator[list[Content]]:
    for state, (symbol, unit) in enumerate(states):
        before = with_uncertainty(float(as_found.states[state]), float(as_found.sd[state]), unit, None, None)
        after = _figures(as_left, row, state, unit)
        yield [symbol, before[0], before[2], after[0], after[2], unit.name]
