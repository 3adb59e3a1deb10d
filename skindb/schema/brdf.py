"""BRDF tables between the stored form, whose phi_d runs over the closed period, and
that of the kernels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.optics.brdf_table import Table, TableGrid

ANGLES = ("theta_h", "theta_d", "phi_d")


def stored_brdf(tables: NDArray[Any]) -> NDArray[Any]:
    """Tables (nh, nd, np, k) of the kernels as `basis_brdf` (k, nh, nd, np + 1): the
    period's end repeats its begin.
    """
    moved = np.moveaxis(tables, -1, 0)
    return np.concatenate([moved, moved[..., :1]], axis=-1)


def brdf_coords(grid: TableGrid) -> dict[str, NDArray[Any]]:
    """Nodes of `stored_brdf` [rad]."""
    return {
        "theta_h": grid.theta_h,
        "theta_d": grid.theta_d,
        "phi_d": np.append(grid.phi_d, np.pi),
    }


def kernel_tables(basis: xr.Dataset) -> Table:
    """Tables (nh, nd, np, k) of `basis_brdf` for the kernels, contiguous and in single
    precision.
    """
    closed = basis["basis_brdf"].transpose(*ANGLES, "component").values
    return np.ascontiguousarray(closed[:, :, :-1], np.float32)
