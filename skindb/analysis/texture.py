"""Distributions of albedo at every scale, which are comparable between takes (Weyrich
et al. 2005, section 10.2).
"""

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import scipy  # scipy.signal takes longer to load, at its first use, than commands run
from numpy.random import Generator
from scipy.ndimage import gaussian_filter
from xarray import Dataset

from skindb.analysis.regions import map_regions
from skindb.analysis.study import each_take, skipped_takes
from skindb.elementwise import thread_count
from skindb.errors import require
from skindb.geometry.atlas import bilinear, push_pull
from skindb.numerics.factorise import principal_axes
from skindb.numerics.texture import (
    LEVELS,
    NOISE,
    ORIENTATIONS,
    Synthesis,
    image_parts,
    level_fractions,
    part_members,
    part_names,
    part_quantiles,
    synthesise,
)
from skindb.schema import dataset, variables
from skindb.schema.cohort import require_comparable
from skindb.schema.label import CHANNELS, FACE
from skindb.types import Array, Mask, finite_rows

SIZE = 1024  # texels along each side
REGIONS = (FACE, "beard", "no_beard")
MAPPED = (variables.TEXEL_DIFFUSE_REFLECTANCE, variables.TEXEL_COVERAGE)
LEAST_COVERED = 0.5  # fraction of the texels of a region that a take must have measured
COVERED = 0.5  # coverage above which a texel counts as measured
DARKEST = 1e-3  # lower limit of R_d; the logarithm of smaller values is mostly noise
ITERATIONS = 5
# standard deviation of the Gaussian that blends a region's edge, in units of (u, v):
# about 5 mm on a face
BLEND = 0.02
BEARD, REST = REGIONS[1:]
# fraction of the variance in the components along which the distance from the data is
# measured
KEPT_VARIANCE = 0.99
MIN_TAKES_DISTANCE = 4  # takes needed for that distance


def texel_regions(landmarks: Mapping[str, Array], size: int = SIZE) -> dict[str, Mask]:
    """Masks (v, u) of the regions in the common (u, v): the whole face, the beard, and
    the skin without a beard.
    """
    masks = map_regions(landmarks, size)
    return {name: masks[name] for name in REGIONS if name in masks}


def texture_statistics(cohort: Dataset, *, landmarks: Mapping[str, Array]) -> Dataset:
    """Quantile functions of log albedo and of its bands, for every take and region.

    The logarithm is used because pigments attenuate by a factor: a change of pigment
    adds the same step at every texel, and no sum of steps leads to a negative albedo.
    Colour is decorrelated with the principal axes of the texels of all takes, each take
    with the same weight, divided by their standard deviations (Heeger and Bergen 1995,
    section 3.5). Every axis is decomposed into a steerable pyramid of 7 levels and 4
    orientations; its 30 parts and the image itself have 256 quantiles each: 23,808
    numbers for each take and region. Means and differences of quantile functions are
    distributions again; those of histograms are mixtures.

    Parameters
    ----------
    cohort
        ``db.cohort("maps", size=1024)``.
    landmarks
        Name -> (2,) position in the common (u, v), from which the regions are drawn.

    Returns
    -------
    Dataset
        `texture_colour_mean`, `texture_colour_axis` (of log R_d),
        `texture_quantile`, `texture_coverage` (fraction of the texels of the region that
        the take has measured; below one half, its distributions are NaN),
        `texture_region`.

    Raises
    ------
    InputError
        If no texel of any take was measured.
    """
    require_comparable(cohort, "maps")
    size = cohort.sizes["v"]
    masks = texel_regions(landmarks, size)
    names = list(masks)
    drawn = np.stack([masks[name] for name in names])
    moments = [take for take in each_take(_moments, cohort, MAPPED) if take is not None]
    require(
        moments,
        "texture",
        "some texels must be measured",
        "none",
        "fit or register more takes",
    )
    mean, axes = colour_axes(*zip(*moments, strict=True))
    takes = each_take(_distributions, cohort, MAPPED, drawn, mean, axes)
    quantiles, covered = (np.stack(values) for values in zip(*takes, strict=True))
    require(
        np.isfinite(quantiles).any(),
        "texture",
        "at least one take must have measured half of a region",
        f"none of {len(takes)} takes",
        "fit or register more takes",
    )
    return dataset(
        {
            variables.TEXTURE_COLOUR_MEAN: mean,
            variables.TEXTURE_COLOUR_AXIS: axes,
            variables.TEXTURE_QUANTILE: quantiles,
            variables.TEXTURE_COVERAGE: covered,
            variables.TEXTURE_REGION: drawn,
        },
        coords={
            "take": cohort["take"].values.tolist(),
            "region": names,
            "part": part_names(),
            "channel": CHANNELS,
        },
        attrs={"skipped": skipped_takes(cohort)},
    )


