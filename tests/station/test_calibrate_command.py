"""station calibrate: how recordings end, and what a bench file says of effects that nobody has declared."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from estimator.geometry.array import triad
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import RateReadings
from estimator.recordings.writing import write_recording
from station.bench.bench import default_bench_text, load_bench
from station.cli import main
from station.errors import BenchError


def recorded(path: Path, factor: float = 1.0) -> Path:
    """A triad beside a rate, and no bench file; in the second half its outputs are ``factor`` times as large."""
    t_s = np.arange(0, 200, 0.02)
    w = 0.8 * np.sin(np.outer(t_s, [1.1, 1.7, 2.3]))
    noise = 1e-3 * np.random.default_rng(1).standard_normal(w.shape)
    stamps = np.round(t_s * 1e9).astype(np.int64)
    output = w * np.where(t_s > 100, factor, 1.0)[:, None] + noise
    write_recording(path, Recording({"imu": ImuData(triad(), stamps, output)}, RateReadings(stamps, w)))
    return path


def test_without_limits_nothing_passes_and_doubts_are_in_the_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["calibrate", str(recorded(tmp_path / "a.h5")), "--json"]) == 0
    good = json.loads(capsys.readouterr().out)
    assert good["outcome"] == "ESTIMATED"
    assert re.fullmatch("estimated; the bench has no limits to compare with; constancy not proved.*", good["reason"])
    assert [axis["axis"] for axis in good["constancy"]] == ["x", "y", "z"]
    assert {"gearing"}.isdisjoint(good["constancy"][0]["concerns"])
    assert good["doubts"] == []
    assert "unseen_effects" in good["gyros"][0]["budget"]
    assert main(["calibrate", str(recorded(tmp_path / "b.h5", 1.02)), "--json"]) == 0
    odd = json.loads(capsys.readouterr().out)
    assert odd["outcome"] == "ESTIMATED"
    assert "the two halves of this recording disagree" in odd["reason"]
    assert main(["calibrate", str(tmp_path / "a.h5"), "--details"]) == 0
    printed = capsys.readouterr().out
    assert "ESTIMATED" in printed
    assert "Valid for rates of" in printed
    assert "effects that this script cannot show (type B)" in printed


def test_a_bench_file_says_which_effects_are_ruled_out(tmp_path: Path) -> None:
    path, text = tmp_path / "bench.toml", default_bench_text()
    assert load_bench(None).excluded is None
    some = 'excluded = ["scale_asymmetry", "table_harmonic"]'
    for line, excluded in ((some, {"scale_asymmetry", "table_harmonic"}), ("", set())):
        path.write_text(text.replace('effects = "none"', line))
        assert load_bench(path).excluded == excluded
    path.write_text(text.replace('effects = "none"', 'excluded = ["phlogiston"]'))
    with pytest.raises(BenchError, match="phlogiston.*scale_asymmetry"):
        load_bench(path)


def test_limits_that_undeclared_effects_break_are_told_with_what_would_help(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = tmp_path / "bench.toml"
    bench.write_text(default_bench_text().replace('effects = "none"', ""))
    assert main(["calibrate", str(recorded(tmp_path / "a.h5")), "--bench", str(bench), "--json"]) == 1
    assert "in [undeclared] of the bench file" in json.loads(capsys.readouterr().out)["reason"]
