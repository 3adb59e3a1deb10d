"""The dictionary of measured BRDFs a surface is mixed from: 59 embedded materials, or a user's MERL files."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.optics.abc_low2012 import PARAMETERS
from skindb.optics.angles import directions, half_difference
from skindb.optics.brdf_table import DEFAULT_GRID, Table, TableGrid, tabulate
from skindb.optics.fresnel import fresnel_reflectance
from skindb.optics.merl import read_merl

Array = NDArray[np.floating[Any]]
HORIZON = 0.03  # cosines are kept above this: cells below the horizon continue the last value above it


@dataclass(frozen=True)
class Dictionary:
    """Monochrome (mean of RGB), non-negative tables (nh, nd, np, m) in sr^-1, one per material."""

    names: tuple[str, ...]
    table: Table
    grid: TableGrid
    source: str
    disc_angular_radius: float = 0.0  # rad; 0 where the tables are not convolved


def evaluate_abc(parameters: Array, wi: Array, wo: Array) -> Array:
    """ABC microfacet BRDFs (..., m) for rows (m, 9) of `abc_low2012`, mean of RGB, local frame (Loew et al. 2012).

    f = kd/pi + A F(theta_d) (1 + B (1 - cos theta_h))^-C G / (pi cos_i cos_o), G of V grooves.
    """
    cos_i, cos_o = np.maximum(wi[..., 2], HORIZON), np.maximum(wo[..., 2], HORIZON)
    theta_h, theta_d, _ = half_difference(wi, wo)
    cos_h, cos_d = np.maximum(np.cos(theta_h), 1e-6), np.maximum(np.cos(theta_d), HORIZON)
    masking = np.minimum(1.0, 2 * cos_h * np.minimum(cos_i, cos_o) / cos_d) / (np.pi * cos_i * cos_o)
    out = np.empty((*cos_i.shape, len(parameters)))
    lean = 2.0 * np.sin(theta_h / 2) ** 2  # 1 - cos theta_h without cancellation
    for m, row in enumerate(parameters):
        kd, scale, b, c, index = row[:3].mean(), row[3:6].mean(), row[6], row[7], row[8]
        lobe = np.exp(-c * np.log1p(b * lean))
        out[..., m] = kd / np.pi + scale * fresnel_reflectance(cos_d, float(index)) * lobe * masking
    return out


@cache
def embedded_dictionary() -> Dictionary:
    """The 59 dielectrics of `abc_low2012` on the default grid."""
    rows = np.array(list(PARAMETERS.values()))
    table = tabulate(lambda wi, wo: evaluate_abc(rows, wi, wo), DEFAULT_GRID)
    table.setflags(write=False)
    return Dictionary(tuple(PARAMETERS), table, DEFAULT_GRID, "ABC parameters of Loew et al. 2012")


def read_merl_folder(path: str | Path) -> Dictionary:
    """Every `*.binary` of a folder, in the order of the names, resampled to the default grid.

    Cells without a measurement continue the value at the next smaller theta_d; all damaged files are reported together.
    """
    files = sorted(Path(path).glob("*.binary"))
    if not files:
        raise InputError(
            Fault(str(path), "a folder of measured BRDFs holds MERL .binary files", "none", "give their folder")
        )
    tables: list[Table] = []
    faults: list[Fault] = []
    for file in files:
        try:
            tables.append(tabulate(_merl_evaluator(file), DEFAULT_GRID))
        except InputError as error:
            faults.extend(error.faults)
    if faults:
        raise InputError(faults)
    return Dictionary(
        tuple(f.stem for f in files), np.concatenate(tables, axis=-1), DEFAULT_GRID, Path(path).resolve().name
    )


def _merl_evaluator(file: Path) -> Callable[[Array, Array], Array]:
    table, _ = read_merl(file)
    mean = _continue_holes(table.mean(axis=-1))

    def evaluate(wi: Array, wo: Array) -> Array:
        # bins of MERL: centres at (i + 1/2), theta_h quadratic
        th, td, pd = half_difference(wi, wo)
        x = np.clip(np.sqrt(th / (np.pi / 2)) * 90 - 0.5, 0, 89)
        y, z = np.clip(td / (np.pi / 2) * 90 - 0.5, 0, 89), pd / np.pi * 180 - 0.5
        i, j, k = np.minimum(x.astype(int), 88), np.minimum(y.astype(int), 88), np.floor(z).astype(int)
        fx, fy, fz = x - i, y - j, z - k
        out = np.zeros(x.shape)
        for corner in np.ndindex(2, 2, 2):
            w = np.prod([f if c else 1 - f for c, f in zip(corner, (fx, fy, fz), strict=True)], axis=0)
            out += w * mean[i + corner[0], j + corner[1], (k + corner[2]) % 180]
        return out[..., None]

    return evaluate


def _continue_holes(mean: Array) -> Array:
    """Holes (NaN: below the horizon, unmeasured) of (90, 90, 180) take the value of the nearest smaller theta_d.

    Where there is none, that of the nearest larger one, then of the neighbour in theta_h; left at 0 they would darken
    the cells beside them by interpolation.
    """
    for axis, backwards in ((1, False), (1, True), (0, False), (0, True)):
        turned = np.flip(mean, axis) if backwards else mean
        place = np.arange(turned.shape[axis]).reshape([-1 if a == axis else 1 for a in range(3)])
        last = np.maximum.accumulate(np.where(np.isfinite(turned), place, 0), axis=axis)
        turned = np.take_along_axis(turned, last, axis=axis)
        mean = np.flip(turned, axis) if backwards else turned
    return np.asarray(mean)


@cache
def _disc_rule(rings: int, spokes: int) -> tuple[Array, Array]:
    """Points (q, 2) of the unit disc and weights (q,): Gauss in the squared radius, uniform in the angle."""
    x, w = np.polynomial.legendre.leggauss(rings)
    radius = np.sqrt((x + 1) / 2)
    angle = 2 * np.pi * (np.arange(spokes)[None] + 0.5 * (np.arange(rings)[:, None] % 2)) / spokes
    points = np.stack([radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle)], axis=-1)
    return points.reshape(-1, 2), np.repeat(w / 2 / spokes, spokes)


def convolve_disc(dictionary: Dictionary, angular_radius: float, *, rings: int = 4, spokes: int = 12) -> Dictionary:
    """Tables averaged over the disc of the light (Weyrich et al. 2005, section 7).

    Parameters
    ----------
    dictionary
        Tables of point lights.
    angular_radius
        Of the disc as seen from the surface [rad].
    rings, spokes
        Gauss points in the squared radius and points per ring. 3 x 8 halves the time and doubles the worst error (lobes
        as narrow as the disc: 2.6 to 5.9 % rms).

    Notes
    -----
    Averaging over one direction breaks reciprocity; the tables have period pi in phi_d, so the average is taken over
    the disc around either direction, which restores it.
    """
    if angular_radius <= 0:
        return dictionary
    from skindb.optics import _row_kernels  # compiled at first use only

    points, weights = _disc_rule(rings, spokes)
    grid, disc = dictionary.grid, points * np.tan(angular_radius)
    out = np.zeros_like(dictionary.table)

    def fill(slab: int) -> None:
        th, td, pd = np.meshgrid(grid.theta_h[slab], grid.theta_d, grid.phi_d, indexing="ij")
        nodes = out[slab].reshape(-1, out.shape[-1])
        for turn in (0.0, np.pi):  # phi_d + pi is the pair with its directions exchanged
            wi, wo = directions(th.ravel(), td.ravel(), pd.ravel() + turn)
            _row_kernels.average_disc(dictionary.table, wi, wo, disc, weights / 2, nodes)

    # plain threads: the kernel releases the GIL, and numba's own would clash with dask's and with forks
    with ThreadPoolExecutor() as pool:
        list(pool.map(fill, range(grid.n_theta_h)))
    return replace(dictionary, table=out, disc_angular_radius=angular_radius)
