"""Mean free path under the skin, for renderers that trace random walks instead of the dipole."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.optics.diffuse import dipole_s

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
