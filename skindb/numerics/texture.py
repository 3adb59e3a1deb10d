"""Distributions of the parts of a steerable pyramid within regions, and images that have them (Heeger and Bergen 1995).

The parts of an image are the image itself and those of its pyramid: with 7 levels of 4 orientations 31 of them. A
distribution is kept as a quantile function, so that sums and differences of distributions are distributions again once
they are made monotone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.optimize import isotonic_regression

from skindb.numerics.pyramid import Image, build, reconstruct

LEVELS, ORIENTATIONS = 7, 4
QUANTILES = 256  # entries of a quantile function
MOST_SORTED = 1 << 17  # values: a quantile of so many is off by 0.14 % of all ranks, a third of a level
NOISE = 0.05  # standard deviation of what is added before matching, over that of the asked change


@dataclass(frozen=True)
class Synthesis:
    """An image with other distributions, and how it came to them."""

    image: Image  # (h, w)
    trace: tuple[
        float, ...
    ]  # RMS difference of quantiles from those asked for, before each iteration and after the last


def image_parts(image: Image, levels: int = LEVELS, orientations: int = ORIENTATIONS) -> list[Image]:
    """An image (h, w) and the parts of its pyramid, the high-pass residual first."""
    return [image, *build(image, levels, orientations).parts()]


def part_names(levels: int = LEVELS, orientations: int = ORIENTATIONS) -> list[str]:
    """Names of `image_parts`; level 1 is the finest, directions are those in which the image changes."""
    angles = [180 * i // orientations for i in range(orientations)]
    bands = [f"level {level + 1}, {angle} degrees" for level in range(levels) for angle in angles]
    return ["image", "high-pass", *bands, "low-pass"]


def level_shares(mask: Image, shapes: Sequence[tuple[int, ...]]) -> list[Image]:
    """Fraction of a region about each entry of images of these shapes.

    Parameters
    ----------
    mask
        (h, w) fraction of the region in every entry of the complete image, 0 to 1.
    shapes
        Of the parts; an entry of a smaller image stands for as many as fall to it.
    """
    found: dict[tuple[int, ...], Image] = {mask.shape: np.asarray(mask, np.float32)}
    for shape in dict.fromkeys(shapes):
        if shape not in found:
            width = [max(1, round(n / m)) for n, m in zip(mask.shape, shape, strict=True)]
            near = uniform_filter(np.asarray(mask, np.float32), width, mode="nearest")
            at = [np.minimum(np.round(np.arange(m) * n / m), n - 1) for n, m in zip(mask.shape, shape, strict=True)]
            found[shape] = near[np.ix_(at[0].astype(int), at[1].astype(int))]
    return [found[shape] for shape in shapes]


def members(share: Image) -> NDArray[np.bool_]:
    """Entries that belong to a region by more than half of the most: coarse ones may only touch a small region."""
    return share > 0.5 * float(share.max(initial=0.0))


def quantile_levels() -> NDArray[np.float64]:
    """(QUANTILES,) fractions at which quantile functions are kept."""
    return (np.arange(QUANTILES) + 0.5) / QUANTILES


def quantile_function(values: Image) -> NDArray[np.float64]:
    """Quantiles (QUANTILES,) of values of any shape, of every n-th one where there are many; NaN without any."""
    flat = np.sort(values.ravel()[:: max(1, values.size // MOST_SORTED)])
    if not len(flat):
        return np.full(QUANTILES, np.nan)
    # the k-th of n sorted values stands for the fraction (k + 0.5) / n
    return np.interp(quantile_levels() * len(flat) - 0.5, np.arange(len(flat)), flat)


def part_quantiles(parts: Sequence[Image], shares: Sequence[Image]) -> NDArray[np.float64]:
    """Quantiles (part, QUANTILES) of the entries of each part that belong to a region; see `members`."""
    return np.stack([quantile_function(part[members(share)]) for part, share in zip(parts, shares, strict=True)])


def part_histogram(part: Image, share: Image, edges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fractions (bins,) of the entries of a region in bins of equal width; what lies beyond counts in the last ones."""
    inside = part[members(share)]
    bins = len(edges) - 1
    if not inside.size:
        return np.full(bins, np.nan)
    place = ((inside - edges[0]) * (bins / (edges[-1] - edges[0]))).astype(np.int64)
    return np.bincount(np.clip(place, 0, bins - 1), minlength=bins) / inside.size


def valid_quantiles(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quantile functions nearest to `values` (..., levels), in the mean square over levels.

    Isotonic regression: a monotone quantile function is that of a non-negative histogram of the same mass; its mean
    is that of `values`. NaN stays NaN.
    """
    flat = values.reshape(-1, values.shape[-1])
    out = np.array(flat, np.float64)
    for i in np.flatnonzero(np.isfinite(flat).all(axis=1) & (np.diff(flat, axis=1) < 0).any(axis=1)):
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
    """Image whose parts have moved distributions (Heeger and Bergen 1995, section 3).

    Every iteration matches the image, then every part of its pyramid, and puts the pyramid together again; the image is
    matched a last time. A value takes the quantile that belongs to its rank, so that the image keeps its features.

    Parameters
    ----------
    image
        (h, w).
    regions
        Of each region (h, w) its share in every entry; together 1. Between regions, values blend.
    shifts
        (region, part, QUANTILES) what is added to the quantile functions of the image's own parts in that region; the
        sums are made valid by `valid_quantiles`. NaN moves nothing.
    measured
        Of each region (h, w) the entries whose distributions count; default the region itself.
    iterations
        How often the parts are matched.
    levels, orientations
        Of the pyramid.
    rng
        Of the noise that is added before, so that parts without any detail can get some.
    """
    image = np.asarray(image, np.float64)
    if not np.nan_to_num(shifts).any():
        return Synthesis(image, (0.0,))
    parts = image_parts(image, levels, orientations)
    shapes = [part.shape for part in parts]
    blend = [level_shares(region, shapes) for region in regions]
    total = [np.maximum(sum(own), 1e-6) for own in zip(*blend, strict=True)]
    counted = blend if measured is None else [level_shares(own, shapes) for own in measured]
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
                step, inside = targets[region, at] - now[region], own[at] > 0
                moved[inside] += own[at][inside] * np.interp(part[inside], _rising(now[region]), step)
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
        now = np.stack([quantiles_of(part, at) for at, part in enumerate([image, *own])], axis=1)
        trace.append(distance(now))
        image = reconstruct(pyramid.with_parts([matched(p, at + 1, now[:, at + 1]) for at, p in enumerate(own)]))
    image = matched(image, 0, quantiles_of(image, 0))
    last = image_parts(image, levels, orientations)
    trace.append(distance(np.stack([quantiles_of(part, at) for at, part in enumerate(last)], axis=1)))
    return Synthesis(image, tuple(trace))


def _rising(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quantiles that rise everywhere, by less than what matters, so that each value has one rank."""
    span = max(float(values[-1] - values[0]), 1e-12)
    return values + np.linspace(0, 1e-9 * span, len(values))
