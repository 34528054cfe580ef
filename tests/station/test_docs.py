"""The documentation agrees with the code, and the READMEs lead to pages that exist."""

from __future__ import annotations

import re
import runpy
from pathlib import Path
from typing import Any

import pytest
from printed import blocks_of, not_printed

from sims.physics.hidden import KINDS
from station.cli import main

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "docs/pages"
PACKAGES = ("drivers", "estimator", "sims", "station")
READMES = {ROOT / "README.md": 8000} | {ROOT / package / "README.md": 4500 for package in PACKAGES}
"""The longest that each may be, bytes."""


@pytest.fixture
def generator() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "docs/generate.py"))


def test_generated_pages_are_up_to_date(generator: dict[str, Any]) -> None:
    stale = generator["stale"]()
    assert not stale, f"out of date: {', '.join(stale)}; run: {generator['COMMAND']}"


def test_every_page_of_the_decisions_is_numbered_in_a_row() -> None:
    numbers = [int(path.name[:4]) for path in sorted((PAGES / "decisions").glob("[0-9]*.md"))]
    assert numbers == list(range(1, len(numbers) + 1))


@pytest.mark.parametrize("readme", READMES, ids=lambda path: path.parent.name)
def test_readmes_are_short_and_their_links_lead_somewhere(readme: Path) -> None:
    assert readme.stat().st_size <= READMES[readme]
    targets = re.findall(r"\]\(([^)#]+)[^)]*\)", readme.read_text(encoding="utf-8"))
    assert targets
    missing = [target for target in targets if "://" not in target and not (readme.parent / target).exists()]
    assert not missing


def test_no_page_or_picture_fetches_anything_from_elsewhere() -> None:
    for path in [*PAGES.rglob("*.md"), *PAGES.rglob("*.svg"), *PAGES.rglob("*.css")]:
        assert not re.search(r"""(?:src=|url\()["']?(?:https?:)?//""", path.read_text(encoding="utf-8")), path


PLANS = [
    pytest.param(block, id=block[0].removeprefix("$ "), marks=[pytest.mark.full] if "--improve" in block[0] else [])
    for block in blocks_of(PAGES / "guide/scripts.md")
    if block[0].startswith("$ station plan")
]


def test_the_guide_shows_plans() -> None:
    assert len(PLANS) == 3


@pytest.mark.parametrize("block", PLANS)
def test_plans_of_the_guide_are_what_the_command_prints(
    block: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, value in {"COLUMNS": "80", "FORCE_COLOR": "1", "NO_COLOR": "1"}.items():
        monkeypatch.setenv(name, value)
    assert main(block[0].split()[2:]) == 0
    printed = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out).splitlines()
    assert not not_printed(block[1:], printed)


def test_every_hidden_effect_stands_on_the_page_of_the_twins() -> None:
    page = (PAGES / "reference/twins.md").read_text(encoding="utf-8")
    assert not [name for name in KINDS if f"`{name}`" not in page]
