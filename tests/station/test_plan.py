"""station plan: what it says, and whether that comes true."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plan import spread_over_predicted

from sims.physics.motion import AxisMotion
from station.bench.bench import default_bench_text, load_bench
from station.cli import main
from station.errors import ScriptError
from station.scripts.axis_profile import profile_lines
from station.scripts.planned import planned_motion
from station.scripts.script import Move, Rest, Rotate, Script, check, load_script, paper_script

DEG = np.pi / 180

X_ONLY = """
name = "x only"
[[step]]
kind = "rest"
duration = "20 s"
[[step]]
kind = "rotate"
axis = "x"
rate = "20 deg/s"
duration = "40 s"
"""


def planned(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, str, str]:
    """Return exit code, stdout and stderr of station plan."""
    code = main(["plan", *map(str, arguments)])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def effects_of(text: str) -> dict[str, Any]:
    return {effect["name"]: effect for effect in json.loads(text)["effects"]}


def write(folder: Path, text: str, name: str = "script.toml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_of_the_paper_s_script_it_says_that_asymmetry_cannot_be_seen_and_what_it_corrupts(
    capsys: pytest.CaptureFixture[str],
) -> None:
    code, text, _ = planned(capsys)
    assert code == 0
    row = next(line for line in text.splitlines() if line.startswith("│ scale asymmetry"))
    assert "not detectable" in row
    words = " ".join(text.split())
    start = words.index("scale asymmetry, each direction, 5000 ppm; detected by: turns in both directions")
    corrupted = re.findall(r"(k|b|sigma_j|sigma_k) of (gyro\d .*?) (?:ppm|deg/h|urad)", words[start:])[:3]
    assert [state for state, _ in corrupted] == ["k", "sigma_j", "sigma_k"]
    assert corrupted[0][1].startswith("gyro1 +5000 (")
    assert all(f"gyro{n}" in corrupted[0][1] for n in (1, 2, 3, 4))
    assert "saturated: 4 different steady conditions" in text
    assert text.splitlines()[0].startswith("OK")


def test_json_holds_in_si_what_a_person_reads(capsys: pytest.CaptureFixture[str]) -> None:
    code, text, _ = planned(capsys, "--json")
    found = json.loads(text)
    assert code == 0
    assert found["duration_s"] == pytest.approx(360)
    assert found["saturated"]
    assert found["reached"]
    assert [gyro["name"] for gyro in found["gyros"]] == ["gyro1", "gyro2", "gyro3", "gyro4"]
    assert all(30e-6 < gyro["sd"]["k"] < found["required"]["k"] for gyro in found["gyros"])
    asymmetry = effects_of(text)["scale_asymmetry"]["parameters"][0]
    assert not asymmetry["seen"]
    assert asymmetry["shift_of_largest"][0]["k"] == pytest.approx(asymmetry["largest"], rel=0.01)
    assert ["earth_rate", "g_sensitivity"] in [pair["effects"] for pair in found["alike"]]


def test_a_warmer_run_shows_smaller_thermal_effects(capsys: pytest.CaptureFixture[str]) -> None:
    sizes = []
    for rise in ("4 degC", "16 degC"):
        _, text, _ = planned(capsys, "--json", "--temperature-rise", rise)
        sizes.append(effects_of(text)["thermal_bias"]["parameters"][0]["smallest"]["gyro1"])
    assert sizes[0] == pytest.approx(4 * sizes[1])


def test_a_script_that_leaves_states_unseen_names_them_and_fails(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    code, text, _ = planned(capsys, write(tmp_path, X_ONLY))
    assert code == 1
    assert "unobservable: gyro1: k; sigma_j" in text
    assert "unobservable: gyro2: k + 2.83 sigma_k; sigma_j" in text
    assert "NOT REACHED k, sigma_j" in text


def test_a_bench_that_requires_more_is_not_reached(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    bench = default_bench_text().replace('sd_bias = "5 deg/h"', 'sd_bias = "1 deg/h"')
    code, text, _ = planned(capsys, "--bench", write(tmp_path, bench, "bench.toml"))
    assert code == 1
    assert text.count("NOT REACHED b") == 4


def test_several_devices_are_planned_together(capsys: pytest.CaptureFixture[str]) -> None:
    _, both, _ = planned(capsys, "--json", "--device", "array", "--device", "stim300")
    _, one, _ = planned(capsys, "--json", "--device", "array")
    assert {gyro["device"] for gyro in json.loads(both)["gyros"]} == {"array", "stim300"}
    # Latency is shared by all gyros: the better ones of the second device show less of it.
    latency = [effects_of(text)["latency"]["parameters"][0]["smallest"]["all"] for text in (both, one)]
    assert latency[0] < 0.7 * latency[1]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("name = ", "script.toml"),
        (X_ONLY.replace("20 deg/s", "200 deg/s"), "200 deg/s exceeds the limit of axis x, 100 deg/s"),
    ],
)
def test_what_cannot_be_read_or_done_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, text: str, says: str
) -> None:
    code, _, error = planned(capsys, write(tmp_path, text))
    assert code == 2
    assert says in error


def test_a_temperature_rise_without_a_unit_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    code, _, error = planned(capsys, "--temperature-rise", "8")
    assert code == 2
    assert "degC" in error


def turn(axis: str, rate_dps: float, duration_s: float) -> Rotate:
    return Rotate(axis, rate_dps * DEG, duration_s, 20 * DEG, "")


def moves() -> Script:
    steps = (
        Rest(3.3),
        Move("x", 30 * DEG, 10 * DEG, 5 * DEG, "a trapezoid"),
        turn("x", -20, 10),
        Move("z", -1 * DEG, 50 * DEG, 20 * DEG, "too short for its rate"),
        turn("z", 7, 6.01),
        Move("x", 0.0, 100 * DEG, 50 * DEG, "home"),
        Rest(2),
    )
    return Script("moves", steps)


def test_the_planned_motion_is_the_one_that_the_twin_of_the_table_makes() -> None:
    script = moves()
    planned_x = planned_motion(script, ("z", "y", "x"), 0.01)
    for column, axis in enumerate("zyx"):
        twin, at_s, target = AxisMotion(0.0, 10.0, 10.0), 0.0, 0.0
        twin.keep_all()
        for step, span in zip(script.steps, script.spans(), strict=True):
            if not isinstance(step, Rest) and step.axis == axis:
                target = step.angle_rad if isinstance(step, Move) else target + step.turn_rad
                twin.move(at_s, target, step.rate_rps, step.acceleration_rps2)
            at_s += span.least_s
        assert np.allclose(planned_x.angle_rad[:, column], twin.angles(planned_x.t_s), rtol=0, atol=1e-12)
        rates = [twin.at(float(t))[1] for t in planned_x.t_s]
        assert np.allclose(planned_x.rate_rps[:, column], rates, rtol=0, atol=1e-12)
    assert planned_x.angle_rad[-1, 2] == 0.0


def test_planned_accelerations_are_those_of_the_ramps() -> None:
    motion = planned_motion(moves(), ("z", "y", "x"), 0.001)
    numeric = np.gradient(motion.rate_rps, 0.001, axis=0)
    corner = np.abs(np.diff(motion.acceleration_rps2, axis=0, prepend=0, append=0)).max(axis=1) > 0
    smooth = ~(corner[:-1] | corner[1:])
    assert smooth.mean() > 0.99
    assert np.allclose(motion.acceleration_rps2[smooth], numeric[smooth], atol=1e-8)


def test_the_profile_draws_both_directions_within_the_width_of_the_terminal() -> None:
    script = Script("both", (Rest(10), turn("x", 20, 20), turn("x", -40, 20), turn("z", 5, 20), Rest(10)))
    lines = profile_lines(planned_motion(script, ("z", "y", "x")), 80)
    assert [line.split()[0] for line in lines[:4]] == ["x", "-40", "y", "z"]  # only x has a row for turning back
    assert all(len(line) <= 80 for line in lines)
    forward, back = (set(np.flatnonzero([c in "▁▂▃▄▅▆▇█▔▀" for c in line])) for line in lines[:2])
    assert forward
    assert back
    assert max(forward) <= min(back)
    assert "█" not in lines[0]  # 20 of 40 deg/s is half the height


def check_spread(runs: int, doubt: float) -> None:
    ratios = spread_over_predicted(runs, load_bench(None), paper_script(), quiet=True)
    assert np.all(np.abs(ratios - 1) < doubt), ratios


@pytest.mark.full
def test_the_spread_of_a_few_runs_is_about_as_predicted() -> None:
    check_spread(12, 4 / np.sqrt(2 * 4 * 11))  # four sigmas of the chi-square over 4 gyros


@pytest.mark.full
@pytest.mark.timeout(1200)
def test_the_spread_of_300_runs_is_as_predicted_within_5_percent() -> None:
    check_spread(300, 0.05)  # of which 2 % is the doubt of the spread itself


def test_accelerations_that_a_controller_has_in_steps_are_planned_as_it_makes_them(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    script = write(tmp_path, X_ONLY + 'acceleration = "10 deg/s2"\n')
    code, text, _ = planned(capsys, "--bench", Path("tests/data/benches/galil_xsens.toml"), script)
    assert code in (0, 1)
    assert "axis x at 10 deg/s2 does 5.62: the controller rounds accelerations" in " ".join(text.split())
    assert "takes 62 s instead of 60 s" in " ".join(text.split())


def test_a_turn_goes_as_far_with_the_acceleration_that_the_controller_has() -> None:
    asked = Script("turns", (Rotate("x", -40 * DEG, 20.0, 10 * DEG, "x"), Move("x", 0.0, 40 * DEG, 10 * DEG, "back")))
    limits = load_bench(Path("tests/data/benches/galil_xsens.toml")).table.limits
    driven = check(asked, limits)
    assert isinstance(asked.steps[0], Rotate)
    assert isinstance(driven.steps[0], Rotate)
    assert driven.steps[0].turn_rad == pytest.approx(asked.steps[0].turn_rad)
    assert driven.steps[0].duration_s == pytest.approx(16 + 40 / 5.625, rel=1e-3)
    assert driven.steps[0].acceleration_rps2 == pytest.approx(5.625 * DEG, rel=1e-3)
    slow = Script("slow", (Move("x", 1.0, 40 * DEG, 4 * DEG, "slow"),))
    with pytest.raises(ScriptError, match="smallest acceleration that the controller can set on axis x is 5.62"):
        check(slow, {"x": replace(limits["x"], acceleration_rps2=5 * DEG)})


def test_plan_offers_a_script_of_the_same_length_that_turns_each_axis_early_and_late(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, text, _ = planned(capsys, "--json")
    found = json.loads(text)
    assert [(axis["axis"], axis["proved"]) for axis in found["constancy"]] == [("x", False), ("y", False), ("z", False)]
    offered = found["early_late"]
    assert all(axis["proved"] for axis in offered["constancy"])
    assert [gyro["name"] for gyro in offered["gyros"]] == [gyro["name"] for gyro in found["gyros"]]
    path = tmp_path / "early and late.toml"
    code, text, _ = planned(capsys, "--early-late", "-o", path)
    assert code == 0
    assert "gyro4" in text
    assert str(path) in text.replace("\n", "")
    code, text, _ = planned(capsys, path, "--json")
    written = json.loads(text)
    assert code == 0
    assert written["duration_s"] == pytest.approx(360)
    assert written["early_late"] is None
    sigmas = [[list(gyro["sd"].values()) for gyro in gyros] for gyros in (written["gyros"], offered["gyros"])]
    assert np.array(sigmas[0]) == pytest.approx(np.array(sigmas[1]), rel=1e-6)
    code, _, errors = planned(capsys, "--early-late", "-o", path)
    assert code == 2
    assert "early and late.toml" in errors


def test_plan_says_so_where_no_script_of_that_length_turns_each_axis_early_and_late(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = '[[step]]\nkind = "rotate"\naxis = "x"\nrate = "20 deg/s"\nduration = "2 s"\nacceleration = "40 deg/s2"\n'
    script = write(tmp_path, short)
    code, text, errors = planned(capsys, script, "--early-late", "-o", tmp_path / "new.toml")
    assert (code, text) == (1, "")
    assert "do not fit twice into 2 s" in errors
    assert not (tmp_path / "new.toml").exists()
    assert planned(capsys, "--early-late", "--improve")[0] == 2


def test_a_name_with_quotes_is_written_into_the_script_as_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script = write(tmp_path, X_ONLY.replace('"x only"', "'x \"only\" \\ here'"))
    assert planned(capsys, script, "--early-late", "-o", tmp_path / "new.toml")[0] == 0
    assert load_script(tmp_path / "new.toml").name == 'x "only" \\ here, early and late'


@pytest.mark.full
@pytest.mark.timeout(600)
def test_a_scale_factor_that_steps_between_turns_fails_with_the_script_that_plan_writes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    step = '[scale_step]\nsize = ["8000 ppm", "0 ppm", "0 ppm", "0 ppm"]\nat = "142.6 s"\n'
    (tmp_path / "hidden.toml").write_text(step)
    bench = tmp_path / "bench.toml"
    bench.write_text(default_bench_text().replace("[twin]\n", '[twin]\nhidden = "hidden.toml"\n', 1))
    script = tmp_path / "early-late.toml"
    assert planned(capsys, "--early-late", "-o", script)[0] == 0
    run = ["run", "--json", "--bench", str(bench)]
    assert main([*run, "--script", str(script), "-o", str(tmp_path / "late.h5")]) == 1
    assert re.search(r"from \d+ (s on,|to \d+ s) k of gyro1 differed by", json.loads(capsys.readouterr().out)["reason"])
    assert main([*run, "-o", str(tmp_path / "paper.h5")]) == 0
    assert json.loads(capsys.readouterr().out)["reason"].endswith("; constancy not proved: x, y, z")
