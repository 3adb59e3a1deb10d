"""Rows of the linear system of measured BRDFs, computed from directions, and fits of
mixtures to such rows (Weyrich et al. 2005, eq. 7 and 8).

Fits of captures do both in one kernel, see `skindb.reflectance.mixture`.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from skindb.reflectance import _mixture_kernels, _row_kernels
from skindb.reflectance.block import empty_fit
from skindb.reflectance.model import SurfaceFit
from skindb.reflectance.tables import Table, TableGrid, pad_to_lanes
from skindb.schema import FitStatus
from skindb.types import Array

Mode = Literal["linear", "perceptual"]


def basis_rows(
    table: Table,
    grid: TableGrid,
    normal: Array,
    to_light: Array,
    to_camera: Array,
    usable: NDArray[np.bool_],
) -> tuple[Table, NDArray[np.int64], NDArray[np.int32]]:
    """Rows cos(theta_i) b_j(w_i, w_o) of all usable samples, in the order of surfels.

    Parameters
    ----------
    table, grid
        (nh, nd, np, m) sr^-1 on the nodes of `grid`.
    normal
        (n, 3) unit normals.
    to_light, to_camera
        (n, l, 3) and (n, c, 3) unit directions that point away from the surfel.
    usable
        (n, l, c) samples to use; those below the horizon or with NaN are excluded.

    Returns
    -------
    rows, offsets, index
        (total, m) float32 [sr^-1]; (n + 1,) index of each surfel's first row; (total,
        2) light and camera of each row.
    """
    if table.shape[:3] != (grid.n_theta_h, grid.n_theta_d, grid.n_phi_d):
        raise ValueError(
            f"the table must have the shape of the grid {grid}, found {table.shape}"
        )
    normal, to_light, to_camera = (
        np.ascontiguousarray(a, np.float64) for a in (normal, to_light, to_camera)
    )
    lit = _above_horizon(normal, to_light)
    seen = _above_horizon(normal, to_camera)
    use = np.ascontiguousarray(usable & lit[:, :, None] & seen[:, None, :])
    offsets = np.concatenate([[0], np.cumsum(use.sum((1, 2)))]).astype(np.int64)
    padded = pad_to_lanes(table)
    rows = np.empty((offsets[-1], padded.shape[3]), np.float32)
    index = np.empty((offsets[-1], 2), np.int32)
    _row_kernels.fill_rows(
        padded, normal, to_light, to_camera, use, offsets, rows, index
    )
    return rows[:, : table.shape[3]], offsets, index


def _above_horizon(normal: Array, away: Array) -> NDArray[np.bool_]:
    """(n, d) mask of directions above the horizon; false for NaN and infinite ones."""
    cosine = np.einsum("sc,sdc->sd", normal, away)
    return np.asarray(np.isfinite(cosine) & (cosine > 0))


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
) -> SurfaceFit:
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
    out = empty_fit(len(offsets) - 1, lift.shape[1])
    out.parameters[...] = 0.0
    weights = np.ones(len(rows)) if weight is None else weight
    samples = _mixture_kernels.Samples(
        np.ascontiguousarray(rows),
        np.asarray(offsets, np.int64),
        np.ascontiguousarray(target, np.float64),
        np.ascontiguousarray(weights, np.float64),
    )
    _mixture_kernels.fit_many(
        samples,
        np.ascontiguousarray(lift, np.float64),
        mode == "perceptual",
        float(noise_floor),
        tolerance,
        max(min_samples, 1),
        out,
    )
    unfitted = (out.status == FitStatus.TOO_FEW_SAMPLES) | (
        out.status == FitStatus.NOT_FINITE
    )
    out.parameters[unfitted] = np.nan
    return out
