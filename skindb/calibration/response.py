"""Response of a camera from a stack of exposures of a static scene (Debevec and Malik
1997), and noise of its sensor: read noise and electrons per value from pairs of flat
frames (photon transfer; Janesick 2007), mean dark frame and defect pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from skindb.errors import Fault, InputError, require
from skindb.files import private_file
from skindb.numerics.statistics import robust_deviation
from skindb.types import Float64, Index, Mask

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


@dataclass(frozen=True)
class ResponseOptions:
    """Options for the fit of a response.

    `smoothness` is the weight of the integral of the squared second derivative of
    ln(exposure / value) over the coordinate of the knots, relative to the mean squared
    misfit; without a value, cross-validation chooses it. `knots` is the number of
    knots, `samples` the number of blocks of `block` by `block` px.
    """

    smoothness: float | None = None
    knots: int = 48
    samples: int = 1000
    block: int = 4


@dataclass(frozen=True)
class Response:
    """A response, and measures of its accuracy.

    `table` (row, 4) holds the values of the file and the relative exposures of red,
    green and blue, from 0 at black to 1 at white. `residual` (3,) is the root mean
    square of the misfit in natural logarithms, weighted as in the fit. `samples`
    (3,) counts those that were used; beyond their values the response is extrapolated.
    """

    table: Float64
    residual: Float64
    samples: Index

    @property
    def nonlinearity(self) -> float:
        """Largest difference of relative exposure from a linear response, which is
        small for a linear sensor.
        """
        table = self.table
        value = (table[:, :1] - table[0, 0]) / (table[-1, 0] - table[0, 0])
        return float(np.abs(table[:, 1:] - value).max())


def recover_response(
    stack: ArrayLike,
    seconds: ArrayLike,
    *,
    black: float,
    white: float,
    options: ResponseOptions | None = None,
) -> Response:
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
        (exposure, height, width, 3) values of the file; several views may be stacked
        along the height.
    seconds
        (exposure,) exposure times in s, at least two different ones.
    black, white
        Levels in values of the file.
    options
        Weight of smoothness, numbers of knots and samples.

    Raises
    ------
    InputError
        The stack has a wrong shape or non-finite values, or too few pixels are usable
        in two exposures.
    """
    options = options or ResponseOptions()
    frames = np.asarray(stack)
    times = np.asarray(seconds, float)
    _require_stack(frames, times, (black, white), options.block)
    channels = [
        response_samples(
            (frames[..., c].astype(float) - black) / (white - black),
            times,
            options,
        )
        for c in range(3)
    ]
    few = [
        f"{colour} {len(samples.value)}"
        for colour, samples in zip(("red", "green", "blue"), channels, strict=True)
        if len(samples.value) < MIN_SAMPLES
    ]
    require(
        not few,
        STACK,
        f"at least {MIN_SAMPLES} blocks of pixels must be neither dark nor "
        "saturated in two exposures",
        ", ".join(few),
        "add exposures, or photograph a scene with more range",
    )
    # forced to rise from 0 at black to 1 at white
    value = np.linspace(0.0, 1.0, TABLE_ROWS)
    fits = [_fit_channel(samples, options) for samples in channels]
    rising = [_rising(_curve(value, ratio, options.knots)) for ratio, _, _ in fits]
    return Response(
        table=np.column_stack(
            [black + value * (white - black), *(curve / curve[-1] for curve in rising)]
        ),
        residual=np.array([residual for _, residual, _ in fits]),
        samples=np.array([count for _, _, count in fits], int),
    )


def write_response(path: Path, response: Response) -> None:
    """Write the CSV `dn,r,g,b` of the capture format."""
    np.savetxt(
        private_file(path),
        response.table,
        fmt="%.10g",
        delimiter=",",
        header="dn,r,g,b",
        comments="",
    )


def _place(value: Float64) -> Float64:
    """Coordinate in which the knots are evenly spaced, 0 at black and 1 at white."""
    return np.asarray(np.arcsinh(value / TOE) / np.arcsinh(1 / TOE))


def _curve(value: Float64, log_ratio: Float64, knots: int) -> Float64:
    """Exposure (n,) of values (n,), up to a factor."""
    ratio = np.interp(_place(value), np.linspace(0, 1, knots), log_ratio)
    return value * np.exp(ratio)


def _rising(curve: Float64) -> Float64:
    """The running maximum of a curve, which rises slightly where the curve falls."""
    return np.asarray(np.maximum.accumulate(curve) + MIN_RISE * np.arange(len(curve)))


