"""Translucency for programs without the dipole: mean free paths of random walks, and light
that passes through thin parts of a face, such as an ear.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.geometry.rays import RAY_OFFSET_MM, RayScene
from skindb.optics.diffusion import (
    dipole_power_beyond,
    dipole_s,
    scattering_coefficients,
)

Float = NDArray[np.floating[Any]]
# mean free path of the walk over that of the dipole, s / sigma_tr, is this constant
# plus this factor times R_d. Fitted to the edge of a shadow for R_d from 0.02 to 0.9
# and an index of 1.3, within 3 %; within 20 % for an index of 1.45
CONSTANT = 1.7
FACTOR = 0.4


def mean_free_path(diffuse: Float, sigma_tr: Float, *, eta: float) -> Float:
    """Mean free path [mm] with which a random walk spreads light as far as the dipole
    with R_d and sigma_tr.

    The walk is that of OpenPBR and of similar renderers: isotropic scattering in a
    half-space without a boundary, whose albedo is chosen such that R_d of the light
    returns. It has another mean free path than the dipole, because light that has
    entered is reflected at the boundary of the dipole, and because the dipole has no
    light near its entry.

    Parameters
    ----------
    diffuse, sigma_tr
        R_d, and mm^-1, of one shape.
    eta
        Refractive index of the skin.
    """
    s, _ = dipole_s(diffuse, eta=eta)
    return np.asarray(
        (CONSTANT + FACTOR * np.asarray(diffuse, np.float64)) * s / sigma_tr
    )


def thickness(position: Float, normal: Float, triangles: NDArray[np.integer]) -> Float:
    """Distance [mm] (n,) from each vertex straight inwards to where the mesh ends;
    infinity where it does not.

    A ray that first meets a triangle from its outer side has left the body through an
    opening of the scan: there, too, the thickness counts as infinite.

    Parameters
    ----------
    position, normal
        (n, 3) mm and (n, 3) unit normals that point outwards.
    triangles
        (f, 3), counter-clockwise seen from outside.
    """
    face, _, distance = RayScene(position, triangles).first_hit(
        position - RAY_OFFSET_MM * normal, -normal
    )
    corner = position[triangles[np.maximum(face, 0)]]
    outwards = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    leaves = (face >= 0) & (np.einsum("nc,nc->n", outwards, normal) < 0)
    return np.where(leaves, distance + RAY_OFFSET_MM, np.inf)


def transmitted_fraction(
    distance: Float, diffuse: Float, sigma_tr: Float, *, eta: float
) -> Float:
    """Fraction (n, 3) of the diffuse light at a surface that comes from the other side,
    if both are lit evenly.

    The light of the other side is the dipole's power beyond the thickness, and both
    sides together give R_d, as in `skindb.optics.dipole_tree.subsurface_exitance`.

    Parameters
    ----------
    distance
        (n,) thickness in mm; infinity gives 0.
    diffuse, sigma_tr
        (n, 3) R_d, and mm^-1. Where sigma_tr is not known the fraction is 0.
    eta
        Refractive index of the skin.
    """
    finite = np.isfinite(sigma_tr) & np.isfinite(distance)[:, None]
    s, _ = dipole_s(diffuse, eta=eta)
    absorption, scattering = scattering_coefficients(s, np.where(finite, sigma_tr, 1.0))
    beyond, here = (
        dipole_power_beyond(depth, absorption, scattering, eta=eta)
        for depth in (np.where(finite, distance[:, None], 0.0), 0.0)
    )
    return np.where(
        finite & (here > 0), beyond / np.maximum(beyond + here, 1e-300), 0.0
    )
