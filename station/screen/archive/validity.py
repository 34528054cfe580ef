"""Which calibration of a device was valid on a day, by the recordings of a folder."""

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import date, datetime

from station.errors import UsageError
from station.run.outcome import Outcome
from station.schema.tables import Table
from station.screen.archive.entries import Entry

_JUDGED = (Outcome.PASS, Outcome.FAIL)
"""Other runs say nothing about the device: they were stopped, driven by hand, or had no limits."""


@dataclass(frozen=True, slots=True)
class Validity:
    """The newest judged run of a device up to a day; ``reason`` says why it is not valid then, empty if it is."""

    entry: Entry | None
    reason: str = ""


def validity_on(entries: Iterable[Entry], serial: str, day: date) -> Validity:
    """Return the calibration of the device with this serial number that was valid on ``day``, or the reason for none.

    It is the newest run up to that day that ended PASS, if no later one up to that day ended FAIL, and if the next
    calibration stated in the certificate form beside the recording was not due before that day. Runs that ended
    otherwise or have no calibration do not count. Days are those of local time. With a reason the entry is the run that
    stands against it, None if there is no run. UsageError if the form cannot be read.
    """
    judged = [e for e in entries if e.serial == serial and e.gyros and e.texts.get("outcome") in _JUDGED]
    earlier = [entry for entry in judged if _day_of(entry) <= day]
    if not earlier:
        first = min(map(_day_of, judged), default=None)
        after = f"; the first one is of {first}" if first else ""
        return Validity(None, f"{serial} has no calibration that passed or failed before {day}{after}")
    newest = max(earlier, key=lambda entry: entry.when_utc_s)
    if newest.texts.get("outcome") == Outcome.FAIL:
        return Validity(newest, f"{serial} failed on {_day_of(newest)} and has had no valid calibration since")
    due = _next_due(newest)
    if due is not None and due < day:
        return Validity(newest, f"the next calibration of {serial} was due on {due}")
    return Validity(newest)


def _day_of(entry: Entry) -> date:
    return datetime.fromtimestamp(entry.when_utc_s).date()


def _next_due(entry: Entry) -> date | None:
    """Return the date of the next calibration stated in the form of a recording; None without a form or a date in it.

    UsageError if the form cannot be read.
    """
    from station.report.formal import kept_facts

    kept = kept_facts(entry.path)
    if not kept.is_file():
        return None
    certificate = Table.load(kept, UsageError).again().table("certificate", optional=True)
    due = certificate.read("certificate.certificate")["next_due"]
    return due if isinstance(due, date) else None
