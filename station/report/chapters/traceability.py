"""The uncertainties: what they are traced to, and the budget that they are made of."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from markupsafe import Markup

from drivers.packaged import packaged_toml
from estimator.calibration.budget import TYPE_A
from estimator.calibration.gyro import GyroCalibration
from estimator.calibration.values import Calibration
from estimator.recordings.reference import TableReadings
from station.report.chapters.results import States
from station.report.figures import ARCSEC, MICROSECONDS, PPM, plain
from station.report.formal import Equipment
from station.report.recorded import Recorded
from station.report.tables import Content, Table, grouped_table, table_of

_SOURCES: Mapping[str, str] = packaged_toml("station.views", "budget.toml")["report"]
"""What lines of the budget are called."""
_NOT_STATED = "not stated"
_RUNS = "runs"  # of a joined calibration: all that a run alone leaves open
_COMBINED = Markup("<strong>combined standard uncertainty</strong>")


@dataclass(kw_only=True, frozen=True, slots=True)
class TraceabilityView:
    """What the results are traced to.

    ``on_table``: the reference is the table of a station, whose stated uncertainties are ``stated``, None if there are
    none. ``chain`` are the calibrations of the instruments, None if none is stated.
    """

    on_table: bool
    stated: Table | None
    chain: Table | None


def traceability_view(recorded: Recorded, equipment: Sequence[Equipment]) -> TraceabilityView:
    """Return what the results are traced to: the stated uncertainty of a table, and the equipment with certificates.

    Equipment without a certificate is left out. Without a table there is no stated uncertainty.
    """
    reference = recorded.recording.reference
    table = reference if isinstance(reference, TableReadings) else None
    certified = [instrument for instrument in equipment if instrument.certificate]
    return TraceabilityView(
        on_table=table is not None,
        stated=_stated(table) if table is not None else None,
        chain=_chain(certified) if certified else None,
    )


def _stated(table: TableReadings) -> Table | None:
    """Return the standard uncertainties of the table, None if none are stated."""
    stated = table.uncertainty
    if stated is None:
        return None
    quantities = [
        ("its rate (time base), relative", stated.rate, PPM, "u_rate"),
        ("wobble of an axis", stated.wobble_rad, ARCSEC, "u_wobble_rad"),
        ("orthogonality of each axis to the others", stated.orthogonality_rad, ARCSEC, "u_orthogonality_rad"),
        ("timing of its readings", stated.timing_s, MICROSECONDS, "u_timing_s"),
    ]
    rows = [[name, plain(value, unit, 3, f"table@{key}"), unit.name] for name, value, unit, key in quantities]
    return table_of(["quantity", "u", "unit"], "lrl", rows)


def _chain(equipment: Sequence[Equipment]) -> Table:
    heads = ["instrument", "certificate", "issued by", "calibrated on", "valid until", "uncertainty stated there"]
    return table_of(heads, "llllll", map(_instrument, equipment))


def _instrument(instrument: Equipment) -> list[Content]:
    """Return the row of an instrument: name and number, certificate, laboratory, dates, uncertainty.

    What is missing is said to be not stated, except for the certificate, which stays empty.
    """
    return [
        ", ".join(filter(None, (instrument.name, instrument.serial_number))),
        instrument.certificate,
        instrument.laboratory or _NOT_STATED,
        instrument.calibrated or _NOT_STATED,
        instrument.due or instrument.no_due or _NOT_STATED,
        instrument.uncertainty or _NOT_STATED,
    ]


@dataclass(kw_only=True, frozen=True, slots=True)
class BudgetView:
    """The uncertainty budget; ``has_type_b``: with contributions of the reference."""

    table: Table
    has_type_b: bool


def budget_view(recorded: Recorded, calibration: Calibration, states: States) -> BudgetView | None:
    """Return the uncertainty budget of a calibration, by gyro; None if no gyro has one."""
    gyros = calibration.gyros
    if not any(gyro.budget for gyro in gyros):
        return None
    uncertainties = [Markup("<var>u</var>({}), {}").format(symbol, unit.name) for symbol, unit in states]
    groups = [
        (recorded.label(gyro.source, gyro.name), _budget_rows(gyro, row, states)) for row, gyro in enumerate(gyros)
    ]
    return BudgetView(
        table=grouped_table(["gyro", "source", "type", *uncertainties], "lllrrrr", groups),
        has_type_b=any(line.name not in TYPE_A for gyro in gyros for line in gyro.budget),
    )


def _budget_rows(gyro: GyroCalibration, row: int, states: States) -> Iterator[list[Content]]:
    """Yield the contributions of a gyro, and their combination."""
    for number, line in enumerate(gyro.budget):
        kind = "A" if line.name in TYPE_A else "A, B" if line.name == _RUNS else "B"
        place = f"calibration/budget[{row},{number},%d]"
        yield [_SOURCES.get(line.name, line.name), kind, *_shares(line.u, place, states)]
    yield [_COMBINED, None, *_shares(gyro.sd, f"calibration/sd[{row},%d]", states)]


def _shares(u: Iterable[float], source: str, states: States) -> list[Markup]:
    """Return standard uncertainties state by state, in the units of these. ``source``: %d, state."""
    return [
        plain(float(value), unit, 2, source % s) for s, (value, (_, unit)) in enumerate(zip(u, states, strict=True))
    ]
