"""Texture statistics of regions from steerable pyramids, and synthesis of matching
images (Heeger and Bergen 1995).

The parts of an image are the image itself and those of its pyramid: 31 with 7 levels of
4 orientations. The distribution of a part is stored as a quantile function, so that
sums and differences of distributions are again distributions after they are made
monotone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.optimize import isotonic_regression

from skindb.numerics.pyramid import Image, build, reconstruct

LEVELS = 7
ORIENTATIONS = 4
QUANTILES = 256  # entries of a quantile function
# values; a quantile of this many is accurate to 0.14 % of all ranks, a third of a level
MAX_SORTED = 1 << 17
# standard deviation of the noise added before matching, relative to that of the
# requested change
NOISE = 0.05


@dataclass(frozen=True)
class Synthesis:
    """An image with the requested distributions, and the convergence of its synthesis."""

    image: Image  # (h, w)
    # RMS difference between the quantiles and the requested ones, before each iteration
    # and after the last
    trace: tuple[float, ...]


def image_parts(
    image: Image, levels: int = LEVELS, orientations: int = ORIENTATIONS
) -> list[Image]:
    """An image (h, w) and the parts of its pyramid, the high-pass residual first."""
    return [image, *build(image, levels, orientations).parts()]


def part_names(levels: int = LEVELS, orientations: int = ORIENTATIONS) -> list[str]:
    """Names of `image_parts`; level 1 is the finest, and angles are those along which
    the image changes.
    """
    angles = [180 * i // orientations for i in range(orientations)]
    bands = [
        f"level {level + 1}, {angle} degrees"
        for level in range(levels)
        for angle in angles
    ]
    return ["image", "high-pass", *bands, "low-pass"]


def level_fractions(mask: Image, shapes: Sequence[tuple[int, ...]]) -> list[Image]:
    """Fraction of a region around each entry of images of these shapes.

    Parameters
    ----------
    mask
        (h, w) fraction of the region in every entry of the whole image, 0 to 1.
    shapes
        Shapes of the parts; an entry of a smaller image represents a block of entries
        of the whole image.
    """
    found: dict[tuple[int, ...], Image] = {mask.shape: np.asarray(mask, np.float32)}
    for shape in dict.fromkeys(shapes):
        if shape not in found:
            width = [
                max(1, round(n / m)) for n, m in zip(mask.shape, shape, strict=True)
            ]
            near = uniform_filter(np.asarray(mask, np.float32), width, mode="nearest")
            at = [
                np.minimum(np.round(np.arange(m) * n / m), n - 1)
                for n, m in zip(mask.shape, shape, strict=True)
            ]
            found[shape] = near[np.ix_(at[0].astype(int), at[1].astype(int))]
    return [found[shape] for shape in shapes]


def members(share: Image) -> NDArray[np.bool_]:
    """Mask of entries whose fraction of a region exceeds half of the largest, since
    coarse ones may only overlap it.
    """
    return share > 0.5 * float(share.max(initial=0.0))


def quantile_levels() -> NDArray[np.float64]:
    """Fractions (QUANTILES,) at which quantile functions are sampled."""
    return (np.arange(QUANTILES) + 0.5) / QUANTILES


def quantile_function(values: Image) -> NDArray[np.float64]:
    """Quantiles (QUANTILES,) of values of any shape, subsampled if there are many; NaN
    if there are none.
    """
    flat = np.sort(values.ravel()[:: max(1, values.size // MAX_SORTED)])
    if not len(flat):
        return np.full(QUANTILES, np.nan)
    # the k-th of n sorted values is the quantile of the fraction (k + 0.5) / n
    return np.interp(quantile_levels() * len(flat) - 0.5, np.arange(len(flat)), flat)


def part_quantiles(
    parts: Sequence[Image], shares: Sequence[Image]
) -> NDArray[np.float64]:
    """Quantiles (part, QUANTILES) of the entries of each part that belong to a region;
    see `members`.
    """
    return np.stack(
        [
            quantile_function(part[members(share)])
            for part, share in zip(parts, shares, strict=True)
        ]
    )


def part_histogram(
    part: Image, share: Image, edges: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Fractions (bins,) of the entries of a region in bins of equal width; the
    outermost bins include all beyond.
    """
    inside = part[members(share)]
    bins = len(edges) - 1
    if not inside.size:
        return np.full(bins, np.nan)
    place = ((inside - edges[0]) * (bins / (edges[-1] - edges[0]))).astype(np.int64)
    return np.bincount(np.clip(place, 0, bins - 1), minlength=bins) / inside.size


