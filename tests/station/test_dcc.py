"""station report --dcc: the digital certificate says what the recording holds, is valid, and can be signed."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from certified import META, certified
from lxml import etree

from estimator.calibration.accelerometer import AccelerometerCalibration, ForceCalibration, ForceEffectValues
from estimator.observations.timing import TimeOffset
from station.cli import main
from station.errors import UsageError
from station.report.dcc import make_dcc, read_key, sign, validate
from station.report.document import Report
from station.report.document_status import standing_of
from station.report.formal import read_formal
from station.report.recorded import Recorded, read_recorded

SPACES = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si", "ds": "http://www.w3.org/2000/09/xmldsig#"}
UNITS = [r"\one", r"\radian\second\tothe{-1}", r"\radian", r"\radian"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording that passed, beside it meta.toml."""
    return certified(tmp_path_factory.mktemp("run"))


def made(run: Path, meta: Path | None = None, pdf: bytes | None = None) -> bytes:
    """Return the certificate of a recording without that of paper."""
    recorded = read_recorded(run)
    formal = read_formal(recorded, meta or run.with_name("meta.toml"))
    report = Report(
        html="", standing=standing_of(recorded, formal), number="1A2B3C", hashes={"file": "0" * 64, "data": "1" * 64}
    )
    return make_dcc(recorded, formal, report, pdf)


def found(xml: bytes | etree._Element, path: str) -> list[Any]:
    tree = etree.fromstring(xml) if isinstance(xml, bytes) else xml
    return list(tree.xpath(path, namespaces=SPACES))


def texts(xml: bytes | etree._Element, path: str) -> list[str]:
    return [element.text for element in found(xml, path)]


def numbers(xml: etree._Element, path: str) -> Any:
    return np.array([text.split() for text in texts(xml, path)], dtype=float).squeeze()


def test_every_state_has_the_value_unit_k_and_uncertainty_of_the_recording(run: Path) -> None:
    results = found(made(run), "//dcc:result[starts-with(@id, 'gyro')]")
    assert made(run) == made(run)
    with h5py.File(run) as file:
        states, sd, covariance = (file[f"calibration/{key}"][()] for key in ("states", "sd", "covariance"))
    assert len(results) == len(states)
    for result, x, u, c in zip(results, states, sd, covariance, strict=True):
        real = ".//dcc:list[1]/dcc:quantity/si:real"
        assert np.array_equal(numbers(result, f"{real}/si:value"), x)
        assert texts(result, f"{real}/si:unit") == UNITS
        expanded = f"{real}/si:measurementUncertaintyUnivariate/si:expandedMU"
        assert np.array_equal(numbers(result, f"{expanded}/si:valueExpandedMU"), 2 * u)
        assert set(texts(result, f"{expanded}/si:coverageFactor")) == {"2"}
        assert set(texts(result, f"{expanded}/si:coverageProbability")) == {"0.95"}
        assert set(texts(result, f"{expanded}/si:distribution")) == {"normal"}
        together = found(result, ".//si:realListXMLList")[0]
        assert np.array_equal(numbers(together, "si:valueXMLList"), x)
        assert together.findtext("si:unitXMLList", namespaces=SPACES).split() == UNITS
        assert np.array_equal(numbers(together, ".//si:columnXMLList//si:valueXMLList"), c)
        units = [text.split() for text in texts(together, ".//si:columnXMLList//si:unitXMLList")]
        assert units[0][:2] == UNITS[:2]
        assert units[1][1] == r"\radian\tothe{2}\second\tothe{-2}"
        assert units[1][2] == units[2][1] == r"\radian\tothe{2}\second\tothe{-1}"


