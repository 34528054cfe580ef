"""Files as strangers bring them, under a mapping that does not fit: what is said names the key that helps."""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from foreign_logs import MAPPING, imported, written

from estimator.errors import RecordingError

HEADING = ("t", "gx", "gy", "gz", "rx", "ry", "rz")
T = np.arange(600) / 100
BODY = np.column_stack([30 * np.sin(T), 20 * np.cos(1.3 * T), 25 * np.sin(0.7 * T)])
ROWS = np.column_stack([T, 0.99 * BODY + np.random.default_rng(1).normal(scale=0.02, size=BODY.shape), BODY])


def text(rows: np.ndarray = ROWS, heading: tuple[str, ...] = HEADING, spec: str = "%.6f") -> str:
    lines = [",".join(spec % v for v in row) for row in rows]
    return "\n".join([",".join(heading), *lines]) + "\n"


def with_stamps(stamp: Callable[[datetime], str]) -> str:
    began = datetime(2024, 1, 31, 12)
    lines = [line.partition(",")[2] for line in text().splitlines()[1:]]
    stamps = [stamp(began + timedelta(seconds=float(t))) for t in T]
    return "\n".join([",".join(HEADING), *(f"{a},{b}" for a, b in zip(stamps, lines, strict=True))])


RECORD = MAPPING.replace(
    '"csv"', '"binary"\nrecord = ["t f8", "gx f8", "gy f8", "gz f8", "rx f8", "ry f8", "rz f8"]', 1
)


@pytest.mark.parametrize(
    ("content", "mapping", "message"),
    [
        (
            text(heading=("t [s]", "gx [deg/s]", "gy [deg/s]", "gz [deg/s]", "rx", "ry", "rz")),
            MAPPING,
            'did you mean "t [s]", "gx [deg/s]", "gy [deg/s]", "gz [deg/s]"?',
        ),
        ("made by\nlogger 2\n" + text(heading=tuple(h.upper() for h in HEADING)), MAPPING, 'did you mean "T", "GX"'),
        (
            text(np.hstack([ROWS, ROWS[:, 1:2]]), (*HEADING, "gx")),
            MAPPING,
            "has 2 columns called gx. Give every column its own name",
        ),
        (with_stamps(lambda at: at.strftime("%H:%M:%S.%f")), MAPPING, "t holds '12:00:00.000000': "),
        (
            with_stamps(lambda at: at.strftime("%d/%m/%Y %H:%M:%S.%f")),
            MAPPING,
            'write unit = "pattern", pattern = "%d/%m/%Y %H:%M:%S.%f" in [time]',
        ),
        (
            with_stamps(lambda at: at.strftime("%m/%d/%Y %I:%M:%S.%f %p")),
            MAPPING,
            'write unit = "pattern", pattern = "%m/%d/%Y %I:%M:%S.%f %p" in [time]',
        ),
        (text().replace("-", "~", 300), MAPPING, "holds '~"),
        (text(ROWS[::-1]), MAPPING, "has time stamps that run backwards: "),
        (text(ROWS[:1]), MAPPING, "has 1 row to read: record more"),
        (text(ROWS * ([1e6] + [1] * 6)), MAPPING, "samples are 10000 s apart according to [time]. Correct its unit"),
        (text(ROWS * ([1e9] + [1] * 6) + ([1.7e18] + [0] * 6), spec="%.0f"), MAPPING, "Correct its unit"),
        (b"PK\x03\x04" + np.random.default_rng(2).bytes(5000), MAPPING, "is a spreadsheet or an archive. Save its"),
        (ROWS.astype("<f8").tobytes(), MAPPING, 'is not a text file. Write format = "binary" with its record'),
        (ROWS.astype("<f4").tobytes(), RECORD, "heck record"),
    ],
    ids=range(14),
)
def test_what_does_not_fit_is_said_with_the_key_that_helps(
    tmp_path: Path, content: str | bytes, mapping: str, message: str
) -> None:
    with pytest.raises(RecordingError, match=re.escape(message)):
        imported(*written(tmp_path, mapping, content))


def test_words_for_nothing_are_blanks(tmp_path: Path) -> None:
    lines = text().splitlines()
    for number, word in enumerate(("n/a", "-", "NULL", "None", "NaN", "")):
        fields = lines[10 + number].split(",")
        lines[10 + number] = ",".join([*fields[:2], word, *fields[3:]])
    run = imported(*written(tmp_path, MAPPING, "\n".join(lines)))
    assert len(run.recording.sources["imu"].t_ns) == len(T)
    assert not any("broken" in note for note in run.notes)


def test_stamps_in_another_unit_are_told_where_they_could_be_true(tmp_path: Path) -> None:
    run = imported(*written(tmp_path, MAPPING, text(ROWS * ([1e3] + [1] * 6))))
    assert any(
        "samples are 10 s apart according to [time]. If that is wrong, correct its unit" in note for note in run.notes
    )


def test_a_reference_that_stands_still_under_gyros_that_turn_is_told(tmp_path: Path) -> None:
    run = imported(*written(tmp_path, MAPPING, text(ROWS * ([1] * 4 + [0] * 3))))
    assert sum("the output hardly follows the reference" in note for note in run.notes) == 3


def test_an_output_in_another_unit_is_told_with_the_unit(tmp_path: Path) -> None:
    run = imported(*written(tmp_path, MAPPING, text(np.column_stack([T, np.radians(ROWS[:, 1:4]), BODY]), spec="%.9f")))
    assert any("as in rad/s. Check unit and count in [gyro]" in note for note in run.notes)


def test_coarse_steps_are_told(tmp_path: Path) -> None:
    coarse = np.round(ROWS[:, 1:4] / 0.57) * 0.57
    run = imported(*written(tmp_path, MAPPING, text(np.column_stack([T, coarse, BODY]))))
    assert any("the resolution of 0.57 deg/s is coarser than the noise" in note for note in run.notes)
    assert not any("coarser" in note for note in imported(*written(tmp_path, MAPPING, text())).notes)
