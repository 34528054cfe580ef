"""A day at the station: a tray of three devices, and what is handed over of each, by commands alone."""

from __future__ import annotations

import json
import re
from datetime import date
from pathlib import Path
from typing import Any

import pytest
from test_report import SCRIPT

from station.bench.bench import default_bench_text
from station.cli import main
from station.report.dcc import validate

META = f"""
[laboratory]
name = "Test laboratory"
address = ["1 Main Street"]
country = "DE"
contact = "lab@example.org"
[customer]
name = "A customer"
address = ["2 Side Street"]
[item]
maker = "A maker"
model = "M4"
received = {date.today()}
condition = "no damage"
[performed]
date = {date.today()}
place = "the laboratory"
[certificate]
issued = {date.today()}
approved_by = "B. Second"
"""


@pytest.mark.full
def test_a_tray_of_three_ends_with_a_certificate_a_report_and_their_history(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    text = default_bench_text()
    for key, wide in (("sd_scale_factor_error", "9 %"), ("sd_bias", "9 deg/s"), ("sd_misalignment", "9 deg")):
        text = re.sub(rf'^{key} = ".*?"', f'{key} = "{wide}"', text, flags=re.MULTILINE)
    Path("bench.toml").write_text(text)
    before, _, limits = text.partition("[limits]")
    limits = re.sub(r'(?m)^scale_factor_error = ".*?"', 'scale_factor_error = "10 ppm"', limits)
    Path("strict.toml").write_text(f"{before}[limits]{limits}")
    Path("script.toml").write_text(SCRIPT)
    Path("meta.toml").write_text(META)

    def did(*words: str, code: int = 0) -> Any:
        assert main([*words, "--json"]) == code
        return json.loads(capsys.readouterr().out)

    def run(serial: str, name: str, *options: str, code: int = 0) -> Any:
        who = ["--operator", "A. First", "--serial-number", serial]
        return did("run", "--script", "script.toml", "-o", name, *who, *options, code=code)

    wrong = run("SN-1", "one.h5", "--bench", "bench.toml", "--device", "stim300", code=4)
    assert "SN-1" in wrong["reason"]
    failed = run("SN-2", "two.h5", "--bench", "strict.toml", code=1)
    assert "k " in failed["reason"]
    assert run("SN-3", "three.h5", "--bench", "bench.toml")["outcome"] == "PASS"

    assert did("report", "two.h5", "--meta", "meta.toml")["title"] == "Calibration report: not within limits"
    handed = did("report", "three.h5", "--pdf", "--dcc", "--meta", "meta.toml")
    assert handed["title"] == "Specimen of a calibration certificate"  # of twins
    assert Path(handed["pdf"]).read_bytes().startswith(b"%PDF-")
    validate(Path("three.xml").read_bytes())
    for form, name in (("c", "gyros.h"), ("json", "gyros.json"), ("matlab", "gyros.mat")):
        assert main(["export", "three.h5", "--format", form, "-o", name]) == 0
    capsys.readouterr()
    listed = did("history", ".")["recordings"]
    assert {(row["serial"], row["outcome"]) for row in listed} == {
        ("SN-1", "FAULT"),
        ("SN-2", "FAIL"),
        ("SN-3", "PASS"),
    }