def log_albedo(maps: Dataset) -> tuple[Array, Mask]:
    """Log R_d (v, u, 3) of a map, extrapolated to texels without measurements, and the
    mask (v, u) of measured ones.
    """
    log, measured = _measured_log(maps)
    if not measured.any():
        return np.zeros_like(log), measured
    return push_pull(log, measured), measured


def _measured_log(maps: Dataset) -> tuple[Array, Mask]:
    """Log R_d (v, u, 3), NaN where it is unknown, and the mask (v, u) of measured texels."""
    albedo = maps[variables.TEXEL_DIFFUSE_REFLECTANCE].values
    measured = maps[variables.TEXEL_COVERAGE].values > COVERED
    for channel in range(albedo.shape[-1]):
        measured &= np.isfinite(albedo[..., channel])
    return np.log(np.maximum(albedo, DARKEST, dtype=albedo.dtype)), measured


def decorrelated(log: Array, mean: Array, axes: Array) -> Array:
    """Coordinates (axis, v, u) on the decorrelated axes, in single precision."""
    rows = (log - mean.astype(log.dtype)).reshape(-1, len(mean))
    images = axes.astype(rows.dtype) @ rows.T
    return images.reshape(-1, *log.shape[:-1]).astype(np.float32, copy=False)


def _moments(maps: Dataset) -> tuple[Array, Array] | None:
    """Mean (3,) and covariance (3, 3) of the log albedo of a take; None if it is unknown."""
    log, measured = _measured_log(maps)
    if not measured.any():
        return None
    rows = log.reshape(-1, log.shape[-1]).take(np.flatnonzero(measured), axis=0)
    mean = rows.mean(axis=0, dtype=float)
    from_mean = rows - mean
    return mean, from_mean.T @ from_mean / len(rows)


def colour_axes(
    means: Sequence[Array], scatters: Sequence[Array]
) -> tuple[Array, Array]:
    """Common mean (3,) and decorrelated axes (3, 3), in rows, of takes of the same
    weight, from their means (3,) and covariances (3, 3).
    """
    mean = np.mean(means, axis=0)
    # the variance includes differences between takes
    between = np.stack(means) - mean
    values, vectors = np.linalg.eigh(
        np.mean(scatters, axis=0) + between.T @ between / len(means)
    )
    axes = (vectors / np.sqrt(np.maximum(values, 1e-12))).T[::-1]
    # brighter is larger on every axis
    return mean, axes * np.where(axes.sum(axis=1, keepdims=True) < 0, -1.0, 1.0)


def covered_fractions(measured: Mask, regions: Mask) -> Array:
    """Fraction (region,) of the texels of each region (region, v, u) that are measured."""
    texels = np.maximum(regions.sum(axis=(1, 2)), 1)
    return np.asarray((measured & regions).sum(axis=(1, 2)) / texels)


def _distributions(
    maps: Dataset, drawn: Mask, mean: Array, axes: Array
) -> tuple[Array, Array]:
    """Quantiles (region, axis, part, level) of a take, NaN for regions of which it has
    measured less than half, and the measured fractions (region,); the face, which is
    the first region, needs no minimum coverage.
    """
    log, measured = log_albedo(maps)
    covered = covered_fractions(measured, drawn)
    enough = covered >= LEAST_COVERED
    enough[0] = True
    masks = drawn & measured & enough[:, None, None]
    quantiles = _quantiles(decorrelated(log, mean, axes), masks)
    return quantiles.astype(np.float32), covered


@dataclass(frozen=True)
class TextureEdit:
    """What an edit does to the albedo map of a take."""

    change: Array  # (v, u, channel) change of log R_d at every texel
    trace: tuple[tuple[float, ...], ...]  # for each axis, see `Synthesis`
    # Mahalanobis distance over the square root of the number of axes; None if unknown
    distance: float | None
    distance_before: float | None  # the same for the unedited take


