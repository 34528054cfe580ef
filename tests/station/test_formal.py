"""The formal facts of a certificate: from the recording, from its bench, and from the file for --meta."""

from __future__ import annotations

from datetime import date
from io import BytesIO
from pathlib import Path
from typing import Any, cast

import pytest
from PIL import Image

from estimator.recordings.recording import Recording
from station.bench.bench import default_bench_text, read_bench
from station.errors import BenchError, UsageError
from station.report.formal import Equipment, read_formal
from station.report.recorded import Recorded, Step

BENCH = """
[laboratory]
name = "Gyro laboratory"
address = ["Seestrasse 7", "Zürich"]
[[equipment]]
name = "rate table"
certificate = "RT-2026-11"
due = 2026-06-30
[decision]
rule = "guard band"
[station]
approved_by_another = true
"""
META = """
[laboratory]
name = "Branch laboratory"
[customer]
name = "Aerial surveys"
[item]
model = "TG4"
received = "2026-05-02"
[performed]
temperature = "21.4 degC"
humidity = "43 %"
[certificate]
number = "C-17"
approved_by = "G. Hopper"
"""
FIRST_OF_MAY_2026_UTC_S = 1777593600.0


def recorded(folder: Path, bench: str = BENCH, **attributes: Any) -> Recorded:
    """Return a recording that holds only attributes and a step."""
    told = {"operator": "A. Turing", "clock_zero_utc_s": FIRST_OF_MAY_2026_UTC_S, "bench": bench} | attributes
    recording = Recording({}, cast(Any, None), attributes=told)
    return Recorded(
        path=folder / "run.h5",
        recording=recording,
        calibration=None,
        rest=None,
        courses={},
        source_attributes={},
        steps=(Step("rest", 0, 1),),
        events=(),
    )


def written(folder: Path, text: str) -> Path:
    path = folder / "meta.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_file_goes_before_the_bench_and_the_recording_says_the_rest(tmp_path: Path) -> None:
    found = read_formal(recorded(tmp_path, device_serial="TG-0042"), written(tmp_path, META))
    assert (found.laboratory_name, found.laboratory_address) == ("Branch laboratory", ("Seestrasse 7", "Zürich"))
    assert (found.item_model, found.item_serial_number, found.item_maker) == ("TG4", "TG-0042", None)
    assert (found.item_received, found.performed_date) == (date(2026, 5, 2), date(2026, 5, 1))
    assert (found.performed_temperature_c, found.performed_humidity) == (21.4, 0.43)
    assert found.equipment == (Equipment("rate table", None, "RT-2026-11", date(2026, 6, 30)),)
    assert (found.decision_rule, found.decision_false_accept) == ("guard band", 0.025)
    assert (found.operator, found.certificate_approved_by, found.approved) == ("A. Turing", "G. Hopper", True)
    assert not found.overdue


def test_a_file_of_another_device_or_that_is_wrong_is_refused_with_its_line(tmp_path: Path) -> None:
    run = recorded(tmp_path, device_serial="TG-0042")
    for text, said in {
        '[item]\nserial_number = "TG-0043"': r"line 2: item.serial_number: 'TG-0043'.*'TG-0042'",
        '[item]\nreceived = "2.5.2026"': r"line 2: item.received: '2.5.2026' is not a date. Write it as 2026-11-23",
        '[customer]\nnmae = "x"': r"line 2: customer.nmae: unknown key; did you mean name\?",
        '[decision]\nrule = "simple"\nfalse_accept = "1 %"': r"line 3: decision.false_accept: is for rule = ",
        "[performed]\ndate = 2026-04-20": r"line 2: performed.date: 2026-04-20 .* began on 2026-05-01",
        "[item]\nreceived = 2026-05-20": r"line 2: item.received: 2026-05-20 and performed.date, 2026-05-01, are in",
        "[certificate]\nissued = 2020-01-01": r"line 2: certificate.issued: 2020-01-01 and performed.date, 2026",
        '[[equipment]]\nserial_number = "7"': r"equipment.0: name is missing",
        "[lab]": r"lab: unknown key",
    }.items():
        with pytest.raises(UsageError, match=said):
            read_formal(run, written(tmp_path, text))


