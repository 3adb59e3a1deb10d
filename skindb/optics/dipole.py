"""Diffuse reflectance profile of the dipole (Jensen et al. 2001; Weyrich et al. 2005,
section 8 and eq. 9).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from skindb.optics.fresnel import boundary_factor
from skindb.types import Array


def sigma_tr(sigma_a: ArrayLike, sigma_s_prime: ArrayLike) -> Array:
    """sigma_tr = sqrt(3 sigma_a (sigma_a + sigma_s')) in mm^-1 (eq. 9)."""
    a = np.asarray(sigma_a, np.float64)
    s = np.asarray(sigma_s_prime, np.float64)
    return np.asarray(np.sqrt(3.0 * a * (a + s)))


def dipole_profile(
    r: ArrayLike, sigma_a: ArrayLike, sigma_s_prime: ArrayLike, *, eta: float
) -> Array:
    """R(r) in mm^-2: radiant exitance at distance r [mm] per unit of power that enters.

    Arguments broadcast. The integral of R over the plane is eq. 5.
    """
    r, a, s = (np.asarray(x, np.float64) for x in (r, sigma_a, sigma_s_prime))
    extinction = a + s
    decay = np.sqrt(3.0 * a * extinction)
    depth = 1.0 / extinction
    above = depth * (1.0 + 4.0 / 3.0 * boundary_factor(eta))
    total = np.zeros(())
    for z in (depth, above):
        d = np.sqrt(r * r + z * z)
        total = total + z * (1.0 / d + decay) / (d * d) * np.exp(
            -decay * d
        )  # 0 at infinity, instead of infinity times 0
    return np.asarray(s / extinction / (4.0 * np.pi) * total)


def dipole_power_beyond(
    distance: ArrayLike, sigma_a: ArrayLike, sigma_s_prime: ArrayLike, *, eta: float
) -> Array:
    """Fraction of the entered power that leaves farther than `distance` [mm] from where it entered.

    The integral of 2 pi r R(r) from `distance` to infinity, in closed form; at 0 it is
    R_d (eq. 5). Arguments broadcast. It is also the exitance of a plane at that
    distance from an evenly lit one.
    """
    r, a, s = (np.asarray(x, np.float64) for x in (distance, sigma_a, sigma_s_prime))
    extinction = a + s
    decay = np.sqrt(3.0 * a * extinction)
    depth = 1.0 / extinction
    total = np.zeros(())
    for z in (depth, depth * (1.0 + 4.0 / 3.0 * boundary_factor(eta))):
        d = np.sqrt(r * r + z * z)
        total = total + z / d * np.exp(-decay * d)
    return np.asarray(s / extinction / 2.0 * total)
