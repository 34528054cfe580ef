"""station import with a mapping of kind poses: what a person and a program are told, and the file that opens again."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from estimator.importing.hands.mapping import read_pose_mapping
from station.cli import main

DATA = Path(__file__).parents[1] / "data" / "poses"
PHONE = [str(DATA / "phone.toml"), str(DATA / "phone_lis3dh_30_poses.mat")]
GUIDE = Path(__file__).parents[2] / "docs/pages/guide/poses.md"


def test_the_result_is_printed_written_and_printed_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = str(tmp_path / "phone.h5")
    assert main(["import", *PHONE, "-o", output]) == 0
    printed = capsys.readouterr().out
    for name in ("scale x", "bias z", "angle yz", "U (95 %)", "m/s2", "mg", "Refused rests", "less than gravity"):
        assert name in printed
    flat = " ".join(printed.split())
    assert re.search(
        r"standard deviation: 0\.1\d+ m/s2 \(1\d\.\d+ mg\) before, 0\.0\d+ m/s2 \(\d\.\d+ mg\) after", flat
    )
    assert main(["import", "--look", output]) == 0
    assert capsys.readouterr().out == printed


def test_a_program_gets_all_numbers_in_si(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["import", "--json", *PHONE, "-o", str(tmp_path / "phone.h5")]) == 0
    result = json.loads(capsys.readouterr().out)["accelerometer"]
    assert [own["name"] for own in result["parameters"]][::4] == ["scale x", "bias y", "angle yz"]
    covariance = np.array(result["covariance"])
    assert np.sqrt(np.diag(covariance)) == pytest.approx([own["sd"] for own in result["parameters"]])
    means = np.array([rest["mean"] for rest in result["rests"]])
    bias = [own["value"] for own in result["parameters"][3:6]]
    force = np.linalg.solve(np.array(result["matrix"]), (means - bias).T).T
    lengths = np.linalg.norm(force, axis=1)
    assert lengths == pytest.approx([rest["after_mps2"] for rest in result["rests"]])
    assert [rest["number"] for rest in result["rests"] if rest["refused"]]


def test_a_gross_error_writes_nothing_and_says_what_to_check(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (DATA / "phone.toml").read_text(encoding="utf-8").replace('unit = "m/s2"', 'unit = "g"')
    (tmp_path / "mapping.toml").write_text(text, encoding="utf-8")
    output = tmp_path / "phone.h5"
    assert main(["import", str(tmp_path / "mapping.toml"), PHONE[1], "-o", str(output)]) == 2
    assert "its values look like m/s2 given as g. Check unit and count" in " ".join(capsys.readouterr().err.split())
    assert not output.exists()


def test_the_mappings_of_the_guide_are_read(tmp_path: Path) -> None:
    blocks = re.findall(r"```toml\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) >= 4
    for block in blocks:
        path = tmp_path / "mapping.toml"
        path.write_text(block, encoding="utf-8")
        assert read_pose_mapping(path).device
