"""Noise of a sensor: read noise and electrons per value from pairs of flat frames (photon
transfer; Janesick 2007), mean dark frame and defect pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from skindb.errors import Fault, InputError

Array = NDArray[np.float64]

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
    covariance: Array
    chi_square: float
    mean: Array
    variance: Array


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
    if (
        frames.ndim != 4
        or frames.shape[1] != 2
        or frames[0, 0].size < 100
        or not np.isfinite(frames).all()
    ):
        rule = (
            "they must be finite, of the shape (pair, 2, height, width), and have 100 "
            "pixels or more"
        )
        raise InputError(
            Fault(
                "pairs of flat frames",
                rule,
                str(frames.shape),
                "give one channel of each frame",
            )
        )
    cut = (frames >= white).mean(axis=(1, 2, 3)) > SATURATION_FRACTION
    count = frames[0, 0].size
    mean = np.where(cut, np.nan, frames.mean(axis=(1, 2, 3)) - black)
    variance = np.where(
        cut, np.nan, np.var(frames[:, 0] - frames[:, 1], axis=(1, 2), ddof=1) / 2
    )
    x = mean[~cut]
    y = variance[~cut]
    if (
        len(x) < MIN_PAIRS
        or x.max() < MIN_RATIO * max(x.min(), 0.0)
        or not (y > 0).all()
    ):
        rule = (
            f"at least {MIN_PAIRS} pairs must be unsaturated, noisy, and differ "
            f"{MIN_RATIO:g} times in brightness"
        )
        found = f"{len(x)} unsaturated pairs, {int((y > 0).sum())} of them noisy"
        raise InputError(
            Fault(
                "pairs of flat frames",
                rule,
                found,
                "photograph them with several exposure times",
            )
        )
    design = np.stack([np.ones_like(x), x], axis=1)
    expected = y
    for _ in range(ROUNDS):
        sigma = expected * np.sqrt(2 / (count - 1))
        covariance = np.linalg.inv(design.T @ (design / sigma[:, None] ** 2))
        solution = covariance @ (design.T @ (y / sigma**2))
        expected = np.maximum(design @ solution, 1e-3 * y)
    floor, slope = solution
    if slope <= 0:
        rule = "the noise must grow with brightness"
        cure = "check that the frames are linear and not denoised"
        raise InputError(
            Fault("pairs of flat frames", rule, f"a slope of {slope:.3g}", cure)
        )
    chi_square = float(
        (((y - design @ solution) / sigma) ** 2).sum() / max(len(x) - 2, 1)
    )
    return _electrons(
        solution, covariance, floor - step**2 / 12, chi_square, (mean, variance)
    )


def _electrons(
    line: Array,
    covariance: Array,
    read: float,
    chi_square: float,
    points: tuple[Array, Array],
) -> NoiseModel:
    """Convert variances in values to electrons; a read noise that is negative by chance
    becomes 0.
    """
    gain = 1 / float(line[1])
    noise = gain * np.sqrt(max(read, 0.0))
    # d noise = gain / (2 sqrt(read)) d read - noise gain d slope; near zero, the error
    # of the square root
    deviation = float(np.sqrt(covariance[0, 0]))
    slopes = np.array([gain / (2 * np.sqrt(max(read, deviation))), -noise * gain])
    error = float(np.sqrt(slopes @ covariance @ slopes))
    return NoiseModel(
        gain,
        gain**2 * float(np.sqrt(covariance[1, 1])),
        float(noise),
        error,
        covariance,
        chi_square,
        *points,
    )


@dataclass(frozen=True)
class DarkFrame:
    """Mean, its standard error, and mask of defect pixels, each (height, width, 3), in
    values of the file.
    """

    mean: Array
    error: Array
    defect: NDArray[np.bool_]


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
    stack = np.asarray(frames)
    if (
        stack.ndim != 4
        or stack.shape[-1] != 3
        or len(stack) < 2
        or not np.isfinite(stack.astype(np.float64)).all()
    ):
        rule = (
            "at least two frames (frame, height, width, 3) of finite values are needed"
        )
        raise InputError(
            Fault(
                "dark frames",
                rule,
                f"an array of {stack.shape}",
                "repeat the frame with the lens covered",
            )
        )
    values = stack.astype(np.float64)
    mean = values.mean(axis=0)
    spread = values.std(axis=0, ddof=1)
    noisy = float(np.median(spread)) > 0
    defect = (
        _outliers(mean) | _outliers(spread) | ((spread == 0) & noisy & (len(stack) > 3))
    )
    return DarkFrame(mean, spread / np.sqrt(len(stack)), defect)


def _outliers(picture: Array) -> NDArray[np.bool_]:
    """Mask (h, w, 3) of the pixels that deviate from their neighbourhood."""
    apart = picture - ndimage.median_filter(
        picture, size=(NEIGHBOURHOOD, NEIGHBOURHOOD, 1), mode="nearest"
    )
    spread = 1.4826 * np.median(np.abs(apart), axis=(0, 1))
    # in a perfectly even picture every difference is an outlier
    return np.asarray((np.abs(apart) > MAX_DEVIATIONS * spread) & (apart != 0))