def _fit_channel(
    samples: ResponseSamples, options: ResponseOptions
) -> tuple[Float64, float, int]:
    """Log ratio of exposure to value at the knots, weighted residual, and number of
    samples that did not move.
    """
    value = samples.value
    smoothness = options.smoothness
    if smoothness is None:
        smoothness = FIRST_SMOOTHNESS
    for _ in range(MEANS):
        solution, _, _ = _fit_values(samples, value, smoothness, options.knots)
        value = _mean_exposure_value(samples.pixels, solution, options.knots)
    if options.smoothness is None:
        smoothness = _cross_validated(samples, value, options.knots)
    solution, misfit, still = _fit_values(samples, value, smoothness, options.knots)
    residual = float(np.sqrt(np.mean(misfit[still] ** 2)))
    return solution, residual, int(still.sum())


def _mean_exposure_value(pixels: Float64, log_ratio: Float64, knots: int) -> Float64:
    """Value (sample, exposure) of the mean exposure of the pixels of each block, by a
    preliminary response.

    Blocks that are darker than their noise keep the mean of their values: their
    exposures are clipped at black.
    """
    grid = np.linspace(0.0, 1.0, MEAN_ROWS)
    curve = _rising(_curve(grid, log_ratio, knots))
    exposure = np.interp(pixels, grid, curve)
    mean = exposure.mean(axis=-1)
    usable = mean > MIN_SIGNAL_TO_NOISE * exposure.std(axis=-1)
    value = np.interp(mean, curve, grid)
    return np.asarray(np.where(usable, value, pixels.mean(axis=-1)))


def _fit_values(
    samples: ResponseSamples, value: Float64, smoothness: float, knots: int
) -> tuple[Float64, Float64, Mask]:
    """The fit to given values (sample, exposure): log ratios (knot,), weighted root mean
    square misfit (sample,), and mask (sample,) of those that did not move.
    """
    design, target, weight = _equations(samples, value, knots)
    chosen = np.ones(len(value), bool)
    for _ in range(ROUNDS):
        rows = design[chosen].reshape(-1, knots)
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
    return solution, misfit, chosen


def _equations(
    samples: ResponseSamples, value: Float64, knots: int
) -> tuple[Float64, Float64, Float64]:
    """Design (sample, exposure, knot), target and weight (sample, exposure)."""
    value = np.where(samples.usable, value, 0.5)
    hat = np.where(value < 0.5, value, np.maximum(1 - value, MIN_BRIGHT_WEIGHT))
    weight = np.where(samples.usable, hat, 0.0) ** 2
    design = _knot_weights(value, knots)
    target = np.log(samples.seconds) - np.log(value)
    # subtracting the weighted mean eliminates the unknown radiance of a sample
    total = weight.sum(axis=1, keepdims=True)
    design -= (weight[..., None] * design).sum(axis=1, keepdims=True) / total[..., None]
    target = target - (weight * target).sum(axis=1, keepdims=True) / total
    return design, target, weight


def _solve(normal: Float64, moment: Float64, smoothness: float) -> Float64:
    """Log ratios (..., knot) from normal equations (..., knot, knot) and (..., knot)."""
    knots = moment.shape[-1]
    bend = np.diff(np.eye(knots), 2, axis=0)
    penalty = smoothness * (knots - 1) ** 3 * bend.T @ bend
    # fixes the free factor of the curve: 1 at white
    anchor = np.eye(knots)[-1:]
    whole = normal + penalty + anchor.T @ anchor
    return np.asarray(np.linalg.solve(whole, moment[..., None])[..., 0])


def _cross_validated(samples: ResponseSamples, value: Float64, knots: int) -> float:
    """The smoothness with which fits predict the ranges of brightness that they do not
    contain best.
    """
    _, _, still = _fit_values(samples, value, FIRST_SMOOTHNESS, knots)
    design, target, weight = _equations(samples, value, knots)
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


def _knot_weights(value: Float64, knots: int) -> Float64:
    """Weights (sample, exposure, knot) of linear interpolation between the knots."""
    position = _place(value) * (knots - 1)
    cell = np.minimum(position.astype(int), knots - 2)[..., None]
    part = position[..., None] - cell
    weights = np.zeros((*value.shape, knots))
    np.put_along_axis(weights, cell, cell + 1 - position[..., None], axis=-1)
    np.put_along_axis(weights, cell + 1, part, axis=-1)
    return weights


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
        return np.asarray(self.pixels.mean(axis=-1))


