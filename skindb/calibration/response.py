"""Response of a camera from a stack of exposures of a static scene (Debevec and Malik
1997), and noise of its sensor: read noise and electrons per value from pairs of flat
frames (photon transfer; Janesick 2007), and defect pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy import ndimage

from skindb.errors import require
from skindb.numerics.statistics import robust_deviation
from skindb.types import Float64, Mask

STACK = "the exposure stack"
# value at which the knots change from even steps to even ratios: below it sensors and
# encodings are nearly linear
TOE = 0.02
# least weight of bright values, whose noise is small; with the hat function alone,
# which is 0 at white, responses that are steep there are 3 to 6 % off at 0.98 of the
# white level (benchmarks/responses.py), and 1 to 3 % with this. At 0.2 the published
# JPEG files agree less
MIN_BRIGHT_WEIGHT = 0.1
# misfit relative to the median above which a sample is assumed to have moved
MAX_SAMPLE_RATIO = 4.0
ROUNDS = 3  # fits, each without the samples that moved according to the previous one
# fits, each with means of blocks in the exposure of the previous one: a mean of values
# of a curved response is biased by noise, 3 % at 1/512 of white in captures of a gamma
# response; a third changes nothing above 0.1 %
MEANS = 2
# of a pixel, for means of exposures; 3 and 4 leave 2.2 and 2.8 % at 1/512 of white
MIN_SIGNAL_TO_NOISE = 2.0
MEAN_ROWS = 4097  # of the preliminary response, which is interpolated at every pixel
# of the CSV; between them the straight line differs from a gamma of 2.2 by less than
# 1e-6
TABLE_ROWS = 1025
# tried by cross-validation, in steps of half a decade
SMOOTHNESS = 10.0 ** np.arange(-8.5, -2.9, 0.5)
# of preliminary fits. With less, a wrong curve keeps the samples that agree with it
FIRST_SMOOTHNESS = 1e-6
# ranges of brightness, each held out in turn. Samples of nearby brightness share the
# errors of the curve: with every fifth sample held out, no curve is too rough. Chosen
# between 4 and 10 on simulated stacks; the published stacks confirm it
FOLDS = 5
KNOTS = 48
SAMPLES = 1000  # blocks of BLOCK x BLOCK px
BLOCK = 4
MIN_SAMPLES = 50  # with two usable exposures; fewer would not cover the range of values
MIN_RISE = 1e-9  # relative exposure between rows of the table, which must increase
STRATA = 40  # classes of brightness with equally many samples
# of the range of values: nearer to black, quantisation and the error of the black level
# exceed a few per cent
MIN_VALUE = 0.004
# of the range of values: noise must not reach the white level, where it is clipped
MAX_VALUE = 0.995
PAIRS = "pairs of flat frames"
MIN_PAIRS = 3  # pairs of different brightness
# brightest over darkest mean; with less, slope and intercept cannot be separated
MIN_RATIO = 4.0
# fraction of pixels at the white level above which a pair is excluded
SATURATION_FRACTION = 1e-4
NOISE_ROUNDS = 10  # of reweighting by the fitted variance
# robust standard deviations: of a million good pixels less than one is marked
MAX_DEVIATIONS = 6.0
NEIGHBOURHOOD = 5  # px; side of the median that a pixel is compared with


def recover_response(
    stack: ArrayLike, seconds: ArrayLike, *, black: float, white: float
) -> Float64:
    """Relative exposure as a function of the value, per channel.

    The method is that of Debevec and Malik (1997, eq. 3): ln f(value) = ln radiance +
    ln seconds for all samples, by least squares with hat-shaped weights and a penalty
    on curvature. There are four differences. The unknowns are values of ln f - ln
    value at knots that are even in arsinh(value / TOE), so that files of 16 bits need
    as many unknowns as files of 8 bits, and linear and gamma responses have no penalty.
    The weights do not fall to 0 at white. Samples are means of the exposure over flat
    blocks, and those that moved are excluded. The penalty has the weight that predicts
    held-out ranges of brightness best.

    Parameters
    ----------
    stack
        (exposure, height, width, 3) finite values of the file; several views may be
        stacked along the height.
    seconds
        (exposure,) exposure times in s, at least two different ones.
    black, white
        Levels in values of the file.

    Returns
    -------
    ndarray
        (row, 4) values of the file, and the relative exposures of red, green and blue,
        from 0 at black to 1 at white. Beyond the values of the samples they are
        extrapolated.

    Raises
    ------
    InputError
        All times are equal, or too few pixels are usable in two exposures.
    """
    frames = np.asarray(stack)
    times = np.asarray(seconds, float)
    require(
        len(np.unique(times)) > 1,
        STACK,
        "at least two of the exposure times must be different",
        np.array2string(times, threshold=8),
        "photograph the scene with several times",
    )
    channels = [
        response_samples((channel.astype(float) - black) / (white - black), times)
        for channel in np.moveaxis(frames, -1, 0)
    ]
    counts = [len(samples.pixels) for samples in channels]
    require(
        min(counts) >= MIN_SAMPLES,
        STACK,
        f"at least {MIN_SAMPLES} blocks of pixels must be neither dark nor "
        "saturated in two exposures",
        "red {}, green {}, blue {}".format(*counts),
        "add exposures, or photograph a scene with more range",
    )
    # forced to rise from 0 at black to 1 at white
    value = np.linspace(0.0, 1.0, TABLE_ROWS)
    rising = [_rising(_curve(value, _fit_channel(samples))) for samples in channels]
    exposures = (curve / curve[-1] for curve in rising)
    return np.column_stack([black + value * (white - black), *exposures])


def _place(value: Float64) -> Float64:
    """Coordinate in which the knots are evenly spaced, 0 at black and 1 at white."""
    return np.arcsinh(value / TOE) / np.arcsinh(1 / TOE)


def _curve(value: Float64, log_ratio: Float64) -> Float64:
    """Exposure (n,) of values (n,), up to a factor."""
    ratio = np.interp(_place(value), np.linspace(0, 1, KNOTS), log_ratio)
    return value * np.exp(ratio)


def _rising(curve: Float64) -> Float64:
    """The running maximum of a curve, which rises slightly where the curve falls."""
    return np.maximum.accumulate(curve) + MIN_RISE * np.arange(len(curve))


def _fit_channel(samples: ResponseSamples) -> Float64:
    """Log ratio of exposure to value at the knots."""
    value = samples.value
    for _ in range(MEANS):
        solution, _ = _fit_values(samples, value, FIRST_SMOOTHNESS)
        value = _mean_exposure_value(samples.pixels, solution)
    smoothness = _cross_validated(samples, value)
    return _fit_values(samples, value, smoothness)[0]


def _mean_exposure_value(pixels: Float64, log_ratio: Float64) -> Float64:
    """Value (sample, exposure) of the mean exposure of the pixels of each block, by a
    preliminary response.

    Blocks that are darker than their noise keep the mean of their values: their
    exposures are clipped at black.
    """
    grid = np.linspace(0.0, 1.0, MEAN_ROWS)
    curve = _rising(_curve(grid, log_ratio))
    exposure = np.interp(pixels, grid, curve)
    mean = exposure.mean(axis=-1)
    usable = mean > MIN_SIGNAL_TO_NOISE * exposure.std(axis=-1)
    value = np.interp(mean, curve, grid)
    return np.where(usable, value, pixels.mean(axis=-1))


def _fit_values(
    samples: ResponseSamples, value: Float64, smoothness: float
) -> tuple[Float64, Mask]:
    """The fit to given values (sample, exposure): log ratios (knot,), and mask (sample,)
    of the samples that did not move.
    """
    design, target, weight = _equations(samples, value)
    chosen = np.ones(len(value), bool)
    for _ in range(ROUNDS):
        rows = design[chosen].reshape(-1, KNOTS)
        heavy = weight[chosen].ravel()[:, None] / weight[chosen].sum()
        solution = _solve(
            rows.T @ (heavy * rows),
            rows.T @ (heavy[:, 0] * target[chosen].ravel()),
            smoothness,
        )
        square = weight * (design @ solution - target) ** 2
        misfit = np.sqrt(square.sum(axis=1) / weight.sum(axis=1))
        still = misfit <= MAX_SAMPLE_RATIO * float(np.median(misfit[chosen]))
        if (still == chosen).all() or still.sum() < MIN_SAMPLES:
            break
        chosen = still
    return solution, chosen


def _equations(
    samples: ResponseSamples, value: Float64
) -> tuple[Float64, Float64, Float64]:
    """Design (sample, exposure, knot), target and weight (sample, exposure)."""
    value = np.where(samples.usable, value, 0.5)
    hat = np.where(value < 0.5, value, np.maximum(1 - value, MIN_BRIGHT_WEIGHT))
    weight = np.where(samples.usable, hat, 0.0) ** 2
    # of linear interpolation between the knots
    position = _place(value)[..., None] * (KNOTS - 1)
    design = np.maximum(1 - np.abs(position - np.arange(KNOTS)), 0)
    target = np.log(samples.seconds) - np.log(value)
    # subtracting the weighted mean eliminates the unknown radiance of a sample
    total = weight.sum(axis=1, keepdims=True)
    design -= (weight[..., None] * design).sum(axis=1, keepdims=True) / total[..., None]
    target = target - (weight * target).sum(axis=1, keepdims=True) / total
    return design, target, weight


def _solve(normal: Float64, moment: Float64, smoothness: float) -> Float64:
    """Log ratios (..., knot) from normal equations (..., knot, knot) and (..., knot)."""
    bend = np.diff(np.eye(KNOTS), 2, axis=0)
    penalty = smoothness * (KNOTS - 1) ** 3 * bend.T @ bend
    # fixes the free factor of the curve: 1 at white
    anchor = np.eye(KNOTS)[-1:]
    whole = normal + penalty + anchor.T @ anchor
    return np.asarray(np.linalg.solve(whole, moment[..., None])[..., 0])


def _cross_validated(samples: ResponseSamples, value: Float64) -> float:
    """The smoothness with which fits predict the ranges of brightness that they do not
    contain best.
    """
    _, still = _fit_values(samples, value, FIRST_SMOOTHNESS)
    design, target, weight = _equations(samples, value)
    root = np.sqrt(weight / weight[still].sum())
    rows = root[..., None] * design
    columns = root * target
    order = np.argsort(samples.value[still].mean(axis=1))
    folds = np.array_split(np.flatnonzero(still)[order], FOLDS)
    normals = np.array(
        [np.tensordot(rows[f], rows[f], ((0, 1), (0, 1))) for f in folds]
    )
    moments = np.array([np.einsum("sek,se->k", rows[f], columns[f]) for f in folds])
    scores = []
    for smoothness in SMOOTHNESS:
        fits = _solve(
            normals.sum(axis=0) - normals, moments.sum(axis=0) - moments, smoothness
        )
        square = np.einsum("fi,fij,fj->", fits, normals, fits)
        scores.append(square - 2 * (fits * moments).sum())
    return float(SMOOTHNESS[np.argmin(scores)])


@dataclass(frozen=True)
class ResponseSamples:
    """Samples of one channel.

    `pixels` (sample, exposure, pixel) are values of blocks, 0 black and 1 white;
    `usable` (sample, exposure) says in which exposures a block counts; `seconds`
    (exposure,).
    """

    pixels: Float64
    usable: Mask
    seconds: Float64

    @property
    def value(self) -> Float64:
        """Mean value (sample, exposure) of each block."""
        return self.pixels.mean(axis=-1)


def response_samples(values: Float64, times: Float64) -> ResponseSamples:
    """Choose flat blocks of pixels that are spread over all brightnesses.

    Blocks are divided into classes of equal width of their mean value over all
    exposures, and the flattest of each class are taken. A block counts in an exposure
    if none of its pixels is at the white level, and if its mean lies between MIN_VALUE
    and MAX_VALUE; it is a sample if it counts in two.

    `values` (exposure, height, width) are those of one channel, 0 black and 1 white;
    `times` (exposure,) in s.
    """
    rows, columns = (side // BLOCK for side in values.shape[1:])
    tiles = values[:, : rows * BLOCK, : columns * BLOCK].reshape(
        len(times), rows, BLOCK, columns, BLOCK
    )
    tiles = tiles.transpose(1, 3, 0, 2, 4).reshape(
        rows * columns, len(times), BLOCK * BLOCK
    )
    mean = tiles.mean(axis=-1)
    usable = (mean >= MIN_VALUE) & (mean <= MAX_VALUE) & (tiles.max(axis=-1) < 1)
    enough = usable.sum(axis=1) >= 2
    tiles = tiles[enough]
    mean = mean[enough]
    usable = usable[enough]
    roughness = tiles.std(axis=-1) / np.maximum(mean, MIN_VALUE)
    rough = np.where(usable, roughness, 0).max(axis=1, initial=0)
    # the flattest of each class of brightness, the second flattest of each, and so on
    bright = np.clip(mean, 0, 1).mean(axis=1)
    low, high = (bright.min(), bright.max()) if len(bright) else (0.0, 1.0)
    relative = (bright - low) / max(high - low, 1e-12)
    stratum = np.minimum((relative * STRATA).astype(int), STRATA - 1)
    rank = pd.Series(rough).groupby(stratum).rank("first")
    chosen = np.lexsort((stratum, rank))[:SAMPLES]
    return ResponseSamples(tiles[chosen], usable[chosen], times)


@dataclass(frozen=True)
class NoiseModel:
    """Noise of a linear sensor: electrons per value and read noise in electrons, with
    their standard errors.

    `chi_square` is the chi-squared of the fit per degree of freedom, about 1 if the
    sensor follows the model.
    """

    electrons_per_dn: float
    electrons_per_dn_error: float
    read_noise: float
    read_noise_error: float
    chi_square: float


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
        Too few unsaturated pairs, or pairs of one brightness.
    """
    frames = np.asarray(pairs, float)
    clipped = (frames >= white).mean(axis=(1, 2, 3)) > SATURATION_FRACTION
    frames = frames[~clipped]
    x = frames.mean(axis=(1, 2, 3)) - black
    y = (frames[:, 0] - frames[:, 1]).var(axis=(1, 2), ddof=1) / 2
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
    (floor, slope), covariance, chi_square = _line(x, y, frames[0, 0].size)
    require(
        not slope <= 0,
        PAIRS,
        "the noise must grow with brightness",
        f"a slope of {slope:.3g}",
        "check that the frames are linear and not denoised",
    )
    gain = 1 / float(slope)
    noise, noise_error = _read_noise(floor - step**2 / 12, gain, covariance)
    return NoiseModel(
        electrons_per_dn=gain,
        electrons_per_dn_error=gain**2 * float(np.sqrt(covariance[1, 1])),
        read_noise=noise,
        read_noise_error=noise_error,
        chi_square=chi_square,
    )


