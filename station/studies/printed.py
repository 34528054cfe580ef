"""The studies as people read them, and as --json gives them."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from drivers.arrays import Floats
from estimator.array import tetrahedron_as_printed
from station.rich_table import rich_table
from station.studies.baselines import BaselineStudy
from station.studies.detection import DetectionStudy, Summary
from station.studies.paper import BARS_PERCENT, PaperStudy
from station.studies.paper_text import (
    NAMES,
    TABLE_1,
    TABLE_2,
    TABLE_3,
    UNITS,
    contradictions,
    errata,
    relative_percent,
    sentences,
)
from station.terminal import stdout

_GYROS = len(TABLE_2)
_STATES = tuple(f"{name}, {unit}" for name, unit in zip(NAMES, UNITS, strict=True))
_FORMATS = (".4f", ".1f", ".4f", ".4f")
"""Of an error in b, k, sigma_j, sigma_k."""


def print_paper(study: PaperStudy) -> None:
    """Print the tables of the reproduction, what they show, and what is wrong with the paper's own."""
    console = stdout()
    for table in (_table_2(study), _table_3(study), _headings(study), _mems(study)):
        console.print(table)
    _list(console, "What this shows", paper_findings(study))
    _list(console, "The paper against itself", contradictions(study.bias_bound_dps))
    _list(console, "Errata of its axes", errata(tetrahedron_as_printed()))


def print_detection(study: DetectionStudy) -> None:
    """Print how often each effect was found, at each size."""
    console = stdout()
    heads = ("effect", "size", "seeds", "right", "or told\nas rivals", "wrong\nname", "error over\noracle's")
    table = rich_table(
        "What is found of effects that only the twin knows, % of seeds",
        (*heads, "before :\nafter", "coverage\nbefore", "\nafter"),
        "lr",
        map(_detected, study.lines),
    )
    table.title_justify = "center"
    console.print(table)


def _detected(line: Summary) -> list[str]:
    return [
        line.name.replace("_", " "),
        f"{line.size:g}" if line.size else "-",
        str(line.seeds),
        *map(_share, (line.right, line.told, line.wrong)),
        "-" if np.isnan(line.over_oracle) else f"{line.over_oracle:.3f}",
        "-" if np.isnan(line.gain) else f"{line.gain:.1f}",
        *map(_share, (line.coverage_before, line.coverage_after)),
    ]


def _share(value: float) -> str:
    return "-" if np.isnan(value) else f"{100 * value:.0f}"


def detection_object(study: DetectionStudy) -> dict[str, Any]:
    """Return the lines as --json prints them: shares from 0 to 1, null where nothing was named."""
    lines = [{k: None if v != v else v for k, v in asdict(line).items()} for line in study.lines]
    return {"study": "detection", "lines": lines}


def print_baselines(study: BaselineStudy) -> None:
    """Print every method beside the others, and what the direct observation cannot see."""
    console = stdout()
    for table in (_errors(study), _cost(study)):
        console.print(table)
    _list(console, "What the table rates alone do not show, however long they are watched", study.unseen)
    _list(console, "What this shows", baseline_findings(study))


def paper_findings(study: PaperStudy) -> list[str]:
    """Return what the numbers of the reproduction say, in sentences."""
    floor = relative_percent(study.noise_free.linear)[2:].mean()
    decoded = relative_percent(study.noise_free.decoded)[2:].mean()
    k_alone, k_noisy = (np.abs(e.linear[:, 1]).max() for e in (study.noise_free, study.clean))
    earth = np.abs(np.array([e.linear for e in study.headings.values()]))
    values = {
        "study": study,
        "floor": floor,
        "decoded": decoded,
        "k_alone": k_alone,
        "k_noisy": k_noisy,
        "b": earth[:, :, 0],
        "k": earth.mean(axis=1)[:, 1],
        "printed_b": TABLE_2[:, 0],
        "printed_k": TABLE_2[:, 1],
        "ours": 100 * np.abs(study.ours / TABLE_1).max(),
    }
    return sentences("paper_findings.txt", values)


