"""station investigate: its verdicts on recordings whose cause is known, what it prints, what it refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
import pytest
from support import ASYMMETRY, SITE, first_gyros, tetrahedron_recording, three_recordings

import station.commands.investigate
from estimator.effects.law import in_words
from estimator.estimation.runs.build import runs_of
from estimator.recordings.recording import Recording
from estimator.recordings.writing import write_recording
from estimator.tracing.investigation import (
    Added,
    Errors,
    Finding,
    GyroErrors,
    Improvement,
    Investigation,
    ModelStep,
    PhaseErrors,
    Suspect,
    Unexplained,
    Value,
)
from station.bench.bench import default_bench_text, load_bench
from station.cli import main
from station.render.investigation_printed import print_investigation
from station.render.terminal import stdout
from station.scripts.loop_scripts import candidates, exploration_script, there_and_back, verification_script
from station.scripts.next_script import NextScript, Past, next_script
from station.scripts.script import Rest, Script, check, load_script, paper_script
from station.views.figures import human, probability
from station.views.investigation import investigation_object, investigation_view

if TYPE_CHECKING:
    from shared import Traced

DEG = np.pi / 180
KEYS = {"verdict", "added", "rivals", "unexplained", "before", "after", "in_sample", "next_script", "models", "gyros"}


def simulated(
    script: Script, seed: int, hidden: dict[str, Any] | None = None, started_s: float = 0.0, bench: bool = True
) -> Recording:
    """Return a recording of the tetrahedron, with what is hidden in it."""
    return on_bench(tetrahedron_recording(script, seed, hidden or {}, started_s), bench)


def on_bench(recording: Recording, bench: bool = True) -> Recording:
    return replace(recording, attributes={"bench": load_bench(None).text}) if bench else recording


def files(folder: Path, hidden: dict[str, Any] | None = None, *, seed: int = 1, gyros: int = 4) -> list[Path]:
    """Write a calibration, an exploration and a verification recording."""
    recordings = first_gyros(gyros, *three_recordings(seed, hidden or {}))
    paths = [folder / f"{number}.h5" for number in range(len(recordings))]
    for path, recording in zip(paths, recordings, strict=True):
        write_recording(path, on_bench(recording))
    return paths


def investigated(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, str, str]:
    """Return exit code, stdout and stderr of station investigate."""
    code = main(["investigate", *map(str, arguments)])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_what_the_model_lacks_is_named_and_its_size_is_right(traced_asymmetry: Traced) -> None:
    found = json.loads(traced_asymmetry.said)
    assert traced_asymmetry.code == 0
    assert found["verdict"] == "added"
    assert set(found) >= KEYS
    (added,) = found["added"]
    assert added["effect"] == "scale_asymmetry"
    assert added["gyros"] == ["gyro1", "gyro2", "gyro3", "gyro4"]
    assert added["probability"] > 0.95
    for value, true in zip(added["parameters"].values(), (2e-3, -2e-3, 1.5e-3, 2e-3), strict=True):
        size, sd, unit = value
        assert unit == "1"
        assert abs(size - true) < 5 * sd < 1e-3
    assert not found["in_sample"]
    assert found["before"]["rms_rps"] > 5 * found["after"]["rms_rps"]
    assert found["before"]["coverage95"] < 0.6
    assert 0.85 < found["after"]["coverage95"] <= 1
    assert found["improvement"]["low"] < found["improvement"]["ratio"] < found["improvement"]["high"]
    assert [model["effects"] for model in found["models"]] == [[], ["scale_asymmetry"]]
    assert set(found["gyros"]["gyro1"]) >= {"before", "after", "moved_sigmas", "phases"}
    assert found["next_script"] is None
    assert found["verification"] == [str(traced_asymmetry.recordings[2])]
    assert traced_asymmetry.picture.read_bytes().startswith(b"\x89PNG")
    with h5py.File(traced_asymmetry.results) as file:
        kept = json.loads(str(file["investigation"].attrs["json"]))
        assert kept["added"] == found["added"]
        assert len(file["investigation/residual"]) >= 1


def test_the_360_s_script_alone_does_not_show_an_asymmetry_and_the_script_that_it_asks_for_does(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, _, third = files(tmp_path, ASYMMETRY, gyros=1)
    script = tmp_path / "next.toml"
    code, text, _ = investigated(capsys, first, "--verify", third, "--next-script", script, "--json")
    found = json.loads(text)
    assert code == 1
    assert found["verdict"] in ("cannot tell", "unexplained")
    assert found["added"] == []
    assert found["next_script"] == str(script)
    driven = load_script(script)
    check(driven, load_bench(None).table.limits)
    settling = tmp_path / "next.h5"
    write_recording(settling, *first_gyros(1, simulated(driven, 77, ASYMMETRY, 1100.0)))
    code, text, _ = investigated(capsys, first, settling, "--verify", third)
    assert code == 0
    # A person reads the verdict first, then sizes in everyday units.
    assert text.startswith("ADDED")
    assert "scale asymmetry" in text.splitlines()[1]
    assert " ppm" in text
    assert "times smaller (95 %:" in text
    assert "verification run" in text
    assert "in-sample" not in text


def test_without_a_bench_it_says_what_the_next_script_needs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(station.commands.investigate, "investigate", lambda *_, **__: made(Finding.CANNOT_TELL))
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "run.h5"
    short = Script("short", (Rest(15.0), *there_and_back("z", 20.0, 12.0), Rest(15.0)))
    write_recording(path, simulated(short, 1, bench=False))
    code, text, _ = investigated(capsys, path)
    assert code == 1
    assert "no next script: the limits of the table are unknown. Give its bench file with --bench" in text
    bench = tmp_path / "bench.toml"
    bench.write_text(default_bench_text())
    code, text, _ = investigated(capsys, path, "--bench", bench)
    assert code == 1
    assert "script: next-script.toml" in text
    assert load_script(tmp_path / "next-script.toml").name in text


def test_clean_recordings_need_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second, third = files(tmp_path, seed=3, gyros=1)
    code, text, _ = investigated(capsys, first, second, "--verify", third)
    assert code == 0
    assert text.startswith("NOTHING TO ADD")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nowhere.h5"], "nowhere.h5 is not a file"),
        (["{0}", "--verify", "{0}"], "is given both to fit and to verify"),
        (["{0}", "--plot", "residual.bmp"], "must end in one of"),
        (["{0}", "-o", "{1}"], "exists already"),
        (["{0}", "--bench", "nowhere.toml"], "nowhere.toml"),
    ],
)
def test_bad_input_ends_with_2_and_without_a_verdict(
    traced_asymmetry: Traced, capsys: pytest.CaptureFixture[str], arguments: list[str], says: str
) -> None:
    code, text, error = investigated(capsys, *(a.format(*traced_asymmetry.recordings) for a in arguments), "--json")
    assert code == 2
    assert says in error
    assert json.loads(text)["verdict"] is None
    assert says in json.loads(text)["reason"]


def test_values_are_read_in_units_of_people_to_two_digits_of_their_doubt() -> None:
    assert human(0.00500 * DEG, 0.00012 * DEG, "rad/s/K") == "18.00 ± 0.43 deg/h/degC"
    assert human(0.0041, 0.00003, "s") == "4.100 ± 0.030 ms"
    assert human(61.0, 2.2, "s") == "61.0 ± 2.2 s"
    assert human(2e-3, 31e-6, "1") == "2000 ± 31 ppm"
    assert human(4e-6 / DEG**2, 1e-7 / DEG**2, "1/(rad/s)2") == "4.00 ± 0.10 ppm per (deg/s)2"
    assert human(0.02 * DEG, 0.0, "rad/s/g") == "72 deg/h/g"
    assert human(3.0, 0.5, "furlong") == "3.00 ± 0.50 furlong"


def test_no_probability_is_rounded_to_certainty() -> None:
    assert probability(1.0) == "above 99.9 %"
    assert probability(0.9994) == "above 99.9 %"
    assert probability(0.5) == "50.0 %"
    assert probability(1e-9) == "below 0.1 %"


def made(finding: Finding) -> Investigation:
    """Return an investigation made by hand."""
    before, after = Errors(3e-4, 2e-3, 0.41), Errors(1e-5, 6e-5, 0.95)
    phase = PhaseErrors(
        run="verify.h5",
        start_s=0.0,
        end_s=15.0,
        rate_dps=0.0,
        kind="rest",
        before_rps=1e-4,
        after_rps=float("nan"),
        noise_rps=1e-6,
    )
    gyro = GyroErrors(
        name="gyro1",
        before=before,
        after=after,
        phases=(phase,),
        states_before=np.zeros(4),
        states_after=np.ones(4),
        moved=np.array([1.0, -30.0, 0.5, 0.1]),
    )
    added = Added(effect="latency", gyros=("gyro1",), probability=0.98, parameters={"delay": Value(0.004, 3e-5, "s")})
    return Investigation(
        finding=finding,
        reason="why",
        added=(added,) if finding is Finding.ADDED else (),
        rivals=(("thermal_bias", "bias_drift"),) if finding is Finding.CANNOT_TELL else (),
        unexplained=Unexplained("direction", 0.42) if finding is Finding.UNEXPLAINED else None,
        before=before,
        after=after if finding is Finding.ADDED else before,
        improvement=Improvement(30.0, 25.0, 36.0) if finding is Finding.ADDED else None,
        in_sample=False,
        gyros=(gyro,),
        models=(ModelStep((), 0.0, before), ModelStep(("latency",), 500.0, after)),
        suspects=(Suspect("latency", 500.0, 0.98), Suspect("bandwidth", 496.0, 0.02)),
        left_out={"thermal_bias": "the recordings hold no temperature"},
        notes=("a note",),
    )


def test_rivals_come_with_the_script_that_tells_them_apart(capsys: pytest.CaptureFixture[str]) -> None:
    following = NextScript(Script("a rest", (Rest(300.0),)), 0.9, (("thermal_bias", "bias_drift"),))
    print_investigation(made(Finding.CANNOT_TELL), following, Path("next.toml"), stdout())
    text = capsys.readouterr().out
    assert "cannot tell apart: thermal bias or bias drift" in text
    assert "run next: a rest, 300 s: separates thermal bias and bias drift with probability 90%" in " ".join(
        text.split()
    )
    assert "station run --script next.toml" in text
    assert "left out, the recordings hold no temperature: thermal bias" in text


def test_without_a_verification_run_it_says_that_the_figures_are_in_sample(capsys: pytest.CaptureFixture[str]) -> None:
    print_investigation(replace(made(Finding.ADDED), in_sample=True), None, None, stdout())
    text = capsys.readouterr().out
    assert "in-sample" in text
    assert "--verify" in text


def test_parameters_of_one_gyro_share_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    names = ("gyro1 along body x", "gyro1 along body y", "gyro2 along body x", "time constant")
    sizes = {name: Value(0.02 * DEG, 0.001 * DEG, "rad/s/g") for name in names[:3]}
    added = Added(
        effect="g_sensitivity",
        gyros=("gyro1", "gyro2"),
        probability=0.99,
        parameters={**sizes, names[3]: Value(60.0, 2.0, "s")},
    )
    print_investigation(replace(made(Finding.ADDED), added=(added,)), None, None, stdout())
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    assert "gyro1: along body x 72.0 ± 3.6 deg/h/g, along body y 72.0 ± 3.6 deg/h/g" in lines
    assert "gyro2: along body x 72.0 ± 3.6 deg/h/g" in lines
    assert "time constant: 60.0 ± 2.0 s" in lines


def test_an_effect_without_a_name_is_said_as_the_law_that_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    law = "lag(T, 58.12)"
    parameters = {"gyro1 of lag(T, 58.12)": Value(2e-4, 1e-6, "rad/s per unit"), "constant": Value(58.123, 4.2, "s")}
    added = Added(
        effect=in_words(law),
        gyros=("gyro1",),
        probability=0.98,
        parameters=parameters,
        out_of_sample=None,
        same=(),
        constructed=True,
        expression=law,
    )
    found = replace(made(Finding.ADDED), added=(added,))
    print_investigation(found, None, None, stdout())
    said = "CONSTRUCTED: bias proportional to temperature above 25 degC lagged by 58.1 ± 4.2 s; not in the catalogue"
    assert f"{said}, probability 98.0 %" in " ".join(capsys.readouterr().out.split())
    (entry,) = investigation_object(investigation_view(found, None))["added"]
    assert (entry["constructed"], entry["expression"], entry["effect"]) == (True, law, in_words(law))
    (entry,) = investigation_object(investigation_view(made(Finding.ADDED), None))["added"]
    assert (entry["constructed"], entry["expression"]) == (False, "")


def test_what_is_unexplained_is_said_with_what_it_depends_on(capsys: pytest.CaptureFixture[str]) -> None:
    print_investigation(made(Finding.UNEXPLAINED), None, None, stdout())
    assert "unexplained: 42% of the power of the residual depends on direction" in capsys.readouterr().out


def test_json_has_null_where_a_number_is_not_known() -> None:
    found = investigation_object(investigation_view(made(Finding.ADDED), None, ["a.h5"], ["verify.h5"]))
    assert json.loads(json.dumps(found, allow_nan=False))["gyros"]["gyro1"]["phases"][0]["after_rps"] is None
    assert found["added"][0]["parameters"] == {"delay": [0.004, 3e-5, "s"]}


def test_exploration_and_verification_last_as_the_method_says_and_end_at_home() -> None:
    for script, rates in ((exploration_script(), {12, 30}), (verification_script(), {8, 45})):
        assert script.least_s == pytest.approx(318)
        turns = [step for step in script.steps if not isinstance(step, Rest)]
        for axis in "xyz":
            mine = [step for step in turns if step.axis == axis]
            assert {round(abs(step.rate_rps) / DEG) for step in mine} == rates
            assert sum(step.turn_rad for step in mine) == pytest.approx(0)
    order = [step.label.split()[0] for step in exploration_script().steps]
    assert order != [step.label.split()[0] for step in verification_script().steps]


def test_every_candidate_is_within_the_limits_of_the_table() -> None:
    limits = load_bench(None).table.limits
    slow = {axis: replace(limit, rate_rps=5 * DEG, acceleration_rps2=2 * DEG) for axis, limit in limits.items()}
    for bounds in (limits, slow, {"z": limits["z"]}):
        scripts = list(candidates(bounds, tuple(bounds)))
        assert len(scripts) > 15
        for script in scripts:
            check(script, bounds)


def past_of(*scripts: Script) -> list[Past]:
    clock_s, past = 0.0, []
    for seed, script in enumerate(scripts):
        past += [Past.of(run) for run in runs_of(simulated(script, seed, None, clock_s))[0]]
        clock_s += script.least_s + 20
    return past


def test_the_next_script_turns_both_ways_for_asymmetry_against_a_square() -> None:
    limits, gimbals = load_bench(None).table.limits, ("z", "y", "x")
    rivals = [("scale_asymmetry", "scale_quadratic")]
    following = next_script(rivals, {}, past_of(paper_script()), limits, gimbals, SITE)
    assert following is not None
    assert following.probability > 0.9
    rates = {round(step.rate_rps / DEG) for step in following.script.steps if not isinstance(step, Rest)}
    assert rates == {-rate for rate in rates}
    assert len(rates) >= 4


def test_a_verification_run_that_alone_states_its_device_counts_for_the_next_script() -> None:
    limits, gimbals = load_bench(None).table.limits, ("z", "y", "x")
    short = Script("short", (Rest(15.0), *there_and_back("z", 20.0, 12.0), Rest(15.0)))
    first, second = past_of(short, verification_script())
    judging = [replace(second, device="unit 7")]  # it ends last: the next run is foreseen with this device

    def following(device: str) -> NextScript:
        past = [replace(first, device=device)]
        script = next_script([("latency",)], {}, past, limits, gimbals, SITE, judging=judging, most_s=200.0)
        assert script is not None
        return script

    assert following("") == following("unit 7")
    assert following("").probability > 0.95
    assert following("unit 8").probability > 0.95


def test_a_next_script_keeps_within_the_time_that_is_left() -> None:
    limits, gimbals = load_bench(None).table.limits, ("z", "y", "x")
    past, rivals = past_of(paper_script()), [("bias_drift", "warm_up")]
    following = next_script(rivals, {}, past, limits, gimbals, SITE, most_s=200.0)
    assert following is not None
    assert following.script.least_s <= 200.0
    assert next_script(rivals, {}, past, limits, gimbals, SITE, most_s=10.0) is None


def test_an_effect_without_a_rival_is_to_be_told_from_noise() -> None:
    limits, gimbals = load_bench(None).table.limits, ("z", "y", "x")
    past = past_of(Script("short", (Rest(15.0), *there_and_back("z", 20.0, 12.0), Rest(15.0))))
    following = next_script([("latency", "no such effect")], {}, past, limits, gimbals, SITE)
    assert following is not None
    assert following.probability > 0.95
    assert "separates latency from noise" in following.words()
    assert next_script([("no such effect",)], {}, past, limits, gimbals, SITE) is None
    assert next_script([], {}, past, limits, gimbals, SITE) is None
