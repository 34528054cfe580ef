"""Sets of recordings, each with a mapping, and what should be said of it. A seed makes a set; odd and even differ.

Seeds 0 and 1 are for development, 2 and 3 are the half that stays untouched until the end.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
from scipy.io import loadmat, savemat
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from foreign_sets.motion import (
    G_MPS2,
    Floats,
    Unit,
    by_hand,
    by_robot,
    by_stepper,
    of_rates,
    on_spindle,
    quaternions,
    walk,
)

DATA = Path(__file__).parents[2] / "data"
HALVES = {"development": (0, 1), "sealed": (2, 3)}

QUIET = frozenset({"nothing to add"})
DELAYED = frozenset({"nothing to add", "added"})
OPEN = frozenset({"cannot tell", "added in part", "unexplained"})
DELAYS = frozenset({"latency", "reference_lag"})
NO_LAW_OF_THE_RATE = r"scale (cubic|quadratic|asymmetry), probability"


@dataclass(frozen=True, kw_only=True)
class Expected:
    """What should be said of a set.

    ``states``: true k and b (deg/s) by gyro of those that the set shows, ``k_sd`` and ``b_sd_dps`` the largest sigmas
    that still tell something. ``says`` are expressions that must be found in what the commands print, ``never`` those
    that must not. ``verdicts`` are those that investigate may come to, ``added`` what it may add. ``untraced``:
    investigate may refuse, with a sentence.
    """

    states: Mapping[str, tuple[float, float]]
    k_sd: float = np.inf
    b_sd_dps: float = np.inf
    says: Sequence[str] = ()
    never: Sequence[str] = ()
    verdicts: frozenset[str] = QUIET
    added: frozenset[str] = frozenset()
    untraced: bool = False


@dataclass(frozen=True, kw_only=True)
class ForeignSet:
    """Files in a folder: ``files`` are imported under ``mapping``; empty: ``recording`` is one already."""

    expected: Expected
    mapping: str = ""
    files: Sequence[str] = ()
    recording: str = ""


Builder = Callable[[Path, int, np.random.Generator], ForeignSet]
KINDS: dict[str, Builder] = {}


def kind(build: Builder) -> Builder:
    """List a kind by the name of its function."""
    KINDS[build.__name__] = build
    return build


def built(name: str, seed: int, folder: Path) -> ForeignSet:
    """Write the files of a set and return it."""
    number = sorted(KINDS).index(name)
    return KINDS[name](folder, seed, np.random.default_rng([seed, number, 270]))


# --- mappings

_TOP = '[device]\nname = "unit"\n[file]\nformat = "csv"\n'
_TIME = '[time]\ncolumn = "t"\nunit = "s"\n'
_GYRO = '[gyro]\ncolumns = ["gx", "gy", "gz"]\nunit = "deg/s"\n'
_ACCEL = '[accelerometer]\ncolumns = ["ax", "ay", "az"]\nunit = "m/s2"\n'
_RATE = '[reference]\nkind = "rate"\ncolumns = ["rx", "ry", "rz"]\nunit = "deg/s"\n'
_ATTITUDE = '[reference]\nkind = "attitude"\ncolumns = ["qw", "qx", "qy", "qz"]\norder = "wxyz"\n'
_ANGLE = '[reference]\nkind = "angle"\ncolumn = "angle"\nunit = "deg"\naxis = "z"\n'
_BESIDE = 'file = "{stem}_reference.csv"\n'


def csv(path: Path, **columns: Floats) -> None:
    """Write columns, each (n,) or (n, 3) with a name "gx gy gz"."""
    names = " ".join(columns).replace("__", " ").split()
    rows = np.column_stack(list(columns.values()))
    np.savetxt(path, rows, delimiter=",", fmt="%.7g", header=",".join(names), comments="")


def _gyro_csv(path: Path, t_s: Floats, output: Floats, accel: Floats | None = None, **more: Floats) -> None:
    own = {} if accel is None else {"ax__ay__az": accel}
    csv(path, t=t_s, gx__gy__gz=output, **own, **more)


# --- faults


def clipped(output: Floats, gyro: int, limit_dps: float, random: np.random.Generator) -> Floats:
    """Return outputs (n, 3) of which one ends at a limit before the device corrects axes and offsets."""
    raw = output.copy()
    raw[:, gyro] = np.clip(output[:, gyro], -limit_dps, limit_dps)
    at = np.abs(output[:, gyro]) > limit_dps
    others = [i for i in range(3) if i != gyro]
    raw[at, gyro] += output[at][:, others] @ np.array([0.004, -0.006]) + 0.3 * random.standard_normal(at.sum())
    return raw


def _broad(folder: Path, seed: int, spoil: Callable[[Floats], Floats]) -> dict[str, tuple[float, float]]:
    """Write a trial of BROAD with its outputs (n, 3) in deg/s spoilt; return k and b by least squares of the whole."""
    name = ("01_undisturbed_slow_rotation_A_60s", "04_undisturbed_slow_rotation_with_breaks_A_60s")[seed % 2]
    found = {k: v for k, v in loadmat(DATA / "broad" / f"{name}.mat").items() if not k.startswith("__")}
    output = np.degrees(np.asarray(found["imu_gyr"], dtype=np.float64))
    true = _least_squares(output, np.asarray(found["opt_quat"], dtype=np.float64), float(found["sampling_rate"].item()))
    savemat(folder / "trial.mat", found | {"imu_gyr": np.radians(spoil(output))}, do_compression=True)
    return true


def _least_squares(output: Floats, wxyz: Floats, hz: float) -> dict[str, tuple[float, float]]:
    """Return k and b (deg/s) of gyros beside attitudes of the same rows, in means of 0.1 s, at the best delay."""
    known = np.isfinite(wxyz).all(axis=1)
    q = np.where(known[:, None], wxyz, [1.0, 0.0, 0.0, 0.0])
    turns = Rotation.from_quat(np.roll(q, -1, axis=1))
    rate = np.degrees((turns[:-1].inv() * turns[1:]).as_rotvec()) * hz
    rate[~(known[1:] & known[:-1])] = np.nan
    width = round(0.1 * hz)
    t_s, middle_s = np.arange(len(output)) / hz, (np.arange(len(rate)) + 0.5) / hz

    def means(values: Floats) -> Floats:
        count = len(values) // width
        return values[: count * width].reshape(count, width, -1).mean(axis=1)

    best = (np.inf, np.zeros((4, 3)))
    for delay_s in np.arange(0.0, 0.009, 0.0005):
        seen = np.column_stack([np.interp(middle_s + delay_s, t_s, column) for column in output.T])
        w, y = means(rate), means(seen)
        good = np.isfinite(w).all(axis=1)
        columns = np.column_stack([np.ones(good.sum()), w[good]])
        x, squares, *_ = np.linalg.lstsq(columns, y[good], rcond=None)
        if squares.sum() < best[0]:
            best = (float(squares.sum()), x)
    return {name: (1 - float(best[1][1 + i, i]), -float(best[1][0, i])) for i, name in enumerate("xyz")}


_BROAD_MAPPING = (DATA / "broad" / "mapping.toml").read_text()


# --- kinds


@kind
def clipping(folder: Path, seed: int, random: np.random.Generator) -> ForeignSet:
    """A gyro that ends at a limit before the device corrects its axes: values there vary by some deg/s."""
    gyro = int(random.integers(3))
    share = random.uniform(0.5, 0.75)
    expected = Expected(
        states={},
        k_sd=0.02,
        says=[rf"(?i)\b{'xyz'[gyro]}\b.*(saturat|limit)"],
        never=[r"\b1000000\b", NO_LAW_OF_THE_RATE],
        verdicts=DELAYED | OPEN,
        added=DELAYS | {"saturation"},
    )
    if seed % 2 == 0:

        def spoil(output: Floats) -> Floats:
            return clipped(output, gyro, share * float(np.abs(output[:, gyro]).max()), random)

        true = _broad(folder, seed // 2, spoil)
        return ForeignSet(mapping=_BROAD_MAPPING, files=["trial.mat"], expected=replace(expected, states=true))
    unit, motion = Unit.of(random), by_hand(random, 100.0, 320.0)
    t_s = np.arange(0, 100, 0.01)
    output = unit.output(motion.rate(t_s), 100.0, random)
    output = clipped(output, gyro, share * float(np.abs(output[:, gyro]).max()), random)
    _gyro_csv(folder / "log.csv", t_s, output, rx__ry__rz=motion.rate(t_s))
    mapping = _TOP + _TIME + _GYRO + _RATE
    return ForeignSet(mapping=mapping, files=["log.csv"], expected=replace(expected, states=unit.states()))


@kind
def dead_channel(folder: Path, seed: int, random: np.random.Generator) -> ForeignSet:
    """A gyro that puts out one value, or noise about one, whatever the body does."""
    gyro = int(random.integers(3))
    name = "xyz"[gyro]
    level = random.choice([0.0, 1.7, -30.0])
    noise = (0.0, 0.0, 0.2, 0.2)[seed]

    def spoil(output: Floats) -> Floats:
        spoilt = output.copy()
        spoilt[:, gyro] = np.round((level + noise * random.standard_normal(len(output))) / 0.01) * 0.01
        return spoilt

    says = [rf"(?i)\b{name}\b (is not estimated|is left out|.*(constant|dead|does not follow|disconnected))"]
    expected = Expected(
        states={},
        k_sd=0.02,
        says=says,
        never=[r"\b1000000\b"],
        verdicts=DELAYED | OPEN,
        added=DELAYS | {"stuck"},
    )
    if seed % 2 == 0:
        states = _broad(folder, seed // 2, spoil)
        mapping, file = _BROAD_MAPPING, "trial.mat"
    else:
        unit, motion = Unit.of(random), by_robot(random, 90.0, 80.0)
        t_s = np.arange(0, 90, 0.01)
        at_s = np.arange(0, 90, 1 / 50)
        _gyro_csv(folder / "log.csv", t_s, spoil(unit.output(motion.rate(t_s), 100.0, random)))
        q = quaternions(motion.attitude(at_s))
        csv(folder / "log_reference.csv", t=at_s, qw__qx__qy__qz=q)
        states, mapping, file = unit.states(), _TOP + _TIME + _GYRO + _ATTITUDE + _BESIDE, "log.csv"
    states = {gyro_name: value for gyro_name, value in states.items() if gyro_name != name}
    return ForeignSet(mapping=mapping, files=[file], expected=replace(expected, states=states))


@kind
def stuck_channel(folder: Path, seed: int, random: np.random.Generator) -> ForeignSet:
    """A gyro that holds one value for some seconds, or from an instant on to the end."""
    gyro = int(random.integers(3))
    name = "xyz"[gyro]
    unit, motion = Unit.of(random), by_hand(random, 100.0, 200.0)
    t_s = np.arange(0, 100, 0.01)
    output = unit.output(motion.rate(t_s), 100.0, random)
    start = round(random.uniform(30, 55) * 100)
    stop = len(t_s) if seed % 2 else start + round(random.uniform(5, 15) * 100)
    output[start:stop, gyro] = output[start, gyro]
    at_s = np.arange(0, 100, 1 / 60)
    q = quaternions(motion.attitude(at_s + 0.01))
    _gyro_csv(folder / "log.csv", t_s, output)
    csv(folder / "log_reference.csv", t=at_s, qw__qx__qy__qz=q)
    expected = Expected(
        states=unit.states(),
        k_sd=0.01,
        says=[rf"(?i)\b{name}\b.*(stuck|sticks|held one value|stands still)"],
        verdicts=DELAYED | OPEN,
        added=DELAYS | {"stuck"},
    )
    return ForeignSet(mapping=_TOP + _TIME + _GYRO + _ATTITUDE + _BESIDE, files=["log.csv"], expected=expected)


@kind
def jitter(folder: Path, seed: int, random: np.random.Generator) -> ForeignSet:
    """A reference whose stamps are those of arrivals, come in bursts, or whose readings really are uneven."""
    unit, motion = Unit.of(random), by_hand(random, 120.0, 180.0)
    t_s = np.arange(0, 120, 0.01)
    _gyro_csv(folder / "log.csv", t_s, unit.output(motion.rate(t_s), 100.0, random))
    hz = random.uniform(40, 70)
    says: list[str] = []
    if seed == 0:  # stamps are late by what the line takes
        at_s = np.arange(0.1, 119, 1 / hz)
        stamps = np.sort(at_s + 0.002 + random.exponential(0.012, len(at_s)))
        says = [r"(?i)(uneven|scatter|jitter)"]
    elif seed == 1:  # readings when they come, stamped as they were taken
        at_s = np.cumsum(random.uniform(0.006, 0.034, 6000))
        at_s = at_s[at_s < 119]
        stamps = at_s
        says = [r"(?i)uneven"]
    elif seed == 2:  # four readings arrive together, stamped when they arrive, which scatters
        at_s = np.arange(0.1, 119, 1 / hz)
        number = np.arange(len(at_s)) // 4 * 4 + 3
        arrival = at_s[np.minimum(number, len(at_s) - 1)] + 0.004
        stamps = np.maximum.accumulate(arrival + random.uniform(0, 0.006, len(at_s)))
        says = [r"(?i)(uneven|scatter|jitter|burst)"]
    else:  # one reading in some is late by a whole period and more
        at_s = np.arange(0.1, 119, 1 / hz)
        late = random.uniform(0, 1, len(at_s)) < 0.15
        stamps = np.maximum.accumulate(at_s + 0.003 + late * random.uniform(0.01, 0.06, len(at_s)))
        stamps += 1e-5 * np.arange(len(at_s)) / len(at_s)
        says = [r"(?i)(uneven|scatter|jitter)"]
    q = quaternions(motion.attitude(at_s))
    csv(folder / "log_reference.csv", t=np.round(stamps, 6), qw__qx__qy__qz=q)
    expected = Expected(
        states=unit.states(),
        k_sd=0.01,
        says=says,
        never=[NO_LAW_OF_THE_RATE],
        verdicts=DELAYED,
        added=DELAYS,
    )
    return ForeignSet(mapping=_TOP + _TIME + _GYRO + _ATTITUDE + _BESIDE, files=["log.csv"], expected=expected)


@kind
def glitches(folder: Path, seed: int, random: np.random.Generator) -> ForeignSet:
    """A reference that is wrong for moments: markers that are mixed up, frozen frames, lost counts."""
    unit = Unit.of(random)
    t_s = np.arange(0, 120, 0.01)
    at_s = np.arange(0, 120, 1 / 100)
    never = [NO_LAW_OF_THE_RATE]
    if seed % 2 == 0:
        motion = by_hand(random, 120.0, 200.0)
        attitude = motion.attitude(at_s)
        q = quaternions(attitude)
        for start in random.choice(np.arange(500, 11000, 50), 8, replace=False).tolist():
            length = int(random.integers(1, 6)) if seed == 0 else int(random.integers(15, 60))
            off = random.standard_normal(3)
            off *= np.radians(random.uniform(10, 50)) / np.linalg.norm(off)
            wrong = Rotation.from_rotvec(off) * attitude[start : start + length]
            frozen = np.repeat(q[start - 1 : start], length, axis=0)
            q[start : start + length] = frozen if random.uniform() < 0.4 else quaternions(wrong)
        _gyro_csv(folder / "log.csv", t_s, unit.output(motion.rate(t_s), 100.0, random), qw__qx__qy__qz=q)
        mapping, states = _TOP + _TIME + _GYRO + _ATTITUDE, unit.states()
    else:
        motion = on_spindle(random, (60.0, -90.0, 30.0, 120.0, -45.0))
        t_s = np.arange(0, motion.seconds, 0.01)
        angle = np.degrees(np.unwrap(motion.angles(t_s)[:, 0]))
        for start in random.choice(np.arange(500, len(t_s) - 500, 50), 5, replace=False).tolist():
            if seed == 1:  # single readings with a bit of the counter wrong
                angle[start : start + int(random.integers(1, 3))] += random.choice([-1, 1]) * 360 / 4
            else:  # counts are lost for good
                angle[start:] += random.choice([-1, 1]) * random.uniform(2, 9)
        output = unit.output(motion.rate(t_s), 100.0, random)
        _gyro_csv(folder / "log.csv", t_s, output, angle=np.round(angle / 0.02) * 0.02)
        mapping = _TOP + _TIME + _GYRO + _ANGLE
        states = {"z": unit.states()["z"]}
    expected = Expected(
        states=states,
        k_sd=0.01,
        says=[r"(?i)(jump|spike|glitch|wrong for)"],
        never=never,
        verdicts=DELAYED | OPEN,
        added=DELAYS,
    )
    return ForeignSet(mapping=mapping, files=["log.csv"], expected=expected)


@kind
def robot(folder: Path, seed: int, random: np.random.Generator) -> ForeignSet:
    """A unit on a robot whose controller tells its pose, or its rates, fifteen times a second, and late."""
    unit = Unit.of(random)
    motion = by_robot(random, 150.0, random.uniform(40, 90))
    hz = (100.0, 200.0)[seed % 2]
    t_s = np.arange(0, 150, 1 / hz)
    _gyro_csv(folder / "log.csv", t_s, unit.output(motion.rate(t_s), hz, random))
    late_s = random.uniform(0.03, 0.09)
    at_s = np.arange(0.05, 149, 1 / 15)
    if seed % 2 == 0:
        noise = Rotation.from_rotvec(np.radians(0.01) * random.standard_normal((len(at_s), 3)))
        q = quaternions(motion.attitude(at_s) * noise)
        csv(folder / "log_reference.csv", t=at_s + late_s, qw__qx__qy__qz=q)
        mapping = _TOP + _TIME + _GYRO + _ATTITUDE + _BESIDE
    else:
        csv(folder / "log_reference.csv", t=at_s + late_s, rx__ry__rz=motion.rate(at_s))
        mapping = _TOP + _TIME + _GYRO + _RATE + _BESIDE
    expected = Expected(
        states=unit.states(),
        k_sd=0.01,
        says=[rf"{1e3 * late_s:.0f}\.|{1e3 * late_s - 1:.0f}\.|{1e3 * late_s + 1:.0f}\.|too rarely"],
        never=[NO_LAW_OF_THE_RATE],
        verdicts=DELAYED | OPEN,
        added=DELAYS,
    )
    return ForeignSet(mapping=mapping, files=["log.csv"], expected=expected)


def _poses(random: np.random.Generator, count: int) -> Floats:
    six = np.array([[0, 0, 1.0], [0, 0, -1], [0, 1, 0], [0, -1, 0], [1, 0, 0], [-1, 0, 0]])
    more = random.standard_normal((max(count - 6, 0), 3))
    return np.vstack([six, more / np.linalg.norm(more, axis=1, keepdims=True)])[:count]


@kind
def rests_in_files(folder: Path, seed: int, random: np.random.Generator) -> ForeignSet:
    """One pose a file, power off between: biases that differ by file, or a true sensitivity to gravity."""
    unit = Unit.of(random, arw=0.003)
    ups = _poses(random, (6, 12, 7, 14)[seed])
    g = 0.03 * random.standard_normal((3, 3)) if seed % 2 else np.zeros((3, 3))
    turn_on = 0.0 if seed % 2 else 0.05
    files, biases = [], []
    for number, up in enumerate(ups):
        bias = -unit.b_dps + up @ g + turn_on * random.standard_normal(3)
        n = 60 * 50
        output = bias + unit.arw * np.sqrt(50) * random.standard_normal((n, 3))
        accel = G_MPS2 * up + 0.02 * random.standard_normal((n, 3))
        files.append(f"pose{number:02d}.csv")
        biases.append(-bias)
        _gyro_csv(folder / files[-1], np.arange(n) / 50, output, accel)
    states = {name: (np.nan, float(b)) for name, b in zip("xyz", unit.b_dps, strict=True)}
    says = (
        []
        if seed % 2
        else [r"(?i)(bias(es)? (that )?differs?.*(file|rest|pose)|from (file|rest|pose) to (file|rest|pose))"]
    )
    expected = Expected(
        states=states,
        b_sd_dps=0.2,
        says=says,
        verdicts=frozenset({"added"}) if seed % 2 else QUIET | OPEN,
        added=frozenset({"g_sensitivity"}) if seed % 2 else frozenset(),
    )
    return ForeignSet(
        mapping=_TOP + _TIME + _GYRO + _ACCEL + '[reference]\nkind = "rest"\n', files=files, expected=expected
    )


@kind
def long_rest(folder: Path, seed: int, random: np.random.Generator) -> ForeignSet:
    """A unit at rest for an hour, no temperature recorded: a random walk is no law, the mean is the bias."""
    unit = Unit.of(random, arw=0.004)
    hz, n = 10.0, 36000
    noise = unit.arw * np.sqrt(hz) * random.standard_normal((n, 3))
    wander = walk(random, n, hz, 3e-5 if seed % 2 else 0.0)
    accel = G_MPS2 * np.array([0.1, -0.05, 0.99]) + 0.02 * random.standard_normal((n, 3))
    _gyro_csv(folder / "log.csv", np.arange(n) / hz, -unit.b_dps + noise + wander, accel)
    mean = unit.b_dps - wander.mean(axis=0)
    states = {name: (np.nan, float(b)) for name, b in zip("xyz", mean, strict=True)}
    expected = Expected(
        states=states, b_sd_dps=0.02, never=[r"g sensitivity, probability", r"bias step, probability"], verdicts=QUIET
    )
    return ForeignSet(
        mapping=_TOP + _TIME + _GYRO + _ACCEL + '[reference]\nkind = "rest"\n', files=["log.csv"], expected=expected
    )


@kind
def hand_turns(folder: Path, seed: int, random: np.random.Generator) -> ForeignSet:
    """Turns against a stop by a hand, labelled; on odd seeds one gyro clips in the fast ones."""
    unit = Unit.of(random)
    gyro = int(random.integers(3))
    rates, labels, sections = [np.zeros((1500, 3))], [""] * 1500, []
    for number in range(36):
        axis = number % 3
        way, length_s = (1 if (number // 3) % 2 else -1), float(random.choice([1.6, 4.5]))
        n = round(length_s * 500)
        shape = np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 2
        turn = np.zeros((n, 3))
        turn[:, axis] = shape / shape.mean() * way * (360 + 0.3 * random.standard_normal()) / length_s
        rest = np.zeros((1500, 3))
        # Euler rates about z, y, x are body rates while the other angles are whole turns.
        rates += [turn[:, [2, 1, 0]], rest]
        labels += [f"t{number}"] * n + [""] * 1500
        sections.append(f't{number} = {{ axis = "{"xyz"[axis]}", angle_deg = {360 * way} }}')
    w = np.vstack(rates)[::5][:, [2, 1, 0]]
    output = unit.output(w, 100.0, random)
    if seed % 2:
        output = clipped(output, gyro, 330.0, random)
    t_s = np.arange(len(w)) / 100
    lines = ["t,gx,gy,gz,label"]
    lines += [f"{t:.2f},{a:.4f},{b:.4f},{c:.4f},{x}" for t, (a, b, c), x in zip(t_s, output, labels[::5], strict=True)]
    (folder / "log.csv").write_text("\n".join(lines) + "\n")
    reference = (
        '[reference]\nkind = "turns"\nsection_column = "label"\nsd_deg = 0.3\nrest_s = 0.03\nrest_limit_dps = 5\n'
    )
    expected = Expected(
        states=unit.states(),
        k_sd=0.01,
        says=[rf"(?i)\b{'xyz'[gyro]}\b.*(saturat|limit)"] if seed % 2 else [],
        never=[NO_LAW_OF_THE_RATE],
        verdicts=DELAYED | OPEN,
        added=frozenset({"saturation"}),
    )
    mapping = _TOP + _TIME + _GYRO + reference + "[reference.sections]\n" + "\n".join(sections) + "\n"
    return ForeignSet(mapping=mapping, files=["log.csv"], expected=expected)


@kind
def table_without_rates(folder: Path, seed: int, random: np.random.Generator) -> ForeignSet:
    """A recording that another laboratory wrote: /table holds angles of three axes, and no rates."""
    unit = Unit.of(random)
    n = 140 * 500
    at_s = np.arange(n) / 500
    rates = np.zeros((n, 3))
    for number, (axis, rate) in enumerate([(0, 20), (0, -40), (1, 20), (1, -40), (2, 20), (2, -40)]):
        start = 10 + 20 * number
        turn_s = 360 / abs(rate)
        rates[:, axis] += rate * np.interp(at_s, [start, start + 1, start + turn_s, start + turn_s + 1], [0, 1, 1, 0])
    motion = of_rates(rates)
    t_s = np.arange(0, 139, 0.01)
    read_s = np.arange(0, 139, (0.05, 0.02)[seed % 2])
    with h5py.File(folder / "run.h5", "w") as file:
        file.attrs.update({"format": "turntable-recording", "format_version": 1})
        imu = file.create_group("imu/unit")
        imu.attrs.update({"names": ["x", "y", "z"], "p": np.eye(3)})
        imu["t_ns"] = np.round(t_s * 1e9).astype(np.int64)
        imu["rate_rps"] = np.radians(unit.output(motion.rate(t_s), 100.0, random))
        table = file.create_group("table")
        table.attrs.update({"axes": ["z", "y", "x"], "gimbals": ["z", "y", "x"]})
        table["t_ns"] = np.round(read_s * 1e9).astype(np.int64)
        table["angle_rad"] = np.round(motion.angles(read_s) / 1e-5) * 1e-5
    expected = Expected(states=unit.states(), k_sd=0.003, verdicts=DELAYED, added=DELAYS)
    return ForeignSet(recording="run.h5", expected=expected)


@kind
def delays(folder: Path, seed: int, random: np.random.Generator) -> ForeignSet:
    """A reference that is 20 to 150 ms late, beside hands or a robot; on seed 1 counts of unknown size."""
    unit = Unit.of(random)
    late_s = (0.09, 0.045, 0.14, 0.022)[seed]
    motion = by_hand(random, 120.0, 150.0) if seed % 2 == 0 else by_robot(random, 120.0, 80.0)
    t_s = np.arange(0, 120, 0.01)
    output = unit.output(motion.rate(t_s), 100.0, random)
    reference = motion.rate(t_s - late_s)
    gyro = _GYRO
    states = unit.states()
    if seed == 1:
        count = 0.0612
        output = np.round(output / count)
        gyro = '[gyro]\ncolumns = ["gx", "gy", "gz"]\nunit = "raw"\nscale = "from data"\n'
        reference = lfilter([0.06], [1, -0.94], reference, axis=0)  # the controller smooths its rates over 0.16 s
        late_s += 0.157
        states = dict.fromkeys(states, (np.nan, np.nan))
    _gyro_csv(folder / "log.csv", t_s, output, rx__ry__rz=reference)
    number = f"{1e3 * late_s:.0f}"
    expected = Expected(
        states=states,
        k_sd=0.005,
        says=[rf"\b{number}\.\d|\b{int(number) - 1}\.[5-9]"] if seed != 1 else [r"one count is 0\.06[01]"],
        never=[r"write scale", r"times the reference"],
        verdicts=DELAYED | OPEN if seed == 1 else DELAYED,
        added=DELAYS,
    )
    return ForeignSet(mapping=_TOP + _TIME + gyro + _RATE, files=["log.csv"], expected=expected)


@kind
def laid_by_hand(folder: Path, seed: int, random: np.random.Generator) -> ForeignSet:
    """Gravity as the witness; on odd seeds a gyro is dead. Investigate says that it does not trace that."""
    unit = Unit.of(random)
    hz, rates = 100.0, []
    for _ in range(16):
        rest, n = np.zeros((3000, 3)), round(random.uniform(1.2, 2.2) * 500)
        shape = np.sin(np.pi * (np.arange(n) + 0.5) / n)[:, None] ** 2
        rates += [rest, shape * random.uniform(-1, 1, 3) * [120, 60, 120]]
    motion = of_rates(np.vstack([*rates, np.zeros((3000, 3))]))
    t_s = np.arange(0, motion.seconds, 1 / hz)
    output = unit.output(motion.rate(t_s), hz, random)
    gyro = int(random.integers(3))
    if seed % 2:
        output[:, gyro] = 0.4
    accel = G_MPS2 * motion.up(t_s) * (1 + 3e-3 * random.standard_normal(3)) + 0.03 * random.standard_normal(3)
    accel = accel + 0.02 * random.standard_normal(accel.shape)
    _gyro_csv(folder / "log.csv", t_s, output, accel)
    says = [rf"(?i)\b{'xyz'[gyro]}\b.*(constant|dead|disconnected)"] if seed % 2 else []
    states = {} if seed % 2 else unit.states()
    expected = Expected(states=states, k_sd=0.01, says=[*says, r"no effect can be traced|three axes"], untraced=True)
    return ForeignSet(
        mapping=_TOP + _TIME + _GYRO + _ACCEL + '[reference]\nkind = "gravity"\n', files=["log.csv"], expected=expected
    )


@kind
def encoder(folder: Path, seed: int, random: np.random.Generator) -> ForeignSet:
    """A gyro on a stepper beside an encoder of coarse counts: the rates are the import's own, and accuse nobody."""
    unit = Unit.of(random)
    motion = by_stepper(random, 100.0, (60.0, 190.0, 110.0, 340.0)[seed])
    t_s = np.arange(0, 100, 0.01)
    output = unit.output(motion.rate(t_s), 100.0, random)
    output += 5 * np.sin(2 * np.pi * 37.0 * t_s)[:, None] * [0.1, 0.1, 1.0]  # the motor shakes what it turns
    angle = np.degrees(motion.angles(t_s - 0.012)[:, 0])
    _gyro_csv(folder / "log.csv", t_s, output, angle=np.round(angle / 0.09) * 0.09)
    expected = Expected(
        states={"z": unit.states()["z"]},
        k_sd=0.01,
        never=[r"the encoder of axis", r"the rates of axis", r"the angle of axis"],
        verdicts=DELAYED | OPEN,
        added=DELAYS,
    )
    return ForeignSet(mapping=_TOP + _TIME + _GYRO + _ANGLE, files=["log.csv"], expected=expected)


