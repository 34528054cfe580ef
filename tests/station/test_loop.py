"""station loop: calibration, exploration, verification and what follows, over the wire of the twins in virtual time."""

from __future__ import annotations

import json
import math
import signal
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import h5py
import pytest
from support import changed, command, ctrl_c_of_children
from test_investigate import made

import station.commands.loop
from estimator.recordings.reading import read_recording
from estimator.recordings.recording import Recording
from estimator.tracing.investigation import Finding, Investigation
from station.bench.bench import default_bench_text
from station.cli import main
from station.run.closed_loop import CALIBRATION, EXPLORATION, VERIFICATION
from station.scripts.loop_scripts import between_rests, there_and_back
from station.scripts.script import Script, load_script

SHORT = between_rests("short", there_and_back("z", 20.0, 3.0), 3.0)


def bench_file(folder: Path, *changes: tuple[str, str], hidden: str = "", rate_hz: int = 50) -> Path:
    """Write the built-in bench with slower gyros, which are simulated sooner."""
    slower = (('rate = "100 Hz"', f'rate = "{rate_hz} Hz"'),)
    if hidden:
        (folder / "hidden.toml").write_text(hidden)
        changes = (*changes, ("[twin]\n", '[twin]\nhidden = "hidden.toml"\n'))
    path = folder / "bench.toml"
    path.write_text(changed(default_bench_text(), *slower, *changes, most=1))
    return path


def looped(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, dict[str, Any], str]:
    """Return exit code, the JSON object and stderr of station loop."""
    code = main(["loop", "--json", *map(str, arguments)])
    captured = capsys.readouterr()
    return code, json.loads(captured.out), captured.err


@pytest.mark.full
@pytest.mark.timeout(300)  # a thousand seconds of table time
def test_an_effect_that_only_the_twin_knows_ends_in_the_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = bench_file(
        tmp_path, hidden='[scale_asymmetry]\nsize = ["2000 ppm", "-2000 ppm", "2000 ppm", "-1500 ppm"]\n'
    )
    folder = tmp_path / "loop"
    code, found, _ = looped(capsys, "--bench", bench, "-o", folder, "--seed", "5")
    assert code == 0
    assert found["verdict"] == "added"
    assert [added["effect"] for added in found["added"]] == ["scale_asymmetry"]
    assert found["before"]["rms_rps"] > 4 * found["after"]["rms_rps"]
    assert [run["purpose"] for run in found["runs"]] == [CALIBRATION, EXPLORATION, VERIFICATION]
    assert found["verification"] == [str(folder / "3-verification.h5")]
    assert found["models"][-1]["effects"] == ["scale_asymmetry"]
    assert 16 < found["minutes_used"] < 18
    recordings = [read_recording(Path(run["recording"]), trusted=True) for run in found["runs"]]
    ends = [(data.t_ns[0], data.t_ns[-1]) for r in recordings for name, data in r.sources.items() if name == "gyro1"]
    # One clock for all: what drifts goes on drifting.
    assert all(0 < later[0] - earlier[1] < 20e9 for earlier, later in pairwise(ends))
    with h5py.File(folder / "investigation.h5") as file:
        assert json.loads(str(file["investigation"].attrs["json"]))["rounds"] == found["rounds"]


class Told:
    """Stands for the investigation: verdicts in turn; keeps what it was given."""

    def __init__(self, *findings: Finding) -> None:
        """Give these verdicts, the last for ever."""
        self._findings = list(findings)
        self.given: list[tuple[int, int]] = []

    def __call__(
        self,
        recordings: Sequence[Recording],
        verification: Sequence[Recording] = (),
        *,
        most_effects: int = 4,
        progress: Callable[[float, str], None] | None = None,
    ) -> Investigation:
        self.given.append((len(recordings), len(verification)))
        found = made(self._findings.pop(0) if len(self._findings) > 1 else self._findings[0])
        return replace(found, rivals=(("scale_asymmetry", "scale_quadratic"),)) if found.rivals else found


