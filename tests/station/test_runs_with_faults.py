"""Faults of twins and wires: the table comes to rest, the file is readable, the reason names the right device."""

from __future__ import annotations

import re

import pytest
from faults import Fault, drawn, each, ended, faults_of


@pytest.mark.parametrize(
    ("bench", "kind"),
    [
        ("galil_xsens", "unplug"),
        ("galil_xsens", "bit flips"),
        ("rtu_stim300", "servo trip"),
        pytest.param("rtu_stim300", "stuck", marks=pytest.mark.full),
    ],
)
def test_a_run_with_a_fault_ends_as_it_should(bench: str, kind: str) -> None:
    for fault in [fault for fault in faults_of(bench) if fault.kind == kind]:
        found = ended((bench, (fault,), 0))
        assert not found.wrong, f"{fault}: {found}"


@pytest.mark.parametrize(
    ("bench", "back", "outcome"), [("galil_xsens", "5.3 s", "FAIL"), ("rtu_stim300", "7 s", "FAULT")]
)
def test_a_table_unplugged_at_rest_is_opened_again_before_its_watchdog_acts(
    bench: str, back: str, outcome: str
) -> None:
    found = ended((bench, (Fault("table", "unplug", f'unplug = "5 s"\nreplug = "{back}"'),), 0))
    assert found.outcome == outcome, found.reason  # FAIL of its sigmas: the script is short
    assert found.reason.startswith("table:") is (outcome == "FAULT")


def test_a_link_that_drops_at_rest_is_opened_again_and_the_loss_counted() -> None:
    fault = Fault("stim300", "unplug", 'unplug = "5 s"\nreplug = "6 s"')
    found = ended(("rtu_stim300", (fault,), 0))
    assert found.outcome == "FAIL"  # of its sigmas: the script is short
    assert not found.reason.startswith("stim300:")
    assert "lost" in found.reason


def test_samples_that_come_late_are_named_where_a_run_fails() -> None:
    found = ended(("rtu_stim300", (Fault("stim300", "latency", 'latency = "15 ms"'),), 0))
    assert found.outcome == "FAIL"
    assert re.search(r"stim300 is \+1[45]\.\d\d ± \d\.\d\d ms against the table", found.reason), found.reason


def test_a_table_that_answers_late_is_named_where_a_run_fails() -> None:
    found = ended(("galil_xsens", (Fault("table", "latency", 'late = "5 %"\nlate_by = "150 ms"'),), 0))
    assert found.outcome == "FAIL"  # of its sigmas: the script is short
    assert re.search(r"the table answered up to 1[5-9]\d ms late", found.reason), found.reason


EXCHANGED = 'unplug = "5 s"\nreplug = "5.5 s"\nanother = "5.2 s"'


@pytest.mark.parametrize(
    ("bench", "device", "words"),
    [
        ("rtu_stim300", "stim300", ("N25582405002002", "N25582405002003")),
        pytest.param("galil_xsens", "mti", ("03700715", "03700716"), marks=pytest.mark.full),
        pytest.param("acutrol_vectornav", "vn100", ("0100012345", "0100012346"), marks=pytest.mark.full),
        pytest.param("galil_j1939", "openimu", ("305001", "305002"), marks=pytest.mark.full),
        ("galil_xsens", "table", ("9046", "9047")),
        pytest.param("acutrol_vectornav", "table", ("3117", "3118"), marks=pytest.mark.full),
    ],
)
def test_another_device_after_a_link_came_back_ends_the_run_by_both_names(
    bench: str, device: str, words: tuple[str, str]
) -> None:
    found = ended((bench, (Fault(device, "another", EXCHANGED),), 0))
    assert found.outcome == "FAULT", found.reason
    assert found.reason.startswith(f"{device}: a different device"), found.reason
    assert all(word in found.reason for word in words), found.reason


@pytest.mark.parametrize(
    ("bench", "device"), [("rtu_stim300", "stim300"), pytest.param("galil_j1939", "openimu", marks=pytest.mark.full)]
)
def test_a_device_exchanged_without_a_lost_link_is_known_at_the_end(bench: str, device: str) -> None:
    found = ended((bench, (Fault(device, "another", 'another = "5.2 s"'),), 0))
    assert found.outcome == "FAULT", found.reason
    assert found.reason.startswith(f"{device}: a different device"), found.reason


@pytest.mark.full
def test_a_computer_that_was_suspended_is_no_defect_of_the_station() -> None:
    found = ended(("two_triads", (Fault("host", "suspended", "", "rest", 3.0),), 0), lenient=True)
    assert not found.wrong


@pytest.mark.full
def test_a_device_that_does_not_answer_at_the_end_is_not_taken_for_another() -> None:
    found = ended(("rtu_stim300", (Fault("stim300", "silence", 'silent_from = "22.1 s"'),), 0), lenient=True)
    assert found.outcome == "PASS", found.reason


def test_a_device_that_tells_no_identity_is_doubted_after_its_link_came_back() -> None:
    fault = Fault("sketch", "unplug", 'unplug = "5 s"\nreplug = "5.1 s"')
    found = ended(("described", (fault,), 0))
    assert found.outcome == "FAIL", found.reason  # of its losses: the script is short
    assert "sketch reports no serial number, so it may have been exchanged" in found.reason


@pytest.mark.parametrize(
    ("bench", "device"), [pytest.param("described", "sketch", marks=pytest.mark.full), ("galil_xsens", "mti")]
)
def test_impossible_rates_are_counted_left_out_and_told(bench: str, device: str) -> None:
    found = ended((bench, (Fault(device, "huge", 'huge = "3 %"'),), 0))
    assert found.outcome == "FAIL", found.reason
    assert re.search(r"[1-3]\.\d\d % of the samples lost", found.reason), found.reason
    assert "mean NIS" not in found.reason


@pytest.mark.full
@pytest.mark.parametrize("seed", range(1, 301))
def test_drawn_faults_end_as_they_should(seed: int) -> None:
    assert not ended(drawn(seed), lenient=True).wrong


@pytest.mark.full
@pytest.mark.parametrize("case", each(), ids=lambda case: f"{case[0]} {case[1][0].device} {case[1][0].kind}")
def test_each_fault_on_each_bench_ends_as_it_should(case: tuple[str, tuple[Fault, ...], int]) -> None:
    assert not ended(case).wrong
