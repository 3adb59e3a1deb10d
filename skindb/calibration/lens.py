"""Vignette of a lens from frames of an evenly bright surface."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from skindb.errors import require
from skindb.numerics.statistics import robust_deviation
from skindb.types import Float64, Mask, float64

# robust standard deviations; larger deviations are dust or shadows
MAX_DEVIATIONS = 4.0
ROUNDS = 5  # fits, each without the outliers of the previous one
MIN_PIXELS = 100
# of half the image diagonal; with less, the polynomial is extrapolated to the corners
MIN_REACH = 0.6


@dataclass(frozen=True)
class Vignette:
    """Coefficients a2, a4, a6 of 1 + a2 r^2 + a4 r^4 + a6 r^6, their covariance (3, 3),
    and the relative root mean square deviation of the frame from the fit.
    """

    coefficients: Float64
    covariance: Float64
    residual: float


def fit_vignette(flat: ArrayLike, centre: ArrayLike) -> Vignette:
    """Vignette of the capture format from a flat frame, by least squares without outliers.

    A gradient of the light across the surface is fitted as well and removed, so that
    the surface may be lit slightly from one side.

    Parameters
    ----------
    flat
        (height, width) linear signal, for example a mean of merged frames; NaN for
        pixels to ignore.
    centre
        (2,) principal point in px: column and row.

    Raises
    ------
    InputError
        Too few pixels are finite and positive, or they do not reach far enough from the
        principal point.
    """
    picture = float64(flat)
    middle = float64(centre)
    row, column = np.nonzero(np.isfinite(picture) & (picture > 0))
    half = np.hypot(*picture.shape) / 2
    x = (column + 0.5 - middle[0]) / half
    y = (row + 0.5 - middle[1]) / half
    r2 = x**2 + y**2
    reach2 = r2.max(initial=0)
    require(
        len(r2) >= MIN_PIXELS and reach2 >= MIN_REACH**2,
        "flat frame",
        f"at least {MIN_PIXELS} pixels must be usable, some of them {MIN_REACH} "
        "half diagonals from the centre",
        f"{len(r2)} pixels, up to {np.sqrt(reach2):.2f} half diagonals",
        "fill the picture with the surface, and avoid saturation",
    )
    value = picture[row, column]
    design = np.stack([np.ones_like(x), x, y, r2, r2**2, r2**3], axis=1)
    solution, residual, inliers = _robust_fit(design, value)
    misfit = float(np.sqrt(np.mean(residual[inliers] ** 2)))
    inverse = misfit**2 * np.linalg.inv(design[inliers].T @ design[inliers])
    level = solution[0]
    coefficients = solution[3:] / level
    # covariance of the ratio of the coefficients to the level at the centre
    by_level = -coefficients[:, None] / level
    slope = np.hstack([by_level, np.zeros((3, 2)), np.eye(3) / level])
    covariance = slope @ inverse @ slope.T
    return Vignette(coefficients, covariance, misfit / abs(level))


def _robust_fit(design: Float64, value: Float64) -> tuple[Float64, Float64, Mask]:
    """Coefficients of the columns (n, k) that fit values (n,), residuals (n,), and which
    of the values are not outliers.
    """
    inliers = np.ones(len(value), bool)
    for _ in range(ROUNDS):
        solution = np.linalg.lstsq(design[inliers], value[inliers])[0]
        residual = value - design @ solution
        spread = float(robust_deviation(residual[inliers]))
        limit = MAX_DEVIATIONS * max(spread, 1e-12 * abs(solution[0]))
        inliers = np.abs(residual) <= limit
    return float64(solution), residual, inliers
