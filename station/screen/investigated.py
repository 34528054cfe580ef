"""An investigation as the result screen shows it, from the JSON object of `station investigate`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from rich.text import Text

from station.figures import number
from station.screen.figures import columns, headed

_STYLES = {
    "nothing to add": "bold green",
    "added": "bold green",
    "cannot tell": "bold yellow",
    "unexplained": "bold red",
}
_DPH = math.degrees(3600)


def investigation_lines(found: Mapping[str, Any]) -> list[Text]:
    """Return verdict, effects, rivals, next script, residual and error before and after.

    Loads the words of the printed investigation, which takes a moment: not for the thread that paints.
    """
    from station.investigation_printed import probability, words

    verdict = str(found.get("verdict") or "no verdict")
    lines = [Text.assemble((verdict.upper(), _STYLES.get(verdict, "bold")), f"  {found.get('reason', '')}")]
    for added in found.get("added", []):
        who = ", ".join(added["gyros"]) or "no gyro alone"
        lines.append(Text(f"{words(added['effect'])}, probability {_share(added['probability'])}, shown by {who}"))
        lines += [Text(f"    {name}: {_value(value)}") for name, value in added["parameters"].items()]
    for rivals in found.get("rivals", []):
        said = "these recordings cannot tell apart" if len(rivals) > 1 else "these recordings do not prove"
        lines.append(Text(f"{said}: {' or '.join(map(words, rivals))}", "yellow"))
    unexplained = found.get("unexplained")
    if unexplained:
        lines.append(
            Text(f"unexplained: {unexplained['share']:.0%} of what is left depends on {unexplained['depends_on']}")
        )
    if found.get("next_script"):
        lines.append(Text(f"next script: {found['next_script']}   (d drives it)", "bold"))
    suspects = sorted(found.get("suspects", []), key=lambda suspect: -(suspect["probability"] or 0))[:3]
    if suspects:
        told = ", ".join(f"{words(s['effect'])} {probability(s['probability'] or 0.0)}" for s in suspects)
        lines.append(Text(f"what the four states may lack: {told}"))
    return lines + _before_after(found) + [Text(f"note: {note}", "dim") for note in found.get("notes", [])]


def _before_after(found: Mapping[str, Any]) -> list[Text]:
    gyros = found.get("gyros") or {}
    if not gyros:
        return []
    residual = found.get("residual") or {}
    before, after = ((residual.get(key) or {}).get("gyros", {}) for key in ("before", "after"))
    rows = [["gyro", "rms deg/h", "after", "largest", "after", "NIS", "after", "left depends on"]]
    for name, gyro in gyros.items():
        errors = [gyro[when][key] for key in ("rms_rps", "max_rps") for when in ("before", "after")]
        nis = [number(part.get(name, {}).get("nis"), 2) for part in (before, after)]
        depends = after.get(name, {}).get("depends_on", {})
        most = sorted(depends.items(), key=lambda item: -item[1]["share"])[:2]
        said = ", ".join(f"{variable} {d['share']:.0%}" for variable, d in most if d["share"] >= 0.15) or "nothing"
        rows.append([name, *(_dph(error) for error in errors), *nis, said])
    where = "in-sample, cross-validated by step" if found.get("in_sample") else "verification run"
    lines = [Text(""), Text(f"Error of the compensated rate, before and after ({where})", "bold underline")]
    lines += headed(columns(rows))
    gain = found.get("improvement")
    if gain:
        lines.append(Text(f"{gain['ratio']:.3g} times smaller (95 %: {gain['low']:.3g} to {gain['high']:.3g})"))
    return lines


def _value(value: list[Any]) -> str:
    from estimator.tracing.investigation import Value
    from station.investigation_printed import human

    number_si, sd, unit = value
    return human(Value(math.nan if number_si is None else number_si, math.nan if sd is None else sd, str(unit)))


def _share(share: float | None) -> str:
    from station.investigation_printed import probability

    return "not known" if share is None else probability(share)


def _dph(rate_rps: float | None) -> str:
    return "-" if rate_rps is None else f"{rate_rps * _DPH:.3g}"
