"""Edits of the distributions of albedo at every scale, region by region (Weyrich et al.
2005, section 11).
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter

from skindb.analysis.texture import REGIONS, decorrelated, log_albedo
from skindb.elementwise import thread_count
from skindb.geometry.texture import bilinear
from skindb.numerics.factorise import principal_axes
from skindb.numerics.texture import (
    Synthesis,
    image_parts,
    level_fractions,
    part_quantiles,
    synthesise,
)
from skindb.schema.regions import FACE
from skindb.types import Array

ITERATIONS = 5
# standard deviation of the Gaussian that blends a region's edge, in units of (u, v):
# about 5 mm on a face
BLEND = 0.02
BEARD, REST = REGIONS[1:]
# fraction of the variance in the components along which the distance from the data is
# measured
KEPT_VARIANCE = 0.99
MIN_TAKES_DISTANCE = 4  # takes needed for that distance


@dataclass(frozen=True)
class TextureEdit:
    """What an edit does to the albedo map of a take."""

    change: Array  # (v, u, channel) change of log R_d at every texel
    trace: tuple[tuple[float, ...], ...]  # for each axis, see `Synthesis`
    # Mahalanobis distance over the square root of the number of axes; None if unknown
    distance: float | None
    distance_before: float | None  # the same for the unedited take


def edit_texture(
    maps: xr.Dataset,
    shift: Array,
    texture: xr.Dataset,
    *,
    iterations: int = ITERATIONS,
    whole: bool = False,
    rng: np.random.Generator,
) -> TextureEdit:
    """Shift the distributions of a take's albedo in the common (u, v).

    The beard region is matched to its own distributions, the rest of the face to those
    of the region without a beard. If the population has no such regions, or if `whole`
    is set, the face is matched as one region.

    Parameters
    ----------
    maps
        `common_maps` of the take, of the same size as those of the population.
    shift
        (region, axis, part, level) shift of the quantiles of `texture`; NaN leaves a
        quantile unchanged.
    texture
        From `texture_statistics`.
    iterations
        See `skindb.numerics.texture.synthesise`.
    whole
        Match the face as one region.
    rng
        Random generator of the noise.
    """
    names = [str(name) for name in texture["region"].values]
    mean = texture["texture_colour_mean"].values
    axes = texture["texture_colour_axis"].values
    drawn = texture["texture_region"].values.astype(np.float32)
    log, measured = log_albedo(maps)
    halves = not whole and {BEARD, REST} <= set(names)
    halves = halves and bool(
        np.isfinite(shift[[names.index(BEARD), names.index(REST)], :, 0]).all()
    )
    if halves:
        at = [names.index(BEARD), names.index(REST)]
        beard = gaussian_filter(drawn[at[0]], BLEND * len(drawn[0]))
        regions = [beard, 1 - beard]
    else:
        at = [names.index(FACE)]
        regions = [np.ones(measured.shape, np.float32)]
    counted = [drawn[i] * measured for i in at]
    images = decorrelated(log, mean, axes)

    def synthesised(axis: int, own: np.random.Generator) -> Synthesis:
        wanted = shift[at, axis].astype(np.float64)
        return synthesise(
            images[axis],
            regions,
            wanted,
            measured=counted,
            iterations=iterations,
            rng=own,
        )

    with ThreadPoolExecutor(thread_count()) as pool:
        found = list(pool.map(synthesised, range(len(images)), rng.spawn(len(images))))
    moved = [own.image - image for own, image in zip(found, images, strict=True)]
    change = np.moveaxis(np.stack(moved), 0, -1) @ np.linalg.inv(axes).T
    after = [image + step for image, step in zip(images, moved, strict=True)]
    distances = _distances(
        texture, at, [_quantiles(one, counted) for one in (images, after)]
    )
    return TextureEdit(change, tuple(own.trace for own in found), *distances)


def at_surfels(change: Array, uv: Array) -> Array:
    """Values (n, channel) of a map (v, u, channel) at texture coordinates (n, 2),
    clamped to the map.
    """
    size = np.array(change.shape[1::-1])
    return bilinear(change, np.clip(uv, 0.0, 1.0) * size)


def _quantiles(images: Array | list[Array], counted: list[Array]) -> Array:
    """Quantiles (region, axis, part, level) of the images of three axes."""
    out = []
    for image in images:
        parts = image_parts(np.asarray(image, np.float32))
        shapes = [part.shape for part in parts]
        out.append(
            [
                part_quantiles(parts, level_fractions(own.astype(np.float32), shapes))
                for own in counted
            ]
        )
    return np.moveaxis(np.array(out), 0, 1)


def _distances(
    texture: xr.Dataset, at: list[int], quantiles: list[Array]
) -> tuple[float | None, float | None]:
    """Distances of the edited and the unedited take from the mean of the takes.

    The unit is the standard deviation of the scores on the principal axes of the takes'
    distributions; the distance is the root mean square over the axes, which is about 1
    for takes of the population. None if there are too few takes.
    """
    known = texture["texture_quantile"].values[:, at].astype(np.float64)
    known = known.reshape(len(known), -1)
    rows = known[np.isfinite(known).all(axis=1)]  # takes with all of these regions
    after, before = (one.reshape(-1) for one in quantiles[::-1])
    usable = np.isfinite(before) & np.isfinite(after)
    if len(rows) < MIN_TAKES_DISTANCE or not usable.any():
        return None, None
    found = principal_axes(rows[:, usable], len(rows) - 1)
    fraction = np.cumsum(found.variance) / max(found.total, 1e-300)
    count = int(np.searchsorted(fraction, KEPT_VARIANCE)) + 1
    axes = found.axes[:count]
    spread = np.sqrt(found.variance[:count])

    def distance(one: Array) -> float:
        score = axes @ (one[usable] - found.mean) / spread
        return float(np.sqrt((score**2).mean()))

    return distance(after), distance(before)
