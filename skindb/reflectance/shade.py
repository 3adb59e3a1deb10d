"""Radiance of many points under one disc light."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from skindb.reflectance import _shade_kernels
from skindb.types import Array


def shade_points(
    position: Array,
    normal: Array,
    view: Array,
    diffuse: Array,
    weight: Array,
    table: NDArray[np.float32],
    *,
    lamp: Array,
    lit: NDArray[np.float32],
    axis: Array,
    falloff: float,
    eta: float,
) -> NDArray[np.float32]:
    """Radiance per radiant intensity: the diffuse term plus the weighted measured BRDFs
    (eq. 1, 3, 8).

        sum over lamp points of lit cos(theta_i) / d^2 falloff (F_t(i) F_t(o) R_d / pi +
        sum_k w_k b_k) / points

    Parameters
    ----------
    position, normal, view
        (n, 3) positions [mm]; unit normals; unit directions towards the camera.
    diffuse
        (n, 3) diffuse reflectance R_d; zeros omit the diffuse term.
    weight, table
        (n, k) weights, and (nh, nd, np, k) tables [sr^-1] on nodes uniform in
        sqrt(theta_h), theta_d and the period pi of phi_d; k = 0 omits the surface term.
    lamp
        (n, p, 3) points [mm] that represent equal parts of the light's disc.
    lit
        (n, p) visible fraction, 0 to 1, of the part of the disc that each lamp point represents.
    axis, falloff
        (3,) unit direction in which the light shines, and exponent n of its fall-off cos^n.
    eta
        Refractive index of the surface for the diffuse term.

    Returns
    -------
    ndarray
        (n, 3) float32, sr^-1 mm^-2: radiance per radiant intensity. Zero where the
        normal faces away from the light or the camera.

    Notes
    -----
    Measured BRDFs already contain a Fresnel term, so F_r of eq. 2 is not applied to
    them (Weyrich et al. 2005).
    """
    out = np.empty((len(position), 3), np.float32)
    _shade_kernels.shade(
        *(np.ascontiguousarray(x, np.float64) for x in (position, normal, view)),
        *(np.ascontiguousarray(x, np.float32) for x in (diffuse, weight, table)),
        np.ascontiguousarray(lamp, np.float64),
        np.ascontiguousarray(lit, np.float32),
        np.ascontiguousarray(axis, np.float64),
        float(falloff),
        float(eta),
        weight.shape[1] > 0,
        out,
    )
    return out
