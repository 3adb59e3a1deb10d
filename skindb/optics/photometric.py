"""Normals and their covariance from the samples of each surfel (Weyrich et al. 2005, section 6)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skindb._half_kernels import sample_bits
from skindb._types import Array
from skindb.optics import _photometric_kernels


@dataclass(frozen=True)
class PhotometricNormals:
    """Estimates of n surfels; NaN where the samples give none.

    `peak` (n, 3) is the paper's rule: half way between each camera and its direction of maximum reflectance. The
    darkest channel has the least diffuse light under the highlight; its four brightest lights are weighted by their
    excess over the fifth, the cameras by how far the brightest stands out.

    `normal` (n, 2, 3), `spread` (n, 2) and `covariance` (n, 2, 3, 3) [rad^2] are of robust photometric stereo: first on
    a low quantile over cameras of the mean channel (below the highlights), then on the median of the colour difference
    that white light does not have (Zickler et al. 2008). The spread is the residual over the signal; the covariance is
    that of the samples' noise, from the residuals; a small turn t of the scan's normal turns the estimate by `pull` t.
    """

    peak: Array
    normal: Array
    spread: Array
    covariance: Array
    cross: Array  # (n, 3, 3) of the first with the second
    pull: Array  # (n, 2, 3, 3)


def photometric_normals(
    sample: NDArray[np.float32], position: Array, light: Array, camera: Array, scan: Array, *, eta: float, prior: float
) -> PhotometricNormals:
    """Every estimate at once.

    Parameters
    ----------
    sample
        (n, l, c, 3) f_r cos(theta_i) [sr^-1], NaN where not usable.
    position, light, camera
        (n, 3), (l, 3), (c, 3) [mm].
    scan
        (n, 3) unit normals of the scan.
    eta
        Refractive index of the Fresnel factors.
    prior
        Standard deviation of the scan's normals [rad].
    """
    n = len(position)
    peak, normal, spread = np.full((n, 3), np.nan), np.full((n, 2, 3), np.nan), np.full((n, 2), np.nan)
    covariance, pull = np.full((n, 2, 3, 3), np.nan), np.full((n, 2, 3, 3), np.nan)
    cross = np.full((n, 3, 3), np.nan)
    points = (np.ascontiguousarray(a, np.float64) for a in (position, light, camera, scan))
    _photometric_kernels.estimate(
        sample_bits(sample), *points, eta, prior, peak, normal, spread, covariance, cross, pull
    )
    return PhotometricNormals(peak, normal, spread, covariance, cross, pull)
