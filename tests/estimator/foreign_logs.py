"""Logs as other people make them, from a fixed seed, one for each mapping in tests/data/shapes. Angles in degrees.

Also the pieces of which mappings are put together, and how a log is imported under one.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from estimator.importing.importing import Imported, import_recording
from estimator.importing.mapping.mapping import read_mapping

SHAPES = Path(__file__).parents[1] / "data" / "shapes"
EARTH_DPS = 15.041 / 3600

DEVICE = '[device]\nname = "triad"\n'
CSV = DEVICE + '[file]\nformat = "csv"\n'
STAMPED = CSV + '[time]\ncolumn = "t"\nunit = "s"\n'
GYRO = '[gyro]\ncolumns = ["gx", "gy", "gz"]\nunit = "deg/s"\n'
RATE = '[reference]\nkind = "rate"\ncolumns = ["rx", "ry", "rz"]\nunit = "deg/s"\n'
MAPPING = STAMPED + GYRO + RATE


def written(folder: Path, mapping: str, log: str | bytes, name: str = "log.csv") -> tuple[Path, Path]:
    """Write a mapping and a log to a folder; return where."""
    (folder / "mapping.toml").write_text(mapping)
    (folder / name).write_bytes(log if isinstance(log, bytes) else log.encode())
    return folder / "mapping.toml", folder / name


def imported(mapping: Path, *logs: Path) -> Imported:
    """Return what logs hold under a mapping."""
    return import_recording(read_mapping(mapping), logs)


def spindle(t: np.ndarray) -> np.ndarray:
    """Return the rate of a spindle in deg/s: rests, and turns both ways at several rates, with ramps."""
    corners = [(0, 0), (4, 0), (5, 40), (12, 40), (14, -60), (22, -60), (23, 0), (26, 0), (27, 100), (32, 100), (34, 0)]
    return np.interp(t, *np.array(corners).T)


def gyro_encoder_rate(path: Path, *, factor: float = -14.2, bias_dps: float = 1.3, hold: int = 4) -> Path:
    """A gyro in counts (``factor`` a deg/s), held over rows; an encoder in steps of 0.5 deg/s, held; coarse stamps."""
    rng = np.random.default_rng(11)
    t = np.arange(8000) / 200
    w = spindle(t)
    gyro = np.round(factor * (w - bias_dps) + rng.normal(scale=1.5, size=len(t)))
    encoder = np.round((w + rng.normal(scale=0.3, size=len(t))) / 0.5) * 0.5
    rows = np.arange(len(t))
    gyro, encoder = gyro[rows // hold * hold], encoder[np.maximum(rows // 3 * 3 - 1, 0)]
    stamps = np.floor(t * 1000 / 10) * 10  # a clock of 10 ms: two rows a stamp
    lines = [f"{s:.0f},{g:.0f},{e:g}" for s, g, e in zip(stamps, gyro, encoder, strict=True)]
    lines[500:500] = [lines[499]] * 3  # written again
    path.write_text("t,gyro,encoder_rate\n" + "\n".join(lines) + "\n")
    return path


def gyro_encoder_angle(path: Path, *, k: float = 0.004, bias_dps: float = -0.4, turn: float = 1.0) -> Path:
    """A gyro in deg/s beside the counts of an encoder, 4096 to a turn."""
    rng = np.random.default_rng(12)
    t = np.arange(4000) / 100
    w = spindle(t)
    angle = 17.3 + np.concatenate([[0], np.cumsum((w[1:] + w[:-1]) / 2 / 100)])
    counts = np.floor(angle / 360 * 4096) % 4096
    gyro = turn * (1 - k) * w - bias_dps + rng.normal(scale=0.1, size=len(t))
    lines = [f"{a:.3f},{g:.3f},{c:.0f}" for a, g, c in zip(t, gyro, counts, strict=True)]
    path.write_text("t,rate,encoder\n" + "\n".join(lines) + "\n")
    return path


POSES = np.array([[0, 0, 1], [0, 0, -1], [0, 1, 0], [0, -1, 0], [1, 0, 0], [-1, 0, 0], [0.6, 0, 0.8]])
G_SENSITIVITY_DPS = np.array([0.02, -0.03, 0.05])  # of each gyro, per g along its own axis


def rest_poses(path: Path) -> Path:
    """Ten seconds in each pose, two of handling between; the accelerometer's y and z are upside down."""
    rng = np.random.default_rng(13)
    gyro, accel = [], []
    for pose in POSES:
        n, moving = 1000, 200
        gyro.append(0.5 + G_SENSITIVITY_DPS * pose + rng.normal(scale=0.05, size=(n, 3)))
        accel.append(pose + rng.normal(scale=0.002, size=(n, 3)))
        swing = np.sin(np.linspace(0, np.pi, moving))[:, None]
        gyro.append(0.5 + swing * rng.uniform(40, 120, size=3) + rng.normal(scale=2, size=(moving, 3)))
        accel.append(pose + swing * rng.normal(scale=0.3, size=3) + rng.normal(scale=0.05, size=(moving, 3)))
    rows = np.hstack([np.vstack(gyro), np.vstack(accel) * [1, -1, -1]])
    return _written(path, "gx,gy,gz,ax,ay,az", rows)


