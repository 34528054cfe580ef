"""station report: what the document says, that it says what the recording holds, and what it refuses."""

from __future__ import annotations

import inspect
import json
import os
import re
import shutil
import subprocess
import sys
from base64 import b64decode, b64encode
from collections.abc import Callable, Iterator
from ctypes.util import find_library
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import html5lib
import numpy as np
import pytest

from estimator.calibration.calibration_file import read_calibration
from estimator.calibration.compensation import Compensation
from estimator.calibration.correction import compensate
from estimator.calibration.error_model import ErrorModel, KnownEffect, Size
from estimator.calibration.gyro import EffectValue, GyroCalibration
from estimator.effects.catalogue import everything
from estimator.effects.effect import Acts
from estimator.geometry.array import tetrahedron
from estimator.geometry.model import predicted_output
from estimator.recordings.reading import read_recording
from station.bench.bench import default_bench_text
from station.cli import main
from station.exports.exported import raw_sha256
from station.report.chapters.correction import Correction, snippet
from station.report.chapters.front import links_of, local_links
from station.report.document_status import Kind, standing_of
from station.report.formal import Formal, read_formal
from station.report.investigation_chapter import read_traced
from station.report.pdf import print_pdf
from station.report.recorded import read_recorded

if TYPE_CHECKING:
    from shared import Traced

