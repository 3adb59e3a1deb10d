"""Vignette of a lens from frames of an evenly bright surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skindb.errors import Fault, InputError

Array = NDArray[np.float64]
# robust standard deviations; larger deviations are dust or shadows
MAX_DEVIATIONS = 4.0
ROUNDS = 5  # fits, each without the outliers of the previous one
MIN_PIXELS = 100
# of half the image diagonal; with less, the polynomial is extrapolated to the corners
MIN_REACH = 0.6


@dataclass(frozen=True)
class Vignette:
    """Coefficients a2, a4, a6 of 1 + a2 r^2 + a4 r^4 + a6 r^6, their covariance (3, 3),
    and the residual.

    `residual` is the relative root mean square deviation of the frame from the fit;
    `used` is the fraction of the finite pixels that are not outliers.
    """

    coefficients: Array
    covariance: Array
    residual: float
    used: float


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
    picture = np.asarray(flat, np.float64)
    middle = np.asarray(centre, np.float64)
    if picture.ndim != 2:
        rule = "it must have the shape (height, width)"
        cure = "fit one channel, or the mean of the channels"
        raise InputError(Fault("flat frame", rule, str(picture.shape), cure))
    row, column = np.nonzero(np.isfinite(picture) & (picture > 0))
    half = np.hypot(*picture.shape) / 2
    x = (column + 0.5 - middle[0]) / half
    y = (row + 0.5 - middle[1]) / half
    r2 = x**2 + y**2
    if len(r2) < MIN_PIXELS or r2.max() < MIN_REACH**2:
        rule = (
            f"at least {MIN_PIXELS} pixels must be usable, some of them {MIN_REACH} "
            "half diagonals from the centre"
        )
        found = (
            f"{len(r2)} pixels, up to {np.sqrt(r2.max(initial=0)):.2f} half diagonals"
        )
        raise InputError(
            Fault(
                "flat frame",
                rule,
                found,
                "fill the picture with the surface, and avoid saturation",
            )
        )
    value = picture[row, column]
    design = np.stack([np.ones_like(x), x, y, r2, r2**2, r2**3], axis=1)
    kept = np.ones(len(value), bool)
    for _ in range(ROUNDS):
        solution = np.linalg.lstsq(design[kept], value[kept], rcond=None)[0]
        apart = value - design @ solution
        spread = 1.4826 * float(np.median(np.abs(apart[kept])))
        kept = np.abs(apart) <= MAX_DEVIATIONS * max(spread, 1e-12 * abs(solution[0]))
    misfit = float(np.sqrt(np.mean(apart[kept] ** 2)))
    inverse = misfit**2 * np.linalg.inv(design[kept].T @ design[kept])
    level = solution[0]
    found = solution[3:] / solution[0]
    # covariance of the ratio of the coefficients to the level at the centre
    slope = np.hstack([-found[:, None] / level, np.zeros((3, 2)), np.eye(3) / level])
    return Vignette(
        found, slope @ inverse @ slope.T, misfit / abs(level), float(kept.mean())
    )
