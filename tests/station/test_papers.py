"""What makes a document of a pass a certificate: date, place, number, traceability; and what it says if it is none."""

from __future__ import annotations

import json
import os
import re
import subprocess
from html import unescape
from pathlib import Path

import h5py
import pytest
from certified import certified
from lxml import etree
from support import forked

from station.cli import main

NO_PLACE = 'address = ["Seestrasse 7", "Zürich"]\n'
NO_DATE = "date = 2026-05-09\n"


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a recording that passed, beside it meta.toml; nobody issued a document yet."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return certified(tmp_path)


def changed(run: Path, old: str, new: str) -> Path:
    """Return a file for --meta in which a text is another."""
    meta = run.with_name("meta.toml")
    text = meta.read_text(encoding="utf-8")
    assert old in text
    other = run.with_name("other.toml")
    other.write_text(text.replace(old, new), encoding="utf-8")
    return other


def issue(run: Path, meta: Path, name: str, *options: str) -> tuple[int, str]:
    """Return the exit code of `station report` and the text of the page."""
    page = run.with_name(name)
    code = main(["report", str(run), "--meta", str(meta), "-o", str(page), *options])
    text = unescape(re.sub("<[^>]*>", " ", page.read_text(encoding="utf-8"))) if page.exists() else ""
    return code, " ".join(text.split())


def numbered(run: Path, number: str, more: str = "") -> Path:
    return changed(run, "[certificate]\n", f'[certificate]\nnumber = "{number}"\n{more}')


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        (NO_PLACE, "", "the place of calibration is not stated"),
        (NO_DATE, "", "no date of measurement is stated"),
        ("due = 2027-06-30", "due = 2026-01-01", "the calibration of an instrument had expired"),
    ],
)
def test_without_date_place_or_valid_equipment_it_is_a_report_that_says_why_on_stdout_too(
    run: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, why: str
) -> None:
    _, page = issue(run, changed(run, old, new), "r.html")
    said = " ".join(capsys.readouterr().out.split())
    assert "Calibration report No." in said
    for text in (page, said):
        assert f"This is not a calibration certificate: {why}" in text


