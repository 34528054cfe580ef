"""The calibration as a digital calibration certificate: DCC 3.3.0 of PTB, https://ptb.de/dcc/v3.3.0, with D-SI."""

import base64
import importlib.metadata
import re
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree
from scipy.special import chdtri

from drivers.packaged import packaged_text, packaged_toml
from station.errors import UsageError, sentence
from station.render.template import rendered
from station.report.dcc_forces import force_results, gyro_definition
from station.report.document import Report
from station.report.document_status import Kind
from station.report.figures import COVERAGE
from station.report.formal import Formal
from station.report.recorded import Recorded
from station.views.seen import seen_by

PROBABILITY = 0.95
"""Coverage probability, as the report states it of U = 2 u; that of the ellipsoid of four states is made to be it."""
_FACTS = packaged_toml("station.report", "dcc.toml")
_PARSER = etree.XMLParser(no_network=True, resolve_entities=False, huge_tree=True)
_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def check_facts(formal: Formal) -> None:
    """Check, before any long work, that all mandatory facts are stated; UsageError that lists the missing ones."""
    missing = [fact for fact in _FACTS["mandatory"] if not getattr(formal, fact.replace(".", "_"))]
    if missing:
        raise UsageError(sentence("report.dcc_lacks", missing=", ".join(missing)))


def make_dcc(recorded: Recorded, formal: Formal, report: Report, pdf: bytes | None = None) -> bytes:
    """Return the digital calibration certificate as XML in UTF-8, valid by the schema, with the PDF embedded if given.

    A stylesheet for browsers is always embedded. Characters that XML forbids are replaced by U+FFFD. UsageError if the
    report is neither a certificate nor a specimen, if mandatory facts are missing, or if the result is not valid.
    """
    check_facts(formal)
    if report.standing.kind not in (Kind.CERTIFICATE, Kind.SPECIMEN):
        raise UsageError(f"--dcc: {report.standing.warning}")
    values = _FACTS | {
        "recorded": recorded,
        "formal": formal,
        "report": report,
        "seen": seen_by(recorded.recording.sources.values()),
        "force_results": force_results,
        "gyro_definition": gyro_definition,
        "k": f"{COVERAGE:g}",
        "p": PROBABILITY,
        "k_of_four": float(np.sqrt(chdtri(4, 1 - PROBABILITY))),  # JCGM 102:2011, 6.5.2.4
        "stylesheet": base64.b64encode(packaged_text("station.report", "dcc.css").encode()).decode(),
        "pdf": pdf and base64.b64encode(pdf).decode(),
        "version": importlib.metadata.version("turntable-station"),
    }
    xml = _NOT_XML.sub("\ufffd", rendered("station.report", "dcc.xml", values)).encode()
    validate(xml)
    return xml


def validate(xml: bytes) -> None:
    """Check a certificate by the schema in the package, without network; UsageError with the place of a fault."""
    schema = etree.XMLSchema(etree.parse(str(files("station.report") / "schemas" / "dcc.xsd"), _PARSER))
    if not schema.validate(etree.fromstring(xml, _PARSER)):
        first = schema.error_log[0]
        raise UsageError(f"the digital calibration certificate is not valid, line {first.line}: {first.message}")


def sign(xml: bytes, key: Path, certificate: Path) -> bytes:
    """Return the certificate ``xml`` with an enveloped XAdES signature by the key in the file ``key``.

    The line that names a stylesheet for browsers stays in the result, but is not signed. UsageError as ``read_key``,
    or if the result is not valid by the schema; without the packages, which ``read_key`` checks, an ImportError.
    """
    from signxml.xades.xades import XAdESDataObjectFormat, XAdESSigner

    private, pem, method = read_key(key, certificate)
    described = XAdESDataObjectFormat(Description="digital calibration certificate", MimeType="text/xml")
    signer = XAdESSigner(signature_algorithm=method, data_object_format=described)
    signed = signer.sign(etree.fromstring(xml, _PARSER), key=private, cert=pem)
    text = bytes(etree.tostring(signed, xml_declaration=True, encoding="UTF-8"))
    # The stylesheet for browsers, before the root, is not signed.
    stylesheet = re.search(rb"<\?xml-stylesheet[^>]*\?>", xml)
    if stylesheet:
        declaration, _, rest = text.partition(b"?>\n")
        text = declaration + b"?>\n" + stylesheet[0] + b"\n" + rest
    validate(text)
    return text


def read_key(key: Path, certificate: Path) -> tuple[Any, str, Any]:
    """Return the private key in a PEM file, the text of its X.509 certificate (PEM), and the signature method.

    The method is ECDSA with SHA-256 for a key on a curve, else RSA with SHA-256. UsageError if a file cannot be read,
    the key needs a password, the two do not belong together, the key is of another kind, or packages are missing.
    """
    try:
        from cryptography import x509
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric import ec, rsa
        from signxml.algorithms import SignatureMethod
    except ImportError:
        raise UsageError("--sign needs more packages: pip install turntable-station[sign]") from None
    try:
        private, pem = serialization.load_pem_private_key(key.read_bytes(), None), certificate.read_text()
        if x509.load_pem_x509_certificate(pem.encode()).public_key() != private.public_key():
            raise ValueError("the certificate belongs to another key")
        on_a_curve = isinstance(private, ec.EllipticCurvePrivateKey)
        if not on_a_curve and not isinstance(private, rsa.RSAPrivateKey):
            raise ValueError("sign with RSA or ECDSA")
    except (OSError, ValueError, TypeError) as error:
        raise UsageError(f"--sign {key} --certificate {certificate}: {error}") from None
    return private, pem, SignatureMethod["ECDSA_SHA256" if on_a_curve else "RSA_SHA256"]
