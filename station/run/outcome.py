"""How a run ended, and whether its calibration is within limits."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

from estimator.calibration.budget import UNMEASURED, UNSEEN
from estimator.calibration.values import Calibration
from estimator.observations.coverage import not_proved
from station.bench.bench import Limits
from station.errors import sentence
from station.views.limits import LimitLine, limit_lines

_MOSTLY = 0.5


class Outcome(StrEnum):
    """How a run ended."""

    PASS = "PASS"
    ESTIMATED = "ESTIMATED"
    MANUAL = "MANUAL"
    FAIL = "FAIL"
    ABORTED = "ABORTED"
    FAULT = "FAULT"

    @property
    def exit_code(self) -> int:
        """Exit code of the command that ended so."""
        return {"PASS": 0, "ESTIMATED": 0, "MANUAL": 0, "FAIL": 1, "ABORTED": 3, "FAULT": 4}[self.value]


@dataclass(frozen=True, slots=True)
class Verdict:
    """Outcome and reason of a run or a calibration, the broken limits, and their possible causes."""

    outcome: Outcome
    reason: str
    broken: tuple[LimitLine, ...] = ()
    because: tuple[str, ...] = ()


_UNFINISHED = (Outcome.ABORTED, Outcome.FAULT)
MANUAL_VERDICT = Verdict(Outcome.MANUAL, "driven by hand, so nothing was judged")
_UNSEEN_HINT = sentence("run.unseen")


def judge(calibration: Calibration, limits: Limits | None, causes: Sequence[str] = ()) -> Verdict:
    """Compare a calibration with the limits of its bench; the reason names every broken limit.

    ESTIMATED without limits, else PASS or FAIL. Doubts about the sigmas are always part of the reason; errors that no
    sigma can cover fail the calibration. ``causes``, sentences on possible faults of the run itself, are named only in
    a FAIL, as is that most of a sigma comes from effects not declared; what nothing proves to be constant only in the
    others. A FAIL also has the broken limits in ``broken`` and what may explain them in ``because``.
    """
    unproved = tuple(filter(None, [not_proved(calibration.constancy)]))
    if limits is None or not limits.stated:
        reasons = ("estimated; the bench has no limits to compare with", *unproved, *calibration.doubts)
        return Verdict(Outcome.ESTIMATED, "; ".join(reasons))
    lines = [line for line in limit_lines(calibration, limits) if not line.within]
    if lines or calibration.spoilt:
        because, broken = [*causes, *calibration.doubts], [line.broken for line in lines]
        hints = [_UNSEEN_HINT] if any(line.of_u and _mostly_unseen(calibration, line) for line in lines) else []
        return Verdict(Outcome.FAIL, "; ".join([*because, *broken, *hints]), tuple(lines), (*because, *hints))
    good = "all states, sigmas, innovations and losses are within limits"
    return Verdict(Outcome.PASS, "; but ".join(["; ".join([good, *unproved]), *calibration.doubts]))


def ended_of(attributes: Mapping[str, Any]) -> Verdict | None:
    """Return how the run of a recording ended, from its attributes; None for data that no run of the station made."""
    text = str(attributes.get("outcome", ""))
    return Verdict(Outcome(text), str(attributes.get("reason", ""))) if text in list(Outcome) else None


def judge_recorded(
    calibration: Calibration | None, limits: Limits | None, ended: Verdict | None, *, own_rules: bool = True
) -> Verdict:
    """Judge the calibration of a recording whose run ``ended`` with a verdict, None for imported data.

    A run driven by hand is MANUAL, whatever its data. ``calibration`` is None if there is none: then ``ended`` must be
    given and is returned. A run that was aborted or in fault keeps its outcome, and the reason adds what its data show.
    A run that failed stays FAIL, unless it is judged by other than its ``own_rules``, that is other limits or an error
    model; a better outcome then says in its reason how the run ended.
    """
    if ended is not None and ended.outcome is Outcome.MANUAL:
        return MANUAL_VERDICT
    if calibration is None:
        assert ended is not None, "without a run and an estimate there is nothing to judge"
        return ended
    judged = judge(calibration, limits)
    if ended is not None and ended.outcome in _UNFINISHED:
        return Verdict(ended.outcome, f"{ended.reason}; {_until_then(judged)}")
    if ended is None or ended.outcome is not Outcome.FAIL or judged.outcome is Outcome.FAIL:
        return judged
    if own_rules:
        return Verdict(Outcome.FAIL, f"the run failed: {ended.reason}")
    return replace(judged, reason=f"{judged.reason}; the run itself failed: {ended.reason}")


def _until_then(judged: Verdict) -> str:
    """Return in words how the data of an incomplete run compare with the limits, by their verdict ``judged``.

    They exceed them (FAIL, with the first and the number of others), were estimated without limits (ESTIMATED), or are
    within.
    """
    if judged.outcome is Outcome.FAIL:
        first = judged.broken[0].broken if judged.broken else judged.reason
        more = f", and {len(judged.broken) - 1} more limits exceeded" if len(judged.broken) > 1 else ""
        return f"the data up to that point exceed the limits: {first}{more}"
    if judged.outcome is Outcome.ESTIMATED:
        return "the data up to that point were estimated; the bench has no limits to compare with"
    return "the data up to that point are within limits, but the script is incomplete"


def _mostly_unseen(calibration: Calibration, line: LimitLine) -> bool:
    """Return whether most of a sigma comes from undeclared effects; not of accelerometers, which have no such part."""
    if line.row is None or line.state is None:
        return False
    budget = calibration.gyros[line.row].budget
    unseen = sum(float(part.u[line.state] ** 2) for part in budget if part.name in (UNSEEN, UNMEASURED))
    return unseen > _MOSTLY * line.value**2
