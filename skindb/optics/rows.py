"""Rows of the linear system of measured BRDFs, formed from directions (Weyrich et al. 2005, eq. 7)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.optics.brdf_table import Table, TableGrid

Array = NDArray[np.floating[Any]]


def reduce_dictionary(table: Table, rank: int) -> tuple[Table, Array]:
    """The linear space of `rank` dimensions nearest to the m tables.

    Parameters
    ----------
    table
        (nh, nd, np, m) sr^-1.
    rank
        Dimensions; m keeps the tables as they are.

    Returns
    -------
    reduced, lift
        (nh, nd, np, rank) float32 and (rank, m) with table = reduced @ lift, nearest in the relative sense: every
        cell is weighted by the inverse of its mean over materials, so that dim cells count like bright ones.
    """
    m = table.shape[-1]
    if rank >= m:
        return table, np.eye(m)
    cells = table.reshape(-1, m).astype(np.float64)
    # square root of the mean: between absolute (highlights only) and relative (noise floor) accuracy
    weight = 1.0 / np.sqrt(np.maximum(cells.mean(axis=1, keepdims=True), 1e-6))
    _, vectors = np.linalg.eigh((cells * weight).T @ (cells * weight))
    lift = vectors[:, ::-1][:, :rank].T
    reduced = (cells @ lift.T).astype(np.float32).reshape(*table.shape[:-1], rank)
    return reduced, np.ascontiguousarray(lift)


def basis_rows(
    table: Table, grid: TableGrid, normal: Array, to_light: Array, to_camera: Array, usable: NDArray[np.bool_]
) -> tuple[Table, NDArray[np.int64], NDArray[np.int32]]:
    """Rows cos(theta_i) b_j(w_i, w_o) of all usable samples, surfel after surfel.

    Parameters
    ----------
    table, grid
        (nh, nd, np, m) sr^-1 on the nodes of `grid`.
    normal
        (n, 3) unit normals.
    to_light, to_camera
        (n, l, 3) and (n, c, 3) unit directions away from the surfel.
    usable
        (n, l, c) samples to use; those below the horizon or with NaN are left out.

    Returns
    -------
    rows, offsets, index
        (total, m) float32 [sr^-1]; (n + 1,) where each surfel's rows begin; (total, 2) light and camera of each row.
    """
    from skindb.optics import _row_kernels  # compiled at first use only

    if table.shape[:3] != (grid.n_theta_h, grid.n_theta_d, grid.n_phi_d):
        raise ValueError(f"table {table.shape} does not lie on the grid {grid}")
    normal, to_light, to_camera = (np.ascontiguousarray(a, np.float64) for a in (normal, to_light, to_camera))
    # comparisons with NaN are False: such samples are not usable
    lit, seen = np.einsum("sc,slc->sl", normal, to_light) > 0, np.einsum("sc,slc->sl", normal, to_camera) > 0
    use = np.ascontiguousarray(usable & lit[:, :, None] & seen[:, None, :])
    offsets = np.concatenate([[0], np.cumsum(use.sum((1, 2)))]).astype(np.int64)
    rows, index = np.empty((offsets[-1], table.shape[3]), np.float32), np.empty((offsets[-1], 2), np.int32)
    _row_kernels.fill_rows(np.ascontiguousarray(table), normal, to_light, to_camera, use, offsets, rows, index)
    return rows, offsets, index
