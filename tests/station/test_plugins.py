"""Devices, steps, effects and export forms of one's own: the examples as a package that pip installs, or as files."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
from support import command

from estimator.calibration.calibration_file import read_calibration
from estimator.calibration.compensation import Compensation
from estimator.calibration.correction import compensate
from estimator.effects import catalogue
from estimator.recordings.reading import read_recording
from station.cli import main
from station.screen.choices import Choices
from station.screen.panes.start import ScriptView, script_text
from station.screen.sessions.answers import Reply
from station.screen.tabs.prospects import look_ahead
from station.scripts.script import paper_script
from station.views.answers.plan import plan_view_of
from station.views.figures import STATE_FIGURES

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
EFFECT, FORM = str(EXAMPLES / "sticking_mass.py"), str(EXAMPLES / "octave_form.py")
SIZES = np.radians([0.02, -0.02, 0.015])
ANNOUNCED = """
[turntable_station.tables]
numbered = numbered_table:SPEC
[turntable_station.imus]
counted = counted_imu:SPEC
[turntable_station.effects]
sticking_mass = sticking_mass:EFFECT
[turntable_station.exports]
octave = octave_form:FORMAT
[turntable_station.steps]
wait_for = wait_for:SPEC
"""
AXIS = '[table.{}]\nmax_rate = "100 deg/s"\nmax_acceleration = "50 deg/s2"\n'
BENCH = (
    '{first}\n[site]\nlatitude = "40 deg"\n[undeclared]\neffects = "none"\n'
    '[table]\nprotocol = "numbered"\npoll_rate = "5 Hz"\n'
    + "".join(map(AXIS.format, "zyx"))
    + """
[[imu]]
name = "mine"
protocol = "counted"
array = "triad"
rate = "50 Hz"
resolution = "18 deg/h"
[imu.datasheet]
arw = "0.005 deg/s/rtHz"

[limits]
scale_factor_error = "1 %"
bias = "1 deg/s"
misalignment = "0.5 deg"
lost = "2 %"

[twin]
hidden = "hidden.toml"
[twin.mine]
k = ["3000 ppm", "-2000 ppm", "1000 ppm"]
b = "0.1 deg/s"
[twin.mine.fault]
dropped = "1 %"
"""
)
REST = '[[step]]\nkind = "rest"\nduration = "8 s"\n'
TURN = '[[step]]\nkind = "rotate"\naxis = "{}"\nrate = "{} deg/s"\nacceleration = "40 deg/s2"\nduration = "7 s"\n'
SHORT = REST.join(["", *(TURN.format(axis, rate) for axis in "xyz" for rate in (40, -40)), ""])
"""Each axis turns both ways, at rest before and after: what sticks, sticks at the other end after each turn."""
HIDDEN = f"[hysteresis]\nsize = {json.dumps([f'{size:g} deg/s' for size in np.degrees(SIZES)])}\n"


def packed(folder: Path) -> Path:
    """Pack the examples as a wheel that announces them by entry points."""
    files = {path.name: path.read_text() for path in sorted(EXAMPLES.glob("*.py"))}
    about = "mine-1.0.dist-info"
    files[f"{about}/METADATA"] = "Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n"
    files[f"{about}/WHEEL"] = "Wheel-Version: 1.0\nGenerator: hand\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
    files[f"{about}/entry_points.txt"] = ANNOUNCED
    files[f"{about}/RECORD"] = "".join(f"{name},,\n" for name in files)
    wheel = folder / "mine-1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    return wheel


@pytest.fixture(scope="module", params=["short", pytest.param("paper", marks=pytest.mark.full)])
def script(request: pytest.FixtureRequest) -> str:
    """Which script the table and the IMU of the package run: a short one, or that of 360 s."""
    return str(request.param)


@pytest.fixture(scope="module")
def installed(script: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with the package installed by pip, and a run on its table and its IMU."""
    folder = tmp_path_factory.mktemp("installed")
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--no-compile"]
    subprocess.run([*pip, "--target", str(folder / "site"), str(packed(folder))], check=True, timeout=60)
    (folder / "bench.toml").write_text(BENCH.format(first=""))
    (folder / "hidden.toml").write_text(HIDDEN)
    (folder / "short.toml").write_text(SHORT)
    typed = ["--script", str(folder / "short.toml")] if script == "short" else []
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder / "site"))
        patch.setattr(catalogue, "_BY_NAME", dict(catalogue._BY_NAME))
        bench, run, model = (str(folder / name) for name in ("bench.toml", "run.h5", "model.h5"))
        assert main(["run", "--bench", bench, *typed, "--json", "--seed", "3", "-o", run]) == 0
        assert main(["investigate", run, "-o", model, "--most-effects", "1", "--json"]) == 0
        assert main(["calibrate", run, "--model", model, "--write", "--json"]) == 0
        yield folder


