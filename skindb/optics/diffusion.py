"""Diffusion in a semi-infinite medium: diffuse reflectance and its inverse (Weyrich et
al. 2005, eq. 5), and the reflectance profile of the dipole (Jensen et al. 2001; Weyrich
et al. 2005, section 8 and eq. 9).

The reflectance uses s = sqrt(3 (1 - alpha')), which is also the stored variable, because alpha'
near 1 suffers from cancellation.
"""

import numpy as np
from numpy.typing import ArrayLike

from skindb.optics.fresnel import boundary_factor
from skindb.types import Array, Mask, float64

S_MAX = float(np.sqrt(3.0))
# range of R_d that is inverted; values outside are clamped
MIN_R_D = 1e-6
MAX_R_D = 1.0 - 1e-9
# lower limit of s for scattering coefficients, as sigma_t' = sigma_tr / s diverges
S_FLOOR = 1e-4


def diffuse_reflectance(s: ArrayLike, *, eta: float) -> Array:
    """R_d = alpha'/2 (1 + exp(-4/3 A s)) exp(-s) for s in [0, sqrt 3]."""
    s = float64(s)
    albedo = 1.0 - s * s / 3.0
    far = np.exp(-_steepness(eta) * s)
    return albedo / 2.0 * (1.0 + far) * np.exp(-s)


def dipole_s(diffuse: ArrayLike, *, eta: float) -> tuple[Array, Mask]:
    """Inverse of `diffuse_reflectance`.

    Parameters
    ----------
    diffuse
        R_d, any shape; NaN stays NaN.
    eta
        Relative index of refraction.

    Returns
    -------
    s, clamped
        s with a relative error below 1e-12 for R_d in [1e-6, 1 - 1e-9], and a mask of
        values that were outside this range and clamped.
    """
    value = float64(diffuse)
    clamped = (value < MIN_R_D) | (value > MAX_R_D)
    absorbed = 1.0 - np.clip(value, MIN_R_D, MAX_R_D)
    low = np.zeros(value.shape)
    high = np.full(value.shape, S_MAX)
    for _ in range(8):  # bisection until Newton's method converges
        mid = (low + high) / 2.0
        below = _absorbed(mid, eta) < absorbed
        low = np.where(below, mid, low)
        high = np.where(below, high, mid)
    s = (low + high) / 2.0
    for _ in range(5):
        s = np.clip(s - (_absorbed(s, eta) - absorbed) / _slope(s, eta), low, high)
    return np.where(np.isnan(value), np.nan, s), clamped


def reduced_albedo(s: ArrayLike) -> Array:
    """Alpha' = 1 - s^2 / 3."""
    return 1.0 - np.square(float64(s)) / 3.0


def scattering_coefficients(s: ArrayLike, sigma_tr: ArrayLike) -> tuple[Array, Array]:
    """(sigma_a, sigma_s') in mm^-1 from s and sigma_tr (Weyrich et al. 2005, section
    9); s is floored at 1e-4.
    """
    s = np.maximum(float64(s), S_FLOOR)
    extinction = float64(sigma_tr) / s
    return extinction * s * s / 3.0, extinction * (1.0 - s * s / 3.0)


def _steepness(eta: float) -> float:
    return 4.0 / 3.0 * boundary_factor(eta)


def _absorbed(s: Array, eta: float) -> Array:
    """1 - R_d(s) as a sum of non-negative terms, which avoids cancellation for R_d near 1."""
    near = np.exp(-s)
    far = np.exp(-(1.0 + _steepness(eta)) * s)
    lost = -(np.expm1(-s) + np.expm1(-(1.0 + _steepness(eta)) * s)) / 2.0
    return lost + s * s / 6.0 * (near + far)


def _slope(s: Array, eta: float) -> Array:
    """Derivative of 1 - R_d(s)."""
    b = 1.0 + _steepness(eta)
    near = np.exp(-s)
    far = np.exp(-b * s)
    albedo = 1.0 - s * s / 3.0
    return albedo / 2.0 * (near + b * far) + s / 3.0 * (near + far)


def sigma_tr(sigma_a: ArrayLike, sigma_s_prime: ArrayLike) -> Array:
    """sigma_tr = sqrt(3 sigma_a (sigma_a + sigma_s')) in mm^-1 (eq. 9)."""
    a = float64(sigma_a)
    s = float64(sigma_s_prime)
    return np.sqrt(3.0 * a * (a + s))


def dipole_profile(
    r: ArrayLike, sigma_a: ArrayLike, sigma_s_prime: ArrayLike, *, eta: float
) -> Array:
    """R(r) in mm^-2: radiant exitance at distance r [mm] per unit of power that enters.

    Arguments broadcast. The integral of R over the plane is eq. 5.
    """
    r, a, s = (float64(x) for x in (r, sigma_a, sigma_s_prime))
    decay, sources = _sources(a, s, eta)
    total = np.zeros(())
    for z in sources:
        d = np.sqrt(r * r + z * z)
        # in this order 0 at infinity, instead of infinity times 0
        total = total + z * (1.0 / d + decay) / (d * d) * np.exp(-decay * d)
    return s / (a + s) / (4.0 * np.pi) * total


def _sources(a: Array, s: Array, eta: float) -> tuple[Array, tuple[Array, Array]]:
    """sigma_tr, and depth of the real and height of the virtual source of the dipole."""
    depth = 1.0 / (a + s)
    return sigma_tr(a, s), (depth, depth * (1.0 + 4.0 / 3.0 * boundary_factor(eta)))
