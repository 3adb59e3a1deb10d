"""Linear algebra on one thread, so that the last digits do not depend on the number of cores."""

from __future__ import annotations

import scipy.linalg  # noqa: F401  its BLAS is another one than NumPy's, and only what is loaded can be limited
from threadpoolctl import threadpool_limits


def one_blas_thread() -> threadpool_limits:
    """Context in which matrix products and decompositions give the same bits whatever the number of threads.

    BLAS adds up in an order that depends on its threads; fits amplify the last digit to 1e-3 of a weight.
    """
    return threadpool_limits(1)