def valid_quantiles(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Monotone quantile functions nearest to `values` (..., levels), in the mean square
    over levels.

    Isotonic regression: a monotone quantile function belongs to a non-negative
    histogram of the same mass, and its mean is that of `values`. NaN stays NaN.
    """
    flat = values.reshape(-1, values.shape[-1])
    out = np.array(flat, np.float64)
    for i in np.flatnonzero(
        np.isfinite(flat).all(axis=1) & (np.diff(flat, axis=1) < 0).any(axis=1)
    ):
        out[i] = isotonic_regression(flat[i]).x
    return out.reshape(values.shape)


def synthesise(
    image: Image,
    regions: Sequence[Image],
    shifts: NDArray[np.float64],
    *,
    measured: Sequence[Image] | None = None,
    iterations: int = 5,
    levels: int = LEVELS,
    orientations: int = ORIENTATIONS,
    rng: np.random.Generator,
) -> Synthesis:
    """Change the distributions of the parts of an image (Heeger and Bergen 1995, section 3).

    Every iteration matches the image, then every part of its pyramid, and reconstructs
    the image; at the end the image is matched again. A value is mapped to the quantile
    of its rank, so that the image keeps its features.

    Parameters
    ----------
    image
        (h, w).
    regions
        One (h, w) per region, its fraction in every entry; the sum over regions is 1.
        Between regions, values blend.
    shifts
        (region, part, QUANTILES) shift of the quantile functions of the image's own
        parts in each region; the sums are made monotone by `valid_quantiles`. NaN
        leaves a distribution unchanged.
    measured
        One (h, w) per region, the entries whose distributions are measured; by default
        the region itself.
    iterations
        Number of iterations.
    levels, orientations
        Size of the pyramid.
    rng
        Random generator of the noise that is added first, so that parts without detail
        can gain some.
    """
    image = np.asarray(image, np.float64)
    if not np.nan_to_num(shifts).any():
        return Synthesis(image, (0.0,))
    parts = image_parts(image, levels, orientations)
    shapes = [part.shape for part in parts]
    blend = [level_fractions(region, shapes) for region in regions]
    total = [np.maximum(sum(own), 1e-6) for own in zip(*blend, strict=True)]
    counted = (
        blend
        if measured is None
        else [level_fractions(own, shapes) for own in measured]
    )
    sources = np.stack([part_quantiles(parts, own) for own in counted])
    targets = valid_quantiles(np.where(np.isfinite(shifts), sources + shifts, sources))
    weight = np.array([part.size for part in parts], np.float64)

    def distance(now: NDArray[np.float64]) -> float:
        squares = np.nan_to_num(((now - targets) ** 2).mean(axis=-1))
        return float(np.sqrt((squares * weight).sum() / (weight.sum() * len(regions))))

    def matched(part: Image, at: int, now: NDArray[np.float64]) -> Image:
        moved = np.zeros_like(part)
        for region, own in enumerate(blend):
            if np.isfinite(targets[region, at]).all():
                step = targets[region, at] - now[region]
                inside = own[at] > 0
                moved[inside] += own[at][inside] * np.interp(
                    part[inside], _strictly_increasing(now[region]), step
                )
        return part + moved / total[at]

    def quantiles_of(part: Image, at: int) -> NDArray[np.float64]:
        return np.stack([quantile_function(part[members(own[at])]) for own in counted])

    asked = float(np.sqrt(np.mean(np.nan_to_num(shifts[:, 0]) ** 2)))
    image = image + NOISE * asked * rng.standard_normal(image.shape)
    trace = []
    for _ in range(iterations):
        image = matched(image, 0, quantiles_of(image, 0))
        pyramid = build(image, levels, orientations)
        own = pyramid.parts()
        now = np.stack(
            [quantiles_of(part, at) for at, part in enumerate([image, *own])], axis=1
        )
        trace.append(distance(now))
        image = reconstruct(
            pyramid.with_parts(
                [matched(p, at + 1, now[:, at + 1]) for at, p in enumerate(own)]
            )
        )
    image = matched(image, 0, quantiles_of(image, 0))
    last = image_parts(image, levels, orientations)
    trace.append(
        distance(
            np.stack([quantiles_of(part, at) for at, part in enumerate(last)], axis=1)
        )
    )
    return Synthesis(image, tuple(trace))


def _strictly_increasing(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quantiles made strictly increasing by a negligible slope, so that each value has
    a unique rank.
    """
    span = max(float(values[-1] - values[0]), 1e-12)
    return values + np.linspace(0, 1e-9 * span, len(values))
