"""Kinds of steps beside rest, move and rotate, driven on the built-in bench, and what is wrong with them."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from station.bench.bench import load_bench
from station.cli import main
from station.errors import ScriptError
from station.scripts.planned import planned_motion
from station.scripts.script import check, load_script

POSE = """
[[step]]
kind = "pose"
x = "-40 deg"
z = "30 deg"
rate = "40 deg/s"
settle = "2 s"
duration = "5 s"
label = "tilted"
"""
SINE = """
[[step]]
kind = "sine"
axis = "x"
amplitude = "10 deg"
frequency = "0.2 Hz"
cycles = 3
"""
REST = """
[[step]]
kind = "rest"
duration = "5 s"
"""


@pytest.fixture
def scripted(tmp_path: Path) -> Callable[[str], Path]:
    """Write the text of a script into a file."""

    def write(text: str) -> Path:
        path = tmp_path / "script.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_a_pose_and_swings_are_driven_as_they_are_planned_and_recorded_part_by_part(
    tmp_path: Path, scripted: Callable[[str], Path]
) -> None:
    path, run = scripted(REST + POSE + SINE), tmp_path / "run.h5"
    assert main(["run", "--script", str(path), "-o", str(run), "--seed", "1", "--json"]) in (0, 1)
    with h5py.File(run) as file:
        labels = [label.decode() for label in file["steps/label"][()]]
        begins_s, ends_s = (file[f"steps/t_{end}_ns"][()] * 1e-9 for end in ("start", "end"))
        t_s = file["table/t_ns"][()] * 1e-9
        angles_deg, rates_dps = (np.degrees(file[f"table/{name}"][()]) for name in ("angle_rad", "rate_rps"))
    assert labels[:5] == ["rest", "tilted: x to -40 deg", "tilted: z to 30 deg", "tilted: settling", "tilted"]
    assert labels[5] == "x ±10 deg at 0.2 Hz: x to -30 deg"
    assert labels[6] == "x ±10 deg at 0.2 Hz: x to -50 deg"
    assert len(labels) == 5 + 7
    assert np.allclose(begins_s[1:], ends_s[:-1], atol=1e-6)
    lasted_s = ends_s - begins_s
    assert lasted_s[3:5] == pytest.approx([2, 5])
    # Half a cycle each; the sequencer asks every 50 ms whether an axis has arrived.
    assert lasted_s[6:11] == pytest.approx([2.5] * 5, abs=0.06)

    resting = (t_s > begins_s[4] + 0.2) & (t_s < ends_s[4] - 0.2)
    assert np.allclose(angles_deg[resting], [30, 0, -40], atol=0.05)
    swinging = t_s > begins_s[5] + 0.2
    assert angles_deg[swinging, 2].min() == pytest.approx(-50, abs=0.1)
    assert angles_deg[swinging, 2].max() == pytest.approx(-30, abs=0.1)
    assert np.abs(rates_dps[swinging, 2]).max() == pytest.approx(2 * np.pi * 0.2 * 10, rel=0.02)


def test_the_plan_of_swings_has_amplitude_largest_rate_and_frequency_of_the_sine(
    scripted: Callable[[str], Path],
) -> None:
    script = check(load_script(scripted(SINE)), load_bench(None).table.limits)
    motion = planned_motion(script, ("z", "y", "x"), 0.001)
    angle_deg = np.degrees(motion.angle_rad[:, 2])
    assert (angle_deg.min(), angle_deg.max()) == pytest.approx((-10, 10), abs=1e-3)
    assert np.degrees(np.abs(motion.rate_rps).max()) == pytest.approx(2 * np.pi * 0.2 * 10)
    assert np.degrees(np.abs(motion.acceleration_rps2).max()) < (2 * np.pi * 0.2) ** 2 * 10
    crossings_s = motion.t_s[1:][np.diff(np.sign(angle_deg)) != 0]
    assert np.diff(crossings_s[:5]) == pytest.approx([2.5] * 4, abs=0.005)
    assert angle_deg[-1] == pytest.approx(0, abs=1e-3)


RUNAWAY = """
from dataclasses import dataclass
from station.scripts.steps.kind import Part, Step, StepKind, turn_to

@dataclass(frozen=True, slots=True)
class Runaway(Step):
    label: str

    def words(self):
        return "runaway"

    def parts(self, angles_rad):
        return [Part.standing(1.0)]

    async def carry_out(self, stage, parts):
        await stage.stand(1.0)
        await stage.turn(turn_to("x", 0.0, 6.0, 60.0, 1.0))

SPEC = StepKind(name="runaway", what="turn faster than planned", keys=(), make=Runaway)
"""


def test_a_step_that_turns_beyond_the_limits_against_its_plan_ends_the_run_with_the_table_at_rest(
    tmp_path: Path,
    scripted: Callable[[str], Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("STATION_PLUGINS", "")  # what main leaves there goes with the test
    plugin, run = tmp_path / "runaway.py", tmp_path / "run.h5"
    plugin.write_text(RUNAWAY)
    path = scripted('[[step]]\nkind = "runaway"\n')
    assert main(["run", "--script", str(path), "--plugin", str(plugin), "-o", str(run), "--json"]) == 4
    told = json.loads(capsys.readouterr().out)["reason"]
    assert re.search(r"table: step 'runaway': 3437.75 deg/s exceeds the limit of axis x", told)
    with h5py.File(run) as file:
        assert np.abs(file["table/rate_rps"][()]).max() < 1e-3
        assert b"table at rest" in file["events/text"][()]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (SINE.replace("0.2 Hz", "3 Hz"), "188.496 deg/s exceeds the limit of axis x"),
        (SINE.replace("10 deg", "1 deg").replace("0.2 Hz", "2 Hz"), "138.3[0-9]* deg/s2 exceeds the limit of axis x"),
        (SINE.replace("cycles = 3", "cycles = 0"), "cycles: 0: give 1 to 10000"),
        (POSE.replace("x =", "# x =").replace("z =", "# z ="), "a pose states the angle of one axis or more"),
        (POSE.replace('"5 s"', '"0 s"'), "a rest of 0 s after 2 s; give times above zero"),
        (POSE.replace("settle", "setle"), "setle"),
        (POSE.replace('"pose"', '"poes"'), "'poes' is not one of rest, move, rotate, pose, sine.*; did you mean pose"),
        ('name = "empty"\n', "step"),
    ],
)
def test_a_step_that_cannot_be_driven_or_read_is_refused_with_the_reason(
    scripted: Callable[[str], Path], text: str, told: str
) -> None:
    with pytest.raises(ScriptError, match=told):
        check(load_script(scripted(text)), load_bench(None).table.limits)