@kind
def dead_zone(folder: Path, seed: int, random: np.random.Generator) -> ForeignSet:
    """Gyros that put out exactly 0 at slow rates, as consumer devices do that hide their bias."""
    unit = Unit.of(random)
    unit = Unit(unit.k, np.zeros(3), unit.skew, unit.arw)
    motion = by_robot(random, 120.0, 70.0)
    zone_dps = random.uniform(0.6, 2.0)
    t_s = np.arange(0, 120, 0.01)
    output = unit.output(motion.rate(t_s), 100.0, random)
    output = np.where(np.abs(output) < zone_dps, 0.0, output)
    at_s = np.arange(0, 120, 1 / 50)
    if seed % 2 == 0:
        _gyro_csv(folder / "log.csv", t_s, output, rx__ry__rz=motion.rate(t_s))
        mapping = _TOP + _TIME + _GYRO + _RATE
    else:
        _gyro_csv(folder / "log.csv", t_s, output)
        csv(folder / "log_reference.csv", t=at_s, qw__qx__qy__qz=quaternions(motion.attitude(at_s)))
        mapping = _TOP + _TIME + _GYRO + _ATTITUDE + _BESIDE
    expected = Expected(
        states=unit.states(),
        k_sd=0.01,
        says=[r"(?i)exactly 0|dead (zone|band)"],
        never=[r"stuck", r"disconnected"],
        verdicts=QUIET | OPEN | frozenset({"added"}),
        added=DELAYS | {"dead_band"},
    )
    return ForeignSet(mapping=mapping, files=["log.csv"], expected=expected)


