"""The title that a document may have: every limit compared with the result, and a certificate only for a pass."""

import hashlib
import math
from dataclasses import dataclass, replace
from enum import Enum

from scipy.optimize import brentq
from scipy.special import ndtr

from estimator.calibration.values import Calibration
from station.bench.bench import Limits, read_limits
from station.bench.table import TWIN
from station.report.formal import Formal, read_formal
from station.report.recorded import Recorded
from station.run.outcome import Outcome, Verdict, ended_of, judge
from station.views.limits import LimitLine, limit_lines


class Kind(Enum):
    """Kinds of documents: title, and why it is not a certificate."""

    CERTIFICATE = ("Calibration certificate", "")
    SPECIMEN = ("Specimen of a calibration certificate", " of any real device")
    ELSEWHERE = ("Calibration report", ": the recording was not made by a run of the station")
    UNJUDGED = ("Calibration report", ": the recording states no limits, so nothing was judged")
    FAILED = ("Calibration report: not within limits", ": the calibration failed its limits")
    OVERDUE = ("Calibration report", ": the calibration of an instrument had expired, or has no due date")
    NOT_APPROVED = ("Calibration report", ": the bench file requires approval by someone other than the operator")
    JOINED = ("Calibration report", ": it joins several runs, each with conditions and a date of its own")
    UNDATED = ("Calibration report", ": no date of measurement is stated ([performed] date)")
    NO_PLACE = (
        "Calibration report",
        ": the place of calibration is not stated ([performed] place, or [laboratory] address)",
    )
    NO_ESTIMATE = ("Report of a failed calibration", ": the run gave no estimate")
    MANUAL = ("Report of a session in manual mode", ": the table was driven by hand, and nothing was judged")
    ABORTED = ("Report of an aborted run", ": the run was ended early")
    FAULT = ("Report of a run that ended with a fault", ": a device failed during the run")


@dataclass(frozen=True, slots=True)
class Standing:
    """The kind of the document, the verdict (None if not judged), and each limit with the value found.

    ``beside`` are further formal reasons why it is not a certificate.
    """

    kind: Kind
    verdict: Verdict | None
    lines: tuple[LimitLine, ...]
    simulated: bool
    beside: tuple[Kind, ...] = ()

    @property
    def certificate(self) -> bool:
        """Whether the document is a certificate."""
        return self.kind is Kind.CERTIFICATE

    @property
    def title(self) -> str:
        """Title of the document."""
        return str(self.kind.value[0])

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """The kind of the document, and further reasons why it is not a certificate."""
        return (self.kind, *self.beside)

    @property
    def warning(self) -> str:
        """Why it is not a certificate, empty for one."""
        twins = "Simulated devices: table and gyros of this run were twins in software." if self.simulated else ""
        why = "".join(kind.value[1].replace(": ", "; " if kind in self.beside else ": ", 1) for kind in self.kinds)
        return " ".join(filter(None, (twins, why and f"This is not a calibration certificate{why}.")))


def standing_of(recorded: Recorded, formal: Formal | None = None) -> Standing:
    """Return the kind, verdict and judged limits of a recording's document, by its formal facts, by default its own.

    A run that merits a certificate has as its kind the first formal reason against one, with the others in ``beside``;
    with simulated devices and no such reason it is a SPECIMEN. There are no lines without limits or a calibration.
    BenchError if its bench text cannot be read.
    """
    formal, limits, found = formal or read_formal(recorded), limits_of(recorded), recorded.calibration
    lines: tuple[LimitLine, ...] = ()
    if found is not None and limits is not None:
        listed = limit_lines(found, limits, recorded.labels)
        lines = tuple(_guarded(line, found, formal.decision_false_accept) for line in listed)
    simulated = is_simulated(recorded)
    kind, verdict = _kind_of(recorded, limits, lines)
    beside: tuple[Kind, ...] = ()
    if kind is Kind.CERTIFICATE:
        kind, *more = _formal_kinds(formal, simulated=simulated) or [kind]
        beside = tuple(more)
    return Standing(kind, verdict, lines, simulated, beside)


def _formal_kinds(formal: Formal, *, simulated: bool) -> list[Kind]:
    """Return what keeps a passed run from a certificate: equipment overdue, not approved, no date, no place, in order.

    With simulated devices neither date nor place is needed, and without another reason the only one is SPECIMEN. [] if
    nothing keeps a run.
    """
    lacking = {Kind.OVERDUE: bool(formal.overdue), Kind.NOT_APPROVED: not formal.approved}
    if not simulated:
        lacking |= {Kind.UNDATED: formal.performed_date is None, Kind.NO_PLACE: not formal.place}
    return [kind for kind, so in lacking.items() if so] or [Kind.SPECIMEN] * simulated


