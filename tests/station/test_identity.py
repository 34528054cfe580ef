"""Which device was calibrated: a number that is given and one that the device says must be one, or be confirmed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import pytest

from station.cli import main

REST = '[[step]]\nkind = "rest"\nduration = "3 s"\n'


def run(capsys: pytest.CaptureFixture[str], folder: Path, *options: str) -> tuple[int, dict[str, Any]]:
    """Run three seconds at rest with the one device of the built-in bench that tells a serial number."""
    (folder / "rest.toml").write_text(REST)
    words = ["run", "--json", "--device", "stim300", "--script", str(folder / "rest.toml"), *options]
    code = main([*words, "-o", str(folder / "r.h5")])
    return code, json.loads(capsys.readouterr().out)


def test_a_device_that_says_another_number_ends_the_run_before_the_table_moves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, result = run(capsys, tmp_path, "--serial-number", "SN-OTHER")
    with h5py.File(tmp_path / "r.h5") as file:
        told = file["imu/stim300"].attrs["serial"]
        assert not any(len(rows) for rows in file["table"].values())
    assert (code, result["outcome"]) == (4, "FAULT")
    assert result["reason"].startswith("stim300: ")
    assert told in result["reason"]
    assert "SN-OTHER" in result["reason"]
    assert "--serial-reason" in result["reason"]


def test_a_number_that_is_confirmed_with_a_reason_is_on_record_and_certificate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    why = "label of the customer, <SN-OTHER> inside"
    _, result = run(capsys, tmp_path, "--serial-number", "SN-OTHER", "--serial-reason", why)
    assert result["outcome"] != "FAULT"
    with h5py.File(tmp_path / "r.h5") as file:
        told = file["imu/stim300"].attrs["serial"]
        assert (file.attrs["device_serial"], file.attrs["serial_reason"]) == ("SN-OTHER", why)
    assert main(["report", str(tmp_path / "r.h5")]) == 0
    page = (tmp_path / "r.html").read_text()
    assert f"SN-OTHER (the device says {told}; confirmed: label of the customer, &lt;SN-OTHER&gt; inside)" in page
