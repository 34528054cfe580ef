"""The body rate at any instant, from the readings of a table."""

from collections.abc import Sequence
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np

from estimator.errors import RecordingError
from estimator.geometry.kinematics import Site, body_rate, check_gimbals
from estimator.recordings.motion.as_read import SURE_RPS, as_read, followed_by
from estimator.recordings.motion.felt import felt_at, felt_known, interpolated, mean_slopes
from estimator.recordings.motion.growing_rows import GrowingRows, drift_of, final_rows, integrated, rows_of_motion
from estimator.recordings.motion.ramps import (
    HOLD_S,
    LEAST_RPS2,
    LONGEST_S,
    PIECE_S,
    WINDOW_S,
    Ramp,
    centred,
    changing,
    ends,
    fitted,
    is_ramp,
    piece_of,
    with_corners,
)
from estimator.recordings.reference import TableReadings
from estimator.types import Flags, Floats, Stamps

GAP_NS = 150_000_000
GAP_ANGLE_RAD = float(np.radians(0.02))
"""Readings further apart than the one hide what happened between them, unless the turn was steady and their angles
agree with that to the other, and to what the doubt of their instants is in angle."""
ANCHOR_HALF_WINDOW_NS = 3_000_000_000
"""Half of the window over which the angles correct the rates."""
_STEADY_SHARE, _STEADY_RPS = 0.005, 2e-4  # rates that differ by no more than these together are those of a steady turn
_ANGLE_SD_RAD = 1e-4  # of an angle whose instant is known
_RATE_SD_RPS = 3e-4  # error of a rate reading before the angles correct it
_NEAR_NS = 1_000_000  # distance on both sides at which a change of rate is searched
_AT_ONCE = 1024  # readings: sums over more lose digits
_KEPT_NS = 60_000_000_000  # rows and readings: more than windows, ramps and gaps between readings reach back
_MADE: "WeakKeyDictionary[TableReadings, dict[Site | None, BodyRates]]" = WeakKeyDictionary()