def up_and_down(path: Path, *, bias_dps: float = 0.02, latitude_deg: float = 48.14) -> Path:
    """Five minutes with the gyro's axis up, five with it down, turned over between."""
    rng = np.random.default_rng(14)
    t = np.arange(6000) / 10
    vertical = EARTH_DPS * np.sin(np.radians(latitude_deg))
    rate = np.where(t < 300, vertical, -vertical) - bias_dps + rng.normal(scale=0.01, size=len(t))
    rate[(t > 295) & (t < 305)] += 18
    return _written(path, "t,rate", np.column_stack([t, rate]))


def temperature_plateaus(path: Path) -> Path:
    """Three plateaus of two minutes at 50 Hz, each in another pose, warming up between; temperature once a second."""
    rng = np.random.default_rng(15)
    plateaus = [("cold", -10.0, [0, 0, 1]), ("room", 22.0, [0, 1, 0]), ("hot", 55.0, [1, 0, 0])]
    lines, t = ["t,gx,gy,gz,ax,ay,az,temp,plateau"], 0.0
    for i, (name, warmth, pose) in enumerate(plateaus):
        for label, n in ((name, 6000), ("", 1000 if i < 2 else 0)):
            for row in range(n):
                moving = 30 * np.sin(row / 50) if not label else 0.0
                gyro = 0.1 + 0.002 * (warmth - 22) + moving + rng.normal(scale=0.05, size=3)
                accel = 9.81 * np.array(pose) + rng.normal(scale=0.02, size=3)
                temp = f"{warmth + rng.normal(scale=0.02):.2f}" if row % 50 == 0 else ""
                numbers = ",".join(f"{v:.4f}" for v in (t, *gyro, *accel))
                lines.append(f"{numbers},{temp},{label}")
                t += 0.02
    path.write_text("\n".join(lines) + "\n")
    return path


def hours_of_rest(path: Path, *, hours: float = 3.0, rate_hz: float = 1.0, walk_dph_rth: float = 3.0) -> Path:
    """One channel: angle random walk 0.3 deg/rth, rate random walk in deg/h per root hour; no heading."""
    rng = np.random.default_rng(16)
    n = round(hours * 3600 * rate_hz)
    white = 0.3 / 60 * np.sqrt(rate_hz)
    walk = np.cumsum(rng.normal(scale=walk_dph_rth / 3600 / 60 / np.sqrt(rate_hz), size=n))
    rate = 0.05 + walk + rng.normal(scale=white, size=n)
    path.write_text("\n".join(f"{v:.6f}" for v in rate) + "\n")
    return path


def broken_log(path: Path, *, broken: int = 40, seed: int = 17) -> Path:
    """A triad turned by hand at 50 Hz, k 1 %, bias 0.5 deg/s; 1500 lines of which about ``broken`` are spoilt."""
    rng = np.random.default_rng(seed)
    t = np.arange(1500) / 50
    w = np.column_stack([30 * np.sin(t), 20 * np.cos(1.3 * t), 25 * np.sin(0.7 * t)])
    y = 0.99 * w - 0.5 + rng.normal(scale=0.05, size=w.shape)
    heading = "gx;gy;gz;rx;ry;rz"
    lines = [";".join(f"{v:.4f}".replace(".", ",") for v in (*a, *b)) for a, b in zip(y, w, strict=True)]
    for at in rng.choice(np.arange(20, 1500), size=broken, replace=False):
        cut = lines[at][: rng.integers(1, len(lines[at]) - 12)]
        lines[at] = cut if at % 2 else cut + "\ufffd\x00@" + heading[:5]
    lines.insert(900, heading)
    lines.insert(901, "deg/s;deg/s;deg/s;deg/s;deg/s;deg/s")
    lines.insert(300, "# cable touched")
    top = ["Logger 2.1, started 12:00", "", "# rate table 4", heading, "deg/s;deg/s;deg/s;deg/s;deg/s;deg/s"]
    path.write_text("\r\n".join([*top, *lines]), encoding="utf-8")
    return path


def _written(path: Path, heading: str, rows: np.ndarray) -> Path:
    path.write_text(heading + "\n" + "\n".join(",".join(f"{v:.5f}" for v in row) for row in rows) + "\n")
    return path
