"""Separation of the light that a surfel scatters under its surface from the light that
the surface reflects, without a model fitted to the surface.

Light from the surface is white, so that differences between channels give the
differences of R_d by a robust slope. What is common to the channels is split by
non-negative least squares between the diffuse shape cos(theta_i) F_t F_t and six
microfacet lobes without diffuse part.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from skindb.reflectance._separation_kernels import separate_block
from skindb.reflectance.block import kernel_block
from skindb.reflectance.dictionary import abc_parameters, evaluate_abc
from skindb.reflectance.model import Block
from skindb.reflectance.tables import DEFAULT_GRID, TableGrid, tabulate
from skindb.types import Array, Float32, Float64, float64

# The six most different embedded materials, from narrow to nearly diffuse. The width of
# the broadest one trades two errors: broad lobes take light from R_d, and without them
# R_d includes the even reflection of the surface. These balance the two on captures
# with and without such reflection (notes of `estimate_diffuse_reflectance`).
LOBES = (
    "black-fabric",
    "green-plastic",
    "beige-fabric",
    "white-paint",
    "pearl-paint",
    "fruitwood-241",
)


def separate_diffuse(
    block: Block, turns: Float64, *, eta: float
) -> tuple[Array, Array, Array, Array]:
    """R_d of every surfel, and its errors.

    Parameters
    ----------
    block
        Samples of n surfels; their `diffuse` is not used.
    turns
        (n, 2) standard errors of the normal about each of two axes [rad], for either of
        the errors; 0 where the normal is exact.
    eta
        Refractive index of F_t.

    Returns
    -------
    reflectance, error, shared
        (n, 3) R_d, its standard error for independent samples, and that for errors that
        the samples of a light or of a camera have in common; NaN for too few samples.
    gloss
        (n,) mean factor by which polarisers changed the surface term of the samples that
        were used, 1 without polarisers: where there are enough, those behind crossed ones.
    """
    n = len(block.position)
    value, error, shared = np.full((3, n, 3), np.nan)
    gloss = np.ones(n)
    table = _lobe_table()
    separate_block(
        kernel_block(block), turns, table, float(eta), value, error, shared, gloss
    )
    return value, error, shared, gloss


@cache
def surface_lobes() -> tuple[Float32, TableGrid]:
    """Tables (nh, nd, np, 6) of `LOBES` without their diffuse part, and their grid."""
    rows = np.array([abc_parameters()[name] for name in LOBES], np.float64)
    rows[:, :3] = 0
    return tabulate(
        lambda wi, wo: evaluate_abc(rows, wi, wo), DEFAULT_GRID
    ), DEFAULT_GRID


@cache
def _lobe_table() -> Float32:
    """Tables (nh, nd, np, 16) for the kernel: six lobes, two zeros, their derivatives
    by theta_h [rad], two zeros.
    """
    table, grid = surface_lobes()
    steep = np.gradient(float64(table), grid.theta_h, axis=0)
    gap = np.zeros((*table.shape[:3], 2))
    joined = np.ascontiguousarray(
        np.concatenate([table, gap, steep, gap], axis=-1), np.float32
    )
    # as for all tables, so that kernels are compiled once
    joined.flags.writeable = False
    return joined
