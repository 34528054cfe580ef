"""An investigation as the result screen shows it, from the JSON object of `station investigate`."""

import math
from collections.abc import Mapping
from typing import Any

from rich.text import Text

from station.screen.figures import columns, templated
from station.views.figures import FINDING_STYLES, number

_DPH = math.degrees(3600)


def investigation_lines(found: Mapping[str, Any]) -> list[Text]:
    """Return verdict, effects, rivals, next script, residual and error before and after.

    Loads the words of the printed investigation, which takes a moment: not for the thread that paints.
    """
    from station.views.words import probability, words

    verdict = str(found.get("verdict") or "no verdict")
    values = {
        "found": found,
        "verdict": verdict,
        "style": FINDING_STYLES.get(verdict, "bold"),
        "words": words,
        "either": lambda rivals: " or ".join(map(words, rivals)),
        "probability": probability,
        "share": lambda share: "not known" if share is None else probability(share),
        "shown": _value,
        "suspects": sorted(found.get("suspects", []), key=lambda suspect: -(suspect["probability"] or 0))[:3],
        "errors": _errors(found),
    }
    return [templated("investigation.rich", values)]


def _errors(found: Mapping[str, Any]) -> list[str]:
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
    return columns(rows)


def _value(value: float | None, sd: float | None, unit: str) -> str:
    from estimator.tracing.investigation import Value
    from station.views.words import human

    return human(Value(math.nan if value is None else value, math.nan if sd is None else sd, unit))


def _dph(rate_rps: float | None) -> str:
    return "-" if rate_rps is None else f"{rate_rps * _DPH:.3g}"