def test_a_bench_that_states_how_much_may_be_accepted_wrongly_has_a_guard_band_or_is_told(tmp_path: Path) -> None:
    run = recorded(tmp_path, '[decision]\nfalse_accept = "1 %"\n')
    with pytest.raises(BenchError, match=r"decision.false_accept: is for rule = \"guard band\""):
        read_formal(run)
    for rule, share in (("guard band", 0.01), ("simple", None)):
        chosen = read_formal(run, written(tmp_path, f'[decision]\nrule = "{rule}"\n'))
        assert chosen.decision_false_accept == share


def test_the_bench_of_a_stranger_leads_to_no_file_but_beside_its_recording(tmp_path: Path) -> None:
    bench = '[laboratory]\nlogo = "/etc/../etc/passwd"\n'
    with pytest.raises(UsageError, match=f"laboratory.logo: {tmp_path}/passwd cannot be read"):
        read_formal(recorded(tmp_path, bench))


def test_equipment_is_overdue_and_approval_lacking_by_what_the_bench_wants(tmp_path: Path) -> None:
    late = read_formal(recorded(tmp_path, BENCH.replace("2026-06-30", "2026-04-30")))
    assert [one.name for one in late.overdue] == ["rate table"]
    assert not late.approved
    for same in ("A.  TURING", "A.Turing.", "A. Tur\u200bing", "-"):
        assert not read_formal(recorded(tmp_path, accepted_by=same)).approved
    assert read_formal(recorded(tmp_path, BENCH.replace("true", "false"))).approved


def test_a_bench_file_is_checked_when_it_is_read_and_not_when_the_certificate_is_made() -> None:
    more = BENCH.partition("[station]")[0]
    assert read_bench(default_bench_text() + more, "bench.toml").text.endswith(more)
    with pytest.raises(BenchError, match=r"laboratory.adress: unknown key; did you mean address\?"):
        read_bench(default_bench_text() + '[laboratory]\nadress = ["Zürich"]\n', "bench.toml")


def test_what_a_form_kept_beside_the_recording_is_found_and_leads_to_no_file_elsewhere(tmp_path: Path) -> None:
    kept = tmp_path / "run-certificate.toml"
    kept.write_text('[customer]\nname = "Aerial surveys"\n[laboratory]\nlogo = "/etc/passwd"\n', encoding="utf-8")
    with pytest.raises(UsageError, match=f"laboratory.logo: {tmp_path}/passwd cannot be read"):
        read_formal(recorded(tmp_path))
    kept.write_text('[customer]\nname = "Aerial surveys"\n', encoding="utf-8")
    assert read_formal(recorded(tmp_path)).customer_name == "Aerial surveys"
    assert read_formal(recorded(tmp_path), written(tmp_path, "")).customer_name is None


def test_a_logo_is_a_picture_by_what_it_holds(tmp_path: Path) -> None:
    whole = BytesIO()
    Image.new("RGB", (40, 40), "navy").save(whole, "PNG")
    files = {"text.png": b"not a picture", "torn.png": whole.getvalue()[:-40], "text.svg": b"<svg", "html.svg": b"<a/>"}
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(UsageError, match=rf"laboratory.logo: .*{name} is not a picture.*Give a .svg, .png or .jpg"):
            read_formal(recorded(tmp_path), written(tmp_path, f'[laboratory]\nlogo = "{name}"\n'))
    (tmp_path / "photo.jpg").write_bytes(whole.getvalue())
    found = read_formal(recorded(tmp_path), written(tmp_path, '[laboratory]\nlogo = "photo.jpg"\n'))
    assert found.laboratory_logo == tmp_path / "photo.jpg"


