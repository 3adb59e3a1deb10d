"""Noise of a sensor: read noise and electrons per value from pairs of flat frames (photon
transfer; Janesick 2007), mean dark frame and defect pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from skindb.errors import require
from skindb.types import Float64, Mask

PAIRS = "pairs of flat frames"
MIN_PAIRS = 3  # pairs of different brightness
# brightest over darkest mean; with less, slope and intercept cannot be separated
MIN_RATIO = 4.0
# fraction of pixels at the white level above which a pair is excluded
SATURATION_FRACTION = 1e-4
ROUNDS = 10  # of reweighting by the fitted variance
# robust standard deviations: of a million good pixels less than one is marked
MAX_DEVIATIONS = 6.0
NEIGHBOURHOOD = 5  # px; side of the median that a pixel is compared with


@dataclass(frozen=True)
class NoiseModel:
    """Noise of a linear sensor: electrons per value and read noise in electrons, with
    their standard errors.

    `covariance` (2, 2) is that of the variance at black and the variance per value, in
    values of the file. `chi_square` is the chi-squared of the fit per degree of
    freedom, about 1 if the sensor follows the model. `mean` and `variance` (pair,) are
    the points of the curve; a pair that is clipped at the white level is NaN.
    """

    electrons_per_dn: float
    electrons_per_dn_error: float
    read_noise: float
    read_noise_error: float
    covariance: Float64
    chi_square: float
    mean: Float64
    variance: Float64


def fit_noise(
    pairs: ArrayLike, *, black: float, white: float, step: float = 1.0
) -> NoiseModel:
    """Photon transfer: the variance of the difference of two equal frames is a straight
    line over their mean.

    Half the variance of the difference is free of the fixed pattern and of uneven
    light. The line is fitted with the relative error sqrt(2 / (n - 1)) of a variance;
    the quantisation noise step^2 / 12 is subtracted from the read noise.

    Parameters
    ----------
    pairs
        (pair, 2, height, width) values of the file of one channel, linear; two frames
        of the same scene in each pair, which differ in brightness from pair to pair. A
        dark pair may be among them.
    black, white
        Levels in values of the file.
    step
        Distance between neighbouring values that occur.

    Raises
    ------
    InputError
        Wrong shape, values that are not finite, too few unsaturated pairs, or pairs of
        one brightness.
    """
    frames = np.asarray(pairs, np.float64)
    shaped = frames.ndim == 4 and frames.shape[1] == 2 and frames[0, 0].size >= 100
    require(
        shaped and np.isfinite(frames).all(),
        PAIRS,
        "they must be finite, of the shape (pair, 2, height, width), and have 100 "
        "pixels or more",
        str(frames.shape),
        "give one channel of each frame",
    )
    clipped = (frames >= white).mean(axis=(1, 2, 3)) > SATURATION_FRACTION
    count = frames[0, 0].size
    difference = frames[:, 0] - frames[:, 1]
    mean = np.where(clipped, np.nan, frames.mean(axis=(1, 2, 3)) - black)
    variance = np.where(clipped, np.nan, difference.var(axis=(1, 2), ddof=1) / 2)
    x = mean[~clipped]
    y = variance[~clipped]
    require(
        len(x) >= MIN_PAIRS
        and x.max() >= MIN_RATIO * max(x.min(), 0.0)
        and (y > 0).all(),
        PAIRS,
        f"at least {MIN_PAIRS} pairs must be unsaturated, noisy, and differ "
        f"{MIN_RATIO:g} times in brightness",
        f"{len(x)} unsaturated pairs, {int((y > 0).sum())} of them noisy",
        "photograph them with several exposure times",
    )
    (floor, slope), covariance, chi_square = _line(x, y, count)
    require(
        not slope <= 0,
        PAIRS,
        "the noise must grow with brightness",
        f"a slope of {slope:.3g}",
        "check that the frames are linear and not denoised",
    )
    # from values to electrons; a read noise that is negative by chance becomes 0
    gain = 1 / float(slope)
    read = floor - step**2 / 12
    noise = gain * np.sqrt(max(read, 0.0))
    # d noise = gain / (2 sqrt(read)) d read - noise gain d slope; near zero, the error
    # of the square root
    deviation = float(np.sqrt(covariance[0, 0]))
    slopes = np.array([gain / (2 * np.sqrt(max(read, deviation))), -noise * gain])
    return NoiseModel(
        electrons_per_dn=gain,
        electrons_per_dn_error=gain**2 * float(np.sqrt(covariance[1, 1])),
        read_noise=float(noise),
        read_noise_error=float(np.sqrt(slopes @ covariance @ slopes)),
        covariance=covariance,
        chi_square=chi_square,
        mean=mean,
        variance=variance,
    )


def _line(x: Float64, y: Float64, count: int) -> tuple[Float64, Float64, float]:
    """Offset and slope of variances y of `count` values over means x, their covariance,
    and chi-squared per degree of freedom.
    """
    design = np.stack([np.ones_like(x), x], axis=1)
    expected = y
    for _ in range(ROUNDS):
        sigma = expected * np.sqrt(2 / (count - 1))
        covariance = np.linalg.inv(design.T @ (design / sigma[:, None] ** 2))
        solution = covariance @ (design.T @ (y / sigma**2))
        expected = np.maximum(design @ solution, 1e-3 * y)
    square = (((y - design @ solution) / sigma) ** 2).sum()
    return solution, covariance, float(square / max(len(x) - 2, 1))


@dataclass(frozen=True)
class DarkFrame:
    """Mean, its standard error, and mask of defect pixels, each (height, width, 3), in
    values of the file.
    """

    mean: Float64
    error: Float64
    defect: Mask


def average_dark(frames: ArrayLike) -> DarkFrame:
    """Average dark frames of one exposure time, and mark pixels that are hot, stuck or
    unusually noisy.

    A pixel is a defect if its mean or its deviation in time differs from the median of
    its neighbourhood by more than MAX_DEVIATIONS robust standard deviations of such
    differences over the channel. A pixel that never changes while its neighbours do is
    a defect too.

    Parameters
    ----------
    frames
        (frame, height, width, 3) values of the file, at least two frames. The lens is covered.

    Raises
    ------
    InputError
        Fewer than two frames, another shape, or values that are not finite.
    """
    values = np.asarray(frames).astype(np.float64)
    shaped = values.ndim == 4 and values.shape[-1] == 3 and len(values) >= 2
    require(
        shaped and np.isfinite(values).all(),
        "dark frames",
        "at least two frames (frame, height, width, 3) of finite values are needed",
        f"an array of {values.shape}",
        "repeat the frame with the lens covered",
    )
    mean = values.mean(axis=0)
    spread = values.std(axis=0, ddof=1)
    defect = _outliers(mean) | _outliers(spread)
    if len(values) > 3 and np.median(spread) > 0:
        defect |= spread == 0
    return DarkFrame(mean, spread / np.sqrt(len(values)), defect)


def _outliers(picture: Float64) -> Mask:
    """Mask (h, w, 3) of the pixels that deviate from their neighbourhood."""
    apart = picture - ndimage.median_filter(
        picture, size=(NEIGHBOURHOOD, NEIGHBOURHOOD, 1), mode="nearest"
    )
    spread = 1.4826 * np.median(np.abs(apart), axis=(0, 1))
    # in a perfectly even picture every difference is an outlier
    return np.asarray((np.abs(apart) > MAX_DEVIATIONS * spread) & (apart != 0))
