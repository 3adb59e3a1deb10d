"""Resampling of measured tables to the default grid: holes, interpolation and its error."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from skindb.optics.angles import half_difference
from skindb.reflectance.dictionary import Origin, sample_pairs, weighted_error
from skindb.reflectance.tables import DEFAULT_GRID, Table, lookup
from skindb.types import Array

Nodes = tuple[Array, Array, Array]  # theta_h, theta_d, phi_d [rad]


def to_default_grid(
    brdf: Array, nodes: Nodes, check: str, sha256: str
) -> tuple[Table, Origin]:
    """One material (theta_h, theta_d, phi_d) on the default grid, and its origin with
    the error of resampling.
    """
    table = resample(fill_holes(brdf), nodes)
    return table, Origin(
        check, sha256, hole_fraction(brdf, nodes), _resampling_error(brdf, nodes, table)
    )


def hole_fraction(brdf: Array, nodes: Nodes) -> float:
    """Fraction of NaN among the nodes with both directions above the horizon."""
    theta_h, theta_d, phi_d = np.ix_(*nodes)
    # cosine
    smaller = np.cos(theta_h) * np.cos(theta_d) - np.abs(
        np.sin(theta_h) * np.sin(theta_d) * np.cos(phi_d)
    )
    return float(np.isnan(brdf[smaller > 1e-9]).mean())


def resample(brdf: Array, nodes: Nodes) -> Table:
    """Interpolate values (nh, nd, np) to the default grid, linearly in sqrt(theta_h),
    theta_d and phi_d.
    """
    grid = DEFAULT_GRID
    same = zip(nodes, (grid.theta_h, grid.theta_d, grid.phi_d), strict=True)
    if all(len(a) == len(b) and np.allclose(a, b, rtol=0, atol=1e-6) for a, b in same):
        return brdf.astype(np.float32)
    phi, column = _periodic_nodes(nodes[2])
    table = np.einsum(
        "kp,hdp->hdk", _linear_matrix(phi, grid.phi_d), brdf[:, :, column]
    )
    table = np.einsum("jd,hdk->hjk", _linear_matrix(nodes[1], grid.theta_d), table)
    table = np.einsum(
        "ih,hjk->ijk", _linear_matrix(np.sqrt(nodes[0]), np.sqrt(grid.theta_h)), table
    )
    # phi_d is undefined where the half vector is the normal
    table[0] = table[0].mean(axis=-1, keepdims=True)
    return table.astype(np.float32)


def _periodic_nodes(phi_d: Array) -> tuple[Array, NDArray[np.int64]]:
    """Nodes with one more on both sides of their period pi, and the column of each."""
    n = len(phi_d)
    return np.concatenate([[phi_d[-1] - np.pi], phi_d, [phi_d[0] + np.pi]]), np.arange(
        -1, n + 1
    ) % n


def _linear_matrix(nodes: Array, at: Array) -> Array:
    """Matrix (len(at), len(nodes)) of linear interpolation; constant beyond the ends."""
    return np.stack(
        [np.interp(at, nodes, column) for column in np.eye(len(nodes))], axis=1
    )


def _resampling_error(brdf: Array, nodes: Nodes, table: Table) -> float:
    """Error of the table against trilinear interpolation of the measured nodes, where
    all eight were measured.
    """
    wi, wo = sample_pairs()
    th, td, pd = half_difference(wi, wo)
    phi, column = _periodic_nodes(nodes[2])
    axes = (np.sqrt(nodes[0]), nodes[1], phi)
    values = RegularGridInterpolator(axes, brdf[:, :, column], bounds_error=False)(
        np.stack([np.sqrt(th), td, pd], -1)
    )
    finite = np.isfinite(values)
    if not finite.any():
        return float("nan")
    values_of_table = lookup(table[..., None], th[finite], td[finite], pd[finite])
    return float(
        weighted_error(values_of_table, values[finite, None], wi[finite], wo[finite])[0]
    )


def fill_holes(brdf: Array) -> Array:
    """Fill holes of (nh, nd, np), which are NaN: below the horizon or unmeasured.

    They take the value of the nearest smaller theta_d, else of the nearest larger
    theta_d, else of the neighbour in theta_h, else in phi_d. Zeros instead would darken
    adjacent cells by interpolation.
    """
    for axis, backwards in (
        (1, False),
        (1, True),
        (0, False),
        (0, True),
        (2, False),
        (2, True),
    ):
        turned = np.flip(brdf, axis) if backwards else brdf
        place = np.arange(turned.shape[axis]).reshape(
            [-1 if a == axis else 1 for a in range(3)]
        )
        nearest = np.maximum.accumulate(
            np.where(np.isfinite(turned), place, 0), axis=axis
        )
        turned = np.take_along_axis(turned, nearest, axis=axis)
        brdf = np.flip(turned, axis) if backwards else turned
    return np.asarray(brdf)
