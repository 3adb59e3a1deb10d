"""Tables of isotropic, reciprocal BRDFs over half and difference angles: grid,
interpolation, integrals, and the stored form.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from skindb.jit import LANES
from skindb.optics.angles import directions, half_difference
from skindb.types import AnyArray, Array, Float32, Float64, float64

Table = Float32
ANGLES = ("theta_h", "theta_d", "phi_d")
WIDTH_DIFFERENCE = np.radians(20)  # theta_d at which widths of lobes are measured
# theta_h up to which light belongs to the narrow of two lobes. Of seven angles from 6 to 25
# degrees the one at which glossiness of regions differs least from the truth over 70 virtual
# subjects; docs/results has 13 others
NARROW_ANGLE = np.radians(20)


@dataclass(frozen=True)
class TableGrid:
    """Nodes, uniform in sqrt(theta_h) and theta_d over [0, pi/2] including both ends,
    and in phi_d over a period pi.
    """

    n_theta_h: int
    n_theta_d: int
    n_phi_d: int

    @property
    def theta_h(self) -> Array:
        """(nh,) rad."""
        return np.linspace(0.0, 1.0, self.n_theta_h) ** 2 * np.pi / 2

    @property
    def theta_d(self) -> Array:
        """(nd,) rad."""
        return np.linspace(0.0, np.pi / 2, self.n_theta_d)

    @property
    def phi_d(self) -> Array:
        """(np,) rad."""
        return np.arange(self.n_phi_d) * np.pi / self.n_phi_d


# Interpolation error of the 59 materials, weighted by both cosines, median of the rms:
# 0.8 % above 6 degrees of elevation, 0.3 % above 12. Grazing light requires many nodes
# in theta_d, while few suffice in phi_d (90 x 90 x 24: 1.3 % or more).
DEFAULT_GRID = TableGrid(90, 120, 16)


def tabulate(
    evaluate: Callable[[Array, Array], Array], grid: TableGrid = DEFAULT_GRID
) -> Table:
    """Values of `evaluate(wi, wo)` -> (..., m) at the nodes, (nh, nd, np, m) float32.

    At some nodes a direction is below the horizon. `evaluate` must be defined there
    too, for example by clamping the cosines.
    """
    # at theta_d = pi/2 the directions are opposite and have no half vector; rounding
    # would choose an arbitrary one
    theta_d = np.minimum(grid.theta_d, np.pi / 2 - 1e-6)
    mesh = np.meshgrid(grid.theta_h, theta_d, grid.phi_d, indexing="ij")
    return np.stack(
        [
            evaluate(*directions(*(a[i] for a in mesh))).astype(np.float32)
            for i in range(grid.n_theta_h)
        ]
    )


def lookup(
    table: AnyArray, theta_h: ArrayLike, theta_d: ArrayLike, phi_d: ArrayLike
) -> Array:
    """Interpolate a table (nh, nd, np, m) trilinearly at angles [rad], (..., m); phi_d
    has period pi.
    """
    nh, nd, n_phi = table.shape[:3]
    half = np.pi / 2
    x = np.sqrt(np.clip(float64(theta_h) / half, 0, 1)) * (nh - 1)
    y = np.clip(float64(theta_d) / half, 0, 1) * (nd - 1)
    z = np.mod(float64(phi_d) / np.pi, 1.0) * n_phi
    x, y, z = np.broadcast_arrays(x, y, z)
    i = np.minimum(x.astype(int), nh - 2)
    j = np.minimum(y.astype(int), nd - 2)
    k = z.astype(int)
    fx = (x - i)[..., None]
    fy = (y - j)[..., None]
    fz = (z - k)[..., None]
    k, k1 = k % n_phi, (k + 1) % n_phi
    total = np.zeros((*x.shape, table.shape[3]))
    for di, wx in ((0, 1 - fx), (1, fx)):
        for dj, wy in ((0, 1 - fy), (1, fy)):
            total += (
                wx
                * wy
                * ((1 - fz) * table[i + di, j + dj, k] + fz * table[i + di, j + dj, k1])
            )
    return total


def brdf_metric(tables: AnyArray, *, weighted_like: AnyArray | None = None) -> Array:
    """Gram matrix (m, m) of the bases over pairs of directions above the horizon.

    Pairs are weighted by their solid angles, both cosines, and the mean of the bases to
    the power -4/3. This amounts to differences in cube-root space, so that highlights
    do not dominate. `weighted_like` are tables on the same grid whose mean is used
    instead.
    """
    grid = TableGrid(*tables.shape[:3])
    means = (tables if weighted_like is None else weighted_like).mean(
        axis=-1, dtype=np.float64
    )
    theta_d, phi_d = np.meshgrid(grid.theta_d, grid.phi_d, indexing="ij")
    gram = np.zeros((tables.shape[-1],) * 2)
    for slab, mean, theta_h in zip(tables, means, grid.theta_h, strict=True):
        wi, wo = directions(theta_h, theta_d, phi_d)
        # dwi dwo = 4 cos(theta_d) dwh dwd (Rusinkiewicz 1998); nodes are uniform in sqrt(theta_h)
        measure = np.sin(theta_h) * np.sqrt(theta_h) * np.sin(theta_d) * np.cos(theta_d)
        measure = measure * np.maximum(wi[..., 2], 0.0) * np.maximum(wo[..., 2], 0.0)
        cells = float64(slab.reshape(-1, tables.shape[-1]))
        weight = measure.ravel() / np.maximum(mean.ravel(), 1e-6) ** (4 / 3)
        gram += cells.T @ (cells * weight[:, None])
    return gram


NODES = 96  # of theta_h in `directional_albedo`


def directional_albedo(
    table: AnyArray, cos_o: ArrayLike, max_theta_h: float = np.pi / 2
) -> Array:
    """Fraction (k, m) of the light from a direction that is reflected, for cosines (k,)
    of that direction, at half vectors within `max_theta_h` [rad] of the normal.

    The integral is over half vectors, on a grid that is quadratic in theta_h to resolve
    narrow lobes.
    """
    t, w = np.polynomial.legendre.leggauss(NODES)
    t = (t + 1) / 2
    w = w / 2
    theta = t**2 * max_theta_h
    phi = (np.arange(2 * NODES) + 0.5) * np.pi / NODES
    a, b = np.meshgrid(theta, phi, indexing="ij")
    h = np.stack([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)], axis=-1)
    rows = []
    for c in np.atleast_1d(float64(cos_o)):
        wo = np.broadcast_to([np.sqrt(max(0.0, 1 - c * c)), 0.0, c], h.shape)
        cos_d = (wo * h).sum(-1)
        wi = 2 * cos_d[..., None] * h - wo
        jacobian = (
            4
            * np.maximum(cos_d, 0)
            * np.sin(a)
            * (2 * w * t * max_theta_h)[:, None]
            * (np.pi / NODES)
        )
        weight = np.where(wi[..., 2] > 0, jacobian * wi[..., 2], 0.0)
        rows.append(
            np.einsum("ij,ijm->m", weight, lookup(table, *half_difference(wi, wo)))
        )
    return np.stack(rows)


def half_widths(table: AnyArray) -> Float64:
    """Half width at half maximum (m,) [rad], as an angle theta_h between the normal and
    the half vector, of BRDFs (nh, nd, np, m) at theta_d of about 20 degrees; pi / 2 for
    BRDFs that nowhere fall below half of their peak, and 0 for black ones.
    """
    grid = TableGrid(*table.shape[:3])
    d = int(np.abs(grid.theta_d - WIDTH_DIFFERENCE).argmin())
    lobe = table[:, d].mean(axis=1, dtype=np.float64)
    below = lobe < lobe[:1] / 2
    first = below.argmax(axis=0)
    theta = grid.theta_h
    columns = np.arange(lobe.shape[1])
    high, low = lobe[first - 1, columns], lobe[first, columns]
    between = (high - lobe[0] / 2) / np.where(high > low, high - low, 1.0)
    width = theta[first - 1] + between * (theta[first] - theta[first - 1])
    width = np.where(below.any(axis=0), width, np.pi / 2)
    return np.where(lobe[0] > 0, width, 0.0)


def pad_to_lanes(table: Table) -> Table:
    """The table with its last axis padded by zeros to a multiple of LANES, as the
    kernels require.
    """
    missing = -table.shape[-1] % LANES
    if not missing:
        return np.ascontiguousarray(table, np.float32)
    return np.concatenate(
        [table, np.zeros((*table.shape[:-1], missing))], axis=-1, dtype=np.float32
    )


def stored_brdf(tables: AnyArray) -> AnyArray:
    """Tables (nh, nd, np, k) of the kernels as `basis_brdf` (k, nh, nd, np + 1): the
    period's end repeats its begin.
    """
    moved = np.moveaxis(tables, -1, 0)
    return np.concatenate([moved, moved[..., :1]], axis=-1)


def brdf_coords(grid: TableGrid) -> dict[str, AnyArray]:
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