@kind
def image_of_a_line(folder: Path, seed: int, random: np.random.Generator) -> ForeignSet:
    """A unit at rest beside a fan, logged twice as often as it measures: a line and its image are one cause."""
    unit = Unit.of(random, arw=0.003)
    n, hz = 6000, 50.0
    measured_s = np.arange(n) / hz
    line_hz = random.uniform(6, 12)
    size = 0.4 if seed % 2 == 0 else 0.012
    output = -unit.b_dps + unit.arw * np.sqrt(hz) * random.standard_normal((n, 3))
    output += size * np.sin(2 * np.pi * line_hz * measured_s)[:, None] * [1.0, -0.6, 0.3]
    t_s = np.arange(2 * n - 1) / (2 * hz)
    logged = np.column_stack([np.interp(t_s, measured_s, column) for column in output.T])
    _gyro_csv(folder / "log.csv", t_s, logged)
    states = {name: (np.nan, float(b)) for name, b in zip("xyz", unit.b_dps, strict=True)}
    expected = Expected(
        states=states,
        b_sd_dps=0.02,
        verdicts=frozenset({"added"}) if seed % 2 == 0 else QUIET | frozenset({"added"}),
        added=frozenset({"tone"}),
        never=[r"tone, tone"],
    )
    return ForeignSet(
        mapping=_TOP + _TIME + _GYRO + '[reference]\nkind = "rest"\nwhere = "everywhere"\n',
        files=["log.csv"],
        expected=expected,
    )
