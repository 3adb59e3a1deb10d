"""Normals of surfels and their covariance from reflectance samples (Weyrich et al.
2005, section 6).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skindb.jit import sample_bits
from skindb.optics import _photometric_kernels
from skindb.types import Array


@dataclass(frozen=True)
class PhotometricNormals:
    """Estimates for n surfels; NaN where the samples do not determine them.

    `peak` (n, 3) follows the paper: the normal is half way between each camera and its
    direction of maximum reflectance. It uses the darkest channel, which has the least
    diffuse light under the highlight. The four brightest lights are weighted by their
    excess over the fifth, cameras by the contrast of their brightest light.

    `normal` (n, 2, 3), `spread` (n, 2) and `covariance` (n, 2, 3, 3) [rad^2] are from
    robust photometric stereo. The first signal is a low quantile over cameras of the
    mean channel, below the highlights; the second is the median of the colour
    difference that is zero for white light (Zickler et al. 2008). The spread is the
    residual over the signal. The covariance describes the noise of the samples,
    estimated from the residuals. A small rotation t of the scan's normal rotates the
    estimate by `pull` t.
    """

    peak: Array
    normal: Array
    spread: Array
    covariance: Array
    cross: Array  # (n, 3, 3) covariance of the first normal with the second
    pull: Array  # (n, 2, 3, 3)


def photometric_normals(
    sample: NDArray[np.float32],
    position: Array,
    light: Array,
    camera: Array,
    scan: Array,
    *,
    eta: float,
    prior: float,
) -> PhotometricNormals:
    """Estimate the normals of surfels by all methods.

    Parameters
    ----------
    sample
        (n, l, c, 3) f_r cos(theta_i) [sr^-1]; NaN where unusable.
    position, light, camera
        (n, 3), (l, 3) and (c, 3) positions [mm].
    scan
        (n, 3) unit normals of the scan.
    eta
        Refractive index of the Fresnel factors.
    prior
        Standard deviation of the scan's normals [rad].
    """
    n = len(position)
    peak = np.full((n, 3), np.nan)
    normal = np.full((n, 2, 3), np.nan)
    spread = np.full((n, 2), np.nan)
    covariance = np.full((n, 2, 3, 3), np.nan)
    pull = np.full((n, 2, 3, 3), np.nan)
    cross = np.full((n, 3, 3), np.nan)
    points = (
        np.ascontiguousarray(a, np.float64) for a in (position, light, camera, scan)
    )
    _photometric_kernels.estimate(
        sample_bits(sample),
        *points,
        eta,
        prior,
        peak,
        normal,
        spread,
        covariance,
        cross,
        pull,
    )
    return PhotometricNormals(peak, normal, spread, covariance, cross, pull)
