"""Which samples of a source the readings of the table cover so far, in blocks."""

import numpy as np

from estimator.recordings.motion.body_rates import BodyRates
from estimator.types import Stamps

_MARGIN_NS = 100_000_000  # samples may be later than their stamps by this


def covered_blocks(t_ns: Stamps, rates: BodyRates, rows: int, *, flush: bool) -> tuple[list[slice], int]:
    """Return the blocks of ``rows`` samples that the readings cover, and the number of the first sample to keep.

    ``t_ns`` (n,) are the instants of the samples that wait, in order. Samples of the last 0.1 s of the readings wait,
    because samples may be later than their stamps. With ``flush``, for the end of a run, they do not, and the last
    block may be shorter. Samples before the first known rate are in no block and not kept. No block, and all kept,
    while no rate is known.
    """
    if rates.starts_ns > rates.final_until_ns:
        return [], 0
    early = int(np.searchsorted(t_ns, rates.starts_ns, side="left"))
    until_ns = rates.final_until_ns if flush else rates.final_until_ns - _MARGIN_NS
    ready = int(np.searchsorted(t_ns, until_ns, side="right"))
    end = ready if flush else early + max(ready - early, 0) // rows * rows
    blocks = [slice(start, min(start + rows, end)) for start in range(early, end, rows)]
    return blocks, max(end, early)
