"""What closes a report: clocks and losses of the sources, events, hashes, signatures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from estimator.recordings.recording import ImuData
from station.exports.exported import RAW_RULE
from station.report.chapters.front import rate_hz
from station.report.figures import (
    CELSIUS,
    MILLISECONDS,
    ONE,
    PER_MILLION,
    PERCENT,
    SECONDS,
    Unit,
    count,
    fixed,
    hash_text,
    plain,
)
from station.report.formal import Formal
from station.report.investigation_chapter import Traced
from station.report.recorded import Event, Recorded
from station.report.tables import Content, Fact, Table, facts_of, table_of
from station.views.seen import seen_by

_UNKNOWN = "–"
_BLANK = Markup('<span class="blank"></span>')
_SOURCE_HEADS = (
    "source",
    "samples",
    "rate, Hz",
    "lowest, °C",
    "mean, °C",
    "highest, °C",
    "lost",
    "lost, %",
    "repeated",
    "late",
    "corrupt",
    "clock drift, ppm",
    "arrival jitter, ms",
    "offset to the table, ms",
)


@dataclass(kw_only=True, frozen=True, slots=True)
class ClosingView:
    """The last chapters; ``events`` is None if none were recorded.

    ``raw_rule`` says of what the hash of the raw data is.
    """

    sources: Table
    events: Table | None
    software: Sequence[Fact]
    raw_rule: str
    signatures: Table


def closing_view(
    recorded: Recorded,
    formal: Formal,
    *,
    traced: Traced | None,
    hashes: Mapping[str, str],
    made_with: str,
    simulated: bool,
) -> ClosingView:
    """Return what closes the report of a recording: sources, events, versions and hashes, signatures.

    ``hashes`` are the SHA-256 of "file", "data" and, if there is one in a file of its own, "investigation".
    ``made_with`` is the version that makes the document; the seed is stated only if the run was ``simulated``.
    """
    sources = recorded.recording.sources
    source_rows = [_source(name, data, recorded.source_attributes.get(name, {})) for name, data in sources.items()]
    event_rows = [_event(event, recorded.start_ns) for event in recorded.events]
    return ClosingView(
        sources=table_of(_SOURCE_HEADS, "l" + "r" * (len(_SOURCE_HEADS) - 1), source_rows),
        events=table_of(["time, s", "kind", "text"], "lll", event_rows) if event_rows else None,
        software=facts_of(_software(recorded, traced, hashes, made_with, simulated=simulated)),
        raw_rule=RAW_RULE,
        signatures=_signatures(recorded, formal),
    )


def _source(name: str, data: ImuData, attributes: Mapping[str, Any]) -> list[Content]:
    """Return the row of a source, a cell for each of ``_SOURCE_HEADS``: name, samples and rate, temperatures, losses.

    After the lost samples, as a number and in % of all, lost ones included, come repeated, late and corrupt ones, and
    drift, jitter and offset of the clock. ``attributes`` are those of the source in the recording; figures that it
    lacks are dashes, but no stated loss counts as 0.
    """
    where = f"imu/{name}@"
    samples = len(data.t_ns)
    lost = int(attributes.get("lost", 0))
    return [
        name,
        count(samples),
        plain(rate_hz(data), ONE, 5),
        *_temperatures(data),
        count(lost, f"{where}lost" if "lost" in attributes else None),
        fixed(lost / max(samples + lost, 1), PERCENT, 3),
        _count(attributes, "repeated", where),
        _count(attributes, "late", where),
        _count(attributes, "corrupt", where),
        _clock(attributes, "clock_drift_ppm", PER_MILLION, where),
        _clock(attributes, "arrival_jitter_rms_s", MILLISECONDS, where),
        _clock(attributes, "time_offset_s", MILLISECONDS, where),
    ]


def _temperatures(data: ImuData) -> list[Content]:
    """Return the lowest, the mean and the highest temperature."""
    low_c, mean_c, high_c = seen_by([data]).temperature_c
    if mean_c != mean_c:  # it was not recorded
        return [_UNKNOWN] * 3
    return [fixed(temperature_c, CELSIUS, 1) for temperature_c in (low_c, mean_c, high_c)]


def _count(attributes: Mapping[str, Any], key: str, where: str) -> Content:
    return count(int(attributes[key]), where + key) if key in attributes else _UNKNOWN


def _clock(attributes: Mapping[str, Any], key: str, unit: Unit, where: str) -> Content:
    """Return a property of a clock in ``unit``, with its standard deviation if stored; ``_UNKNOWN`` if not stored.

    The standard deviation of ``time_offset_s`` is ``time_offset_sd_s``. ``where`` is the place of the attributes in
    the recording, to which each figure of the report refers.
    """
    if key not in attributes:
        return _UNKNOWN
    value = fixed(attributes[key], unit, 2, where + key)
    doubt = "_sd_".join(key.rsplit("_", 1))
    if doubt not in attributes:
        return value
    return Markup("{} ± {}").format(value, fixed(attributes[doubt], unit, 2, where + doubt))


def _event(event: Event, start_ns: int) -> list[Content]:
    kind = "note of the operator" if event.is_note else "event"
    return [fixed((event.t_ns - start_ns) * 1e-9, SECONDS, 1), kind, event.words]


def _software(
    recorded: Recorded, traced: Traced | None, hashes: Mapping[str, str], made_with: str, *, simulated: bool
) -> list[tuple[str, Content]]:
    """Return nine (label, content) on how the document was made: versions, files, hashes, and the seed.

    ``hashes`` and ``made_with`` as for ``closing_view``. The content is None for a hash that is missing, for the seed
    unless the run was ``simulated``, and for an investigation unless it is in a file of its own.
    """
    version = recorded.text("software_version")
    apart = traced is not None and "investigation" in hashes
    return [
        ("Measured with", f"turntable-station {version}" if version else "not stated"),
        ("This document made with", made_with),
        ("Recording", recorded.path.name),
        ("SHA-256 of the file", _hash(hashes["file"])),
        ("SHA-256 of the raw data", _hash(hashes["data"])),
        ("SHA-256 of the bench file", _hash(recorded.text("bench_sha256"))),
        ("Investigation", traced.path.name if traced is not None and apart else None),
        ("SHA-256 of the investigation", _hash(hashes.get("investigation", ""))),
        ("Seed of the twins", recorded.text("seed") if simulated else None),
    ]


def _hash(text: str) -> Content:
    return hash_text(text) if text else None


def _signatures(recorded: Recorded, formal: Formal) -> Table:
    """Return the rows to be signed by the operator and by who approves; blanks to fill in where a name is missing.

    The columns are role, name, date and signature. The only date is the stated one of issue, beside the approval.
    """
    operator = recorded.text("operator") or _BLANK
    approved_by = formal.certificate_approved_by or _BLANK
    rows: list[list[Content]] = [
        ["Calibrated by", operator, _BLANK, _BLANK],
        ["Approved by", approved_by, formal.certificate_issued or _BLANK, _BLANK],
    ]
    return table_of(["", "name", "date", "signature"], "llll", rows)
