"""A digital calibration certificate as others read it: pydcc, the validator xmlschema, the units of dsiunits."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import h5py
import numpy as np
import pytest
from certified import certified

sys.path.insert(0, str(Path(__file__).parents[1] / "station"))
from test_dcc import key_pair, made

from station.report.dcc import sign

SCHEMA = Path(__file__).parents[2] / "station" / "report" / "schemas" / "dcc.xsd"
STATES = ("scale factor error k", "bias b", "misalignment sigma_j", "misalignment sigma_k")
UNITS = (r"\one", r"\radian\second\tothe{-1}", r"\radian", r"\radian")


@pytest.fixture
def pydcc(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return the package, without what looks for a trusted root where that does not know the OpenSSL of here."""
    try:
        import certvalidator  # noqa: F401
    except Exception:  # oscrypto 1.3.0 cannot read versions like 3.0.19
        stub: Any = ModuleType("certvalidator")
        stub.CertificateValidator = stub.ValidationContext = stub.errors = None
        monkeypatch.setitem(sys.modules, "certvalidator", stub)
    package = pytest.importorskip("dcc")
    monkeypatch.setattr("dcc.dcc.DCCXMLValidator", lambda: None)  # it asks ptb.de for schemas as soon as it is made
    return package


def test_pydcc_reads_every_value_unit_k_and_uncertainty_of_the_recording(pydcc: Any, tmp_path: Path) -> None:
    run = certified(tmp_path)
    (tmp_path / "c.xml").write_bytes(made(run))
    read = pydcc.DCC(str(tmp_path / "c.xml"))
    assert read.is_loaded()
    assert read.version() == "3.3.0"
    assert read.uid() == "1A2B3C"
    assert read.calibration_laboratory_name() == "Gyro <laboratory> & sons"
    results = dict(read.get_calibration_results("name", "en"))
    with h5py.File(run) as file:
        states, sd, covariance = (file[f"calibration/{key}"][()] for key in ("states", "sd", "covariance"))
        names = [name.decode() for name in file["calibration/name"][()]]
    for i, name in enumerate(names):
        before = f" Calibration certificate Gyro {name}"
        for s, state in enumerate(STATES):
            real = results[f"{before} States {state}"]["real"]
            told = real["measurementUncertaintyUnivariate"]["expandedMU"]
            assert float(real["value"]) == states[i, s]
            assert real["unit"] == UNITS[s]
            assert float(told["valueExpandedMU"]) == 2 * sd[i, s]
            assert told["coverageFactor"] == "2"
            assert told["distribution"] == "normal"
        together = results[f"{before} States together, with their covariances"]["realListXMLList"]
        region = together["measurementUncertaintyMultivariateXMLList"]["ellipsoidalRegionMUXMLList"]
        columns = [
            column["covarianceXMLList"]["valueXMLList"].split()
            for column in region["covarianceMatrixXMLList"]["columnXMLList"]
        ]
        assert np.array_equal(np.array(columns, dtype=float).T, covariance[i])


def test_another_validator_finds_it_valid_signed_or_not(tmp_path: Path) -> None:
    xmlschema = pytest.importorskip("xmlschema")
    schema = xmlschema.XMLSchema(str(SCHEMA), allow="local")
    text = made(certified(tmp_path), pdf=b"%PDF-1.7")
    schema.validate(text.decode())
    schema.validate(sign(text, *key_pair(tmp_path)).decode())
    assert not schema.is_valid(text.decode().replace("respPersons", "people"))


@pytest.mark.filterwarnings("ignore")  # the package warns of its own parser
def test_the_units_are_those_of_d_si(tmp_path: Path) -> None:
    dsi = pytest.importorskip("dsi_unit")
    text = made(certified(tmp_path)).decode()
    told = re.findall("<si:unit>(.*?)</", text) + " ".join(re.findall("<si:unitXMLList>(.*?)</", text)).split()
    assert len(set(told)) > 6
    assert all(dsi.DsiUnit(unit).valid for unit in set(told))