def baseline_findings(study: BaselineStudy) -> list[str]:
    """Return what the comparison says, in sentences."""
    names = ("static", "rotating", "direct", "augmented", "squares", "kalman", "ours")
    methods = dict(zip(names, study.methods, strict=True))
    alike = np.abs(methods["augmented"].rms / methods["squares"].rms - 1).max()
    values = {**methods, "alike": alike, "states": 4 * _GYROS, "unseen": study.unseen}
    return sentences("baseline_findings.txt", values)


def paper_object(study: PaperStudy) -> dict[str, Any]:
    """Return the reproduction as what --json prints; errors by gyro, in the units given."""
    return {
        "study": "paper",
        "states": list(NAMES),
        "units": list(UNITS),
        "paper": {"table_2": TABLE_2.tolist(), "table_3_percent": TABLE_3.tolist()},
        "letter": {
            "without_earth": study.clean.linear.tolist(),
            "without_earth_decoded": study.clean.decoded.tolist(),
            "without_noise": study.noise_free.linear.tolist(),
            "without_noise_decoded": study.noise_free.decoded.tolist(),
            "by_heading_deg": {str(heading): e.linear.tolist() for heading, e in study.headings.items()},
        },
        "ours_at_paper_noise": study.ours.tolist(),
        "ours_at_mems_noise": {
            "seeds": study.seeds,
            "mean_relative_percent": study.mems_percent.tolist(),
            "bound_percent": study.mems_bound_percent.tolist(),
            "bar_percent": BARS_PERCENT.tolist(),
        },
        "findings": paper_findings(study),
        "contradictions": contradictions(study.bias_bound_dps),
        "errata": errata(tetrahedron_as_printed()),
        "filter_apart_sd": study.filter_apart_sd,
        "failed": _failed(study),
    }


def baselines_object(study: BaselineStudy) -> dict[str, Any]:
    """Return the comparison as what --json prints; null where a method does not see a state."""
    return {
        "study": "baselines",
        "states": list(NAMES),
        "units": list(UNITS),
        "seeds": study.seeds,
        "methods": [
            {
                "name": method.name,
                "rms_error": _nullable(method.rms),
                "rms_stated_sigma": _nullable(method.stated),
                "error_over_sigma": _nullable(method.ratio),
                "seconds": method.seconds,
                "operations_a_sample": method.operations_a_sample,
            }
            for method in study.methods
        ],
        "not_seen_directly": list(study.unseen),
        "findings": baseline_findings(study),
        "failed": _failed(study),
    }


def _table_2(study: PaperStudy) -> Table:
    heads = ("state", "gyro", "paper", "to the letter, no Earth rate")
    more = ("to the letter, Earth rate in data,\nleast to most by heading", "our default,\nthe paper's noise")
    table = rich_table("Errors at the end, beside the paper's Table 2", (*heads, *more), "llr")
    earth = np.abs(np.array([e.linear for e in study.headings.values()]))
    for state, (name, form) in enumerate(zip(_STATES, _FORMATS, strict=True)):
        for gyro in range(_GYROS):
            low, high = earth[:, gyro, state].min(), earth[:, gyro, state].max()
            table.add_row(
                name if gyro == 0 else "",
                str(gyro + 1),
                format(TABLE_2[gyro, state], form),
                format(abs(study.clean.linear[gyro, state]), form),
                f"{low:{form}} to {high:{form}}",
                _small(abs(study.ours[gyro, state])),
                end_section=gyro == _GYROS - 1,
            )
    return table


