"""Bounds on the error of mixtures of BRDFs whose tables are reduced to a linear space
of few dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skindb.optics.brdf_table import Table, TableGrid, brdf_metric
from skindb.types import Array

FRANK_WOLFE_STEPS = 200  # each step gives a valid bound; 500 steps lower it by 1 %
MIN_COSINE_SAMPLES = 0.1  # cosine to light and camera above which fits use samples


@dataclass(frozen=True)
class Truncation:
    """Bounds on the error of any non-negative mixture, relative to the mixture."""

    # over pairs of directions, in cube-root space (the metric of `brdf_metric`)
    rms: float
    # at the worst pair of directions; attained by a mixture of a single table
    worst: float


def truncation_bound(
    table: Table, reduced: Table, lift: Array, *, elevation: float = MIN_COSINE_SAMPLES
) -> Truncation:
    """Bound the error of mixtures sum_j x_j b_j, x >= 0, that are formed from reduced tables.

    Parameters
    ----------
    table
        (nh, nd, np, m) b_j >= 0 on the nodes of a `TableGrid` [sr^-1].
    reduced, lift
        (nh, nd, np, r) and (r, m) from `reduce_dictionary`.
    elevation
        Cosine that both directions of a pair exceed, for `worst`.

    Notes
    -----
    Let e_j = b_j - (reduced lift)_j. The ratio of two sums over j is at most the
    largest ratio of their terms. At a pair of directions, |sum x_j e_j| / sum x_j b_j
    <= max_j |e_j| / b_j, and interpolation preserves this, being a mean with
    non-negative weights. In a norm, |sum x_j b_j| >= sum x_j <u, b_j> for every unit
    vector u, so the ratio is at most max_j |e_j| / <u, b_j>. The best u points to the
    point nearest to 0 of the simplex of all b_j / |e_j|, which the method of Frank and
    Wolfe approaches; every step gives a bound. The residual |M x - R| of a fit at its
    minimum then changes by at most worst (|M x| + |M x'|), where x is found with the
    tables and x' with the reduced ones.
    """
    error = (table - reduced @ lift).astype(np.float32)
    if not error.any():
        return Truncation(0.0, 0.0)
    used = nodes_above(TableGrid(*table.shape[:3]), elevation)
    value = table[used]
    off = np.abs(error[used])
    ratio = np.divide(
        off,
        value,
        out=np.where(off > 0, np.inf, 0.0).astype(off.dtype),
        where=value > 0,
    )
    length = np.sqrt(np.diag(brdf_metric(error, weighted_like=table)))
    return Truncation(
        _largest_ratio(brdf_metric(table), length), float(ratio.max(initial=0.0))
    )


def nodes_above(grid: TableGrid, elevation: float) -> NDArray[np.bool_]:
    """(nh, nd, np) nodes of all cells that contain a pair of directions whose cosines
    both exceed `elevation`.

    The smaller cosine is cos(theta_h) cos(theta_d) - sin(theta_h) sin(theta_d)
    |cos(phi_d)|. It decreases with theta_h, theta_d and |cos(phi_d)|, so it is largest
    in a corner of a cell, or where phi_d is pi/2.
    """
    slope = np.abs(np.cos(np.append(grid.phi_d, np.pi)))
    lean = np.minimum(slope[:-1], slope[1:])
    lean[(grid.phi_d < np.pi / 2) & (grid.phi_d + np.pi / grid.n_phi_d > np.pi / 2)] = (
        0.0
    )
    h = grid.theta_h[:-1, None, None]
    d = grid.theta_d[None, :-1, None]
    cells = np.cos(h) * np.cos(d) - np.sin(h) * np.sin(d) * lean > elevation
    nodes = np.zeros((grid.n_theta_h, grid.n_theta_d, grid.n_phi_d), np.bool_)
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        nodes[i : i + cells.shape[0], j : j + cells.shape[1]] |= cells | np.roll(
            cells, 1, axis=2
        )
    return nodes


def _largest_ratio(gram: Array, length: Array) -> float:
    """Upper bound of sum x_j length_j / |sum x_j b_j| over x >= 0; the Gram matrix (m,
    m) of the b_j is >= 0.
    """
    wrong = length > 0
    if not wrong.any():
        return 0.0
    scaled = gram[np.ix_(wrong, wrong)] / np.outer(length[wrong], length[wrong])
    point = np.zeros(len(scaled))
    point[np.argmin(np.diag(scaled))] = 1.0
    reached = 0.0
    for _ in range(FRANK_WOLFE_STEPS):
        inner = scaled @ point
        reached = max(reached, float(inner.min() / np.sqrt(point @ inner)))
        way = -point
        way[np.argmin(inner)] += 1.0
        curvature = way @ scaled @ way
        if curvature <= 0:
            break
        point = point + float(np.clip(-(way @ inner) / curvature, 0.0, 1.0)) * way
    return 1.0 / reached if reached > 0 else float("inf")
