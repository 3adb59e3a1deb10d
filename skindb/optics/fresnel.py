"""Fresnel reflection at the smooth boundary of air and skin (Weyrich et al. 2005, eq. 1 and 2)."""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from skindb.types import Array, float64


def fresnel_reflectance(cos_i: ArrayLike, eta: float) -> Array:
    """Exact unpolarised reflectance F_r of a dielectric boundary.

    Parameters
    ----------
    cos_i
        Cosine of the angle to the normal, in [0, 1].
    eta
        Index of refraction behind the boundary over that in front of it. Total internal
        reflection gives F_r = 1.
    """
    c = np.clip(np.abs(float64(cos_i)), 0.0, 1.0)
    square = eta * eta - 1.0 + c * c
    g = np.sqrt(np.maximum(square, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        across = ((g - c) / (g + c)) ** 2
        along = ((c * (g + c) - 1.0) / (c * (g - c) + 1.0)) ** 2
    # eta = 1 at grazing incidence is 0/0; without a boundary nothing is reflected
    reflected = np.where(
        g + c > 0.0, 0.5 * across * (1.0 + along), 0.0 if eta == 1.0 else 1.0
    )
    return np.where(square > 0.0, reflected, reflected if eta == 1.0 else 1.0)


def fresnel_transmittance(cos_i: ArrayLike, eta: float) -> Array:
    """F_t = 1 - F_r."""
    return 1.0 - fresnel_reflectance(cos_i, eta)


def circular_reversal(cos_i: ArrayLike, eta: float) -> Array:
    """Degree to which the reflection reverses the handedness of circularly polarised light:
    -2 r_s r_p / (r_s^2 + r_p^2) of the amplitudes.

    It is 1 along the normal, 0 at the angle of Brewster, where the reflected light is
    linearly polarised, and -1 at grazing incidence. Parameters as in `fresnel_reflectance`.
    """
    c = np.clip(np.abs(float64(cos_i)), 0.0, 1.0)
    g = np.sqrt(np.maximum(eta * eta - 1.0 + c * c, 0.0))
    ratio = (c * (g + c) - 1.0) / (c * (g - c) + 1.0)  # r_p / -r_s
    return 2.0 * ratio / (1.0 + ratio * ratio)


@lru_cache(maxsize=32)
def internal_diffuse_reflectance(eta: float) -> float:
    """F_dr, the cosine-weighted mean of F_r from inside, by quadrature (relative error
    below 1e-12).
    """
    low = float(np.sqrt(max(1.0 - 1.0 / eta**2, 0.0)))
    # below the critical cosine all light is reflected; above, c = low + (1 - low) t^2
    # removes the square-root kink
    x, w = np.polynomial.legendre.leggauss(200)
    t = (x + 1.0) / 2.0
    wt = w / 2.0
    c = low + (1.0 - low) * t**2
    passed = fresnel_reflectance(c, 1.0 / eta) * 2.0 * c * 2.0 * (1.0 - low) * t
    return float(low**2 + (passed * wt).sum())


def boundary_factor(eta: float) -> float:
    """A = (1 + F_dr) / (1 - F_dr)."""
    inside = internal_diffuse_reflectance(eta)
    return (1.0 + inside) / (1.0 - inside)
