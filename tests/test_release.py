"""The sdist and the wheel: complete, and the wheel alone does the main job where there is no source tree."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from collections.abc import Iterator
from importlib.metadata import Distribution, distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

pytestmark = [pytest.mark.release, pytest.mark.timeout(600)]

ROOT = Path(__file__).parents[1]
PACKAGES = ("drivers", "estimator", "sims", "station")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
NAME, VERSION = "turntable_station", PROJECT["version"]
COPIED = ("LICENSE", "README.md", "pyproject.toml", *PACKAGES)


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sdist of a copy of the sources, and the wheel that is built from the sdist."""
    folder = tmp_path_factory.mktemp("built")
    tree = folder / "tree"
    for name in COPIED:  # what a build leaves behind stays out of the source tree
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            tree.mkdir(exist_ok=True)
            shutil.copy(source, tree)
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(tree)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    shutil.rmtree(tree)
    return folder


@pytest.fixture(scope="session")
def wheel(built: Path) -> Path:
    """The wheel."""
    return built / f"{NAME}-{VERSION}-py3-none-any.whl"


@pytest.fixture(scope="session")
def fresh(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of programs of a new environment with the wheel, and of what else is installed its requirements."""
    folder = tmp_path_factory.mktemp("fresh")
    venv.create(folder, symlinks=True)
    (site,) = folder.glob("lib/python*/site-packages")
    for required in _required():
        for entry in _top_level(required):
            link = site / entry.name
            if not link.is_symlink():
                link.symlink_to(entry)
    pip = [sys.executable, "-m", "pip", "--python", str(folder / "bin/python"), "install", "-q", "--no-index"]
    subprocess.run([*pip, "--no-deps", "--no-compile", str(wheel)], check=True)
    return folder / "bin"


def _required() -> Iterator[Distribution]:
    """Yield what is installed of all that the project requires without extras, directly or not."""
    ahead = [(Requirement(text), "") for text in PROJECT["dependencies"]]
    seen = set()
    while ahead:
        requirement, extra = ahead.pop()
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": extra}):
            continue
        needed = distribution(requirement.name)
        name = canonicalize_name(requirement.name)
        for asked in ("", *requirement.extras):
            if (name, asked) not in seen:
                seen.add((name, asked))
                ahead += [(Requirement(text), asked) for text in needed.requires or ()]
        yield needed


def _top_level(installed: Distribution) -> set[Path]:
    """Return the files and folders of a distribution in site-packages."""
    site = Path(str(installed.locate_file("")))
    names = {Path(str(file)).parts[0] for file in installed.files or ()}
    return {site / name for name in names if name not in ("..", "__pycache__") and (site / name).exists()}


def carried_out(*command: str | Path, folder: Path) -> str:
    """Return what a command prints in a folder; nothing of this environment leads it to the source tree."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "STATION"))}
    environment["XDG_STATE_HOME"] = str(folder / "state")
    done = subprocess.run(
        [str(word) for word in command], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_wheel_holds_every_file_of_the_packages_and_nothing_else(wheel: Path) -> None:
    sources = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    with zipfile.ZipFile(wheel) as archive:
        held = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert held == sources


def test_the_sdist_holds_the_licence_and_the_readme_and_is_of_the_version_that_the_changelog_ends_with(
    built: Path,
) -> None:
    base = f"{NAME}-{VERSION}"
    with tarfile.open(built / f"{base}.tar.gz") as archive:
        held = set(archive.getnames())
    assert {f"{base}/{name}" for name in ("LICENSE", "README.md", "pyproject.toml")} <= held
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    headings = [line.removeprefix("## ") for line in changes.splitlines() if line.startswith("## ")]
    released = [heading for heading in headings if heading != "Not yet released"]
    assert released[0].split()[0] == VERSION


def test_the_wheel_alone_does_the_main_job_and_the_studies(fresh: Path, tmp_path: Path) -> None:
    program = (
        "import json, sys, importlib.metadata as m, drivers, estimator, sims, station;"
        "print(json.dumps([[p.__file__ for p in (drivers, estimator, sims, station)], sys.path,"
        " m.version('turntable-station')]))"
    )
    files, path, version = json.loads(carried_out(fresh / "python", "-c", program, folder=tmp_path))
    assert version == VERSION
    for package, file in zip(PACKAGES, files, strict=True):
        assert Path(file).is_relative_to(fresh.parent), f"{package} comes from {file}"
        assert not Path(file).resolve().is_relative_to(ROOT)
    assert not [entry for entry in path if entry and Path(entry).resolve().is_relative_to(ROOT)]

    station = fresh / "station"
    assert carried_out(station, "run", "-o", "run.h5", folder=tmp_path).startswith("PASS")
    result = json.loads(carried_out(station, "calibrate", "run.h5", "--json", folder=tmp_path))
    assert result["outcome"] == "PASS"
    assert len(result["gyros"]) == 4
    carried_out(station, "report", "run.h5", "--pdf", folder=tmp_path)
    assert (tmp_path / "run.pdf").read_bytes().startswith(b"%PDF")
    methods = json.loads(carried_out(station, "study", "baselines", "--seeds", "1", "--json", folder=tmp_path))
    assert methods["failed"] == []
