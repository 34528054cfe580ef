"""The noise of the gyros, in the data of the whole run and at rest alone."""

from collections.abc import Sequence
from dataclasses import dataclass

from estimator.calibration.gyro import GyroCalibration
from estimator.calibration.values import Calibration
from station.report.figures import ARW, DEG_PER_H, DEG_PER_S, WALK, interval, plain
from station.report.pictures import Picture, allan_picture
from station.report.recorded import Recorded, RestNoise
from station.report.tables import Content, Table, table_of


@dataclass(kw_only=True, frozen=True, slots=True)
class NoiseView:
    """The noise found in the data; ``coloured``: with more than the noise of a sample.

    ``at_rest`` is the noise at rest alone, None if it is not known.
    """

    in_data: Table
    coloured: bool
    at_rest: Table | None
    picture: Picture | None


def noise_view(recorded: Recorded, calibration: Calibration) -> NoiseView:
    """Return the stored noise of the gyros of a calibration as tables and picture, a row for each gyro; computes none.

    ``in_data`` has the noise of one sample and, if that is known for every gyro, the terms of coloured noise.
    ``at_rest`` is None if the recording holds no noise at rest or, in files of older versions, none with intervals;
    ``picture``, the Allan deviations at rest, is None only in the first case.
    """
    labels = [recorded.label(gyro.source, gyro.name) for gyro in calibration.gyros]
    coloured = all(gyro.noise is not None for gyro in calibration.gyros)
    return NoiseView(
        in_data=_data_table(labels, calibration.gyros, coloured=coloured),
        coloured=coloured,
        at_rest=None if recorded.rest is None else _rest_table(labels, recorded.rest),
        picture=allan_picture(recorded),
    )


def _data_table(labels: Sequence[str], gyros: Sequence[GyroCalibration], *, coloured: bool) -> Table:
    """Return a row for each gyro: noise of one sample, and with ``coloured`` the terms estimated from all data."""
    heads = ["gyro", "one sample, °/s"]
    if coloured:
        heads += ["angle random walk, °/s/√Hz", "bias instability, below, °/h", "rate random walk, below, °/h/√h"]
    rows: list[list[Content]] = []
    for row, (label, gyro) in enumerate(zip(labels, gyros, strict=True)):
        sample = plain(gyro.noise_rps, DEG_PER_S, 3, f"calibration/noise_rps[{row}]")
        rows.append([label, sample, *_coloured(gyro, row)] if coloured else [label, sample])
    return table_of(heads, "lrrrr", rows)


def _coloured(gyro: GyroCalibration, row: int) -> list[Content]:
    assert gyro.noise is not None
    return [
        plain(gyro.noise.mean.arw, ARW, 3, f"calibration/noise[{row},0]"),
        plain(gyro.noise.instability_below, DEG_PER_H, 2, f"calibration/noise_below[{row},0]"),
        plain(gyro.noise.walk_below, WALK, 2, f"calibration/noise_below[{row},1]"),
    ]


def _rest_table(labels: Sequence[str], rest: RestNoise) -> Table | None:
    """Return a row for each gyro: N, B and K at rest with their intervals; None for files of older versions."""
    low, high = rest.terms_low, rest.terms_high
    if low is None or high is None:
        return None
    rows: list[list[Content]] = []
    for row, label in enumerate(labels):
        cells: list[Content] = [label]
        for term, unit in enumerate((ARW, DEG_PER_H, WALK)):
            place = f"[{row},{term}]"
            cells.append(interval(rest.terms[row, term], low[row, term], high[row, term], unit, place))
        rows.append(cells)
    heads = ["gyro", "angle random walk, °/s/√Hz", "bias instability, °/h", "rate random walk, °/h/√h"]
    return table_of(heads, "lrrr", rows)