def _table_3(study: PaperStudy) -> Table:
    earth = relative_percent(np.array([e.linear for e in study.headings.values()]))
    columns = (
        ("paper,\nTable 3", TABLE_3),
        ("paper,\nTable 2 / Table 1", relative_percent(TABLE_2)),
        ("to the letter", relative_percent(study.clean.linear)),
        ("the same,\nno noise", relative_percent(study.noise_free.linear)),
        ("the same,\ndecoded exactly", relative_percent(study.clean.decoded)),
        ("to the letter,\nEarth rate in data", earth),
        ("our default", relative_percent(study.ours)),
    )
    rows = [(name, *(_small(values[state], 3) for _, values in columns)) for state, name in enumerate(NAMES)]
    heads = ["state", *(head for head, _ in columns)]
    return rich_table("Mean relative errors in percent, beside the paper's Table 3", heads, "lr", rows)


def _headings(study: PaperStudy) -> Table:
    heads = ["heading, deg", *(f"b{gyro + 1}" for gyro in range(_GYROS)), *(f"mean {state}" for state in _STATES)]
    title = "To the letter, Earth rate at 45 deg latitude in the data and not in the model"
    rows = [(str(heading), *_heading_cells(errors.linear)) for heading, errors in study.headings.items()]
    table = rich_table(title, heads, "r", rows)
    table.add_section()
    table.add_row("Table 2", *_heading_cells(TABLE_2))
    return table


def _heading_cells(errors: Floats) -> Iterable[str]:
    means = np.abs(errors).mean(axis=0)
    yield from (f"{b:.4f}" for b in errors[:, 0])
    yield from (format(mean, form) for mean, form in zip(means, _FORMATS, strict=True))


def _mems(study: PaperStudy) -> Table:
    title = f"Our default, mean relative error in percent over {study.seeds} seeds\n"
    title += "(0.005 deg/s/rtHz, bias instability 2 deg/h)"
    results = zip(NAMES, study.mems_percent, study.mems_bound_percent, BARS_PERCENT, strict=True)
    rows = [
        (name, f"{error:.2f}", f"{least:.2f}", f"{error / least:.2f}", f"{bar:.1f}")
        for name, error, least, bar in results
    ]
    return rich_table(title, ("state", "error", "Cramer-Rao bound", "error / bound", "bar"), "lr", rows)


def _errors(study: BaselineStudy) -> Table:
    title = f"Rms error over {study.seeds} seeds and four gyros (stated sigma; rms error / stated sigma)"
    table = rich_table(title, ("method", *_STATES), "lr")
    for method in study.methods:
        cells = [
            "not seen" if np.isnan(rms) else f"{_number(rms, form)}\n({_number(stated, form)}; {ratio:.2f})"
            for rms, stated, ratio, form in zip(method.rms, method.stated, method.ratio, _FORMATS, strict=True)
        ]
        table.add_row(method.name, *cells, end_section=True)
    return table


def _cost(study: BaselineStudy) -> Table:
    title = "What it costs: 360 s of four gyros at 100 Hz, from the recording to the states"
    rows = [(m.name, f"{1e3 * m.seconds:,.0f}", f"{m.operations_a_sample:,.0f}") for m in study.methods]
    return rich_table(title, ("method", "wall time, ms", "operations a sample"), "lr", rows)


def _list(console: Console, title: str, lines: Sequence[str]) -> None:
    console.print(f"\n[bold]{title}[/]")
    for line in lines:
        console.print(f"- {line}", highlight=False, markup=False)


def _number(value: float, form: str) -> str:
    return format(value, form) if value < 1000 else f"{value:,.0f}"


def _small(value: float, digits: int = 2) -> str:
    """Return a number as people write it, down to where it is as good as nothing."""
    if value < 1e-9:
        return "0"
    return f"{value:.{digits}g}" if value >= 1e-3 else f"{value:.0e}"


def _nullable(values: Floats) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in values]


def _failed(study: PaperStudy | BaselineStudy) -> list[dict[str, str]]:
    return [{"seed": failure.item, "reason": failure.reason} for failure in study.failures]