def test_all_reasons_are_told_at_once(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    meta = changed(run, NO_PLACE, "")
    meta.write_text(meta.read_text(encoding="utf-8").replace(NO_DATE, ""), encoding="utf-8")
    issue(run, meta, "r.html")
    said = " ".join(capsys.readouterr().out.split())
    assert "no date of measurement is stated ([performed] date); the place of calibration is not stated" in said


def test_a_virtual_run_with_a_due_date_is_told_without_a_date_that_there_is_not(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with h5py.File(run, "r+") as file:
        file.attrs["devices"] = ["array (can, twin:)"]
    _, page = issue(run, changed(run, NO_DATE, ""), "r.html")
    assert "had expired on" not in page
    assert "Specimen of a calibration certificate" in page
    assert "no date of measurement, so it is unknown whether these calibrations were valid" in page


def test_place_date_and_summary_stand_on_the_page(run: Path) -> None:
    _, page = issue(run, run.with_name("meta.toml"), "r.html")
    assert "Calibration certificate No." in page
    assert "Place of calibration at the laboratory, Seestrasse 7, Zürich" in page
    assert "Date of measurement 2026-05-09" in page
    summary = page.index("Summary: the largest error of each device")
    assert summary < page.index("Results of the calibration")
    with h5py.File(run) as file:
        largest = max(file["calibration/states"][:, 0], key=abs) * 1e6
    assert re.search(rf"imu {largest:.0f} ± \d+ .* PASS Results of the calibration", page)


def test_the_chain_of_traceability_is_that_of_the_equipment(run: Path) -> None:
    chain = 'certificate = "RT-2026-11"\nlaboratory = "PTB"\ncalibrated = 2026-01-15\nuncertainty = "2 ppm (k = 2)"\n'
    _, page = issue(run, changed(run, 'certificate = "RT-2026-11"\n', chain), "r.html")
    assert "rate table, T-1 RT-2026-11 PTB 2026-01-15 2027-06-30 2 ppm (k = 2)" in page
    assert "no evidence" not in page
    _, page = issue(run, changed(run, 'certificate = "RT-2026-11"\n', ""), "none.html")
    assert "No calibration certificate of the table is stated" in page


def test_a_number_is_used_for_one_recording_only(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    meta = numbered(run, "C-17")
    assert issue(run, meta, "first.html")[0] == 0
    assert issue(run, meta, "again.html")[0] == 0  # drawn up once more
    folder = run.with_name("second")
    folder.mkdir()
    other = certified(folder, seed=8)
    code, page = issue(other, numbered(other, "C-17"), "r.html")
    assert (code, page) == (2, "")
    assert f"certificate.number: 'C-17' is the number of the document of {run}" in capsys.readouterr().err
    assert issue(other, numbered(other, "C-18"), "r.html")[0] == 0


def test_a_number_stays_used_where_the_register_of_a_user_is_lost(
    run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert issue(run, numbered(run, "C-17"), "first.html")[0] == 0
    (run.parent / "second").mkdir()
    other = certified(run.parent / "second", seed=8).rename(run.with_name("other.h5"))
    moved = run.parent.rename(run.parent.with_name("moved"))
    monkeypatch.setenv("XDG_STATE_HOME", str(moved / "of another user"))
    run, other = moved / run.name, moved / other.name
    with (moved / "documents.jsonl").open("a") as documents:
        documents.write("[1]\n{}\nno line of ours\n")
    assert issue(other, numbered(other, "C-17"), "r.html") == (2, "")
    assert "'C-17' is the number of the document of" in capsys.readouterr().err
    assert issue(run, numbered(run, "C-17"), "again.html")[0] == 0
    assert issue(other, numbered(other, "C-18"), "r.html")[0] == 0


def test_of_two_that_take_a_number_at_the_same_time_one_gets_it(run: Path) -> None:
    recordings = [run]
    for seed in (8, 9, 10):
        folder = run.with_name(f"run{seed}")
        folder.mkdir()
        recordings.append(certified(folder, seed=seed))
    children = [
        subprocess.Popen(
            forked("report", one, "--meta", numbered(one, "C-17"), "--json"),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ,
        )
        for one in recordings
    ]
    codes = [(child.communicate(), child.returncode)[1] for child in children]
    assert sorted(codes) == [0, 2, 2, 2]
    assert sum(one.with_suffix(".html").exists() for one in recordings) == 1


def test_a_register_that_is_damaged_is_told_and_no_number_given_twice(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    register = run.with_name("state") / "turntable-station" / "documents.sqlite"
    register.parent.mkdir(parents=True, mode=0o700)
    register.write_bytes(b"no database" * 500)
    assert issue(run, numbered(run, "C-17"), "r.html")[0] == 2
    said = capsys.readouterr().err
    assert f"{register}: the register of documents cannot be used" in said
    assert "restore it from a backup, or move it away" in said


def test_an_amendment_names_what_it_replaces(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    meta = numbered(run, "C-18", 'replaces = "C-17"\nreplaces_reason = "the customer has moved"\n')
    code, page = issue(run, meta, "r.html", "--dcc", "--json")
    assert code == 0
    assert json.loads(capsys.readouterr().out)["replaces"] == "C-17"
    assert "Amendment: replaces No. C-17: the customer has moved" in page
    assert b"Replaces No. C-17: the customer has moved" in run.with_name("r.xml").read_bytes()


def test_the_number_that_is_made_of_hashes_is_another_for_an_amendment(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    numbers = []
    for meta in (run.with_name("meta.toml"), changed(run, "[certificate]\n", '[certificate]\nreplaces = "C-17"\n')):
        issue(run, meta, f"{meta.stem}.html", "--json")
        numbers.append(json.loads(capsys.readouterr().out)["number"])
    assert len(set(numbers)) == 2


def test_the_digital_certificate_has_a_stylesheet_and_the_place_of_the_page(run: Path) -> None:
    meta = changed(run, "[performed]\n", '[performed]\nplace = "hall 3, Winterthur"\n')
    _, page = issue(run, meta, "r.html", "--dcc")
    assert "Place of calibration hall 3, Winterthur" in page
    tree = etree.parse(str(run.with_name("r.xml")))
    [stylesheet] = tree.xpath("/processing-instruction('xml-stylesheet')")
    assert 'type="text/css"' in stylesheet.text
    assert "hall 3, Winterthur" in " ".join(tree.getroot().itertext())
