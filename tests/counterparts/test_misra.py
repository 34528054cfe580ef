"""The exported C header before cppcheck and its addon for MISRA C:2012: nothing but advisory rules is broken."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from strangers import needs_program

sys.path.insert(0, str(Path(__file__).parents[1] / "station"))
from test_export import EFFECTS, LAWS, Record, record
from test_export_accelerometers import RecordForces, record_forces

from estimator.geometry.array import tetrahedron
from station.exports.exported import exported_of
from station.exports.formats import FORMATS

ADVISORY = {
    "2.4": "the enum that says how many gyros there are has no tag that is used",
    "2.5": "the delay is a macro for who wants it",
    "8.9": "tables stand before the functions that use them, for who reads the numbers",
    "12.1": "a product in a sum without brackets",
}
__all__ = ["record", "record_forces"]  # the fixtures


@needs_program("cppcheck", "cppcheck")
@pytest.mark.parametrize("form", ["c", "c-float"])
@pytest.mark.parametrize("effects", [{}, {**EFFECTS, **LAWS}], ids=["none", "all"])
def test_no_rule_is_broken_that_is_more_than_advice(
    record: Record, form: str, effects: dict[str, tuple[float, ...]]
) -> None:
    assert_advice_only(record(tetrahedron(), effects), form)


@needs_program("cppcheck", "cppcheck")
@pytest.mark.parametrize("form", ["c", "c-float"])
def test_accelerometers_break_none_either(record_forces: RecordForces, form: str) -> None:
    assert_advice_only(record_forces(tetrahedron(), {**EFFECTS, **LAWS}), form)


def assert_advice_only(path: Path, form: str) -> None:
    exported = exported_of(path)
    header = exported.path.with_name("made.h")
    header.write_text(str(FORMATS[form].write(exported).text), encoding="utf-8")
    prefix = "my_gyro_1" if form == "c" else "my_gyro_1_float"
    source = exported.path.with_name("made.c")
    source.write_text(f'#include "made.h"\nint main(void)\n{{\n    return {prefix}_self_test();\n}}\n')
    command = ["cppcheck", "--std=c99", "--enable=warning,style,portability", "--addon=misra", "--quiet"]
    told = subprocess.run([*command, str(source)], capture_output=True, text=True, check=True).stderr
    broken = set(re.findall(r"\[misra-c2012-([\d.]+)\]", told))
    others = set(re.findall(r"\[(\w+)\]$", told, flags=re.MULTILINE))
    assert broken
    assert broken <= ADVISORY.keys(), told
    assert not others, told
