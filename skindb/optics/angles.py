"""Half and difference angles of a pair of directions (Rusinkiewicz 1998)."""

import numpy as np
from numpy.typing import ArrayLike

from skindb.types import Array, float64, lengths, unit


def half_difference(
    wi: ArrayLike, wo: ArrayLike, normal: ArrayLike | None = None
) -> tuple[Array, Array, Array]:
    """Angles (theta_h, theta_d, phi_d) of unit directions.

    Parameters
    ----------
    wi, wo
        (..., 3) unit vectors that point away from the surface, to the light and to the camera.
    normal
        (..., 3) unit normals; default +z of the local frame.

    Returns
    -------
    tuple
        theta_h, theta_d in [0, pi/2] and phi_d in [0, pi), as isotropic reciprocal
        BRDFs have period pi. phi_d is 0 where the half vector is the normal.
    """
    wi = float64(wi)
    wo = float64(wo)
    n = np.broadcast_to(
        np.array([0.0, 0.0, 1.0]) if normal is None else float64(normal),
        wi.shape,
    )
    h = wi + wo
    h = unit(h)
    # sines from cross products, because an arc cosine is too inaccurate for narrow lobes
    b = np.cross(n, h)
    t = np.cross(b, h)
    sin_h = lengths(b)
    sin_d = lengths(np.cross(h, wi))
    theta_h = np.arctan2(sin_h, np.maximum((n * h).sum(-1), 0.0))
    theta_d = np.arctan2(sin_d, np.maximum((h * wi).sum(-1), 0.0))
    phi = np.where(sin_h > 1e-7, np.arctan2((b * wi).sum(-1), (t * wi).sum(-1)), 0.0)
    phi = np.where(phi < 0.0, phi + np.pi, phi)
    return theta_h, theta_d, np.where(phi >= np.pi, 0.0, phi)


def directions(
    theta_h: ArrayLike, theta_d: ArrayLike, phi_d: ArrayLike
) -> tuple[Array, Array]:
    """Unit directions (wi, wo), each (..., 3), in the local frame (normal +z, half
    vector in the xz plane).
    """
    th, td, pd = np.broadcast_arrays(*(float64(x) for x in (theta_h, theta_d, phi_d)))
    dx = np.sin(td) * np.cos(pd)
    dy = np.sin(td) * np.sin(pd)
    dz = np.cos(td)
    c = np.cos(th)
    s = np.sin(th)
    wi = np.stack([c * dx + s * dz, dy, -s * dx + c * dz], axis=-1)
    wo = np.stack([-c * dx + s * dz, -dy, s * dx + c * dz], axis=-1)
    return wi, wo