@pytest.fixture
def here(installed: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder as the working one, with the package."""
    monkeypatch.chdir(installed)
    return installed


@pytest.fixture
def alone(here: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The same without the package, as on another computer."""
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry != str(here / "site")])
    monkeypatch.setattr(catalogue, "_BY_NAME", dict(catalogue._BUILT_IN))
    monkeypatch.setenv("STATION_PLUGINS", "")  # what main leaves there goes with the test
    return here


def test_no_example_is_longer_than_a_page_or_three() -> None:
    lengths = {path.name: len(path.read_text().splitlines()) for path in EXAMPLES.glob("*.py")}
    assert len(lengths) == 6
    assert max(lengths.values()) <= 150
    assert lengths["wait_for.py"] <= 60


def test_the_table_and_the_imu_pass_a_script(here: Path, script: str) -> None:
    with h5py.File("run.h5") as file:
        assert file.attrs["outcome"] == "PASS"
        assert list(file.attrs["plugins"]) == ["the package mine 1.0"]
        assert str(file.attrs["script"]) == (paper_script().name if script == "paper" else script)
    gyros = read_calibration(Path("run.h5")).gyros
    for gyro, k in zip(gyros, (3e-3, -2e-3, 1e-3), strict=True):
        k_found, b_rps, *_ = gyro.states
        assert abs(k_found - k) < 4 * gyro.sd[0]
        assert abs(b_rps - np.radians(0.1)) < 4 * gyro.sd[1]


def waiting(change: str) -> str:
    """Return a step that waits for 6 to 30 s until the temperature has settled, as a part of a script."""
    return f'''
[[step]]
kind = "wait_for"
least = "6 s"
most = "30 s"
window = "3 s"
change = "{change}"
label = "within {change}"
'''


TURN = """
[[step]]
kind = "rotate"
axis = "x"
rate = "20 deg/s"
duration = "10 s"
"""


