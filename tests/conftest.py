"""Lets tests import what they share with the benchmarks; an investigation that many of them look at."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from shared import Traced

    from estimator.calibration.error_model import ErrorModel
    from estimator.tracing.investigation import Investigation

# Before numpy: two workers that share two cores with the threads of two BLAS wait for each other most of the time.
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")

# Before the workers start: glibc returns every large array to the system, which then clears pages for the next one.
for name, size in (("MMAP_THRESHOLD", 1 << 28), ("TRIM_THRESHOLD", 1 << 30), ("TOP_PAD", 1 << 24)):
    os.environ.setdefault(f"MALLOC_{name}_", str(size))

# Without bytecode each worker, and each of some two hundred processes that tests start, compiles all sources anew.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

sys.path.insert(0, str(Path(__file__).parent / "bench"))

import forks  # noqa: E402

LONGEST = [
    "test_processes",
    "test_walks",
    "test_hosting",
    "test_host",
    "test_guard",
    "test_kinds",
    "test_terminal",
    "test_pictures",
    "test_runs_with_faults",
    "test_run",
    "test_whole_imu",
    "test_untrue_readings",
    "test_report",
    "test_export",
    "test_force_model",
    "test_timing",
    "test_mountings",
    "test_accelerometers",
    "test_residual",
    "test_one_verdict",
    "test_force_tracing",
    "test_plugins",
    "test_history",
    "test_improve",
    "test_tracing",
    "test_ways_out",
    "test_stop",
    "test_sampling",
    "test_runs_on_wires",
    "test_journal",
    "test_joined_mountings",
    "test_conformance",
    "test_export_accelerometers",
    "test_forks",
    "test_house",
    "test_investigate",
    "test_tray",
    "test_results_first",
    "test_campaigns",
    "test_loop",
    "test_modbus_rtu",
    "test_joint",
    "test_xsens_imu",
    "test_uncommanded",
    "test_bad_recordings",
    "test_who_and_which",
    "test_error_model",
    "test_records",
    "test_import_poses",
    "test_live_forces",
    "test_slow_lines",
    "test_import_shapes",
    "test_better_model",
    "test_hand_turned",
    "test_open_world",
    "test_foreign_rests",
    "test_vectornav_imu",
    "test_misbehaving_wires",
    "test_narrow",
    "test_strangers_files",
    "test_poses",
    "test_constancy",
    "test_untrusted_files",
    "test_check",
    "test_noise",
    "test_end_early",
    "test_stim300_imu",
    "test_table_conformance",
    "test_odd_samples",
    "test_hidden",
    "test_budget",
    "test_import_formats",
    "test_charts",
    "test_studies",
    "test_importing",
    "test_init",
    "test_killed_runs",
    "test_papers",
    "test_public_face",
    "test_repeatability",
    "test_computer",
    "test_foreign_times",
    "test_calibrate",
    "test_foreign_faults",
    "test_facts",
    "test_watchdog_in_scaled_time",
    "test_reference_rates",
]
"""Files that take long, begun first so that no worker is left alone with one; those of real time before all others."""


def pytest_configure(config: pytest.Config) -> None:
    """Offer tests and their workers a server that forks commands of the station."""
    stack = ExitStack()
    stack.enter_context(forks.offered())
    config.add_cleanup(stack.close)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave the folder of counterparts aside where its marker is deselected: importing it takes seconds a worker."""
    deselected = "not counterpart" in str(config.getoption("markexpr"))
    return True if deselected and collection_path.name == "counterparts" else None


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Leave what is imported and collected out of what is looked through for garbage: none of it is.

    Screens make hundreds of thousands of objects that stay: they are looked through as seldom as by the station itself.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(10_000)
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put long files first; the order within a file stays."""
    items.sort(key=lambda item: LONGEST.index(item.path.stem) if item.path.stem in LONGEST else len(LONGEST))


@pytest.fixture(scope="session", autouse=True)
def state_of_nobody(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Let no test read or write what programs remember of the user who runs the tests."""
    os.environ["XDG_STATE_HOME"] = str(tmp_path_factory.mktemp("state"))


@pytest.fixture(scope="session")
def traced_asymmetry(tmp_path_factory: pytest.TempPathFactory) -> Traced:
    """Return what is found in ``three_recordings(4, ASYMMETRY)``; the files are to be read only."""
    from shared import made_once, trace_asymmetry

    return made_once(tmp_path_factory, "asymmetry", trace_asymmetry)


@pytest.fixture(scope="session")
def asymmetry(traced_asymmetry: Traced) -> tuple[Investigation, ErrorModel]:
    """Return what is found in ``three_recordings(4, ASYMMETRY)``, the third to verify, and the model of the type."""
    return traced_asymmetry.found, traced_asymmetry.model
