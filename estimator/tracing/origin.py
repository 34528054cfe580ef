"""Whose a residual is: redundant gyros tell an error of the body rate, which all share, from one that each has alone.

An error dw of the body rate (the table, the site, the clock) shows in n gyros with sense axes P as P dw. What lies
outside the column space of P can only be the gyros' own. Errors of their own fall into both parts, as noise does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from estimator.model import decode
from estimator.tracing.augmented import Augmented
from estimator.tracing.runs import Run
from estimator.tracing.spectra import Stretch, cosines, density_of
