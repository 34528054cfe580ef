"""Many items of work: on the cores of this machine, or on a cluster."""

ONE_BLAS_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""The environment in which numpy must be imported: sums shared among threads differ in their last digits."""