def edit_texture(
    maps: Dataset,
    shift: Array,
    texture: Dataset,
    *,
    surfels: int | None = None,
    iterations: int = ITERATIONS,
    rng: Generator,
) -> TextureEdit:
    """Shift the distributions of a take's albedo in the common (u, v).

    The beard region is matched to its own distributions, the rest of the face to those
    of the region without a beard. If the population has no such regions, the face is
    matched as one region.

    Parameters
    ----------
    maps
        `common_maps` of the take, of the same size as those of the population.
    shift
        (region, axis, part, level) shift of the quantiles of `texture`; NaN leaves a
        quantile unchanged.
    texture
        From `texture_statistics`.
    surfels
        Number of surfels from which the measured texels were interpolated; default as
        many as texels. Octaves above the highest frequency that they sample do not change.
    iterations
        See `skindb.numerics.texture.synthesise`.
    rng
        Random generator of the noise.
    """
    names = texture["region"].values.tolist()
    mean = texture[variables.TEXTURE_COLOUR_MEAN].values
    axes = texture[variables.TEXTURE_COLOUR_AXIS].values
    drawn = texture[variables.TEXTURE_REGION].values.astype(np.float32)
    log, measured = log_albedo(maps)
    size = measured.shape
    octaves = _unsampled_octaves(measured, surfels)
    shape = tuple(-(-side // 2**octaves) for side in size)
    shift = _without_octaves(shift, octaves)
    quantiles = _without_octaves(texture[variables.TEXTURE_QUANTILE].values, octaves)
    halves = {BEARD, REST} <= set(names) and bool(
        np.isfinite(shift[[names.index(BEARD), names.index(REST)], :, 0]).all()
    )
    if halves:
        matched = [names.index(BEARD), names.index(REST)]
        [beard] = level_fractions(drawn[matched[0]], [shape])
        beard = gaussian_filter(beard, BLEND * shape[1])
        regions = [beard, 1 - beard]
    else:
        matched = [names.index(FACE)]
        regions = [np.ones(shape, np.float32)]
    counted = [level_fractions(drawn[i] * measured, [shape])[0] for i in matched]
    images = _resized(decorrelated(log, mean, axes), shape)

    def synthesised(axis: int, result: Generator) -> Synthesis:
        target = shift[matched, axis].astype(float)
        return synthesise(
            images[axis],
            regions,
            target,
            measured=counted,
            iterations=iterations,
            levels=LEVELS - octaves,
            noise=NOISE / 2**octaves,  # as much in every band as in the whole map
            rng=result,
        )

    with ThreadPoolExecutor(thread_count()) as pool:
        syntheses = list(
            pool.map(synthesised, range(len(images)), rng.spawn(len(images)))
        )
    after = np.stack([result.image for result in syntheses])
    moved = _resized(after - images, size)
    change = np.moveaxis(moved, 0, -1) @ np.linalg.inv(axes).T
    distances = _distances(
        quantiles[:, matched],
        [_quantiles(taken, counted, LEVELS - octaves) for taken in (images, after)],
    )
    return TextureEdit(change, tuple(result.trace for result in syntheses), *distances)


def _unsampled_octaves(measured: Mask, surfels: int | None) -> int:
    """Number of the finest octaves of a map of which its surfels sample no more than half."""
    if surfels is None:
        return 0
    texels = max(measured.sum() / surfels, 1.0)  # of a surfel
    return min(int(np.log2(texels) / 2), LEVELS - 1)


def _without_octaves(values: Array, octaves: int) -> Array:
    """Values (..., part, level) without those of the finest octaves, and with 0 for the
    high-pass residual, which then contains these octaves.
    """
    finest = range(2, 2 + ORIENTATIONS * octaves)
    rest = np.delete(values, finest, axis=-2)
    if octaves:
        rest[..., 1, :] = 0.0
    return rest


def _resized(images: Array, shape: tuple[int, ...]) -> Array:
    """Periodic images (n, h, w) in another size, with the frequencies that both have."""
    for axis, side in enumerate(shape, start=1):
        images = scipy.signal.resample(images, side, axis=axis)
    return images


def at_surfels(change: Array, uv: Array) -> Array:
    """Values (n, channel) of a map (v, u, channel) at texture coordinates (n, 2),
    clamped to the map.
    """
    size = np.array(change.shape[1::-1])
    return bilinear(change, np.clip(uv, 0.0, 1.0) * size)


def _quantiles(
    images: Iterable[Array], masks: Iterable[Array], levels: int = LEVELS
) -> Array:
    """Quantiles (region, axis, part, level) of the images of three axes in regions (v, u)."""
    parts = [image_parts(np.asarray(image, np.float32), levels) for image in images]
    inside = [part_members(mask, parts[0]) for mask in masks]
    return np.array(
        [[part_quantiles(axis, index) for axis in parts] for index in inside]
    )


def _distances(
    of_takes: Array, quantiles: list[Array]
) -> tuple[float | None, float | None]:
    """Distances of the edited and the unedited take from the mean of takes with the
    quantiles (take, region, axis, part, level).

    The unit is the standard deviation of the scores on the principal axes of the takes'
    distributions; the distance is the root mean square over the axes, which is about 1
    for takes of the population. None if there are too few takes.
    """
    quantiles_of_takes = of_takes.astype(float).reshape(len(of_takes), -1)
    # takes with all of these regions
    rows = quantiles_of_takes[finite_rows(quantiles_of_takes)]
    after, before = (values.reshape(-1) for values in quantiles[::-1])
    usable = np.isfinite(before) & np.isfinite(after) & rows.any(axis=0)
    if len(rows) < MIN_TAKES_DISTANCE or not usable.any():
        return None, None
    principal = principal_axes([*rows[:, usable]], len(rows) - 1)
    fraction = np.cumsum(principal.variance) / max(principal.total, 1e-300)
    count = int(np.searchsorted(fraction, KEPT_VARIANCE)) + 1
    axes = principal.axes[:count]
    spread = np.sqrt(principal.variance[:count])

    def distance(values: Array) -> float:
        score = axes @ (values[usable] - principal.mean) / spread
        return float(np.sqrt((score**2).mean()))

    return distance(after), distance(before)