FERRARIS = Path(__file__).parents[1] / "data" / "ferraris"
SCRIPT = "name = 'short'\n" + "".join(
    f"[[step]]\nkind = 'rest'\nduration = '3 s'\n[[step]]\nkind = 'rotate'\naxis = '{axis}'\nrate = '40 deg/s'\n"
    "acceleration = '40 deg/s2'\nduration = '6 s'\n"
    for axis in "xyz"
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a short run on the built-in twins, with operator and serial number."""
    folder = tmp_path_factory.mktemp("run")
    text = default_bench_text()
    for key, wide in (("sd_scale_factor_error", "9 %"), ("sd_bias", "9 deg/s"), ("sd_misalignment", "9 deg")):
        text = re.sub(rf'^{key} = ".*?"', f'{key} = "{wide}"', text, flags=re.MULTILINE)
    (folder / "bench.toml").write_text(text)
    (folder / "short.toml").write_text(SCRIPT)
    path = folder / "run.h5"
    options = ["--bench", str(folder / "bench.toml"), "--script", str(folder / "short.toml"), "-o", str(path)]
    assert main(["run", "--json", *options, "--operator", "A. Turing", "--serial-number", "TG-0042"]) == 0
    return path


@pytest.fixture(scope="module")
def traced(tmp_path_factory: pytest.TempPathFactory, traced_asymmetry: Traced) -> tuple[Path, Path]:
    """Return a calibrated recording of gyros whose scale factors differ by direction, and its investigation."""
    path = Path(shutil.copy(traced_asymmetry.recordings[1], tmp_path_factory.mktemp("traced") / "explore.h5"))
    assert main(["calibrate", "--write", "--json", str(path)]) in (0, 1)
    return path, traced_asymmetry.results


@pytest.fixture(scope="module")
def html(run: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the report of the run."""
    return reported(run, tmp_path_factory.mktemp("html"))


@pytest.fixture
def copy(run: Path, tmp_path: Path) -> Path:
    """Return a copy of the run to be changed."""
    return Path(shutil.copy(run, tmp_path / "copy.h5"))


@pytest.fixture
def bare(copy: Path) -> Path:
    """Return a copy without the live estimates: their pictures, which the other documents show, take the most time."""
    with h5py.File(copy, "r+") as file:
        del file["estimate"], file["innovation"]
    return copy


def reported(path: Path, folder: Path, *options: str | Path) -> str:
    """Return the HTML of a report."""
    out = folder / "report.html"
    assert main(["report", str(path), "-o", str(out), *map(str, options)]) == 0
    return out.read_text(encoding="utf-8")


def parsed(text: str) -> Any:
    """Return the tree of a document that has no error of syntax."""
    apart = re.sub(r"</(?:t[dh]|p|h\d|li|caption|figcaption)>", r" \g<0>", text)
    return html5lib.HTMLParser(strict=True, namespaceHTMLElements=False).parse(apart)


def words_of(element: Any) -> str:
    return " ".join("".join(element.itertext()).split())


def title_of(text: str) -> str:
    return words_of(next(parsed(text).iter("h1")))


def refused(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """Return what `station report` says on stderr when it refuses."""
    capsys.readouterr()
    assert main(["report", *map(str, arguments)]) == 2
    said = capsys.readouterr().err
    assert said.startswith("station: ")
    assert "Traceback" not in said
    return said


def held(file: h5py.File, where: str) -> float:
    """Return the number that "group/dataset[row,column]" or "group@attribute" of a file names."""
    path, at, name = where.partition("@")
    if at:
        return float(file[path or "/"].attrs[name])
    match = re.fullmatch(r"(.*)\[([\d,]+)\]", path)
    assert match is not None, where
    return float(file[match[1]][tuple(map(int, match[2].split(",")))])


def test_the_figures_are_those_of_the_recording(run: Path, html: str) -> None:
    tree = parsed(html)
    shown: dict[str, list[float]] = {}
    with h5py.File(run) as file:
        for element in tree.iter("data"):
            value, where = float(element.get("value")), element.get("data-h5")
            if where is not None:
                times = float(element.get("data-times") or 1)
                assert value == pytest.approx(times * held(file, where), rel=1e-14), where
                shown.setdefault(where, []).append(value)
            text = words_of(element).replace("−", "-")
            factor = float(element.get("data-factor"))
            if re.fullmatch(r"-?[\d.]+(e-?\d+)?", text):
                digits = text.partition("e")[0]
                zeros = len(digits) - len(digits.rstrip("0")) if "." not in digits else 0
                place = 10.0 ** (zeros - len(digits.partition(".")[2]))
                place *= 10.0 ** float(text.partition("e")[2] or 0)
                assert abs(float(text) - value * factor) <= 0.5001 * place, (text, value * factor)
        n, states = file["calibration/states"].shape
    # Each state is there with its sigma and with twice that.
    for i in range(n):
        for s in range(states):
            assert f"calibration/states[{i},{s}]" in shown
            assert len({*shown[f"calibration/sd[{i},{s}]"]}) == 2


def test_it_is_one_file_that_a_validator_and_a_screen_reader_take(html: str) -> None:
    tree = parsed(html)
    assert tree.get("lang") == "en"
    ids = [element.get("id") for element in tree.iter() if element.get("id")]
    assert len(ids) == len(set(ids))
    assert {e.get("aria-labelledby") for e in tree.iter("section")} <= set(ids)
    images = list(tree.iter("img"))
    assert len(images) > 5
    for image in images:
        assert len(image.get("alt")) > 40
        assert image.get("src").startswith("data:image/svg+xml;base64,")
    assert all(head.get("scope") in ("col", "row", "rowgroup") for head in tree.iter("th"))
    assert all(table.find("caption") is not None for table in tree.iter("table") if table.find("thead") is not None)
    # Nothing is fetched, nothing runs.
    assert not [e for e in tree.iter() if e.tag in ("script", "link", "iframe", "object", "embed", "base")]
    assert not [e for e in tree.iter() if {"srcset", "onload"} & set(e.attrib)]
    assert {e.get("href") for e in tree.iter() if "href" in e.attrib} == {f"#{e.get('id')}" for e in tree.iter("h2")}
    assert not re.search(r"url\(|@import", html)


def test_who_what_and_how_are_on_it(run: Path, html: str) -> None:
    text = words_of(parsed(html))
    for wanted in ("TG-0042", "A. Turing", "Kinco", "run.h5", "latitude 45.0000°", "Script short", raw_sha256(run)):
        assert wanted in text, wanted
    assert "−0 " not in text
    for chapter in ("Uncertainty budget", "Traceability", "What this run could not see", "Signatures"):
        assert chapter in text
    assert "script begins" in text
    assert "coverage factor of 2" in text
    assert "No calibration certificate of the table is stated" in text
    # The states mean nothing without their signs and axes; an uncertainty says what it leaves out.
    assert "without rotation the output is −b, so b is to be added" in text
    assert "gyro2 0.94281 0.00000 0.33333 −0.33333 0.00000 0.94281 0.00000 −1.00000 0.00000" in text
    assert "u combines the lines of the uncertainty budget in squares" in text
    assert "does not include later drift" in text


def test_the_same_recording_gives_the_same_bytes_and_json_says_what_was_written(
    run: Path, html: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "again.html"
    capsys.readouterr()
    assert main(["report", str(run), "-o", str(out), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert out.read_text(encoding="utf-8") == html
    assert (said["html"], said["pdf"]) == (str(out), None)
    assert (said["outcome"], said["certificate"], said["simulated"]) == ("PASS", False, True)
    assert said["sha256"]["data"] == raw_sha256(run)
    assert f"No. {said['number']}" in html


def test_what_the_motion_does_not_show_is_named(html: str) -> None:
    text = words_of(parsed(html))
    assert "saturated: 4 different steady conditions" in text
    table = text[text.index("Effects that would have passed unnoticed") :]
    assert re.search(r"scale asymmetry ∞ 5000 ppm", table)
    assert "They do not cover effects that the run could not show: scale asymmetry" in text


def without_estimate(path: Path, outcome: str) -> None:
    """Let a recording look like that of a run that came to no estimate."""
    with h5py.File(path, "r+") as file:
        del file["calibration"], file["estimate"], file["innovation"], file["events"]
        file.attrs.update({"outcome": outcome, "reason": "stopped by Ctrl-C in phase 'x at 40 deg/s'"})


def real(path: Path) -> None:
    """Let a recording on twins look like one of hardware."""
    with h5py.File(path, "r+") as file:
        file.attrs["devices"] = ["array (can, can:socketcan:can0)"]
        file.attrs["table_link"] = "modbus, tcp://192.168.1.10:502"
        file.attrs["clock_zero_utc_s"] = 1_795_000_000.0
        file.attrs["bench"] = str(file.attrs["bench"]) + '\n[laboratory]\naddress = ["Seestrasse 7"]\n'


def test_only_a_pass_of_real_devices_is_a_certificate(html: str, bare: Path, tmp_path: Path) -> None:
    assert title_of(html) == "Specimen of a calibration certificate"
    assert "Simulated devices" in html
    real(bare)
    certificate = reported(bare, tmp_path)
    assert title_of(certificate) == "Calibration certificate"
    assert "not a calibration certificate" not in certificate
    assert "2026-11-18" in certificate
    assert "Simulated" not in certificate
    assert "end on this computer" not in certificate


@pytest.mark.parametrize(
    ("attribute", "value", "kind"),
    [
        ("table_link", "modbus, twin:", Kind.SPECIMEN),
        ("time_scale", 10.0, Kind.SPECIMEN),  # no device runs ten times as fast
        ("table_link", "modbus, tcp://127.0.0.1:40001", Kind.CERTIFICATE),
    ],
)
def test_a_twin_is_known_by_any_link_or_by_its_time(copy: Path, attribute: str, value: Any, kind: Kind) -> None:
    real(copy)
    with h5py.File(copy, "r+") as file:
        file.attrs[attribute] = value
    recorded = read_recorded(copy)
    assert standing_of(recorded).kind is kind
    assert ("table" in local_links(links_of(recorded))) is (kind is Kind.CERTIFICATE)


def test_a_broken_limit_is_named_and_makes_it_a_report(bare: Path, tmp_path: Path) -> None:
    real(bare)
    with h5py.File(bare, "r+") as file:
        bench = str(file.attrs["bench"]).replace('scale_factor_error = "10000 ppm"', 'scale_factor_error = "3000 ppm"')
        file.attrs["bench"] = bench
    text = reported(bare, tmp_path)
    assert title_of(text) == "Calibration report: not within limits"
    rows = [words_of(row) for row in parsed(text).iter("tr")]
    assert sum(bool(re.search(r"k ppm [\d.]+ ± 3000 FAIL [\d.]+ ≤ 9 % PASS", row)) for row in rows) == 4
    assert any(re.search(r"mean NIS .* PASS", row) for row in rows)
    standing = standing_of(read_recorded(bare))
    assert standing.verdict is not None
    assert str(standing.verdict.outcome) == "FAIL"
    assert sum(not line.within for line in standing.lines) == 4


def test_the_combined_uncertainty_of_a_fine_gyro_is_a_number_however_small(bare: Path, tmp_path: Path) -> None:
    with h5py.File(bare, "r+") as file:
        file["calibration/covariance"][0, 1, 1] = np.radians(0.0042 / 3600) ** 2
    rows = [words_of(row) for row in parsed(reported(bare, tmp_path)).iter("tr")]
    assert re.search(r" 0\.0042 ", next(row for row in rows if row.startswith("combined")))


@pytest.mark.parametrize(
    ("outcome", "title"),
    [
        ("ABORTED", "Report of an aborted run"),
        ("FAULT", "Report of a run that ended with a fault"),
        ("FAIL", "Report of a failed calibration"),
    ],
)
def test_a_run_without_an_estimate_gets_a_report_that_says_so(
    copy: Path, tmp_path: Path, outcome: str, title: str
) -> None:
    without_estimate(copy, outcome)
    text = reported(copy, tmp_path)
    assert title_of(text) == title
    assert "This is not a calibration certificate" in text
    assert "stopped by Ctrl-C" in text
    assert "Simulated devices" in text
    assert "Clocks and losses" in text
    assert "Correction" not in text


@pytest.mark.parametrize(
    ("outcome", "kind"), [("ABORTED", Kind.ABORTED), ("FAIL", Kind.FAILED), (None, Kind.ELSEWHERE)]
)
def test_a_run_that_did_not_pass_is_no_certificate_however_it_is_calibrated_since(
    copy: Path, outcome: str | None, kind: Kind
) -> None:
    real(copy)
    with h5py.File(copy, "r+") as file:
        del file.attrs["outcome"]
        if outcome is not None:
            file.attrs["outcome"] = outcome
    standing = standing_of(read_recorded(copy))
    assert standing.kind is kind
    assert all(line.within for line in standing.lines)
    assert not standing.certificate


def code_of(text: str, name: str = "correction") -> dict[str, Any]:
    """Return what the snippet of a report defines."""
    (code,) = (e for e in parsed(text).iter("pre") if e.get("data-snippet") == name)
    found: dict[str, Any] = {}
    exec("".join(code.itertext()), found)
    return found


def test_the_snippet_gives_the_compensated_rate(run: Path, html: str) -> None:
    body_rate: Callable[..., Any] = code_of(html)["body_rate"]
    recording, calibration = read_recording(run), read_calibration(run)
    arrays = {name: data.array for name, data in recording.sources.items()}
    n = min(len(data.t_ns) for data in recording.sources.values())
    raw = np.hstack([data.rate_rps[:n] for data in recording.sources.values()])
    ours = compensate(Compensation.of(calibration.gyros, arrays), raw, np.arange(n) * 0.01)
    assert np.abs(body_rate(raw) - ours).max() < 1e-9
    # And of outputs that the states made, the rate that made them.
    w = np.random.default_rng(1).normal(size=(200, 3))
    states = np.array([gyro.states for gyro in calibration.gyros])
    made = predicted_output(tetrahedron(), states, w)
    assert np.abs(body_rate(made) - w).max() < 1e-12


def test_with_an_investigation_the_traced_effects_are_corrected_and_verified(
    traced: tuple[Path, Path], tmp_path: Path
) -> None:
    path, results = traced
    text = reported(path, tmp_path, "--investigation", results)
    words = words_of(parsed(text))
    assert "Verdict: added. Added scale asymmetry." in words
    assert "An investigation added scale asymmetry to the model" in words
    assert "No verification run was given" not in words
    assert re.search(r"The rms error became [\d.]+ times smaller", words)
    with h5py.File(results) as file:
        states = file["investigation/states_after"][()]
        model = json.loads(file["investigation/error_model"][()])
        what = json.loads(file["investigation"].attrs["json"])
    shown = {float(e.get("value")) for e in parsed(text).iter("data")}
    assert {what["before"]["rms_rps"], what["after"]["rms_rps"]} <= shown
    half = np.array([model["effects"][0]["found"][f"gyro{i}"][0][0] for i in (1, 2, 3, 4)])
    w = np.random.default_rng(2).normal(size=(200, 3))
    made = predicted_output(tetrahedron(), states, w) + half * np.abs(w @ tetrahedron().p.T)
    assert np.abs(code_of(text, "traced")["body_rate"](made) - w).max() < 1e-9
    assert title_of(text).startswith("Calibration report")
    with h5py.File(shutil.copy(results, tmp_path / "alone.h5"), "r+") as file:
        file["investigation"].attrs["json"] = json.dumps({**what, "in_sample": True, "verification": []})
    (tmp_path / "alone").mkdir()
    alone = reported(path, tmp_path / "alone", "--investigation", tmp_path / "alone.h5")
    assert "No verification run was given" in words_of(parsed(alone))


def test_an_investigation_that_the_recording_holds_is_found_there(traced: tuple[Path, Path], tmp_path: Path) -> None:
    path = Path(shutil.copy(traced[0], tmp_path / "both.h5"))
    assert read_traced(None, read_recorded(path)) is None
    with h5py.File(traced[1]) as results, h5py.File(path, "r+") as file:
        results.copy("investigation", file)
    found = read_traced(None, read_recorded(path))
    assert found is not None
    assert found.added
    assert len(found.residuals) == 4


def gyros_with(effects: list[KnownEffect]) -> tuple[list[GyroCalibration], str]:
    """Return four gyros that have these effects in sizes of their own, and the text of their model."""
    rng = np.random.default_rng(5)
    gyros = []
    for i, name in enumerate(tetrahedron().names):
        values = tuple(
            EffectValue(
                effect=e.called,
                parameter=s.name,
                value=float(s.sd * rng.normal()),
                sd=0.1 * s.sd,
                unit=s.unit,
                expected_sd=s.sd,
                shared=False,
            )
            for e in effects
            for s in e.sizes
        )
        states = np.array([0.005, 0.002, 0.0017, -0.0017]) * rng.normal(size=4)
        p = tetrahedron().p[i]
        gyros.append(
            GyroCalibration(
                name=name,
                source="array",
                states=states,
                covariance=np.eye(4) * 1e-9,
                noise_rps=1e-4,
                p=p,
                device="array",
                effects=values,
            )
        )
    return gyros, ErrorModel(tuple(effects)).text()


LAWS = [
    *("lag(T, 1.5)*gx", "play(gy, 0.3); exp(T/12)", "last(Tdot)", "log1p(t/2)*gs", "abs(wx)*wy - u**3/9", "u*T"),
    *("sign(u)*sqrt(abs(u))", "last(u)*speed", "last(u, 0.3)", "lag(u**2, 0.8)", "play(u, 0.2); cos(wz)", "u*Tdot"),
    *("jolt*1e-3 + a*1e-3", "tanh(u/2)"),
]


def law(text: str, sd: float = 3e-4) -> KnownEffect:
    """A constructed effect."""
    sizes = tuple(Size(f"of {term.strip()}", "rad/s per unit", 0.0, sd) for term in text.split(";"))
    return KnownEffect("constructed", False, sizes, {"law": text})


@pytest.mark.parametrize("text", LAWS)
def test_the_snippet_undoes_a_law_by_itself(text: str) -> None:
    gyros, model = gyros_with([law(text)])
    compensation = Compensation.of(gyros, {"array": tetrahedron()}, model)
    defined: dict[str, Any] = {}
    exec(snippet(Correction("array", compensation, False, {}), "made by hand"), defined)
    rng, t_s = np.random.default_rng(7), np.arange(300) * 0.01
    raw, warm, force = rng.normal(size=(300, 4)), 25 + rng.normal(size=300) * 5, rng.normal(size=(300, 3)) * 9.8
    given = {"temperature_c": warm, "accel_mps2": force, "t_s": t_s}
    names = inspect.signature(defined["body_rate"]).parameters
    found = defined["body_rate"](raw, **{name: given[name] for name in names if name in given})
    np.testing.assert_allclose(found, compensate(compensation, raw, t_s, warm, force), rtol=0, atol=1e-9)


def test_laws_that_were_constructed_are_printed_and_reported_in_words_and_as_formulas(
    bare: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    laws = [law("lag(abs(u), 5)"), law("cos(2*angle_x); sin(2*angle_x)"), law("u*gz"), law("u*ms")]
    model = tmp_path / "model.json"
    model.write_text(ErrorModel(tuple(laws)).text(), encoding="utf-8")
    assert main(["calibrate", "--write", "--model", str(model), str(bare), "--details"]) in (0, 1)
    printed = " ".join(re.sub("[│┃]", " ", capsys.readouterr().out).split())
    in_words = "bias proportional to the size of the rate about the sense axis lagged by 5 s"
    assert "constructed: bias proportional to" in printed
    assert "of u*gz" in printed
    text = reported(bare, tmp_path)
    words = words_of(parsed(text))
    assert f"constructed: {in_words}" in words
    assert "a lag(abs(u), 5)" in words
    assert "u: rate about the sense axis in rad/s" in words
    assert re.search(
        r"Not undone: constructed: bias proportional to cos of \(.*belongs to the axes of the table", words
    )
    assert re.search(
        r"Not undone: .*horizontal x of the base along the sense axis.*belongs to the axes of the table", words
    )
    arrays = {name: data.array for name, data in read_recording(bare).sources.items()}
    calibration = read_calibration(bare)
    compensation = Compensation.of(calibration.gyros, arrays, calibration.model)
    t_s = np.arange(200) * 0.01
    raw = np.random.default_rng(8).normal(size=(200, len(calibration.gyros)))
    ours = compensate(compensation, raw, t_s, accel_mps2=np.full((200, 3), 5.0))
    assert np.abs(code_of(text)["body_rate"](raw, accel_mps2=np.full((200, 3), 5.0), t_s=t_s) - ours).max() < 1e-9


def test_the_snippet_undoes_every_effect_as_our_compensation_does() -> None:
    effects = [
        KnownEffect("thermal_bias", False, (Size("linear", "rad/s/K", 0.0, 1e-4),)),
        KnownEffect("thermal_bias_quadratic", False, (Size("quadratic", "rad/s/K2", 0.0, 1e-6),)),
        KnownEffect("thermal_scale", False, (Size("linear", "1/K", 0.0, 2e-4),)),
        KnownEffect("g_sensitivity", False, tuple(Size(f"along body {a}", "rad/s/g", 0.0, 1e-3) for a in "xyz")),
        KnownEffect("warm_up", False, (Size("with 90 s", "rad/s", 0.0, 2e-3),), {"time_constant_s": 90.0}),
        KnownEffect("scale_quadratic", False, (Size("u^2", "1/(rad/s)", 0.0, 3e-3),)),
        KnownEffect("scale_cubic", False, (Size("u^3", "1/(rad/s)2", 0.0, 3e-3),)),
        KnownEffect("scale_asymmetry", False, (Size("each direction", "1", 0.0, 3e-3),)),
        KnownEffect("thermal_gradient", False, (Size("slope", "rad/s/(K/s)", 0.0, 0.1),)),
        KnownEffect("bandwidth", False, (Size("time constant", "s", 0.0, 4e-3),)),
        KnownEffect("acceleration_sensitivity", False, tuple(Size(f"about {a}", "s", 0.0, 2e-3) for a in "jk")),
    ]
    assert {effect.name for effect in effects} == {e.name for e in everything() if e.acts and e.acts is not Acts.STAMPS}
    effects += [law(text) for text in LAWS]
    gyros, model = gyros_with(effects)
    compensation = Compensation.of(gyros, {"array": tetrahedron()}, model)
    defined: dict[str, Any] = {}
    exec(snippet(Correction("array", compensation, False, {}), "made by hand"), defined)
    rng = np.random.default_rng(6)
    raw, t_s = rng.normal(size=(300, 4)), np.arange(300) * 0.01
    raw[50], raw[60], t_s[100] = np.nan, 1e6, t_s[99]
    warm, force = 25 + rng.normal(size=300) * 5, rng.normal(size=(300, 3)) * 9.8
    ours = compensate(compensation, raw, t_s, warm, force)
    given = {"temperature_c": warm, "accel_mps2": force, "t_s": t_s}
    with np.errstate(over="ignore", invalid="ignore"):
        found = defined["body_rate"](raw, **given)
    assert np.isnan(found[[50, 60, 61]]).all()
    assert np.isfinite(found).all(axis=1).sum() == 297
    np.testing.assert_allclose(found, ours, rtol=0, atol=1e-9)


def test_gyros_that_do_not_span_space_are_corrected_about_their_own_axes(bare: Path, tmp_path: Path) -> None:
    with h5py.File(bare, "r+") as file:
        for name in ("gyro3", "gyro4"):
            del file[f"imu/{name}"]
        group = file["calibration"]
        for name in list(group):
            kept = group[name][:2]
            del group[name]
            group[name] = kept
    own_rates = code_of(reported(bare, tmp_path))["own_rates"]
    states = np.array([gyro.states for gyro in read_calibration(bare).gyros])
    w = np.random.default_rng(1).normal(size=(50, 3))
    array = tetrahedron().select([0, 1])
    about = array.p - states[:, 3:4] * array.j + states[:, 2:3] * array.k
    assert np.abs(own_rates(predicted_output(array, states, w)) - w @ about.T).max() < 1e-12


def test_gyros_of_the_same_name_are_kept_apart(copy: Path) -> None:
    with h5py.File(copy, "r+") as file:
        file["imu/gyro2"].attrs["names"] = ["gyro1"]
        file["calibration/name"][1] = b"gyro1"
    lines = standing_of(read_recorded(copy)).lines
    assert {line.gyro for line in lines} == {"gyro1 gyro1", "gyro2 gyro1", "gyro3", "gyro4", "all"}


def test_data_measured_elsewhere_get_a_report(tmp_path: Path) -> None:
    path = tmp_path / "imported.h5"
    assert main(["import", str(FERRARIS / "mapping.toml"), str(FERRARIS / "session.csv"), "-o", str(path)]) == 0
    assert main(["calibrate", "--write", "--json", str(path)]) == 0
    text = reported(path, tmp_path)
    assert title_of(text) == "Calibration report"
    words = words_of(parsed(text))
    assert "NOT JUDGED" in words
    assert "turns of known angle measured elsewhere" in words
    assert "states no uncertainty for it" in words
    assert "Type B: none" in words
    assert "Adjustment" not in words  # nobody knows


def test_text_from_a_file_is_never_taken_for_html(bare: Path, tmp_path: Path) -> None:
    nasty = """</style><script>alert("1")</script>' " \\ & <b>"""
    with h5py.File(bare, "r+") as file:
        file.attrs.update({"device_serial": nasty, "operator": nasty, "reason": nasty})
        file.attrs.update({"accepted_by": "G. Hopper", "accepted_utc": "2026-11-21T10:15:02+00:00"})
        file["events/text"][0] = f"note: {nasty}".encode()
    tree = parsed(reported(bare, tmp_path))
    assert not list(tree.iter("script"))
    assert nasty in "".join(tree.itertext())
    assert re.search(r"note of the operator </style>", words_of(tree))
    assert "G. Hopper on 2026-11-21T10:15:02+00:00" in words_of(tree)


def test_the_raw_data_keep_their_hash_whatever_is_estimated(copy: Path) -> None:
    before = raw_sha256(copy)
    assert main(["calibrate", "--write", "--json", str(copy)]) == 0
    with h5py.File(copy, "r+") as file:
        file.attrs["accepted_by"] = "somebody"
    assert raw_sha256(copy) == before
    with h5py.File(copy, "r+") as file:
        file["imu/gyro1/rate_rps"][7] += 1e-12
    assert raw_sha256(copy) != before


def test_without_a_name_it_is_written_beside_the_recording_and_never_over_another(copy: Path) -> None:
    without_estimate(copy, "ABORTED")  # such a report is short
    for name in ("copy.html", "copy-2.html"):
        assert main(["report", str(copy)]) == 0
        assert copy.with_name(name).is_file()


def damaged(path: Path) -> None:
    raw = bytearray(path.read_bytes())
    raw[600 : len(raw) // 2] = bytes(len(raw) // 2 - 600)
    path.write_bytes(raw)


def later(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file.attrs["format_version"] = 99


def uncalibrated(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["calibration"]


def not_finite(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["calibration/states"][0, 0] = np.nan


def misshapen(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["estimate/gyro1/sd"]


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (damaged, "cannot be read|damaged"),
        (later, "format version 99.*Update"),
        (uncalibrated, "station calibrate --write"),
        (not_finite, "station calibrate --write"),
        (misshapen, "do not have the layout"),
    ],
)
def test_a_recording_that_cannot_be_reported_is_refused_with_the_reason(
    copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], spoil: Callable[[Path], None], told: str
) -> None:
    spoil(copy)
    out = tmp_path / "r.html"
    assert re.search(told, refused(capsys, copy, "-o", out))
    assert not out.exists()


def test_files_that_are_there_or_cannot_be_are_refused_before_the_work(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "there.html").write_text("kept")
    assert "exists already" in refused(capsys, run, "-o", tmp_path / "there.html")
    assert "exists already" in refused(capsys, run, "-o", tmp_path / "there.pdf")
    assert (tmp_path / "there.html").read_text() == "kept"
    assert "does not exist" in refused(capsys, run, "-o", tmp_path / "none" / "r.html")
    assert ".html or .pdf" in refused(capsys, run, "-o", tmp_path / "r.docx")
    assert "not a file" in refused(capsys, tmp_path / "missing.h5", "-o", tmp_path / "r.html")


def test_an_investigation_of_other_gyros_or_none_is_refused(
    run: Path, traced: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "is not the result of an investigation" in refused(
        capsys, run, "-o", tmp_path / "r.html", "--investigation", run
    )
    other = Path(shutil.copy(traced[1], tmp_path / "other.h5"))
    with h5py.File(other, "r+") as file:
        file["investigation/name"][0] = b"gyroX"
    assert "gyroX" in refused(capsys, run, "-o", tmp_path / "r.html", "--investigation", other)


def test_without_weasyprint_the_html_is_kept_and_said_what_to_install(
    bare: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "weasyprint", None)
    said = refused(capsys, bare, "-o", tmp_path / "r.pdf")
    assert "apt install libpango" in said
    assert str(tmp_path / "r.html") in said
    assert (tmp_path / "r.html").is_file()
    assert not (tmp_path / "r.pdf").exists()


def test_the_page_of_the_recording_names_all_that_a_run_writes(run: Path) -> None:
    page = (Path(__file__).parents[2] / "docs/pages/reference/recording.md").read_text(encoding="utf-8")
    with h5py.File(run) as recording:
        assert not {name for name in names_in(recording) if f"`{name}`" not in page}


def names_in(group: h5py.Group) -> Iterator[str]:
    """Yield the names of all datasets and attributes."""
    yield from group.attrs
    for name, item in group.items():
        if isinstance(item, h5py.Group):
            yield from names_in(item)
        else:
            yield from (name, *item.attrs)


@pytest.fixture(scope="module")
def printed(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the PDF of the run."""
    if find_library("pango-1.0") is None:
        pytest.skip("no Pango on this machine")
    path = tmp_path_factory.mktemp("printed") / "r.pdf"
    assert main(["report", str(run), "-o", str(path)]) == 0
    return path


def test_the_pdf_is_on_a4_with_numbered_pages(printed: Path) -> None:
    assert printed.with_suffix(".html").is_file()
    if shutil.which("pdftotext") is None:
        pytest.skip("no poppler on this machine")
    size = subprocess.run(["pdfinfo", printed], capture_output=True, text=True, check=True).stdout
    assert re.search(r"Page size: .*\(A4\)", size)
    text = subprocess.run(["pdftotext", "-layout", printed, "-"], capture_output=True, text=True, check=True).stdout
    pages = text.split("\f")[:-1]
    assert len(pages) == 5
    for number, page in enumerate(pages, 1):
        assert f"Page {number} of {len(pages)}" in page
    # Every row of the results is on one page with the heading of its table.
    results = next(page for page in pages if "Results of the calibration" in page)
    assert "expanded uncertainty" in results
    assert all(f"gyro{i}" in results for i in (1, 2, 3, 4))
    # The figures of the document are those of the PDF.
    shown = [words_of(data) for data in parsed(printed.with_suffix(".html").read_text(encoding="utf-8")).iter("data")]
    text = subprocess.run(["pdftotext", "-raw", printed, "-"], capture_output=True, text=True, check=True).stdout
    assert not {figure for figure in shown if "".join(figure.split()) not in "".join(text.split())}


@pytest.mark.full
def test_the_pdf_has_the_same_bytes_again(run: Path, printed: Path, tmp_path: Path) -> None:
    assert main(["report", str(run), "-o", str(tmp_path / "again.pdf")]) == 0
    assert (tmp_path / "again.pdf").read_bytes() == printed.read_bytes()
    if shutil.which("qpdf") is not None:
        said = subprocess.run(["qpdf", "--check", printed], capture_output=True, text=True, check=False)
        assert said.returncode == 0, said.stdout


def test_the_figures_of_json_are_those_of_the_recording(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert main(["export", str(run), "--format", "json"]) == 0
    gyros = json.loads(capsys.readouterr().out)["gyros"]
    with h5py.File(run) as file:
        found = file["calibration"]
        for i, gyro in enumerate(gyros):
            assert list(gyro["states"].values()) == list(found["states"][i])
            assert gyro["covariance"] == found["covariance"][i].tolist()
            budget = [list(line.values()) for line in gyro["budget"].values()]
            assert budget == pytest.approx(np.asarray(found["budget"][i][: len(budget)]), rel=1e-15)


META = """
[laboratory]
name = "Laboratory for <inertial> sensors"
[item]
model = "TG4"
{item}
[performed]
temperature = "21.4 degC"
temperature_from = "thermohygrometer"
[[equipment]]
name = "rate table"
due = {due}
[decision]
rule = "guard band"
false_accept = "{false_accept}"
[certificate]
number = "C-17"
approved_by = "{approved_by}"
next_due = 2027-11-18
"""


def certified(run: Path, folder: Path, **facts: str) -> str:
    """Return the report of a run with formal facts."""
    stated = {"due": "2027-03-31", "false_accept": "1 %", "approved_by": "G. Hopper", "item": ""} | facts
    (folder / "meta.toml").write_text(META.format(**stated))
    return reported(run, folder, "--meta", folder / "meta.toml")


def stating(formal: Formal, **facts: Any) -> Formal:
    """Return formal facts with others."""
    return Formal({**formal.stated, **facts})


def test_a_logo_that_is_no_file_is_refused_at_once(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "zero.png").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "huge.png").write_bytes(bytes(2 << 20))
    meta = tmp_path / "meta.toml"
    for name, said in {"zero": "a pipe or a device", "pipe": "a pipe or a device", "huge": "larger than 1 MB"}.items():
        meta.write_text(f'[laboratory]\nlogo = "{name}.png"\n')
        assert said in refused(capsys, run, "--meta", meta, "-o", tmp_path / "r.html")


def test_a_logo_leads_the_printer_to_no_host_and_no_file(tmp_path: Path) -> None:
    if find_library("pango-1.0") is None:
        pytest.skip("no Pango on this machine")
    pixel = b64decode(
        "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
    )
    (tmp_path / "secret.png").write_bytes(pixel)
    printed = []
    for href in (f"file://{tmp_path}/secret.png", "no:where"):
        image = f'<image href="{href}" width="9" height="9"/>'
        svg = f'<svg xmlns="http://www.w3.org/2000/svg" width="9" height="9">{image}</svg>'
        picture = f'<img src="data:image/svg+xml;base64,{b64encode(svg.encode()).decode()}">'
        print_pdf(f"<html><head><title>t</title><style></style></head><body>{picture}", tmp_path / "r.pdf")
        printed.append((tmp_path / "r.pdf").read_bytes())
        (tmp_path / "r.pdf").unlink()
    assert printed[0] == printed[1]


def test_formal_facts_are_in_their_places_and_what_lacks_is_said(
    bare: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    real(bare)
    found = Path(shutil.copy(bare, tmp_path / "as_found.h5"))
    with h5py.File(found, "r+") as file:
        left = float(file["calibration/states"][0, 0]) * 1e6
        file["calibration/states"][0, 0] = 4321e-6
    html = certified(bare, tmp_path, item='as_found = "as_found.h5"')
    with h5py.File(found, "r+") as file:
        file.attrs["clock_zero_utc_s"] += 60.0
    assert "an earlier calibration" in refused(
        capsys, bare, "--meta", tmp_path / "meta.toml", "-o", tmp_path / "r.html"
    )
    row = next(words_of(row) for row in parsed(html).iter("tr") if words_of(row).startswith("gyro1 k 43"))
    assert float(row.split()[4]) == pytest.approx(left, rel=0.02)
    text = words_of(parsed(html))
    assert title_of(html) == "Calibration certificate"
    for wanted in ("Laboratory for <inertial> sensors", "No. C-17", "TG4", "21.4 °C (thermohygrometer)", "2027-03-31",
                   "Approved by G. Hopper", "Next calibration due 2027-11-18", "rate table"):  # fmt: skip
        assert wanted in text, wanted
    assert re.search(r"Not stated: customer, .*date of receipt, .*date of issue\.", text)


def test_a_certificate_needs_equipment_that_is_not_overdue_and_the_approval_that_the_bench_wants(
    bare: Path, tmp_path: Path
) -> None:
    real(bare)
    late = certified(bare, tmp_path, due="2026-11-17")
    assert title_of(late) == "Calibration report"
    assert "The calibration of rate table had expired on 2026-11-18" in words_of(parsed(late))
    with h5py.File(bare, "r+") as file:
        file.attrs["bench"] = str(file.attrs["bench"]) + "\n[station]\napproved_by_another = true\n"
    recorded = read_recorded(bare)
    for name, kind in (("a. turing", Kind.NOT_APPROVED), (None, Kind.NOT_APPROVED), ("G. Hopper", Kind.CERTIFICATE)):
        assert standing_of(recorded, stating(read_formal(recorded), certificate_approved_by=name)).kind is kind


def test_a_guard_band_accepts_up_to_the_stated_probability_of_a_value_beyond_the_limit(copy: Path) -> None:
    real(copy)
    with h5py.File(copy, "r+") as file:
        row = int(np.argmax(np.abs(file["calibration/states"][:, 0])))
        k, sd = float(file["calibration/states"][row, 0]), float(np.sqrt(file["calibration/covariance"][row, 0, 0]))
        bench = str(file.attrs["bench"])
    for sigmas, kind in ((2.5, Kind.CERTIFICATE), (2.2, Kind.FAILED)):  # 1 % of a normal distribution: 2.326 sigmas
        limit = f'scale_factor_error = "{(abs(k) + sigmas * sd) * 1e6!r} ppm"'
        with h5py.File(copy, "r+") as file:
            file.attrs["bench"] = bench.replace('scale_factor_error = "10000 ppm"', limit, 1)
        recorded = read_recorded(copy)
        guarded = standing_of(recorded, stating(read_formal(recorded), decision_false_accept=0.01))
        line = next(line for line in guarded.lines if (line.row, line.state) == (row, 0))
        assert guarded.kind is kind
        assert line.guard == pytest.approx(2.3263479 * sd, rel=1e-6)
        assert standing_of(recorded).kind is Kind.CERTIFICATE  # by simple acceptance
    assert guarded.verdict is not None
    assert guarded.verdict.reason.startswith("within the limits, but not up to the guard band: ")
    assert f"{line.gyro} k" in guarded.verdict.reason