def _read_noise(
    variance: float, gain: float, covariance: Float64
) -> tuple[float, float]:
    """Read noise in electrons from its variance in values, and its standard error.

    A variance that is negative by chance becomes 0.
    """
    noise = gain * np.sqrt(max(variance, 0.0))
    # d noise = gain / (2 sqrt(variance)) d variance - noise gain d slope; near zero, the
    # error of the square root
    deviation = float(np.sqrt(covariance[0, 0]))
    slopes = np.array([gain / (2 * np.sqrt(max(variance, deviation))), -noise * gain])
    return float(noise), float(np.sqrt(slopes @ covariance @ slopes))


def _line(x: Float64, y: Float64, count: int) -> tuple[Float64, Float64, float]:
    """Offset and slope of variances y of `count` values over means x, their covariance,
    and chi-squared per degree of freedom.
    """
    design = np.stack([np.ones_like(x), x], axis=1)
    expected = y
    for _ in range(NOISE_ROUNDS):
        sigma = expected * np.sqrt(2 / (count - 1))
        covariance = np.linalg.inv(design.T @ (design / sigma[:, None] ** 2))
        solution = covariance @ (design.T @ (y / sigma**2))
        expected = np.maximum(design @ solution, 1e-3 * y)
    square = (((y - design @ solution) / sigma) ** 2).sum()
    return solution, covariance, float(square / max(len(x) - 2, 1))


