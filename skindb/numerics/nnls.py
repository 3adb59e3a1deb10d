"""Non-negative least squares with a certificate, in batches (Weyrich et al. 2005, eq. 8)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skindb.numerics import _nnls_kernels, _reflectance_kernels
from skindb.types import Array

Mode = Literal["linear", "perceptual"]


@dataclass(frozen=True)
class ReflectanceFit:
    """Weights and certificates of n surfels; NaN for surfels that were not fitted, see `status`."""

    weight: Array  # (n, m)
    # (n,) relative KKT residual: dual feasibility and complementarity over max |M' R|
    kkt: Array
    iterations: NDArray[np.int32]  # (n,)
    residual: Array  # (n,) |M x - R| / |R|
    residual_perceptual: Array  # (n,) the same in cube-root space
    # (n,) 0 fitted, 2 too few samples, 5 not converged, 6 not finite
    status: NDArray[np.uint8]


def solve_nnls(
    gram: ArrayLike,
    rhs: ArrayLike,
    *,
    tolerance: float = 1e-10,
    warm: ArrayLike | None = None,
) -> tuple[Array, Array, NDArray[np.int32], NDArray[np.bool_]]:
    """Minimise |M x - r| over x >= 0 given M'M and M'r.

    Parameters
    ----------
    gram, rhs
        (n, m, m) and (n, m); columns of any scale, zero and collinear ones included.
    tolerance
        Largest KKT residual, relative to max |M'r| after scaling columns to unit length.
    warm
        (n, m) non-negative warm start; zero by default.

    Returns
    -------
    x, kkt, iterations, converged
        (n, m) and (n,) each; x is NaN and converged False where the input is not finite.
    """
    # C order: a broadcast array would be copied in the order of its strides, for which
    # the kernel is compiled again
    G = np.array(gram, np.float64, order="C")
    b = np.array(rhs, np.float64, order="C")
    x = (
        np.zeros_like(b)
        if warm is None
        else np.maximum(np.array(warm, np.float64, order="C"), 0.0)
    )
    kkt = np.full(len(b), np.nan)
    count = np.zeros(len(b), np.int32)
    met = np.zeros(len(b), np.bool_)
    finite = np.isfinite(G).all(axis=(1, 2)) & np.isfinite(b + x).all(axis=1)
    _nnls_kernels.solve_many(G, b, x, finite, tolerance, kkt, count, met)
    x[~finite] = np.nan
    return x, kkt, count, met


def fit_reflectance(
    rows: NDArray[np.float32],
    offsets: NDArray[np.int64],
    target: Array,
    weight: Array | None,
    lift: Array,
    *,
    mode: Mode,
    noise_floor: float,
    min_samples: int = 10,
    tolerance: float = 1e-10,
) -> ReflectanceFit:
    """Fit weights x >= 0 of every surfel to all channels at once.

    Parameters
    ----------
    rows
        (total, r) basis rows in the reduced space, cosine included [sr^-1].
    offsets
        (n + 1,) index of the first row of each surfel, and the total.
    target
        (total, channels) samples minus the diffuse term [sr^-1]; negative values are
        used unchanged.
    weight
        (total,) non-negative, or None for ones.
    lift
        (r, m): M = rows @ lift.
    mode
        "linear": min |M x - R|. "perceptual": min |root(M x) - root(R)| with root(y) =
        y / (y^2 + floor^2)^(1/3), the signed cube root that is linear below the noise
        floor, by Gauss-Newton with a line search; then one linear step weighted with
        the squared slopes of the root, which is not biased by noise as the cube root
        is.
    noise_floor
        [sr^-1], positive; not used by "linear".
    min_samples
        Surfels with fewer rows get status 2.
    tolerance
        Largest KKT residual.
    """
    if mode not in ("linear", "perceptual"):
        raise ValueError(f"mode must be 'linear' or 'perceptual', not {mode!r}")
    if not noise_floor > 0:
        raise ValueError(f"noise_floor must be positive, not {noise_floor}")
    n = len(offsets) - 1
    m = lift.shape[1]
    x = np.zeros((n, m))
    iterations = np.zeros(n, np.int32)
    status = np.zeros(n, np.uint8)
    kkt, residual, residual_root = (np.full(n, np.nan) for _ in range(3))
    _reflectance_kernels.fit_many(
        np.ascontiguousarray(rows),
        np.asarray(offsets, np.int64),
        np.ascontiguousarray(target, np.float64),
        np.ones(len(rows))
        if weight is None
        else np.ascontiguousarray(weight, np.float64),
        np.ascontiguousarray(lift, np.float64),
        mode == "perceptual",
        float(noise_floor),
        tolerance,
        max(min_samples, 1),
        x,
        kkt,
        iterations,
        residual,
        residual_root,
        status,
    )
    x[(status == 2) | (status == 6)] = np.nan
    return ReflectanceFit(x, kkt, iterations, residual, residual_root, status)