def test_effects_and_conditions_are_there_in_units_of_d_si(run: Path) -> None:
    xml = made(run)
    quantity = "//dcc:list[dcc:name/dcc:content='Effects']/dcc:quantity"
    thermal = found(xml, f"{quantity}[contains(dcc:name/dcc:content, 'thermal bias')]")
    assert set(texts(thermal[0], "si:real/si:unit")) == {r"\radian\second\tothe{-1}\kelvin\tothe{-1}"}
    with h5py.File(run) as file:
        assert [float(one.findtext(".//si:value", namespaces=SPACES)) for one in thermal] == (
            file["calibration/effects"][:, 0].tolist()
        )
    strange = found(xml, f"{quantity}[contains(dcc:name/dcc:content, 'g sensitivity')]/dcc:noQuantity")
    assert "rad/s/g" in "".join(strange[0].itertext())
    conditions = {
        condition.findtext(".//dcc:content", namespaces=SPACES): (
            condition.findtext(".//si:value", namespaces=SPACES),
            condition.findtext(".//si:unit", namespaces=SPACES),
        )
        for condition in found(xml, "//dcc:influenceCondition[.//si:real]")
    }
    assert conditions["Ambient temperature"] == ("21.4", r"\degreecelsius")
    assert float(conditions["Relative humidity"][0] or "") == 0.43
    assert conditions["Relative humidity"][1] == r"\one"


def test_the_formal_facts_are_those_of_meta(run: Path) -> None:
    xml = made(run)
    core = "//dcc:coreData/dcc:"
    said = {
        "uniqueIdentifier": "1A2B3C",
        "countryCodeISO3166_1": "CH",
        "receiptDate": "2026-05-02",
        "beginPerformanceDate": "2026-05-09",
        "issueDate": "2026-05-11",
        "performanceLocation": "laboratory",
    }
    assert {name: texts(xml, core + name)[0] for name in said} == said
    assert texts(xml, "//dcc:calibrationLaboratory/dcc:contact/dcc:name/dcc:content") == ["Gyro <laboratory> & sons"]
    assert texts(xml, "//dcc:customer//dcc:further/dcc:content") == ["Langstrasse 1", "Bern"]
    assert texts(xml, "//dcc:item/dcc:identifications/dcc:identification/dcc:value") == ["TG-0042"]
    assert texts(xml, "//dcc:respPerson[dcc:mainSigner='true']/dcc:person/dcc:name/dcc:content") == ["G. Hopper"]
    assert "RT-2026-11" in texts(xml, "//dcc:measuringEquipment//dcc:value")
    assert texts(xml, "//dcc:usedMethod/dcc:reference") == ["P-12, edition 3"]


def test_limits_and_decision_rule_are_stated_with_the_verdict(run: Path) -> None:
    xml = made(run)
    assert texts(xml, "//dcc:statement[dcc:conformity]/dcc:conformity") == ["pass"]
    assert "simple acceptance" in "".join(found(xml, "//dcc:statement[dcc:conformity]")[0].itertext())
    recorded = read_recorded(run)
    lines = [line for line in standing_of(recorded).lines if line.state is not None and not line.of_u]
    assert len(lines) == 12
    upper = found(xml, "//dcc:metaData[dcc:conformity='pass']//dcc:quantity[@refType='basic_acceptanceLimitUpper']")
    assert [float(texts(one, "si:real/si:value")[0]) for one in upper] == [line.high for line in lines]


def test_signs_and_axes_are_defined_beside_the_states(run: Path) -> None:
    """From the axes that it states, in the axes x, y, z that it defines, the output of each gyro can be computed."""
    xml = made(run)
    (source,) = read_recorded(run).recording.sources.values()
    axes = [source.array.p, source.array.j, source.array.k]
    for place, text in enumerate(texts(xml, "//dcc:result[starts-with(@id, 'gyro')]/dcc:description/dcc:content")):
        assert "Without rotation the output is -b" in text
        stated = re.findall(r"[pjk] = \(([^)]*)\)", text)
        for own, words in zip(axes, stated, strict=True):
            assert np.allclose(own[place], [float(x) for x in words.split(",")], atol=1e-8)
    statement = "//dcc:statement[dcc:name/dcc:content='Axes']/dcc:declaration/dcc:content"
    assert "innermost axis of the table" in texts(xml, statement)[0]


