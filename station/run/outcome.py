"""How a run ended, and whether its calibration is within limits."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from estimator.calibration.budget import UNSEEN
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
    """Outcome and reason of a run or of a calibration; the limits that are broken, and what may be behind that."""

    outcome: Outcome
    reason: str
    broken: tuple[LimitLine, ...] = ()
    because: tuple[str, ...] = ()


MANUAL_VERDICT = Verdict(Outcome.MANUAL, "driven by hand: nothing was judged")
_UNSEEN_HINT = sentence("run.unseen")


def judge(calibration: Calibration, limits: Limits | None, causes: Sequence[str] = ()) -> Verdict:
    """Compare a calibration with the limits of its bench; the reason names every limit that is broken.

    Without limits it is neither good nor bad. What speaks against its sigmas is told in any case, and what no sigma can
    hold fails it; ``causes``, what the run itself may have done wrong, are told where it fails. Where it does not fail
    the reason also says of which axes, or at which times, nothing proves that what was measured stayed the same.
    """
    unproved = tuple(filter(None, [not_proved(calibration.constancy)]))
    if limits is None or not limits.stated:
        reasons = ("estimated; there are no limits to judge by", *unproved, *calibration.doubts)
        return Verdict(Outcome.ESTIMATED, "; ".join(reasons))
    lines = [line for line in limit_lines(calibration, limits) if not line.within]
    if lines or calibration.spoilt:
        because, broken = [*causes, *calibration.doubts], [line.broken for line in lines]
        hints = [_UNSEEN_HINT] if any(line.of_u and _mostly_unseen(calibration, line) for line in lines) else []
        return Verdict(Outcome.FAIL, "; ".join([*because, *broken, *hints]), tuple(lines), (*because, *hints))
    good = "every state, its sigma, the innovations and the losses are within limits"
    return Verdict(Outcome.PASS, "; but ".join(["; ".join([good, *unproved]), *calibration.doubts]))


def _mostly_unseen(calibration: Calibration, line: LimitLine) -> bool:
    """Return whether a sigma comes of undeclared effects for the most part."""
    assert line.row is not None
    assert line.state is not None
    budget = calibration.gyros[line.row].budget
    unseen = sum(float(part.u[line.state] ** 2) for part in budget if part.name == UNSEEN)
    return unseen > _MOSTLY * line.value**2