def test_blank_names_and_countries_that_there_are_not_are_refused(tmp_path: Path) -> None:
    for text, said in {
        '[customer]\nname = " "': r"line 2: customer.name: ' ' is blank. Fill it in, or leave it out",
        '[customer]\naddress = ["Bern", ""]': r"line 2: customer.address: .* is blank",
        '[laboratory]\ncountry = "XX"': r"line 2: laboratory.country: 'XX' is not a country code of ISO 3166-1",
        '[laboratory]\ncountry = "ch"': r"line 2: laboratory.country: 'ch' is not a country .* two capital letters",
    }.items():
        with pytest.raises(UsageError, match=said):
            read_formal(recorded(tmp_path), written(tmp_path, text))
    with pytest.raises(BenchError, match="laboratory.country: 'UK' is not a country"):
        read_bench(default_bench_text() + '[laboratory]\ncountry = "UK"\n', "bench.toml")
    stated = written(tmp_path, '[laboratory]\ncountry = "GB"\n')
    assert read_formal(recorded(tmp_path), stated).laboratory_country == "GB"


def test_equipment_states_until_when_it_is_good_or_why_that_has_no_date(tmp_path: Path) -> None:
    undated = '[[equipment]]\nname = "level"\ncertificate = "L-1"\n'
    assert [one.name for one in read_formal(recorded(tmp_path), written(tmp_path, undated)).overdue] == ["level"]
    reason = f'{undated}no_due = "a square of granite, checked before each use"\n'
    assert not read_formal(recorded(tmp_path), written(tmp_path, reason)).overdue
    day_unknown = recorded(tmp_path, clock_zero_utc_s=float("nan"))
    assert not read_formal(day_unknown).overdue  # nothing says that it was


def test_dates_that_cannot_follow_each_other_are_told_where_they_stand(tmp_path: Path) -> None:
    run = recorded(tmp_path)
    for text, said in {
        "[certificate]\nnext_due = 2026-04-01": r"line 2: certificate.next_due: 2026-04-01 and performed.date, 2026",
        "[certificate]\nissued = 2026-06-01\nnext_due = 2026-05-20": r"line 3: .* certificate.issued, 2026-06-01",
        "[performed]\ndate = 2026-04-20": r"line 2: performed.date: 2026-04-20 .* 2026-05-01 .*\. Correct it, or leave",
        "[item]\nreceived = 2026-05-02\n[certificate]\nissued = 2026-04-30": "in the wrong order",
        "[performed]\ndate = 2026-05-02": "Correct it, or leave",  # no place was that far ahead at midnight UTC
    }.items():
        with pytest.raises(UsageError, match=said):
            read_formal(run, written(tmp_path, text))


def test_a_bench_that_states_a_false_acceptance_without_a_guard_band_is_told_when_it_is_read() -> None:
    with pytest.raises(BenchError, match=r'decision.false_accept: is for rule = "guard band"'):
        read_bench(default_bench_text() + '[decision]\nfalse_accept = "1 %"\n', "bench.toml")


def test_instruments_state_the_chain_of_their_certificates(tmp_path: Path) -> None:
    chain = (
        '[[equipment]]\nname = "rate table"\ncertificate = "258-1"\nlaboratory = "PTB"\n'
        'calibrated = 2026-01-15\nuncertainty = "2 ppm (k = 2)"\ndue = {due}\n'
    )
    one = read_formal(recorded(tmp_path), written(tmp_path, chain.format(due="2027-01-15"))).equipment[0]
    assert (one.laboratory, one.calibrated, one.uncertainty) == ("PTB", date(2026, 1, 15), "2 ppm (k = 2)")
    with pytest.raises(UsageError, match="rate table was calibrated on 2026-01-15 but was due before that"):
        read_formal(recorded(tmp_path), written(tmp_path, chain.format(due="2025-01-15")))
    later = chain.format(due="2028-01-15").replace("2026-01-15", "2026-08-01")
    with pytest.raises(UsageError, match="calibrated on 2026-08-01, after this measurement of 2026-05-01"):
        read_formal(recorded(tmp_path), written(tmp_path, later))


def test_an_amendment_has_a_number_of_its_own(tmp_path: Path) -> None:
    text = '[certificate]\nnumber = "C-18"\nreplaces = "C-18"\n'
    with pytest.raises(UsageError, match=r"certificate.replaces: 'C-18' is the number of this document"):
        read_formal(recorded(tmp_path), written(tmp_path, text))