class BodyRates:
    """Body rate at any instant, from table readings that keep coming.

    Rate readings give the shape between two readings, angle readings the truth over seconds: the rate of a servo drive
    is rounded and may be off in scale, its encoder counts are not. Each rate is corrected by the slope, within three
    seconds to each side, of the difference between angle and integrated rate. A row is final once a reading three
    seconds later is there, on a ramp three seconds after its end; ``finish`` makes all final. Adding readings singly or
    all at once gives the same numbers. Corners of ramps are determined (``ramps``) and inserted.

    On a slow link the instant of a reading is uncertain, and its angle counts less; the scatter of the angles shows by
    how much. The rate is not given where it changes too fast for its time to be known.
    """

    def __init__(self, gimbals: Sequence[str], site: Site | None) -> None:
        """Start empty, for gimbals named outermost first; RecordingError for unknown gimbals.

        The rates include that of the Earth at ``site``, none of it without a site.
        """
        self._gimbals = check_gimbals(gimbals)
        n = len(self._gimbals)
        # Readings as they came, and how many of them are among the rows: those after it wait for the end of a ramp.
        self._read = GrowingRows(t_ns=np.int64, angle=(n,), rate=(n,), summed=(n,), half_s=(), change=np.bool_)
        self._taken = self._window_ns = 0
        self._site = site
        # The first ``_done`` rows are final, too. Rows and readings are kept only while needed.
        self._rows, self._final = rows_of_motion(n), final_rows(n)
        self._done, self._starts_ns = 0, 2**62

    @classmethod
    def of(cls, readings: TableReadings, site: Site | None) -> "BodyRates":
        """Return the body rates of complete readings, all final; computed once a site for as long as the readings
        exist.
        """
        made = _MADE.setdefault(readings, {})
        if site not in made:
            rates = cls(readings.gimbals, site)
            rows = readings.t_ns, readings.angle_rad, readings.rate_rps, readings.half_width_ns
            rates.add(*rows, readings.rate_window_ns)
            rates.finish()
            made[site] = rates
        return made[site]

    def add(
        self,
        t_ns: Stamps,
        angle_rad: Floats,
        rate_rps: Floats,
        half_width_ns: Stamps | None = None,
        rate_window_ns: int = 0,
    ) -> None:
        """Add readings (k,), (k, gimbals), (k, gimbals), later than all before, with their half widths (k,).

        None stands for half widths of 0. Rates are means over the ``rate_window_ns`` before their instants.
        RecordingError if times do not increase.
        """
        half_ns = np.zeros(len(t_ns)) if half_width_ns is None else half_width_ns
        for first in range(0, len(t_ns), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            self._add(
                t_ns[part],
                angle_rad[part],
                rate_rps[part],
                np.asarray(half_ns[part] * 1e-9, dtype=np.float64),
                rate_window_ns,
            )

    def _add(self, t_ns: Stamps, angle_rad: Floats, rate_rps: Floats, half_s: Floats, rate_window_ns: int) -> None:
        """Add n readings, with jumps by whole turns removed, and make rows of what can be judged now.

        ``angle_rad`` and ``rate_rps`` (n, g) are those of g gimbals, ``half_s`` (n,) the doubt of each instant,
        ``rate_window_ns`` the time over which the table averages its rate. RecordingError if times do not increase.
        """
        step_ns, rates, summed = integrated(self._read, t_ns, rate_rps)
        if np.any(step_ns[not len(self._read) :] <= 0):
            raise RecordingError("the times of the table readings do not increase. Sort them and drop repeats")
        # Without whole-turn jumps: the integrated rate determines the turn.
        drift = angle_rad - summed
        jumps = np.round(np.diff(np.vstack([drift_of(self._read, drift), drift]), axis=0) / (2 * np.pi))
        angle = angle_rad - 2 * np.pi * np.cumsum(jumps, axis=0)
        change = changing(np.concatenate([[0.0], np.cumsum(step_ns * 1e-9)]), rates)
        self._read.append(t_ns, angle, rate_rps, summed, half_s, change)
        self._window_ns = rate_window_ns
        self._take(flush=False)
        if len(self._rows):
            latest = int(self._rows["t_ns"][-1]) - ANCHOR_HALF_WINDOW_NS
            self._refine_up_to(int(np.searchsorted(self._rows["t_ns"], latest, side="right")))
            self._let_go()

    def _take(self, *, flush: bool) -> None:
        """Turn readings that wait into rows, as far as it is known where a ramp among them ends; ``flush`` leaves none.

        The last readings are held back, as they may belong to the beginning of a ramp. A change of rate without an end
        within ``LONGEST_S`` is taken piece by piece if the table averages its rates, else as no ramp.
        """
        times, changes = self._read["t_ns"], self._read["change"]
        hold_ns = round(HOLD_S * 1e9) + self._window_ns
        while (taken := self._taken) < len(times):
            ahead = np.flatnonzero(changes[taken:])
            start = taken + int(ahead[0]) if len(ahead) else len(times)
            if start < len(times):  # a ramp: of its beginning a late reading may know nothing yet
                before = int(np.searchsorted(times, times[start] - hold_ns))
            else:
                before = start if flush else int(np.searchsorted(times, times[-1] - hold_ns))
            if before > taken:
                self._append(taken, before, [])
                continue
            if start == len(times):
                return
            count, seen = ends(changes[start:])
            stop = start + count
            longest = int(np.searchsorted(times, times[start] + round(LONGEST_S * 1e9), side="right"))
            if stop > longest:  # no ramp, or one after the other without a steady rate between
                if not self._window_ns:
                    self._append(taken, longest, [])
                    continue
                until = int(np.searchsorted(times, times[start] + round(PIECE_S * 1e9), side="right"))
                t_s = (times[start:until] - times[start]) * 1e-9
                angle, rate = (self._read[name][start:until] for name in ("angle", "rate"))
                piece = start + piece_of(t_s, angle[:, np.argmax(np.ptp(rate, axis=0))])
                self._append(taken, piece, self._ramps(start, piece, until))
            elif not is_ramp(self._read["rate"][max(start - 1, 0) : stop]) and (seen or flush):
                self._append(taken, stop, [])
            elif flush or (seen and times[-1] >= times[stop - 1] + round(WINDOW_S * 1e9) + hold_ns):
                # A reading soon after, or a mean, may still contain a part of the ramp.
                after = changes[stop : int(np.searchsorted(times, times[stop - 1] + hold_ns))]
                following = min(stop + int(np.argmax(after) if after.any() else len(after)), len(times) - 1)
                # Of the beginning of the next ramp a mean may know nothing yet.
                stop = max(stop, int(np.searchsorted(times, times[following] - self._window_ns)))
                self._append(taken, stop, self._ramps(start, stop))
            else:
                return

    def _ramps(self, start: int, stop: int, until: int | None = None) -> list[tuple[int, Stamps, Ramp | None]]:
        """Return the ramps between the readings before ``start`` and before ``stop``: (gimbal, corners in ns, ramp).

        At most one for each gimbal, by its number, in their order. Readings before ``until`` are fitted; by default
        those up to the next change, or 3 s after. The ``reading_rps`` of a ramp are only those of readings that are not
        rows yet, to before ``stop``. A change that cannot be fitted is listed, without corners and ramp, only if the
        table averages its rates. Empty as long as there are no rows.
        """
        if not len(self._rows):
            return []
        times, changes = self._read["t_ns"], self._read["change"]
        window_ns = round(WINDOW_S * 1e9)
        low = int(np.searchsorted(times, times[start - 1] - window_ns)) if start else 0
        earlier = np.flatnonzero(changes[low + 1 : start])
        low += int(earlier[-1]) + 1 if len(earlier) else 0
        low = min(low, self._taken)
        if until is None:
            until = stop
            high = int(np.searchsorted(times, times[stop - 1] + window_ns, side="right"))
            later = np.flatnonzero(changes[stop:high])
            high = stop + int(later[0]) if len(later) else high
        else:
            high = until
        part = slice(low, high)
        t_s = (times[part] - times[low]) * 1e-9
        found: list[tuple[int, Stamps, Ramp | None]] = []
        for column in range(len(self._gimbals)):
            angle, rate = self._read["angle"][part, column], self._read["rate"][part, column]
            own = np.flatnonzero(changing(t_s, rate[:, None])[max(start - 1 - low, 0) : until - 1 - low])
            if not len(own):
                continue
            first, last = max(start - 1 - low, 0) + int(own[0]), max(start - 1 - low, 0) + int(own[-1]) + 1
            if not is_ramp(rate[first : last + 1, None]):
                continue
            readings = t_s, angle, rate, self._read["half_s"][part], self._window_ns * 1e-9
            ramp = fitted(readings, first, last)
            if ramp is not None:
                corners = times[low] + np.round(ramp.t_s * 1e9).astype(np.int64)
                reading_rps = ramp.reading_rps[self._taken - low : stop - low]
                followed = followed_by(ramp, readings, first, last)
                found.append((column, corners, replace(ramp, reading_rps=reading_rps, followed=followed)))
            elif self._window_ns:
                found.append((column, times[:0], None))
        return found

    def _append(self, start: int, stop: int, changes: list[tuple[int, Stamps, Ramp | None]]) -> None:
        """Append readings ``start`` to before ``stop`` as rows, with rates at their instants and rows for the corners
        of ramps.

        ``changes`` has the gimbal's column, corners and ramp of each change of rate, as ``_ramps`` returns them; one
        whose ramp is None leaves the steps unknown. The rows of corners count as not measured.
        """
        self._taken = stop
        ramps = [(column, corners, ramp) for column, corners, ramp in changes if ramp is not None]
        part = slice(start, stop)
        t_ns, angle = self._read["t_ns"][part], self._read["angle"][part]
        known = slice(start, int(np.searchsorted(self._read["t_ns"], t_ns[-1] + self._window_ns, side="right")))
        rate = centred(t_ns, self._read["t_ns"][known], self._read["rate"][known], self._window_ns)
        half_width_s, measured = self._read["half_s"][part], np.ones(stop - start)
        corner_s = np.full(rate.shape, np.nan)
        felt, sharp = (angle, rate, corner_s), np.zeros(stop - start, dtype=np.bool_)
        if ramps:
            # From the row before on: in between the corners lie.
            known_ns = np.concatenate([self._rows["t_ns"][-1:], t_ns])
            angles, rates = np.vstack([self._rows["angle"][-1:], angle]), np.vstack([self._rows["rate"][-1:], rate])
            t_ns, angle, rate, corner_s = with_corners(known_ns, angles, rates, ramps)
            angles[0], rates[0] = self._rows["felt_angle"][-1], self._rows["felt_rate"][-1]
            felt = as_read(t_ns, angle, rate, known_ns, (angles, rates), ramps)
            sharp = np.isin(t_ns, [corner for _, corners, ramp in ramps if ramp.followed for corner in corners])
            measured = np.isin(t_ns, known_ns).astype(np.float64)
            half_width_s = np.where(measured > 0, np.interp(t_ns, known_ns[1:], half_width_s), 0.0)
        self._add_rows(
            t_ns, angle, rate, half_width_s, measured, corner_s, (*felt, sharp), known=len(ramps) == len(changes)
        )

    def _add_rows(
        self,
        t_ns: Stamps,
        angle: Floats,
        rate_rps: Floats,
        half_width_s: Floats,
        measured: Floats,
        corner_s: Floats,
        felt: tuple[Floats, Floats, Floats, Flags],
        *,
        known: bool,
    ) -> None:
        """Append n rows with rates integrated to angles.

        ``angle`` and ``rate_rps`` (n, g) are those of g gimbals, ``half_width_s`` (n,) the doubt of each instant.
        ``measured`` (n,) is 1 for a reading, 0 for a computed corner; ``corner_s`` (n, g) the doubt of a corner's
        instant, NaN without one; ``felt`` are the columns for accelerometers. A step is understood without a gap if
        ``known`` is set, else at a corner or if a steady rate explains its angle.
        """
        step_ns, rates, summed = integrated(self._rows, t_ns, rate_rps)
        drift = angle - summed
        unexplained = np.diff(np.vstack([drift_of(self._rows, drift), drift]), axis=0)
        widths = np.concatenate([half_width_s[:1] if not len(self._rows) else self._rows["half_s"][-1:], half_width_s])
        doubt = np.abs(rate_rps) * (widths[1:] + widths[:-1])[:, None]
        steady = np.abs(np.diff(rates, axis=0)) <= _STEADY_RPS + _STEADY_SHARE * np.abs(rate_rps)
        explained = np.abs(unexplained) <= GAP_ANGLE_RAD + doubt
        known_step = known & (step_ns <= GAP_NS) | (np.isfinite(corner_s) | (steady & explained)).all(axis=1)
        # A step across a gap is no error of the rates beside it: there the angles alone count.
        hidden = np.cumsum(np.where(known_step[:, None], 0.0, unexplained), axis=0)
        summed, drift = summed + hidden, drift - hidden
        self._starts_ns = min(self._starts_ns, int(t_ns[0]))
        self._rows.append(t_ns, drift + summed, rate_rps, summed, half_width_s, measured, corner_s, known_step, *felt)

    def finish(self) -> None:
        """Make the last seconds final too, with windows that end with the readings."""
        self._take(flush=True)
        self._refine_up_to(len(self._rows))

    @property
    def final_until_ns(self) -> int:
        """Latest instant for ``at``; before the first reading if there is none yet."""
        return int(self._final["t_ns"][-1]) if len(self._final) else -(2**62)

    @property
    def starts_ns(self) -> int:
        """Instant of the first reading."""
        return self._starts_ns

    def forget(self, before_ns: int) -> None:
        """Keep no rows from before this instant: where they were, the body rate is not known any more."""
        gone = int(np.searchsorted(self._final["t_ns"][:-2], before_ns))
        if gone:
            self._final.forget(gone)
            self._final["sure"][0] = self._final["felt_sure"][0] = False

    def at(self, t_ns: Stamps) -> Floats:
        """Return the body rate (rows, 3) in rad/s at ordered instants (rows,) in ns; NaN where it is not known.

        The instants lie between the first and the last final reading; beyond them the nearest reading holds.
        """
        angle, rate = self.gimbals_at(t_ns)
        w = body_rate(angle, rate, self._gimbals, self._site)
        ends = np.searchsorted(self._final["t_ns"][:-1], t_ns, side="left")
        w[~self._final["sure"][ends]] = np.nan
        return w

    def gimbals_at(self, t_ns: Stamps) -> tuple[Floats, Floats]:
        """Return angles and rates (rows, gimbals) at ordered instants; beyond the readings, those of the nearest."""
        angle, rate = interpolated(self._final, t_ns, "angle", "rate")
        return angle, rate

    def felt_at(self, t_ns: Stamps) -> tuple[Floats, Floats, Floats]:
        """Return angles, rates and accelerations (rows, gimbals) for accelerometers at ordered instants, as for ``at``.

        See ``estimator.recordings.motion.felt``.
        """
        return felt_at(self._final, t_ns)

    def felt_known(self, t_ns: Stamps) -> Flags:
        """Return as flags (rows,) whether ``felt_at`` is what accelerometers feel at ordered instants."""
        return felt_known(self._final, t_ns)

    def accelerations_at(self, t_ns: Stamps) -> Floats:
        """Return the mean accelerations (rows, gimbals) over 20 ms about instants as for ``at``, rad/s2."""
        return mean_slopes(self._final, t_ns, "rate")

    def angular_acceleration_at(self, t_ns: Stamps) -> Floats | None:
        """Return the derivative (rows, 3) of the body rate at instants as for ``at``; None where no axis ramps."""
        ramps = np.abs(self.accelerations_at(t_ns)).max(axis=1) > LEAST_RPS2
        if not ramps.any():
            return None
        change = (self.at(t_ns + _NEAR_NS) - self.at(t_ns - _NEAR_NS)) / (2e-9 * _NEAR_NS)
        return np.where(ramps[:, None], change, 0.0)

    def earlier(self, t_ns: Stamps, delay_s: float) -> Stamps:
        """Return instants earlier by ``delay_s``, limited to the final readings."""
        return np.clip(t_ns - round(delay_s * 1e9), self.starts_ns, self.final_until_ns)

    def _let_go(self) -> None:
        """Forget rows and readings that no window needs any more: those 60 s before the newest, final rows excepted."""
        gone = int(np.searchsorted(self._rows["t_ns"][: max(self._done - 1, 0)], self._rows["t_ns"][-1] - _KEPT_NS))
        self._rows.forget(gone)
        self._done -= gone
        read_ns = self._read["t_ns"]
        gone = int(np.searchsorted(read_ns[: max(self._taken - 1, 0)], read_ns[self._taken - 1] - _KEPT_NS))
        self._read.forget(gone)
        self._taken -= gone

    def _terms(self, part: slice, origin: int) -> Floats:
        """Return sums (k + 1, 8, gimbals) of w [1, s, s^2, d, s d, d^2, u] and [1] before each row of ``part``.

        s is time, d angle minus integrated rate, both relative to row ``origin``; u the variance from the instants, w
        weight. Rows of corners, which were not measured, count nothing.
        """
        rows = {name: self._rows[name] for name in ("t_ns", "angle", "rate", "summed", "half_s", "measured")}
        s, drift = ((rows["t_ns"] - rows["t_ns"][origin]) * 1e-9)[part, None], (rows["angle"] - rows["summed"])
        drift, measured = (drift - drift[origin])[part], rows["measured"][part, None]
        may_scatter = (rows["rate"][part] * rows["half_s"][part, None]) ** 2 / 3
        ones = np.ones_like(drift)
        weight = measured / (_ANGLE_SD_RAD**2 + may_scatter)
        terms = np.stack([ones, s * ones, s * s * ones, drift, s * drift, drift**2, may_scatter], axis=1)
        terms = np.concatenate([terms * weight[:, None], (measured * ones)[:, None]], axis=1)
        return np.concatenate([np.zeros_like(terms[:1]), np.cumsum(terms, axis=0)])

    def _refine_up_to(self, stop: int) -> None:
        """Make rows up to ``stop`` final: correct their rates by the angles around, mark which are reliable.

        Rows that are final already stay as they are. With fewer than five readings around a rate is not corrected.
        """
        start, times = self._done, self._rows["t_ns"]
        if stop <= start:
            return
        low = np.searchsorted(times, times[start:stop] - ANCHOR_HALF_WINDOW_NS, side="left")
        high = np.searchsorted(times, times[start:stop] + ANCHOR_HALF_WINDOW_NS, side="right")
        sums = self._terms(slice(low[0], high[-1]), start)
        weight, s, ss, d, sd, dd, u, count = (sums[high - low[0]] - sums[low - low[0]]).transpose(1, 0, 2)
        spread = ss - s * s / weight
        across = sd - s * d / weight
        enough = (count >= 5) & (spread > 0)
        spread = np.where(enough, spread, np.inf)
        scatter = np.maximum(dd - d * d / weight - across**2 / spread, 0.0)
        share = np.minimum(scatter / np.where(u > 0, u, np.inf) * count / np.maximum(count - 2, 1), 1.0)
        slope = np.where(enough, across / (spread + share / _RATE_SD_RPS**2), 0.0)
        part = slice(start, stop)
        known, angle, rate, sharp = (self._rows[name][part] for name in ("known", "felt_angle", "felt_rate", "sharp"))
        felt = angle, rate + slope, known & self._timed(start, stop, share, "felt_rate", "felt_s"), sharp
        sure = known & self._timed(start, stop, share, "rate", "corner_s")
        self._final.append(times[part], self._rows["angle"][part], self._rows["rate"][part] + slope, sure, *felt)
        self._done = stop

    def _timed(self, start: int, stop: int, share: Floats, rates: str, corners: str) -> Flags:
        """Return as flags (rows,) whether the rates since the row before are known in spite of their instants' doubt.

        ``share`` (rows, gimbals) is the part of the doubt's variance that the scatter of the angles shows to be real.
        ``rates`` and ``corners`` are the columns of rates and of the doubts of corners.
        """
        before = np.maximum(np.arange(start, stop) - 1, 0)
        change = np.abs(self._rows[rates][start:stop] - self._rows[rates][before])
        step_s = np.maximum((self._rows["t_ns"][start:stop] - self._rows["t_ns"][before]) * 1e-9, 1e-9)[:, None]
        doubt_s = np.maximum(self._rows["half_s"][start:stop], self._rows["half_s"][before])[:, None]
        corner_s = self._rows[corners][start:stop]
        doubt_s = np.where(np.isfinite(corner_s), corner_s, doubt_s * np.sqrt(share / 3))
        return np.asarray((change / step_s * doubt_s <= SURE_RPS).all(axis=1))