def test_a_guard_band_moves_what_is_accepted_and_is_told(run: Path, tmp_path: Path) -> None:
    meta = tmp_path / "meta.toml"
    meta.write_text(f'{META}[decision]\nrule = "guard band"\nfalse_accept = "1 %"\n', encoding="utf-8")
    xml = made(run, meta)
    assert "guard band by ILAC-G8:09/2019, probability of false acceptance at most 1 %" in xml.decode()
    recorded = read_recorded(run)
    first = standing_of(recorded, read_formal(recorded, meta)).lines[0]
    upper = found(xml, "//dcc:quantity[@refType='basic_acceptanceLimitUpper']")[0]
    assert 0 < float(texts(upper, "si:real/si:value")[0]) == first.high - first.guard < first.high


def test_paper_screen_and_json_have_the_same_figures(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "c.html"
    arguments = ["report", str(run), "--dcc", "--meta", str(run.with_name("meta.toml")), "-o", str(out), "--json"]
    assert main(arguments) == 0
    xml = out.with_suffix(".xml").read_bytes()
    validate(xml)
    assert main(["export", str(run), "--format", "json", "-o", str(tmp_path / "c.json")]) == 0
    exported = json.loads((tmp_path / "c.json").read_text())["gyros"]
    html = out.read_text(encoding="utf-8")
    number = texts(xml, "//dcc:uniqueIdentifier")[0]
    assert f"No. {number}" in html
    for i, result in enumerate(found(xml, "//dcc:result[starts-with(@id, 'gyro')]")):
        values = texts(result, ".//dcc:list[1]/dcc:quantity/si:real/si:value")
        expanded = texts(result, ".//dcc:list[1]//si:valueExpandedMU")
        assert [float(value) for value in values] == list(exported[i]["states"].values())
        for s in range(4):
            assert f'value="{values[s]}" data-factor' in html
            shown = re.search(rf'<data value="([^"]*)"[^>]*data-h5="calibration/sd\[{i},{s}\]" data-times', html)
            assert shown is not None
            assert shown[1] == expanded[s]


def test_the_device_as_found_is_stated_beside_the_device_as_left(run: Path, tmp_path: Path) -> None:
    before, recorded = read_recorded(certified(tmp_path, seed=8)), read_recorded(run)
    formal = read_formal(recorded, run.with_name("meta.toml"))
    xml = make_dcc(
        recorded,
        formal,
        Report(html="", standing=standing_of(recorded, formal), number="1", hashes={"file": "0"}, before=before),
    )
    for of, result in zip((recorded, before), found(xml, "//dcc:measurementResult"), strict=True):
        assert of.calibration is not None
        values = texts(result, ".//dcc:list[dcc:name/dcc:content='States']/dcc:quantity/si:real/si:value")
        assert [float(value) for value in values] == [x for gyro in of.calibration.gyros for x in gyro.states]


def test_what_nobody_stated_is_listed_with_the_place_where_it_is_stated(
    run: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    meta = tmp_path / "meta.toml"
    meta.write_text('[customer]\nname = "Aerial surveys"\n', encoding="utf-8")
    assert main(["report", str(run), "--dcc", "--meta", str(meta), "-o", str(tmp_path / "c.html")]) == 2
    said = capsys.readouterr().err
    for fact in ("laboratory.name", "laboratory.country", "customer.address", "certificate.approved_by", "--meta"):
        assert fact in said, fact
    assert "customer.name" not in said.replace("customer.name is", "")
    meta.write_text(META.replace('"CH"', '"Switzerland"'), encoding="utf-8")
    assert main(["report", str(run), "--dcc", "--meta", str(meta), "-o", str(tmp_path / "c.html")]) == 2
    assert (
        "laboratory.country: 'Switzerland' is not a country code of ISO 3166-1. Write two capital letters"
        in capsys.readouterr().err
    )
    assert not list(tmp_path.glob("c.*"))  # said before the work, and nothing is left half done


def test_what_is_no_certificate_on_paper_is_none_in_xml(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="not a calibration certificate"):
        made(certified(tmp_path, outcome="FAIL", reason="k of x is beyond 1 %"))


def test_the_pdf_is_inside_and_hostile_names_do_no_harm(tmp_path: Path) -> None:
    run = certified(tmp_path, operator="<dcc:x> & \x1b ]]>", device_serial="TG-0042")
    xml = made(run, pdf=b"%PDF-1.7 \x00\xff")
    validate(xml)
    assert base64.b64decode(texts(xml, "/*/dcc:document/dcc:dataBase64")[0]) == b"%PDF-1.7 \x00\xff"
    assert texts(xml, "/*/dcc:document/dcc:mimeType") == ["application/pdf"]


def test_what_is_not_valid_is_told_with_the_place(run: Path) -> None:
    broken = made(run).replace(b"<dcc:uniqueIdentifier>1A2B3C</dcc:uniqueIdentifier>", b"")
    with pytest.raises(UsageError, match="uniqueIdentifier"):
        validate(broken)


def key_pair(folder: Path, *, edwards: bool = False) -> tuple[Path, Path]:
    """Return the files of a new key and of a certificate that it signed itself."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec, ed25519

    key = ed25519.Ed25519PrivateKey.generate() if edwards else ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "Gyro laboratory")])
    now = datetime.now(UTC)
    builder = x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
    builder = builder.not_valid_before(now - timedelta(days=1)).not_valid_after(now + timedelta(days=1))
    certificate = builder.sign(key, None if edwards else hashes.SHA256())
    pem, no_password = serialization.Encoding.PEM, serialization.NoEncryption()
    files = folder / "key.pem", folder / "certificate.pem"
    files[0].write_bytes(key.private_bytes(pem, serialization.PrivateFormat.PKCS8, no_password))
    files[1].write_bytes(certificate.public_bytes(pem))
    return files


def test_it_is_signed_with_the_key_that_the_user_names(run: Path, tmp_path: Path) -> None:
    signxml = pytest.importorskip("signxml")
    from signxml.xades import XAdESVerifier

    key, certificate = key_pair(tmp_path)
    signed = sign(made(run), key, certificate)
    validate(signed)
    pem = certificate.read_text()
    verified = XAdESVerifier().verify(signed, x509_cert=pem, expect_references=3)
    assert any(part.signed_xml.tag == f"{{{SPACES['dcc']}}}digitalCalibrationCertificate" for part in verified)
    with pytest.raises(signxml.InvalidSignature):
        XAdESVerifier().verify(signed.replace(b"TG-0042", b"TG-0043"), x509_cert=pem, expect_references=3)


def test_a_key_that_is_none_is_told_before_the_work(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["report", str(run), "--meta", str(run.with_name("meta.toml")), "-o", str(tmp_path / "c.html")]
    assert main([*arguments, "--dcc", "--sign", str(tmp_path / "none.pem")]) == 2
    assert "--certificate" in capsys.readouterr().err
    assert main([*arguments, "--sign", "k.pem", "--certificate", "c.pem"]) == 2
    assert "--dcc" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    pytest.importorskip("signxml")
    with pytest.raises(UsageError, match="sign with RSA or ECDSA"):
        read_key(*key_pair(tmp_path, edwards=True))


def with_accelerometers(recorded: Recorded) -> Recorded:
    """Return a recording with the calibration of three accelerometers, one effect of which has no unit of D-SI."""
    axes = np.eye(3)
    covariance = np.diag([1e-10, 4e-8, 9e-10, 1e-10])
    accelerometers = tuple(
        AccelerometerCalibration(
            name=f"accel {axis}",
            source="imu",
            device="imu",
            p=axes[place],
            j=axes[(place + 1) % 3],
            k_axis=axes[(place + 2) % 3],
            states=np.array([1e-4, 0.02, 1e-3, -2e-3]) * (place + 1),
            covariance=covariance,
            noise_mps2=1e-3,
            place_m=np.array([0.04, -0.025, 0.015]),
            place_covariance_m2=1e-8 * np.eye(3),
        )
        for place, axis in enumerate("xyz")
    )
    sizes = {"parameters": ("coefficient",), "values": np.full((3, 1), 2e-4), "sd": np.full((3, 1), 1e-5)}
    forces = ForceCalibration(
        source="imu",
        device="imu",
        accelerometers=accelerometers,
        covariance=np.kron(np.eye(3), covariance),
        arm_m=np.array([0.04, -0.025, 0.015]),
        arm_covariance_m2=1e-8 * np.eye(3),
        gravity_mps2=9.8062,
        gravity_from="stated",
        offset=TimeOffset(1.5e-3, 4e-6),
        effects=(
            ForceEffectValues(name="asymmetry", unit="1", **sizes),
            ForceEffectValues(name="second_order", unit="1/g", **sizes),
        ),
    )
    assert recorded.calibration is not None
    return replace(recorded, calibration=replace(recorded.calibration, forces=(forces,)))


def test_accelerometers_have_states_places_intrinsic_parameters_and_effects(run: Path) -> None:
    recorded = with_accelerometers(read_recorded(run))
    formal = read_formal(recorded, run.with_name("meta.toml"))
    report = Report(
        html="", standing=standing_of(recorded, formal), number="1A2B3C", hashes={"file": "0" * 64, "data": "1" * 64}
    )
    xml = etree.fromstring(make_dcc(recorded, formal, report))
    second = found(xml, "//dcc:result[contains(@id, 'Force')]")[1]
    assert second.findtext("dcc:name/dcc:content", namespaces=SPACES) == "Accelerometer accel y of imu"
    states, place, effects = found(second, ".//dcc:list")
    expanded = ".//si:measurementUncertaintyUnivariate//si:valueExpandedMU"
    assert np.allclose(numbers(states, ".//si:value"), [2e-4, 0.04, 2e-3, -4e-3])
    assert np.allclose(numbers(states, expanded), [2e-5, 4e-4, 6e-5, 2e-5])
    assert texts(states, ".//si:unit")[1] == r"\metre\second\tothe{-2}"
    assert np.allclose(numbers(place, ".//si:value"), [0.04, -0.025, 0.015])
    assert np.allclose(numbers(effects, ".//si:value"), 2e-4)
    assert "0.0002 1/g" in texts(effects, ".//dcc:noQuantity/dcc:content")[0]
    (meaning,) = texts(second, "dcc:description/dcc:content")
    assert "Without specific force the output is -b" in meaning
    assert "p = (0, 1, 0)" in meaning
    (added,) = texts(effects, "dcc:description/dcc:content")
    assert "asymmetry" in added
    assert "second order" in added
    (triad,) = found(xml, "//dcc:result[contains(@id, 'Triad')]")
    lists = {one.findtext("dcc:name/dcc:content", namespaces=SPACES): one for one in found(triad, ".//dcc:list")}
    assert list(lists) == ["Sensitivities", "Offsets", "Angles between the axes", "Delay of the outputs"]
    assert [len(found(one, "dcc:quantity")) for one in lists.values()] == [3, 3, 3, 1]
    assert np.allclose(numbers(lists["Offsets"], ".//si:value"), [-0.02, -0.04, -0.06])
    assert "the offset is -b" in texts(lists["Offsets"], "dcc:description/dcc:content")[0]
    condition = "//dcc:influenceCondition[@refType='gravity']"
    assert texts(xml, f"{condition}//si:value") == ["9.8062"]
    assert texts(xml, f"{condition}/dcc:description/dcc:content") == ["stated"]
