"""Light that passes through thin parts of a face, such as an ear, for materials without
transport under the skin.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from skindb.geometry.rays import RAY_OFFSET_MM, RayScene
from skindb.optics.diffuse import dipole_s, scattering_coefficients
from skindb.optics.dipole import dipole_power_beyond

Float = NDArray[np.floating]


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
    known = np.isfinite(sigma_tr) & np.isfinite(distance)[:, None]
    s, _ = dipole_s(diffuse, eta=eta)
    absorption, scattering = scattering_coefficients(s, np.where(known, sigma_tr, 1.0))
    there, here = (
        dipole_power_beyond(where, absorption, scattering, eta=eta)
        for where in (np.where(known, distance[:, None], 0.0), 0.0)
    )
    return np.where(known & (here > 0), there / np.maximum(there + here, 1e-300), 0.0)
