"""What the charts of a run show, from what a session said."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from streams import STREAMS

from station.bench.bench import read_bench
from station.remote.hosting import introduction
from station.run.snapshot import SeriesSnapshot
from station.screen.drawings import STATE_CHARTS
from station.screen.run_charts import run_drawing, series_charts
from station.screen.sessions.greeting import SentLimits
from station.screen.sessions.live_run import LiveRun
from station.scripts.script import load_script


def watched(name: str, until_s: float) -> LiveRun:
    """Return what a screen knows of a run at an instant."""
    run = LiveRun(Path("run.h5"), "short.toml")
    for line in (STREAMS / f"{name}.jsonl").read_text(encoding="utf-8").splitlines():
        said: dict[str, Any] = json.loads(line)
        if said["at_s"] > until_s:
            break
        if said["kind"] == "hello":
            run.greet(said)
        else:
            run.take(said)
    return run


def test_the_rate_of_a_gyro_stands_beside_what_that_gyro_should_measure() -> None:
    run = watched("pass", 36.0)
    for gyro in run.seen[-1].gyros:
        drawing = run_drawing("rate", run, gyro)
        assert ("by the table", "first") in drawing.words
        expected, measured = (
            next(curve for curve in drawing.curves if curve.style == style) for style in ("first", "line")
        )
        pairs = [pair for pair in zip(expected.values, measured.values, strict=True) if all(map(math.isfinite, pair))]
        assert len(pairs) > 20
        # The table turned at up to 40 deg/s, and no axis of this array lies along one of the table's.
        assert max(abs(value) for _, value in pairs) > 10
        off = sorted(abs(one - other) for one, other in pairs)
        assert off[len(off) // 2] < 0.5  # reading and sample are up to 50 ms apart, on ramps of 20 deg/s2


@pytest.mark.parametrize("until_s", [5.0, 12.0, 36.0])
def test_no_state_has_an_empty_frame_and_each_has_its_uncertainty(until_s: float) -> None:
    run = watched("pass", until_s)
    for name in STATE_CHARTS:
        for gyro in run.seen[-1].gyros:
            drawing = run_drawing(name, run, gyro)
            assert drawing.curves, name
            assert any("±" in text for text, style in drawing.words if style == "line"), drawing.words


def test_each_column_that_a_device_appends_is_a_chart_from_when_it_came() -> None:
    run = watched("pass", 36.0)
    columns = ("temperature_c", "degC", "supply", "V")
    for count, snapshot in enumerate(run.seen):
        series = (
            SeriesSnapshot("chamber", columns[0], columns[1], 20.0 + count),
            SeriesSnapshot("supply", columns[2], columns[3], 5.0),
        )
        run.seen[count] = replace(snapshot, series=series if count else series[:1])
    names = series_charts(run.seen[-1])
    temperature, voltage = (run_drawing(name, run, run.seen[-1].gyros[0]) for name in names)
    assert [text for text, _ in temperature.words] == [
        "temperature_c (degC)",
        f"{20 + len(run.seen) - 1}.00",
        "chamber",
    ]
    assert list(temperature.curves[0].values) == [20.0 + count for count in range(len(run.seen))]
    assert math.isnan(voltage.curves[0].values[0])
    assert set(voltage.curves[0].values[1:]) == {5.0}


def test_limits_of_accelerometers_come_with_the_greeting_of_a_session() -> None:
    text = (Path(__file__).parents[2] / "data" / "benches" / "full_imu.toml").read_text(encoding="utf-8")
    limited = text.replace("[undeclared]", '[limits.accelerometers]\nbias = "20 mg"\n\n[undeclared]')
    script = load_script(Path("full-imu"))

    def sent(bench: str) -> SentLimits:
        said = introduction(read_bench(bench, "bench"), None, script, Path("run.h5"), ())
        return SentLimits.read(json.loads(json.dumps(said["limits"])))

    assert sent(limited).force_sizes == pytest.approx((math.inf, 20e-3 * 9.80665, math.inf, math.inf))
    assert sent(limited).force_written == ("", "20 mg", "", "")
    assert sent(limited).sizes == sent(text).sizes
    assert set(sent(text).force_sizes) == {math.inf}
