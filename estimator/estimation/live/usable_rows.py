"""Which outputs of an accelerometer can be used while a run goes on: told from what came so far."""

import math
from collections import deque

import numpy as np

from estimator.observations.defects.stuck import longest_by_chance
from estimator.types import Flags, Floats

_RECENT = 500  # runs of equal outputs by which their usual length is told
_SIGMAS = 8.0  # beyond the data sheet
_FEW = 0.2  # share of a block that may be beyond the data sheet: spikes
_BAD_BLOCKS = 3  # in a row: until then it may have been a knock

NO_NUMBERS = "no numbers"
CONSTANT = "does not change (stuck, or at a limit)"
UNLIKE = "unlike its data sheet (dead, other axis, sign or unit)"


class UsableRows:
    """Judges one accelerometer, block by block; ``reason`` says why its last block was left out, "" if it was not.

    ``excluded``: it has been unlike its data sheet for several blocks, so that nothing of it counts, from the
    beginning.
    """

    def __init__(self, noise_mps2: float) -> None:
        """Begin without outputs; ``noise_mps2`` is the white noise of one sample."""
        self.reason = ""
        self.excluded = False
        self._noise_mps2 = noise_mps2
        self._step_mps2 = math.inf  # the least between two outputs
        self._last, self._equal, self._bad = math.nan, 0, 0
        self._lengths: deque[int] = deque(maxlen=_RECENT)  # of runs of equal outputs

    def judge(self, output_mps2: Floats, error_mps2: Floats, plausible_mps2: Floats) -> Flags:
        """Return as flags (n,) the outputs of the next block that can be used.

        ``error_mps2`` (n,) are their errors, NaN where not known, ``plausible_mps2`` (n,) their standard deviations by
        the data sheet. Left out are outputs without a number or a known error, stuck ones, and those beyond the data
        sheet; all of a block in which more than a fifth is beyond, and all from the third such block in a row on, for
        good: ``excluded`` stays set. Of outputs that the device repeats as a rule, the first of each run counts.
        ``reason`` tells why a block cannot be used, "" if it can.
        """
        numbers = np.isfinite(output_mps2)
        known = np.isfinite(error_mps2)
        if not numbers.any():
            self.reason = self.reason if self.excluded else NO_NUMBERS
            return numbers
        moving = numbers.copy()
        moving[numbers] = self._fresh(output_mps2[numbers])
        if not (moving & known).any():
            if (numbers & known).any() and not self.excluded:
                self.reason = CONSTANT
            return moving & known
        with np.errstate(invalid="ignore"):
            beyond = np.abs(error_mps2) > _SIGMAS * np.hypot(plausible_mps2, self._noise_mps2)
        judged = moving & known
        bad = bool((beyond & judged).sum() > _FEW * judged.sum())
        self._bad = self._bad + 1 if bad else 0
        self.excluded = self.excluded or self._bad >= _BAD_BLOCKS
        self.reason = UNLIKE if bad or self.excluded else ""
        return judged & ~beyond & (not (bad or self.excluded))

    def _fresh(self, output_mps2: Floats) -> Flags:
        """Return as flags (n,) the finite outputs that are not stuck, and no repetitions where the device repeats as a
        rule.

        Stuck are those in runs of equal ones that are longer than chance explains. A run may have begun in earlier
        blocks, and the last one goes on in the next.
        """
        before = np.concatenate([[self._last], output_mps2[:-1]])
        steps = np.abs(output_mps2 - before)
        self._step_mps2 = min(self._step_mps2, float(np.min(steps[steps > 0], initial=math.inf)))
        begins = steps != 0  # of a run; the first output of all is NaN from none
        ends = np.append(np.flatnonzero(begins), len(output_mps2))
        own = np.diff(np.concatenate([[0], ends]))
        lengths = own.copy()
        lengths[0] += self._equal
        self._lengths.extend(lengths[:-1][lengths[:-1] > 0].tolist())
        usual = round(float(np.median(self._lengths))) if self._lengths else 1
        stuck = np.repeat(lengths >= usual * self._longest_by_chance(), own)
        self._last, self._equal = float(output_mps2[-1]), int(lengths[-1])
        return np.asarray(~stuck & (begins | (usual == 1)))

    def _longest_by_chance(self) -> float:
        """Return how many outputs in a row are never equal, by the least step and the noise; 1 before the first."""
        if not math.isfinite(self._step_mps2):
            return 1.0
        return longest_by_chance(self._step_mps2 / (2 * math.sqrt(math.pi) * self._noise_mps2))
