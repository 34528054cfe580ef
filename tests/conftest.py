"""Lets tests import what they share with the benchmarks."""

import os
import sys
from pathlib import Path

# Before numpy: two workers that share two cores with the threads of two BLAS wait for each other most of the time.
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")

sys.path.insert(0, str(Path(__file__).parent / "bench"))