def test_a_plan_and_the_screen_show_a_step_whose_duration_is_not_known(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("waits.toml").write_text(TURN + waiting("5 degC") + TURN)
    assert main(["plan", "waits.toml", "--bench", "bench.toml", "--json"]) in (0, 1)
    planned = json.loads(capsys.readouterr().out)
    assert (planned["duration_s"], planned["longest_s"]) == (26, 50)
    assert planned["steps"][1] == {
        "label": "within 5 degC",
        "duration_s": 6,
        "longest_s": 30,
        "axis": None,
        "rate_rps": None,
    }
    assert main(["plan", "waits.toml", "--bench", "bench.toml"]) in (0, 1)
    shown = " ".join(capsys.readouterr().out.split())
    assert "waits: 26 to 50 s (0:26 to 0:50 min), 3 steps" in shown
    assert re.search("_~+_", shown)
    assert "within 5 degC: 6 to 30 s. The prediction is for the shortest run." in shown

    prospect = look_ahead(Choices(bench="bench.toml", script="waits.toml"))
    reply = Reply(code=0, value=plan_view_of(planned), reason="")
    shown = script_text(ScriptView(prospect=prospect, plan=reply, figures=STATE_FIGURES)).plain
    assert "Script waits: 0:26 to 0:50 min" in shown
    assert all(f"\n{gyro['name']} " in shown for gyro in planned["gyros"])


def test_a_run_waits_as_long_as_a_step_takes_and_says_what_remains(
    here: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    Path("waits.toml").write_text(TURN + waiting("5 degC") + waiting("0 degC") + TURN)
    run = str(tmp_path / "waits.h5")
    assert main(["run", "--bench", "bench.toml", "--script", "waits.toml", "--seed", "3", "-o", run]) in (0, 1)
    with h5py.File(run) as file:
        lasted_s = (file["steps/t_end_ns"][()] - file["steps/t_start_ns"][()]) * 1e-9
        told = [text.decode() for text in file["events/text"][()]]
    # The first has settled as soon as it may end; the noise of the thermometer keeps the second to its end.
    assert lasted_s == pytest.approx([10, 6, 30, 10], abs=0.2)
    assert "step 'within 0 degC' ended after 30 s: the temperature had not settled" in told
    remaining = re.findall(r"(\S+)%  (.+?)  +([0-9:]+(?: to [0-9:]+)?) left", capsys.readouterr().err)
    shares = [int(share) for share, _, _ in remaining]
    assert shares == sorted(shares)
    assert any(label == "x at 20 deg/s" and " to " in left for _, label, left in remaining[:3])
    assert " to " not in remaining[-1][2]


def test_the_effect_is_planned_for_found_and_estimated(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "--bench", "bench.toml", "--json"]) == 0
    planned = {effect["name"]: effect for effect in json.loads(capsys.readouterr().out)["effects"]}
    assert planned["sticking_mass"]["parameters"][0]["smallest"]["x"] < SIZES[0]
    with h5py.File("model.h5") as file:
        told = json.loads(file["investigation"].attrs["json"])
    assert [added["effect"] for added in told["added"]] == ["sticking_mass"]
    for gyro, size in zip(read_calibration(Path("run.h5")).gyros, SIZES, strict=True):
        assert abs(gyro.effects[0].value - size) < 4 * gyro.effects[0].sd < 1e-4


def test_the_effect_is_undone_by_the_exports_and_stands_in_the_report(here: Path) -> None:
    calibration, recording = read_calibration(Path("run.h5")), read_recording(Path("run.h5"))
    data = recording.sources["mine"]
    own = Compensation.of(calibration.gyros, {"mine": data.array}, calibration.model)
    rate, t_s = data.rate_rps[:300], (data.t_ns[:300] - data.t_ns[0]) * 1e-9
    for form, name in (("python", "made.py"), ("c", "made.h")):
        assert main(["export", "run.h5", "--format", form, "-o", name]) == 0
    assert re.search(r"_sticking_mass\[3\] = \{", Path("made.h").read_text(encoding="utf-8"))
    made: dict[str, object] = {}
    exec(Path("made.py").read_text(encoding="utf-8"), made)
    correction = made["Correction"]()  # type: ignore[operator]
    exported = [correction.correct(row) for row in rate.tolist()]
    np.testing.assert_allclose(exported, compensate(own, rate, t_s), rtol=0, atol=1e-12)

    assert main(["report", "run.h5", "-o", "report.html"]) == 0
    text = Path("report.html").read_text(encoding="utf-8")
    assert "sticking mass" in text
    assert "last(<var>u</var>" in text


def test_the_form_is_listed_and_written(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", "--list", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert listed["octave"] == {
        "holds": "function of GNU Octave or MATLAB with scale, misalignment and bias",
        "lacks": "no effects",
    }
    with pytest.raises(SystemExit):
        main(["export", "--help"])
    assert re.search(r"json, yaml,.*ardupilot,\s+octave", capsys.readouterr().out, re.DOTALL)

    assert main(["export", "run.h5", "--format", "octave"]) == 0
    written = capsys.readouterr()
    assert "not in octave: sticking mass: it is not corrected" in written.err
    (solution,) = re.findall(r"solution = \[(.*)\];", written.out)
    (bias,) = re.findall(r"bias = \[(.*)\];", written.out)
    gyros = read_calibration(Path("run.h5")).gyros
    assert np.array(bias.split(), dtype=float) == pytest.approx([gyro.states[1] for gyro in gyros])
    found = np.array([row.split() for row in solution.split("; ")], dtype=float)
    assert np.diag(found) == pytest.approx([1 / (1 - gyro.states[0]) for gyro in gyros], abs=1e-6)


def test_a_form_that_returns_no_written_is_told_so(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("STATION_PLUGINS", "")  # what main leaves there goes with the test
    Path("bare.py").write_text(
        'from station.exports.formats import Format\nFORM = Format(name="bare", write=lambda exported: "text")\n'
    )
    assert main(["export", "run.h5", "--plugin", "bare.py", "--format", "bare"]) == 2
    assert "the form bare failed: TypeError: it returned str, not Written" in capsys.readouterr().err


def test_a_file_in_the_working_folder_is_told_with_its_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text("\nimport no_such_module\n")
    assert main(["conformance", "mine.py"]) == 2
    assert "plug-in mine.py, line 2: ModuleNotFoundError" in capsys.readouterr().err


def test_a_device_without_a_twin_is_told_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    own = (EXAMPLES / "counted_imu.py").read_text().replace("    twin=CountedTwin,\n", "")
    Path("mine.py").write_text(own.replace('name="counted"', 'name="mute"'))
    bench = BENCH.format(first='plugins = ["mine.py"]').replace("hidden", "#").replace('"counted"', '"mute"')
    for axis, letter in zip("zyx", "ABC", strict=True):
        keys = f'[table.{axis}]\nletter = "{letter}"\ncounts_per_turn = 36000'
        bench = bench.replace(f"[table.{axis}]", keys)
    Path("b.toml").write_text(bench.replace('"numbered"', '"galil"'))
    assert main(["check", "b.toml"]) == 2
    assert "mute has no twin: its SPEC needs one, or the bench file a link" in capsys.readouterr().err


def test_a_driver_that_ends_its_samples_ends_the_run_at_rest_and_is_named(
    here: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ends = "yield self._device, block\n                if block.t_ns[-1] > 3_000_000_000:\n                    return"
    own = (EXAMPLES / "counted_imu.py").read_text().replace("yield self._device, block", ends)
    (tmp_path / "ending.py").write_text(own.replace('name="counted"', 'name="ending"'))
    bench = BENCH.format(first=f"plugins = ['{tmp_path / 'ending.py'}']").replace('"counted"', '"ending"')
    (tmp_path / "b.toml").write_text(bench.replace('"hidden.toml"', f"'{here / 'hidden.toml'}'"))
    typed = ["--bench", str(tmp_path / "b.toml"), "--script", "short.toml", "-o", str(tmp_path / "ends.h5")]
    assert main(["run", *typed]) not in (0, 1)
    assert "mine: its driver ended its samples in mid-run" in capsys.readouterr().out


def test_a_form_that_is_none_is_told_with_the_nearest(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", "run.h5", "--format", "octaev"]) == 2
    assert re.search(r"'octaev' is not one of json, .*, octave; did you mean octave\?", capsys.readouterr().err)


@pytest.mark.parametrize(
    "typed",
    [
        ["calibrate", "run.h5", "--model", "model.h5"],
        ["export", "run.h5", "--format", "c"],
        ["report", "run.h5", "-o", "other.html"],
    ],
    ids=lambda typed: typed[0],
)
def test_a_command_without_the_effect_says_which_it_is_and_what_to_do(
    alone: Path, typed: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(typed) == 2
    told = capsys.readouterr().err
    assert "has the effect sticking_mass, which this station's catalogue does not know" in told
    assert "it is of the package mine 1.0; install the package" in told
    assert "--plugin" in told
    assert "Traceback" not in told


def test_a_file_given_by_option_is_used_by_commands_without_a_bench_file(
    alone: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    for given in ([], ["--plugin", EFFECT]):
        assert main(["plan", "--json", *given]) == 0
        effects = json.loads(capsys.readouterr().out)["effects"]
        assert any(effect["name"] == "sticking_mass" for effect in effects) == bool(given)

    assert main(["export", "run.h5", "--plugin", EFFECT, "--plugin", FORM, "--format", "octave"]) == 0
    assert "function rate = calibrated(raw)" in capsys.readouterr().out

    # What processes beside this one estimate knows the effect, too; what is written names its file.
    for name in ("one.h5", "two.h5"):
        (tmp_path / name).write_bytes(Path("run.h5").read_bytes())
    runs = [str(tmp_path / name) for name in ("one.h5", "two.h5")]
    assert main(["calibrate", *runs, "--plugin", EFFECT, "--model", "model.h5", "--jobs", "2", "--write"]) == 0
    assert capsys.readouterr().out.count("after a turn") >= 2
    held = json.loads(read_calibration(Path(runs[0])).model)
    assert re.fullmatch(r"the plug-in sticking_mass.py \(sha256 [0-9a-f]{12}\)", held["effects"][0]["from"])


def test_a_form_of_export_that_fails_is_one_line(
    alone: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "broken.py").write_text(Path(FORM).read_text().replace("constants, dropped =", "constants ="))
    given = ["--plugin", EFFECT, "--plugin", str(tmp_path / "broken.py")]
    assert main(["export", "run.h5", *given, "--format", "octave"]) == 2
    assert re.search(r"^station: the form octave failed: NameError: .*dropped", capsys.readouterr().err)


def test_a_file_may_be_given_twice_and_a_run_says_what_it_used(
    alone: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [str(EXAMPLES / f"{name}.py") for name in ("numbered_table", "counted_imu", "sticking_mass")]
    first = f"plugins = {json.dumps(files[1:])}"
    (tmp_path / "bench.toml").write_text(BENCH.format(first=first).replace('hidden = "hidden.toml"\n', ""))
    (tmp_path / "bench.toml").write_text(
        (tmp_path / "bench.toml").read_text().replace('effects = "none"', 'excluded = ["sticking_mass"]')
    )
    (tmp_path / "short.toml").write_text('[[step]]\nkind = "rest"\nduration = "10 s"\n')
    typed = ["run", "--bench", str(tmp_path / "bench.toml"), "--script", str(tmp_path / "short.toml")]
    given = [word for file in files[:2] for word in ("--plugin", file)]
    assert main([*typed, *given, "-o", str(tmp_path / "run.h5"), "--json"]) in (0, 1)
    with h5py.File(tmp_path / "run.h5") as file:
        told = [text.partition(" (")[0] for text in file.attrs["plugins"]]
    assert sorted(told) == [f"the plug-in {name}.py" for name in ("counted_imu", "numbered_table", "sticking_mass")]

    # The bench in the recording rules out an effect that nobody gives now.
    capsys.readouterr()
    catalogue._BY_NAME.pop("sticking_mass")
    assert main(["calibrate", str(tmp_path / "run.h5")]) == 2
    told_now = capsys.readouterr().err
    assert "'sticking_mass' is none of" in told_now
    assert "the plug-in sticking_mass.py" in told_now
    assert "--plugin" in told_now


def test_nothing_is_loaded_out_of_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plugins").mkdir()
    for name in ("plugins/mine.py", "sticking_mass.py", "station_plugins.py"):
        (tmp_path / name).write_text("raise RuntimeError('loaded')\n")
    assert main(["plan", "--json"]) == 0
    monkeypatch.setenv("STATION_PLUGINS", "sticking_mass.py")
    assert main(["plan", "--json"]) == 2
    assert "sticking_mass.py. Give the full path" in capsys.readouterr().err


FAULTS = {
    "missing": ("no_such_module:X", "ModuleNotFoundError: No module named 'no_such_module'"),
    "leaving": ("mine_leaving:X", "SystemExit: 3"),
    "several": ("mine_several:X", "ImportError: the first line"),
    "wrong": ("math:pi", "float is no "),
    "absent": ("math:no_such_name", "AttributeError: "),
}
ASKED = {
    "tables": ["plan", "--bench", "table.toml"],
    "imus": ["plan", "--bench", "imu.toml"],
    "exports": ["export", "run.h5", "--format", "mine"],
    "effects": ["effects"],
    "steps": ["plan", "script.toml"],
}


def announced(folder: Path, monkeypatch: pytest.MonkeyPatch, group: str, **entries: str) -> None:
    """Have an installed package announce these in a group."""
    about = folder / "bad-2.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: bad\nVersion: 2.0\n")
    lines = [f"[turntable_station.{group}]", *(f"{name} = {value}" for name, value in entries.items())]
    (about / "entry_points.txt").write_text("\n".join(lines))
    (folder / "mine_leaving.py").write_text("raise SystemExit(3)\n")
    (folder / "mine_several.py").write_text("raise ImportError('the first line\\nand another')\n")
    (folder / "script.toml").write_text('[[step]]\nkind = "rest"\nduration = "10 s"\n[[step]]\nkind = "mine"\n')
    bench = BENCH.format(first="").replace("hidden", "#")
    (folder / "table.toml").write_text(bench.replace('"numbered"', '"mine"'))
    for number, axis in enumerate("zyx"):
        bench = bench.replace(f"[table.{axis}]", f"[table.{axis}]\nnumber = {number + 1}")
    (folder / "imu.toml").write_text(bench.replace('"counted"', '"mine"').replace('"numbered"', '"acutrol"'))
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setattr(catalogue, "_BY_NAME", dict(catalogue._BUILT_IN))


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("group", ASKED)
def test_what_cannot_be_imported_costs_a_line_with_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], group: str, fault: str
) -> None:
    value, told = FAULTS[fault]
    announced(tmp_path, monkeypatch, group, mine=value)
    # An effect that is not asked for by name is left out; the command goes on without it.
    assert main(ASKED[group]) == (0 if group == "effects" else 2)
    (line,) = capsys.readouterr().err.splitlines()
    assert "mine" in line
    assert value in line
    assert told in line


@pytest.mark.parametrize(
    ("group", "name", "value", "typed"),
    [
        ("tables", "acutrol", "math:pi", ["plan", "--bench", "imu.toml"]),
        ("imus", "stim300", "math:pi", ["plan"]),
        ("exports", "csv", "math:pi", ["export", "run.h5", "--format", "csv"]),
        ("effects", "sample_hold", "estimator.effects.disturbances:SAMPLE_HOLD", ["effects"]),
        ("steps", "rest", "math:pi", ["plan", "script.toml"]),
    ],
)
def test_a_name_that_is_taken_is_told_not_passed_over(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    group: str,
    name: str,
    value: str,
    typed: list[str],
) -> None:
    announced(tmp_path, monkeypatch, group, **{name: value})
    if group == "imus":
        (tmp_path / "bench.toml").write_text(
            (tmp_path / "imu.toml")
            .read_text()
            .replace('"mine"\narray', '"stim300"\narray')
            .replace('"50 Hz"', '"125 Hz"')
        )
        typed = [*typed, "--bench", "bench.toml"]
    assert main(typed) == (0 if group == "effects" else 2)
    (line,) = capsys.readouterr().err.splitlines()
    assert name in line
    assert re.search("another name", line)


def test_a_record_under_another_name_than_its_own_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine_other.py").write_text("from drivers.tables.registry import TABLES\nSPEC = TABLES['galil']\n")
    announced(tmp_path, monkeypatch, "tables", mine="mine_other:SPEC")
    assert main(ASKED["tables"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "mine" in line
    assert "it is called galil" in line


def test_a_device_that_is_broken_does_not_keep_others_from_being_chosen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    announced(tmp_path, monkeypatch, "imus", mine="no_such_module:X")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}  # what was announced is looked up once a process
    typed = command("init", "made.toml", "--defaults")
    ended = subprocess.run(typed, env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 0, ended.stderr
    assert "simulated" in ended.stdout