@pytest.fixture
def short_scripts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let loops begin with three short runs."""

    def three(bench: object, budget_s: float) -> list[tuple[str, Script]]:
        return [(purpose, replace(SHORT, name=purpose)) for purpose in (CALIBRATION, EXPLORATION, VERIFICATION)]

    monkeypatch.setattr(station.commands.loop, "_first_scripts", three)


@pytest.mark.usefixtures("short_scripts")
def test_rivals_are_told_apart_by_another_run_that_joins_the_fitted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    told = Told(Finding.CANNOT_TELL, Finding.ADDED)
    monkeypatch.setattr(station.commands.loop, "investigate", told)
    folder = tmp_path / "loop"
    code = main(["loop", "--bench", str(bench_file(tmp_path)), "-o", str(folder), "--minutes", "2.5"])
    text = capsys.readouterr().out
    assert code == 0
    assert told.given == [(2, 1), (3, 1)]
    assert (
        "investigation 1, 3 runs: cannot tell: these recordings cannot tell apart: scale asymmetry or scale quadratic"
        in " ".join(text.split())
    )
    assert "ADDED  why" in text
    assert "Chain of models" in text
    driven = load_script(folder / "4-next.toml")
    recording = read_recording(folder / "4-next.h5", trusted=True)
    assert recording.attributes["script"] == driven.name
    assert f"recordings, scripts, results: {folder}" in text


@pytest.mark.usefixtures("short_scripts")
def test_table_time_bounds_the_loop(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(station.commands.loop, "investigate", Told(Finding.CANNOT_TELL))
    code, found, _ = looped(capsys, "--bench", bench_file(tmp_path), "-o", tmp_path / "loop", "--minutes", "1.2")
    assert code == 1
    assert found["verdict"] == "cannot tell"
    assert len(found["runs"]) == 3
    assert found["minutes_used"] < 1.2
    assert "table time left" in found["ended"]
    assert found["next_script"] is None


@pytest.mark.full
@pytest.mark.usefixtures("short_scripts")
def test_the_runs_of_one_loop_have_noise_of_their_own_and_the_seed_repeats_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(station.commands.loop, "investigate", Told(Finding.NOTHING))
    bench = bench_file(tmp_path)
    rates = []
    for name in ("first", "second"):
        _, found, _ = looped(capsys, "--bench", bench, "-o", tmp_path / name, "--seed", "7")
        recordings = [read_recording(Path(run["recording"]), trusted=True) for run in found["runs"]]
        rates.append([r.sources["gyro1"].rate_rps[:50, 0] for r in recordings])
    assert all((a == b).all() for a, b in zip(*rates, strict=True))
    assert all((rates[0][0] == other).mean() < 0.2 for other in rates[0][1:])  # counts may be equal by chance


@pytest.mark.usefixtures("short_scripts")
def test_a_fault_ends_the_loop_with_what_was_recorded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bench = bench_file(tmp_path, ("[twin.array]", '[twin.fault]\naxis = "z"\nat = "6 s"\n\n[twin.array]'))
    folder = tmp_path / "loop"
    code, found, error = looped(capsys, "--bench", bench, "-o", folder)
    assert code == 4
    assert found["verdict"] is None
    assert [run["outcome"] for run in found["runs"]] == ["FAULT"]
    assert f"the recordings are in {folder}" in error
    assert (folder / "1-calibration.h5").is_file()


@pytest.mark.full  # the short form is that of station run
def test_ctrl_c_in_a_run_brings_the_table_to_rest_and_keeps_the_recordings(tmp_path: Path) -> None:
    folder = tmp_path / "loop"
    arguments = command("loop", "--bench", bench_file(tmp_path), "-o", folder)
    with ctrl_c_of_children():
        process = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    with process:
        assert process.stderr is not None
        for line in process.stderr:
            if "x at 20 deg/s" in line:
                break
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=60)
    assert process.returncode == 3
    assert "Ctrl-C" in error
    assert f"the recordings are in {folder}" in error
    with h5py.File(folder / "1-calibration.h5") as file:
        assert file.attrs["outcome"] == "ABORTED"
        assert b"table at rest" in [text.rstrip(b"\0") for text in file["events/text"][:]]
        assert math.isfinite(file["table/angle_rad"][-1, 0])


@pytest.mark.parametrize(
    ("arguments", "change", "says"),
    [
        (["--minutes", "10"], ("", ""), "the first three runs take 17.1 min"),
        (["-o", "."], ("", ""), "exists already"),
        ([], ('max_rate = "100 deg/s"', 'max_rate = "40 deg/s"'), "45 deg/s exceeds the limit of axis x, 40 deg/s"),
        (["--device", "nothing"], ("", ""), "no device 'nothing'"),
    ],
)
def test_what_cannot_be_done_is_refused_before_anything_moves(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    change: tuple[str, str],
    says: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    code, found, error = looped(capsys, "--bench", bench_file(tmp_path, change), *arguments)
    assert code == 2
    assert says in error
    assert found["runs"] == []
    assert not (tmp_path / "recordings").exists()
