"""Memory and error of the viewer's bases as sums of products (Kautz and McCool 1999)
instead of 3D textures.

A basis b(theta_h, theta_d, phi_d) is approximated by a sum over r of u_r(theta_h)
v_r(theta_d, phi_d), with the optimal factors for every rank (singular values). The
error of the BRDF is weighted with both cosines and the solid angles as in
`brdf_metric`, but without the compression of highlights.

    python -m benchmarks viewer_factors DB [TAKE]
"""

from __future__ import annotations

import numpy as np

import skindb
from skindb.reflectance.tables import TableGrid, directions
from skindb.render.scene import from_model

RANKS = (1, 2, 3, 4, 6, 8, 12)
BYTES = 2  # per value in half precision


def measure(grid: TableGrid) -> np.ndarray:
    """Weight (nh, nd * np) of every entry of a table: solid angle and cosines."""
    theta_d, phi_d = np.meshgrid(grid.theta_d, grid.phi_d, indexing="ij")
    rows = []
    for theta_h in grid.theta_h:
        wi, wo = directions(theta_h, theta_d, phi_d)
        cosines = np.maximum(wi[..., 2], 0) * np.maximum(wo[..., 2], 0)
        rows.append(
            (
                np.sin(theta_h)
                * np.sqrt(theta_h)
                * np.sin(theta_d)
                * np.cos(theta_d)
                * cosines
            ).ravel()
        )
    return np.array(rows)


def main(db: str, take: str = "") -> None:
    """Print memory, texture fetches and errors."""
    database = skindb.open(db)
    surface = from_model(database.read("model", take or database.takes("model")[0]))
    tables = np.asarray(surface.model.table, np.float64)
    nh, nd, nphi, count = tables.shape
    weight = measure(TableGrid(nh, nd, nphi))
    groups = -(-count // 4)
    print(f"{count} bases of {nh} x {nd} x {nphi}")
    print(
        f"3D textures: {nh * nd * nphi * 4 * groups * BYTES / 1e6:.2f} MB, "
        f"{groups} fetches for each light, exact"
    )
    print(
        "rank  MB      fetches  error of each basis, and of the mean mixture of the face"
    )
    mixture = np.nanmean(surface.parameters, axis=0)
    for rank in RANKS:
        near = np.empty_like(tables)
        for k in range(count):
            u, size, v = np.linalg.svd(
                tables[..., k].reshape(nh, -1), full_matrices=False
            )
            near[..., k] = ((u[:, :rank] * size[:rank]) @ v[:rank]).reshape(
                nh, nd, nphi
            )

        def error(values: np.ndarray, true: np.ndarray) -> float:
            square = weight * (values - true).reshape(nh, -1) ** 2
            return float(
                np.sqrt(square.sum() / (weight * true.reshape(nh, -1) ** 2).sum())
            )

        errors = [error(near[..., k], tables[..., k]) for k in range(count)]
        mixed = error(near @ mixture, tables @ mixture)
        size_mb = rank * (nh + nd * nphi) * 4 * groups * BYTES / 1e6
        print(
            f"{rank:4d}  {size_mb:6.3f}  {2 * rank * groups:7d}  "
            f"{' '.join(f'{e:6.1%}' for e in errors)}  {mixed:6.1%}"
        )
