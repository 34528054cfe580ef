"""What the station tells people to type exists, and what they mistype is answered in a way that helps."""

from __future__ import annotations

import argparse
import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from station.cli import main, make_parser

ROOT = Path(__file__).parents[2]
PACKAGES = ("drivers", "estimator", "sims", "station")
_NOUN = r"\b(?:the|a|an|this|that|another|one|no|each|its|of|second|calibration|rate)\s+(?:\w+\s+)?"
_VERBS = r"(?!was\b|is\b|has\b|can\b|does\b|had\b)"
_ADVICE = re.compile(rf"(?P<noun>(?i:{_NOUN}))?(?<![\w./-])`?station {_VERBS}(?P<command>[a-z]+)\b(?P<rest>[^`\n]*)")


def _texts() -> Iterator[tuple[str, str]]:
    """Yield (where, text) for every text of the product: strings of the code, tables, templates, pages."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*")):
            if path.suffix == ".py":
                for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                    if isinstance(node, ast.Constant) and isinstance(node.value, str):
                        yield f"{path.relative_to(ROOT)}:{node.lineno}", node.value
            elif path.suffix in {".toml", ".rich", ".txt", ".html", ".jinja", ".md"}:
                yield str(path.relative_to(ROOT)), path.read_text(encoding="utf-8")
    for page in [ROOT / "README.md", *sorted((ROOT / "docs/pages").rglob("*.md"))]:
        yield str(page.relative_to(ROOT)), page.read_text(encoding="utf-8")


def _options(parser: argparse.ArgumentParser) -> dict[str, set[str]]:
    """Return the option strings of each command."""
    (commands,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    return {name: set(command._option_string_actions) for name, command in commands.choices.items()}


def _wrong(text: str, options: dict[str, set[str]]) -> list[str]:
    """Return what a text tells people to type that does not exist: ``station COMMAND``, or an option of it."""
    wrong = []
    for advice in _ADVICE.finditer(text):
        if advice["noun"]:
            continue
        command = advice["command"]
        if command not in options:
            wrong.append(advice[0].strip())
            continue
        spelled = re.split(r"[,;:()|#>]|\. |\bor\b|\band\b|station ", advice["rest"])[0]
        named = re.findall(r"(?<!\S)--[a-z][a-z-]*", spelled)
        wrong += [f"station {command} {option}" for option in named if option not in options[command]]
    return wrong


def test_every_command_that_a_text_names_exists_with_its_options() -> None:
    options = _options(make_parser())
    found = {where: wrong for where, text in _texts() if (wrong := _wrong(text, options))}
    assert not found


@pytest.mark.parametrize("text", ["try `station improve`", "station improve finds one", "`station plan --nonsense`"])
def test_a_command_or_an_option_that_does_not_exist_is_noticed(text: str) -> None:
    assert _wrong(text, _options(make_parser()))


def test_a_mistyped_command_is_answered_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["runn"])
    assert ended.value.code == 2
    assert "did you mean 'run'?" in capsys.readouterr().err


@pytest.mark.parametrize("more", [[], ["--scale", "10"], ["--host"], ["--manual"]])
def test_a_recording_that_exists_is_refused_before_anything_is_opened(
    more: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], recwarn: pytest.WarningsRecorder
) -> None:
    there = tmp_path / "there.h5"
    there.write_bytes(b"mine")
    assert main(["run", "--output", str(there), *more]) == 2
    said = capsys.readouterr().err
    assert f"{there} exists already" in said
    assert "errno" not in said
    assert there.read_bytes() == b"mine"
    assert not [w for w in recwarn.list if "never awaited" in str(w.message)]


def test_a_folder_is_refused_as_a_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--output", str(tmp_path)]) == 2
    assert "is a folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "wanted"),
    [
        (["run", "--bench"], "bench file"),
        (["check"], "bench file"),
        (["run", "--script"], "script"),
        (["plan"], "script"),
    ],
)
def test_a_recording_given_for_another_file_is_called_one(
    command: list[str], wanted: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = tmp_path / "run.h5"
    recording.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(2 << 20))
    assert main([*command, str(recording)]) == 2
    assert f"run.h5 is a recording, not a {wanted}" in capsys.readouterr().err