def _guarded(line: LimitLine, calibration: Calibration, false_accept: float | None) -> LimitLine:
    """Return the limit of a state with its guard band; unchanged for other limits, or if ``false_accept`` is None.

    At the acceptance limit the probability that the state, normal about its estimate with its u, is beyond one of its
    limits, plus or minus ``line.high``, is ``false_accept`` (JCGM 106:2012, 7.4 and 8.3.2; ILAC-G8:09/2019, 4.2.2). If
    it is larger even in the middle, or u is not above 0, the band is infinite, so that nothing is accepted.
    """
    if false_accept is None or line.state is None or line.row is None or line.of_u:
        return line
    u = float(calibration.gyros[line.row].sd[line.state])

    def beyond(size: float) -> float:
        return float(ndtr((size - line.high) / u) + ndtr(-(size + line.high) / u)) - false_accept

    return replace(line, guard=line.high - brentq(beyond, 0, line.high) if u > 0 and beyond(0) < 0 else math.inf)


def _kind_of(recorded: Recorded, limits: Limits | None, lines: tuple[LimitLine, ...]) -> tuple[Kind, Verdict | None]:
    """Return the kind of the document, before formal reasons, and the verdict to print, None without one.

    A run by hand, aborted or ended by a fault keeps the verdict with which it ended, as does one without a calibration.
    Otherwise the calibration is judged by ``limits``, and a pass that is within them but not within ``lines``, those
    with guard bands, is a fail. Imported data are ELSEWHERE unless they fail; without limits a run is UNJUDGED, with no
    verdict. A pass of several runs is JOINED. A calibration that passes is FAILED, with the verdict of the run, if the
    run ended with another outcome than PASS or ESTIMATED.
    """
    ended = ended_of(recorded.recording.attributes)
    if ended is not None and not recorded.joined and ended.outcome in (Outcome.MANUAL, Outcome.ABORTED, Outcome.FAULT):
        return Kind[ended.outcome.name], ended
    if recorded.calibration is None:
        return Kind.NO_ESTIMATE, ended
    judged = judge(recorded.calibration, limits) if limits is not None and lines else None
    refused = tuple(line for line in lines if not line.within)
    if judged is not None and judged.outcome is Outcome.PASS and refused:
        names = ", ".join(f"{line.gyro} {line.what}" for line in refused)
        judged = Verdict(Outcome.FAIL, f"within the limits, but not up to the guard band: {names}", refused)
    if judged is not None and judged.outcome is Outcome.FAIL:
        return Kind.FAILED, judged
    if ended is None:
        return Kind.ELSEWHERE, judged
    if judged is None:
        return Kind.UNJUDGED, None
    if recorded.joined:  # one mounting alone seldom is within the limits, and need not be
        return Kind.JOINED, judged
    # Calibrated again since, but the run itself was never judged a pass.
    if ended.outcome not in (Outcome.PASS, Outcome.ESTIMATED):
        return Kind.FAILED, ended
    return Kind.CERTIFICATE, judged


def is_simulated(recorded: Recorded) -> bool:
    """Return whether a run was made with twins: by the links of devices or table, or by the time that it ran in.

    That is virtual time, or a time scale other than 1, and counts only if the recording lists devices. Twins on real
    ports in real time cannot be told from devices.
    """
    attributes = recorded.recording.attributes
    links = [str(device).rstrip(")") for device in attributes.get("devices", ())]
    scaled = bool(links) and ("clock_zero_utc_s" not in attributes or float(attributes.get("time_scale", 1.0)) != 1.0)
    return scaled or any(link.endswith(TWIN) for link in (*links, recorded.text("table_link")))


def limits_of(recorded: Recorded) -> Limits | None:
    """Return the limits of the bench that a recording carries, None if it carries none."""
    text = recorded.text("bench")
    return read_limits(text) if text else None


def number_of(recorded: Recorded, hashes: tuple[str, ...], replaces: str = "") -> str:
    """Return a document number, "YYYYMMDD-" and ten hexadecimal digits: the same sources give the same number.

    The digits depend on the ``hashes`` and on the number that it ``replaces``, so that an amendment has another number.
    The date, UTC, is that of the measurement; it is left out if that is unknown.
    """
    digest = hashlib.sha256("".join((*hashes, replaces)).encode()).hexdigest()[:10].upper()
    begun = recorded.begun_utc
    return f"{begun:%Y%m%d}-{digest}" if begun else digest
