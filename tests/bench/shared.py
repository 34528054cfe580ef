"""What is made once for all tests of a session: by whoever asks first, and then read by all workers."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path
from shutil import rmtree
from typing import Any, TypeVar

import pytest
from support import ASYMMETRY, three_recordings

import station.commands.investigate as command
from estimator.calibration.error_model import ErrorModel
from estimator.recordings.writing import write_recording
from estimator.tracing.investigation import Investigation
from estimator.tracing.type_model import error_model_of
from station.bench.bench import load_bench
from station.cli import main

T = TypeVar("T")


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], T]) -> T:
    """Return what ``make(folder)`` returns, made once for all workers; the folder stays."""
    base = factory.getbasetemp()
    folder = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    with (folder / f"{name}.lock").open("w") as lock:
        if os.name == "posix":
            import fcntl

            fcntl.flock(lock, fcntl.LOCK_EX)  # elsewhere two workers may both make it
        own = folder / (name if os.name == "posix" else f"{name}-{os.getpid()}")
        kept = own / "made.pickle"
        if not kept.exists():
            rmtree(own, ignore_errors=True)  # of one that was broken off
            own.mkdir()
            kept.write_bytes(pickle.dumps(make(own)))
        made: T = pickle.loads(kept.read_bytes())
    return made


@dataclass(frozen=True)
class Traced:
    """A calibration, an exploration and a verification recording, and what ``station investigate`` made of them.

    The third was to verify. ``found`` is without its model, ``model`` that of the type.
    """

    recordings: tuple[Path, Path, Path]
    code: int
    said: str
    results: Path
    picture: Path
    found: Investigation
    model: ErrorModel


def trace_asymmetry(folder: Path) -> Traced:
    """Write three recordings, and investigate them by the command, the third to verify."""
    first, second, third = (folder / f"{name}.h5" for name in ("calibration", "exploration", "verification"))
    for path, recording in zip((first, second, third), three_recordings(4, ASYMMETRY), strict=True):
        write_recording(path, replace(recording, attributes={"bench": load_bench(None).text}))
    results, picture = folder / "results.h5", folder / "residual.png"
    files = [first, second, "--verify", third, "-o", results, "--plot", picture]
    kept: list[Investigation] = []

    def investigated(*runs: Any, **options: Any) -> Investigation:
        kept.append(investigate(*runs, **options))
        return kept[-1]

    investigate = command.investigate
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(StringIO()) as said:
        patch.setattr(command, "investigate", investigated)
        code = main(["investigate", "--json", *map(str, files)])
    (found,) = kept
    assert found.model is not None
    model = error_model_of(found.model)
    without = replace(found, model=None)
    return Traced((first, second, third), code, said.getvalue(), results, picture, without, model)