def defect_pixels(frames: ArrayLike) -> Mask:
    """Mask (height, width, 3) of the pixels of dark frames of one exposure time that are
    hot, stuck or unusually noisy.

    A pixel is a defect if its mean or its deviation in time differs from the median of
    its neighbourhood by more than MAX_DEVIATIONS robust standard deviations of such
    differences over the channel. A pixel that never changes while its neighbours do is
    a defect too.

    Parameters
    ----------
    frames
        (frame, height, width, 3) values of the file, at least two frames. The lens is covered.
    """
    values = np.asarray(frames).astype(float)
    spread = values.std(axis=0, ddof=1)
    defect = _outliers(values.mean(axis=0)) | _outliers(spread)
    if len(values) > 3 and np.median(spread) > 0:
        defect |= spread == 0
    return defect


def _outliers(picture: Float64) -> Mask:
    """Mask (h, w, 3) of the pixels that deviate from their neighbourhood."""
    apart = picture - ndimage.median_filter(
        picture, size=(NEIGHBOURHOOD, NEIGHBOURHOOD, 1), mode="nearest"
    )
    spread = robust_deviation(apart, axis=(0, 1))
    # in a perfectly even picture every difference is an outlier
    return (np.abs(apart) > MAX_DEVIATIONS * spread) & (apart != 0)
