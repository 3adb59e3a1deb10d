"""Roughness of albedo and normals: deviations in a band of wavelengths, which does not
depend on the spacing of the surfels.

The band is the difference of two Gaussians over the surface, by distances in space.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array, vstack
from scipy.spatial import cKDTree
from xarray import Dataset

from skindb.geometry.mesh import lattice_spacing
from skindb.schema import variables
from skindb.types import Array, Index, Mask, finite_rows, float64, lengths, unit

# mm, at which each Gaussian passes half of an amplitude: mottled pigment and folds
WAVELENGTHS = (10.0, 25.0)
SIGMAS = np.sqrt(np.log(2) / 2) / np.pi * np.array(WAVELENGTHS)
# mm; with fewer surfels, texture of shorter wavelengths appears in the band: a contrast of
# virtual faces is up to 5 % too large at 1.7 mm, and twice as large at 3.4 mm
MAX_SPACING = 2.2
STEP = (
    3.0  # mm between the places of the band, below the smaller Gaussian's width of 4.4
)
REACH = 4.0  # standard deviations
PLACES = 500  # whose pairs with surfels are in memory at a time
# length of the mean normal over the larger Gaussian: 16 degrees about it. Where the surface
# bends more, as on a nose, its shape is in the band, and errors of folds are
MIN_FLATNESS = 0.96
MIN_AREA = WAVELENGTHS[1] ** 2  # mm2 of a region, a square of the longest wave
MIN_COMPLETE = 0.8  # of a Gaussian; at the edge of the surface it is one half
NEEDED = (
    variables.DIFFUSE_REFLECTANCE_ERROR,
    variables.SHADING_NORMAL,
    variables.NORMAL_ERROR,
)
DARKEST = 1e-3  # lower limit of R_d; the logarithm of smaller values is mostly noise


class Deviations(NamedTuple):
    """Squared deviations in the band at m surfels: those of log R_d in three channels,
    and of the normal.
    """

    surfel: Index  # (m,)
    area: Array  # (m,) mm2
    square: Array  # (m, 4)
    noise: Array  # (m, 4) the part of the squares that the errors of surfels cause


def band_deviations(fitted: Dataset, trusted: Mask) -> Deviations:
    """Deviations of the trusted surfels (n,), none where these are too far apart, or end
    or bend within the larger Gaussian.

    Noise of a mean with the smaller Gaussian is measured by the errors of the surfels,
    and that of the difference of both follows for noise that is white.
    """
    surfels = np.flatnonzero(trusted)
    part = fitted.isel(surfel=surfels)
    area = part[variables.SURFEL_AREA].values.astype(float)
    is_known = set(NEEDED) <= set(fitted)
    if not (is_known and len(area)) or lattice_spacing(area.mean()) > MAX_SPACING:
        return Deviations(
            np.zeros(0, np.int64), *np.zeros((1, 0)), *np.zeros((2, 0, 4))
        )
    position = part[variables.SURFEL_POSITION].values.astype(float)
    colour = np.maximum(part[variables.DIFFUSE_REFLECTANCE].values, DARKEST)
    normal = part[variables.SHADING_NORMAL].values
    error = np.column_stack(
        [
            part[variables.DIFFUSE_REFLECTANCE_ERROR].values / colour,
            np.radians(part[variables.NORMAL_ERROR].values),
        ]
    )
    cell = np.floor(position / STEP).astype(np.int64)
    node, member = np.unique(cell, axis=0, return_index=True, return_inverse=True)[1:]
    node_area = float64(np.bincount(member.ravel(), area))
    width = np.sqrt(SIGMAS[1] ** 2 - SIGMAS[0] ** 2)
    fine, _ = _gaussian(position[node], position, area, SIGMAS[0])
    coarse, complete = _gaussian(position[node], position[node], node_area, width)
    log = fine @ np.log(colour)
    smooth = unit(fine @ normal)
    mean_normal = coarse @ smooth
    turn = lengths(smooth - unit(mean_normal))
    square = np.column_stack([log - coarse @ log, turn]) ** 2
    fine.data **= 2
    ratio = (SIGMAS[0] / SIGMAS[1]) ** 2
    noise = (1 + ratio - 4 * ratio / (1 + ratio)) * (fine @ error**2)
    inside = (complete > MIN_COMPLETE) & (lengths(mean_normal) > MIN_FLATNESS)
    inside &= finite_rows(noise)  # errors of some surfels may be unknown
    return Deviations(
        surfels[node][inside], node_area[inside], square[inside], noise[inside]
    )


def _gaussian(
    places: Array, position: Array, area: Array, width: float
) -> tuple[csr_array, Array]:
    """Matrix (n, m) of Gaussian means at places (n, 3) mm over points with areas, and the
    fraction (n,) of each Gaussian that has points.
    """
    tree = cKDTree(position)
    parts = []
    # of some places at a time: a fine scan has millions of pairs
    for part in np.array_split(places, len(places) // PLACES + 1):
        near = csr_array(
            cKDTree(part).sparse_distance_matrix(
                tree, REACH * width, output_type="coo_matrix"
            )
        )
        near.data = area[near.indices] * np.exp(-0.5 * (near.data / width) ** 2)
        parts.append(near)
    matrix = csr_array(vstack(parts))
    total = np.asarray(matrix.sum(axis=1))
    matrix.data /= np.repeat(total, np.diff(matrix.indptr))
    return matrix, total / (2 * np.pi * width**2)
