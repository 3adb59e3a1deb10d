"""Photographs compared with predictions for a matte face: offset from the scan, brightness.

A prediction is albedo x irradiance. The comparison is robust, and uses square roots,
which reduces the effect of highlights. Pictures are downsampled until a pixel covers
about `PIXEL_MM` of the face: the effects that the prediction ignores (gloss, light
between parts of the face, hair) have a size on the face, independent of the resolution.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from skindb.ingest._sample_kernels import (
    FLOOR,
    alignment_rows,
    block_means,
    interpolate,
    shift_moments,
)
from skindb.numerics.statistics import correlation, robust_deviation
from skindb.types import Array, Float32, Float64, Mask, contiguous, float64

PIXEL_MM = 2.0  # mm; about the width of an eyelid, well below the offsets to be found
SMOOTHING_PX = 0.7  # px of the downsampled picture; makes its derivatives smooth
# number of Gauss-Newton steps, and step length in px at which they stop
MAX_STEPS = 12
SMALL_STEP = 0.01
# range of the search for large offsets in radii of the face, and steps per side
SEARCH_RADII = 0.75
SEARCH_STEPS = 7
# of the mean square; smaller ones are rounding
CONSTANT_VARIANCE = 1e-12
# robust standard deviations at which the weight of a residual is one half
ROBUST_SCALE = 2.0
# of the ratios measured / predicted of a surfel; highlights raise the larger ones
ALBEDO_QUANTILE = 0.4
# relative to the median albedo, from brows and nostrils to the forehead
ALBEDO_RANGE = (0.2, 3.0)
# of the largest irradiance in a view, above which a surfel is compared
LIT_FRACTION = 0.3
# of the medians of cameras and lights in turn; three change factors by less than 1 %
POLISH_ROUNDS = 10


@dataclass(frozen=True)
class ReducedView:
    """A downsampled photograph and the positions of the surfels in it."""

    light: int
    camera: int
    image: Float64  # (h, w) square roots of the downsampled grey radiance
    pixels: Float64  # (n, 2) px of the downsampled picture
    clear: Mask  # (n,) the camera sees the surfel


@dataclass(frozen=True)
class Offset:
    """Similarity that aligns the photographs of one camera with the scan: shift,
    relative scale and roll.
    """

    # correlation of measured and predicted square roots after alignment, median over
    # photographs
    agreement: float
    shift: Float64  # (2,) px of the downsampled picture, columns and rows
    scale: float  # relative; 0.01: the face is 1 % larger in the photographs
    roll: float  # radians, clockwise in the picture
    # (2,) px, centroid of the visible surfels, the centre of roll and scale
    middle: Float64
    radius: float  # px, root mean square distance of the surfels from their centroid

    @property
    def parameters(self) -> Float64:
        """Shift, and displacements at the radius by scale and roll, (4,) [px]."""
        along = [self.scale * self.radius, self.roll * self.radius]
        return np.concatenate([self.shift, along])

    @property
    def length(self) -> float:
        """Root mean square displacement [px] over the face by shift and roll."""
        return float(np.sqrt(self.shift @ self.shift + (self.roll * self.radius) ** 2))

    def moves(self, pixels: Float64) -> Float64:
        """Displacements (n, 2) of pixels (n, 2) by shift and roll, without the scale."""
        away = pixels - self.middle
        return self.shift + self.roll * np.stack([-away[:, 1], away[:, 0]], axis=1)


def reduction(width_mm: float) -> int:
    """Downsampling factor for pixels that cover `width_mm` each."""
    return max(int(PIXEL_MM / width_mm), 1)


def reduced(image: Float32, factor: int) -> Float32:
    """Means (h // factor, w // factor, c) of square blocks of a picture (h, w, c),
    whose NaN count as its maximum.
    """
    height, width, channels = image.shape
    out = np.empty((height // factor, width // factor, channels), np.float32)
    block_means(image, factor, out)
    return out


def bilinear(image: Float64, pixels: Float64) -> Float64:
    """Interpolated values (n,) at pixels (n, 2); 0 outside the picture."""
    return interpolated(image[..., None], pixels)[:, 0]


def interpolated(images: Float64, pixels: Float64) -> Float64:
    """Interpolated values (n, picture) of pictures (h, w, picture) at pixels (n, 2); 0
    outside the pictures.
    """
    out = np.empty((len(pixels), images.shape[2]))
    interpolate(
        contiguous(images),
        contiguous(pixels),
        out,
    )
    return out


def camera_offset(
    views: Sequence[ReducedView],
    irradiance: Float64,
    albedo: Float64,
    *,
    start: Offset | None = None,
) -> Offset:
    """Similarity of the picture that brings the photographs of one camera and the
    predictions together.

    Parameters
    ----------
    views
        Photographs of this camera, each under one light.
    irradiance
        (light, n) at the surfels, 0 in shadow.
    albedo
        (n,) of the surfels, in any unit.
    start
        Offset from which the Gauss-Newton steps start, unless no offset agrees better;
        without it, large offsets, which these steps would not reach, are searched.
    """
    surfels = np.flatnonzero(views[0].clear)
    pixels = views[0].pixels[surfels]
    middle = pixels.mean(axis=0)
    radius = float(np.sqrt(((pixels - middle) ** 2).sum(axis=1).mean()))
    images = np.stack([view.image for view in views], axis=-1)
    lights = [view.light for view in views]
    light = np.ascontiguousarray(irradiance[lights][:, surfels].T)
    predicted = np.sqrt(np.maximum(light * albedo[surfels, None], 0))

    def agreement(places: Float64) -> float:
        correlations = map(correlation, interpolated(images, places).T, predicted.T)
        # the median ignores a light with a wrong position
        return float(np.median([*correlations]))

    away = (pixels - middle) / radius
    # px: shift, and displacements at the radius by scale and roll
    moves = np.zeros((len(surfels), 2, 4))
    moves[:, 0, 0] = 1
    moves[:, 1, 1] = 1
    moves[:, :, 2] = away
    moves[:, 0, 3] = -away[:, 1]
    moves[:, 1, 3] = away[:, 0]
    first = np.zeros(4)
    if start is None:
        first[:2] = _large_shift(images, predicted, pixels, radius)
    elif agreement(pixels + moves @ start.parameters) > agreement(pixels):
        first = start.parameters
    move = _gauss_newton(images, predicted, pixels, moves, first)
    aligned = agreement(pixels + moves @ move) if np.isfinite(move).all() else -np.inf
    if aligned < (coarse := agreement(pixels + moves @ first)):
        move = first
        aligned = coarse
    shift = move[:2].copy()
    scale, roll = (move[2:] / radius).tolist()
    return Offset(aligned, shift, scale, roll, middle, radius)


def _large_shift(
    images: Float64, predicted: Float64, pixels: Float64, radius: float
) -> Float64:
    """Shift (2,) px on a coarse grid that agrees best; 0 unless it is clearly better."""
    few = slice(None, None, max(len(pixels) // 2000, 1))
    thin = predicted[few] - predicted[few].mean()
    steps = radius * SEARCH_RADII * np.linspace(-1, 1, 2 * SEARCH_STEPS + 1)
    # the one in the middle is 0
    shifts = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    moments = np.empty((len(shifts), 3))
    shift_moments(images, np.ascontiguousarray(pixels[few]), shifts, thin, moments)
    total, square, product = moments.T
    variance = square - total**2 / thin.size
    product[variance <= CONSTANT_VARIANCE * square] = 0
    agreement = product / np.sqrt(np.maximum(variance * (thin**2).sum(), FLOOR**2))
    best = int(np.argmax(agreement))
    none = len(shifts) // 2
    better = agreement[best] > agreement[none] + 0.02
    return shifts[best if better else none]


def moved_pixels(view: ReducedView, offset: Offset) -> Float64:
    """Pixels (n, 2) of the surfels after the alignment."""
    return (
        view.pixels
        + offset.moves(view.pixels)
        + offset.scale * (view.pixels - offset.middle)
    )


def surfel_albedo(
    views: Sequence[ReducedView], irradiance: Float64, offsets: Mapping[int, Offset]
) -> Float64:
    """Albedo (n,) relative to the median: a low quantile of measured / predicted over
    the views that light a surfel.
    """
    # takes longer to import than most commands run
    from scipy.stats import quantile

    ratios = np.full((len(views), len(views[0].clear)), np.nan)
    for ratio, view in zip(ratios, views, strict=True):
        light = irradiance[view.light]
        lit = view.clear & (light > 0.3 * light.max())
        if lit.any():
            pixels = moved_pixels(view, offsets[view.camera])[lit]
            ratio[lit] = bilinear(view.image, pixels) ** 2 / light[lit]
            # removes errors of the intensity
            ratio /= max(float(np.nanmedian(ratio)), FLOOR)
    measured = np.isfinite(ratios).any(axis=0)
    albedo = np.ones(ratios.shape[1])
    # `np.nanquantile` makes a call for each column
    albedo[measured] = quantile(
        ratios[:, measured], ALBEDO_QUANTILE, axis=0, nan_policy="omit"
    )
    middle = max(float(np.median(albedo[measured])), FLOOR)
    return np.clip(albedo / middle, *ALBEDO_RANGE)


def square_root_image(image: Array) -> Float64:
    """Square roots of a picture, slightly smoothed so that its derivatives are smooth."""
    smooth = gaussian_filter(float64(image), SMOOTHING_PX)
    return np.sqrt(np.maximum(smooth, 0))


def _gauss_newton(
    images: Float64,
    predicted: Float64,
    pixels: Float64,
    moves: Float64,
    start: Float64,
) -> Float64:
    """Alignment (4,) that minimises the robust sum of (gain predicted - measured)^2
    with one gain per picture.
    """
    move = start.copy()
    count = images.shape[2]
    rows = np.empty((len(pixels), count, 4))
    rest = np.empty((len(pixels), count))
    for _ in range(MAX_STEPS):
        alignment_rows(images, pixels + moves @ move, moves, predicted, rows, rest)
        matrix = rows.reshape(-1, 4)
        residual = rest.ravel()
        scale = ROBUST_SCALE * float(robust_deviation(residual)) + FLOOR
        weight = 1 / (1 + (residual / scale) ** 2)
        weighted = (matrix * weight[:, None]).T
        step = np.linalg.lstsq(weighted @ matrix, weighted @ residual)[0]
        move += step
        if np.abs(step).max() < SMALL_STEP:
            break
    return move


@dataclass(frozen=True)
class Brightness:
    """Factors of the radiance over that of a matte face of reflectance 1; NaN where too
    little is visible.
    """

    reflectance: Float64  # (3,) of the face, the factor of the median camera and light
    camera: Float64  # (camera, 3) relative to the median camera
    light: Float64  # (light,) relative to the median light


def view_factors(
    view: ReducedView,
    picture: Float32,
    pixels: Float64,
    irradiance: Float64,
    albedo: Float64,
) -> Float64:
    """Median factor (3,) of the radiance of a view over that of a matte face.

    Parameters
    ----------
    view
        The surfels that the camera sees.
    picture
        (h, w, 3) downsampled radiance.
    pixels
        (n, 2) px of the surfels in it.
    irradiance
        (n, 3) at the surfels, 0 in shadow.
    albedo
        (n,) of the surfels, relative to the median.
    """
    grey = irradiance.mean(axis=1)
    surfels = view.clear & (grey > LIT_FRACTION * grey.max())
    radiance = interpolated(float64(picture), pixels[surfels])
    return np.pi * np.median(
        radiance / (irradiance[surfels] * albedo[surfels, None]), axis=0
    )


def relative_brightness(
    factors: Float64,
    lights: Sequence[int],
    cameras: Sequence[int],
    *,
    shape: tuple[int, int],
) -> Brightness:
    """Split the factors of views into those of lights and cameras, by medians of
    logarithms in turn (Tukey 1977).

    Parameters
    ----------
    factors
        (view, 3), see `view_factors`.
    lights, cameras
        Light and camera of each view.
    shape
        Number of lights and of cameras.
    """
    log = np.log(np.maximum(factors, FLOOR)).reshape(-1, 3)
    light_of = np.asarray(lights, np.int64)
    camera_of = np.asarray(cameras, np.int64)
    by_light = np.full((shape[0], 3), np.nan)
    by_camera = np.full((shape[1], 3), np.nan)
    if not len(log):
        return Brightness(np.full(3, np.nan), by_camera, by_light[:, 0])
    by_light[light_of] = 0.0
    for _ in range(POLISH_ROUNDS):
        rest = log - by_light[light_of]
        for c in np.unique(camera_of):
            by_camera[c] = np.median(rest[camera_of == c], axis=0)
        by_camera -= np.nanmedian(by_camera, axis=0)
        rest = log - by_camera[camera_of]
        for j in np.unique(light_of):
            by_light[j] = np.median(rest[light_of == j], axis=0)
    level = np.nanmedian(by_light, axis=0)
    light = np.exp((by_light - level).mean(axis=1))
    return Brightness(np.exp(level), np.exp(by_camera), light)