def response_samples(
    values: Float64, times: Float64, options: ResponseOptions
) -> ResponseSamples:
    """Choose flat blocks of pixels that are spread over all brightnesses.

    Blocks are divided into classes of equal width of their mean value over all
    exposures, and the flattest of each class are taken. A block counts in an exposure
    if none of its pixels is at the white level, and if its mean lies between MIN_VALUE
    and MAX_VALUE; it is a sample if it counts in two.

    `values` (exposure, height, width) are those of one channel, 0 black and 1 white;
    `times` (exposure,) in s.
    """
    block = options.block
    height, width = (side // block * block for side in values.shape[1:])
    tiles = values[:, :height, :width].reshape(
        len(times), height // block, block, width // block, block
    )
    tiles = tiles.transpose(1, 3, 0, 2, 4).reshape(-1, len(times), block * block)
    mean = tiles.mean(axis=-1)
    usable = (mean >= MIN_VALUE) & (mean <= MAX_VALUE) & (tiles.max(axis=-1) < 1)
    enough = usable.sum(axis=1) >= 2
    tiles = tiles[enough]
    mean = mean[enough]
    usable = usable[enough]
    roughness = tiles.std(axis=-1) / np.maximum(mean, MIN_VALUE)
    rough = np.where(usable, roughness, 0).max(axis=1, initial=0)
    order = _flattest_first(rough, np.clip(mean, 0, 1).mean(axis=1))
    chosen = order[: options.samples]
    return ResponseSamples(tiles[chosen], usable[chosen], times)


def _flattest_first(rough: Float64, bright: Float64) -> Index:
    """Order of blocks (n,): the flattest of each class of brightness, the second
    flattest of each, and so on.
    """
    low, high = (bright.min(), bright.max()) if len(bright) else (0.0, 1.0)
    relative = (bright - low) / max(high - low, 1e-12)
    stratum = np.minimum((relative * STRATA).astype(int), STRATA - 1)
    order = np.lexsort((rough, stratum))
    start = np.searchsorted(stratum[order], np.arange(STRATA))
    rank = np.arange(len(order)) - start[stratum[order]]
    return order[np.argsort(rank, kind="stable")]


def _require_stack(
    frames: NDArray[np.generic], times: Float64, levels: tuple[float, float], block: int
) -> None:
    """Report every fault of the arguments at once."""
    faults = list[Fault]()
    if frames.ndim != 4 or frames.shape[-1] != 3 or times.shape != frames.shape[:1]:
        rule = "it must have the shape (exposure, height, width, 3) and one time for each exposure"
        finding = f"{frames.shape} and {times.shape}"
        cure = "stack the frames along a new first axis"
        faults.append(Fault(STACK, rule, finding, cure))
    elif min(frames.shape[1:3]) < block:
        rule = f"frames must be at least {block} px wide and high"
        faults.append(Fault(STACK, rule, str(frames.shape)))
    elif not np.isfinite(frames.astype(float)).all():
        rule = "its values must be finite"
        faults.append(Fault(STACK, rule, "NaN or infinity", "remove damaged frames"))
    if not (np.isfinite(times) & (times > 0)).all() or len(np.unique(times)) < 2:
        rule = "exposure times must be positive, and at least two of them different"
        finding = np.array2string(times, threshold=8)
        cure = "photograph the scene with several times"
        faults.append(Fault(STACK, rule, finding, cure))
    if not levels[0] < levels[1]:
        rule = "the white level must be above the black level"
        faults.append(Fault(STACK, rule, f"{levels[0]:g}, {levels[1]:g}"))
    if faults:
        raise InputError(faults)


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
    frames = np.asarray(pairs, float)
    shaped = frames.ndim == 4 and frames.shape[1] == 2 and frames[0, 0].size >= 100
    require(
        shaped and np.isfinite(frames).all(),
        PAIRS,
        "they must be finite, of the shape (pair, 2, height, width), and have 100 "
        "pixels or more",
        str(frames.shape),
        "give one channel of each frame",
    )
    mean, variance = _transfer_curve(frames, black=black, white=white)
    unclipped = np.isfinite(mean)
    x = mean[unclipped]
    y = variance[unclipped]
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
        covariance=covariance,
        chi_square=chi_square,
        mean=mean,
        variance=variance,
    )


def _transfer_curve(
    frames: Float64, *, black: float, white: float
) -> tuple[Float64, Float64]:
    """Mean above black and variance (pair,) of pairs of frames (pair, 2, h, w); NaN of a
    pair that is clipped.
    """
    clipped = (frames >= white).mean(axis=(1, 2, 3)) > SATURATION_FRACTION
    difference = frames[:, 0] - frames[:, 1]
    mean = frames.mean(axis=(1, 2, 3)) - black
    variance = difference.var(axis=(1, 2), ddof=1) / 2
    return np.where(clipped, np.nan, mean), np.where(clipped, np.nan, variance)


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
    values = np.asarray(frames).astype(float)
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
    spread = robust_deviation(apart, axis=(0, 1))
    # in a perfectly even picture every difference is an outlier
    return np.asarray((np.abs(apart) > MAX_DEVIATIONS * spread) & (apart != 0))
