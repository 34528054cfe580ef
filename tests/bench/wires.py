"""The main job on each bench through real wires: twins in one process, the station in another, ten times as fast.

python tests/bench/wires.py                    all benches, the 360 s script
python tests/bench/wires.py galil_xsens        one of them
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

from support import TwinProcess, station

BENCHES = Path(__file__).parents[1] / "data" / "benches"
DEFAULT = "kinco_can"


def run(name: str, scale: float, script: Path | None = None) -> dict[str, object]:
    """Return what `station run --json` says of a bench whose twins are in another process."""
    bench = ["--bench", BENCHES / f"{name}.toml"] if name != DEFAULT else []
    with TwinProcess(*bench, "--scale", str(scale)) as twin, tempfile.TemporaryDirectory() as folder:
        devices = [device for device in twin.links if name != DEFAULT or device in ("table", "array")]
        words = ["run", *bench, "--scale", str(scale), "--json", "-o", Path(folder) / "run.h5", *twin.options(*devices)]
        if script is not None:
            words += ["--script", script]
        done = station(*words, timeout=400)
    result: dict[str, object] = json.loads(done.stdout)
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("benches", nargs="*", default=[DEFAULT, *sorted(path.stem for path in BENCHES.glob("*.toml"))])
    parser.add_argument("--scale", type=float, default=10.0)
    arguments = parser.parse_args()
    for name in arguments.benches:
        began = time.perf_counter()
        found = run(name, arguments.scale)
        nis = f"NIS {found['nis_mean']:.3f}" if found["nis_mean"] is not None else "no NIS"
        print(
            f"{name}: {found['outcome']}, {nis}, {found['samples']} samples, {found['lost']} lost, "
            f"{time.perf_counter() - began:.0f} s; {found['reason']}",
            flush=True,
        )
