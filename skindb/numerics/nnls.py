"""Non-negative least squares with a certificate, in batches (Weyrich et al. 2005, eq. 8)."""

import numpy as np
from numpy.typing import ArrayLike

from skindb.numerics import _nnls_kernels
from skindb.types import Array, Index32, Mask, finite_rows

# largest KKT residual, relative to max |M'r| after scaling columns to unit length
TOLERANCE = 1e-10


def solve_nnls(
    gram: ArrayLike,
    rhs: ArrayLike,
    *,
    warm: ArrayLike | None = None,
) -> tuple[Array, Array, Index32, Mask]:
    """Minimise |M x - r| over x >= 0 given M'M and M'r.

    Parameters
    ----------
    gram, rhs
        (n, m, m) and (n, m); columns of any scale, zero and collinear ones included.
    warm
        (n, m) non-negative warm start; zero by default.

    Returns
    -------
    x, kkt, iterations, converged
        (n, m) and (n,) each; x is NaN and converged False where the input is not finite.
    """
    # C order: a broadcast array would be copied in the order of its strides, for which
    # the kernel is compiled again
    G = np.array(gram, float, order="C")
    b = np.array(rhs, float, order="C")
    x = (
        np.zeros_like(b)
        if warm is None
        else np.maximum(np.array(warm, float, order="C"), 0.0)
    )
    kkt = np.full(len(b), np.nan)
    count = np.zeros(len(b), np.int32)
    met = np.zeros(len(b), bool)
    valid = np.isfinite(G).all(axis=(1, 2)) & finite_rows(b + x)
    finite = np.asarray(valid)
    _nnls_kernels.solve_many(G, b, x, finite, TOLERANCE, kkt, count, met)
    x[~finite] = np.nan
    return x, kkt, count, met
