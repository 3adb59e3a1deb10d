"""Texture: steerable pyramids, statistics of their parts in regions, and synthesis of
matching images (Heeger and Bergen 1995).

Pyramids are computed in the Fourier domain (Simoncelli and Freeman 1995; Portilla and
Simoncelli 2000). All masks are functions of the frequency in the whole image, so that
images may have any size and aspect ratio. Transforms use the number of threads set by
`scipy.fft.set_workers`, one by default.

The parts of an image are the image itself and those of its pyramid: 31 with 7 levels of
4 orientations. The distribution of a part is stored as a quantile function, so that
sums and differences of distributions are again distributions after they are made
monotone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import factorial, pi, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fftfreq, irfft2, rfft2, rfftfreq
from scipy.optimize import isotonic_regression
from scipy.sparse import csr_array

from skindb.types import Array, Float64, Index, Mask, finite_rows, float64

Image = Array
Spectrum = NDArray[np.complexfloating[Any, Any]]
LEVELS = 7
ORIENTATIONS = 4
MAX_SHAPES = LEVELS + 1  # whose masks are kept: 25 MB for images of 1024 x 1024
QUANTILES = 256  # entries of a quantile function
# values; a quantile of this many is accurate to 0.14 % of all ranks, a third of a level
MAX_SORTED = 1 << 17
NOISE = 0.05  # see `synthesise`


def build(
    image: Image, levels: int = LEVELS, orientations: int = ORIENTATIONS
) -> list[Image]:
    """Decompose an image, which is extended periodically, into the parts of a pyramid.

    Parameters
    ----------
    image
        (h, w), computed in single precision if it is float32, and otherwise in double precision.
    levels
        Number of octaves; each halves both sides, rounded up, at most until the
        low-pass residual has one entry.
    orientations
        Number of bands per level; the first responds to changes along w, the others
        follow in steps of pi / orientations.

    Returns
    -------
    list
        High-pass residual (h, w), bands of every level, the finest first, and low-pass
        residual: 2 + levels x orientations images. `reconstruct` returns the image to
        within 1e-12 of its range in double precision, 1e-6 in single precision.

    Raises
    ------
    ValueError
        If the image is not two-dimensional and finite, or too small for this number of levels.
    """
    image = np.asarray(image)
    image = image if image.dtype == np.float32 else image.astype(float)
    if image.ndim != 2 or not image.size or not np.isfinite(image).all():
        raise ValueError(
            f"an image must have two dimensions and finite values, not the shape {image.shape}"
        )
    if orientations < 1 or levels < 0 or 2**levels > max(image.shape):
        limit = max(image.shape).bit_length() - 1
        raise ValueError(
            f"an image {image.shape} must have 0 to {limit} levels of 1 or more "
            f"bands, not {levels} of {orientations}"
        )
    spectrum = _transform(image)
    shape = image.shape
    kind: Any = image.dtype.type
    low, high = _low(shape, shape, 0, kind)
    parts = [_image(spectrum * high, shape)]
    spectrum *= low
    size = shape
    for level in range(levels):
        low, high = _low(size, shape, level + 1, kind)
        ring = spectrum * high * _phase(orientations, kind)
        masks = _angular(size, shape, orientations, kind)
        parts += [_image(ring * mask, size) for mask in masks]
        size = tuple((side + 1) // 2 for side in size)
        spectrum = _cropped(spectrum * low, size)
    return [*parts, _image(spectrum, size)]


def reconstruct(parts: Sequence[Image], orientations: int = ORIENTATIONS) -> Image:
    """Rebuild an image from the parts of its pyramid as their sum, filtered with the
    masks of the decomposition.
    """
    shape = parts[0].shape
    kind: Any = parts[0].dtype.type
    spectrum = _transform(parts[-1])
    starts = range(1, len(parts) - 1, orientations)
    for level, start in reversed([*enumerate(starts, start=1)]):
        size = parts[start].shape
        low, high = _low(size, shape, level, kind)
        ring = np.zeros(low.shape, spectrum.dtype)
        masks = _angular(size, shape, orientations, kind)
        for part, mask in zip(parts[start : start + orientations], masks, strict=True):
            ring += _transform(part) * mask
        ring *= high * np.conj(_phase(orientations, kind))
        spectrum = ring + _widened(spectrum, size) * low
    low, high = _low(shape, shape, 0, kind)
    return _image(spectrum * low + _transform(parts[0]) * high, shape)


def _frequencies(
    size: tuple[int, ...], shape: tuple[int, ...], kind: Any
) -> tuple[Image, Image]:
    """Frequencies of the spectrum of a level, in cycles per entry of the whole image,
    at most 0.5.
    """
    rows = fftfreq(size[0], 1 / size[0]) / shape[0]
    columns = rfftfreq(size[1], 1 / size[1]) / shape[1]
    return rows[:, None].astype(kind), columns[None].astype(kind)


@lru_cache(MAX_SHAPES)
def _low(
    size: tuple[int, ...], shape: tuple[int, ...], level: int, kind: Any
) -> tuple[Image, Image]:
    """Low-pass and high-pass mask, whose squares add up to 1.

    The first is 1 up to half of the highest frequency of a level, 0 above the highest
    frequency, and a cosine of the logarithm of the frequency in between.
    """
    rows, columns = _frequencies(size, shape, kind)
    square = rows * rows + columns * columns
    square *= 4.0 ** (level + 1)
    between = np.flatnonzero((square > 0.25) & (square < 1))
    low = (square <= 0.25).astype(kind)
    high = (square >= 1).astype(kind)
    octave = pi / 4 * np.log2(square.ravel()[between]) + pi / 2
    low.ravel()[between] = np.cos(octave)
    high.ravel()[between] = np.sin(octave)
    return low, high


@lru_cache(MAX_SHAPES)
def _angular(
    size: tuple[int, ...], shape: tuple[int, ...], orientations: int, kind: Any
) -> list[Image]:
    """Oriented masks, powers of the cosine of the angle to each direction, whose
    squares add up to 1.
    """
    rows, columns = _frequencies(size, shape, kind)
    order = orientations - 1
    scale = 2**order * factorial(order) / sqrt(orientations * factorial(2 * order))
    inverse = rows * rows + columns * columns
    inverse.flat[0] = 1  # frequency 0 has no direction; the other masks are 0 there
    inverse = 1 / np.sqrt(inverse)
    masks = []
    for angle in pi * np.arange(orientations) / orientations:
        along = (columns * kind(np.cos(angle)) + rows * kind(np.sin(angle))) * inverse
        mask = np.full_like(along, scale)
        for _ in range(order):
            mask *= along
        masks.append(mask)
    return masks


def _phase(orientations: int, kind: Any) -> Any:
    """Factor that makes the bands real, because odd powers of the cosine are odd
    functions of the frequency.
    """
    return np.result_type(kind, np.complex64).type((-1j) ** (orientations - 1))


def _cropped(spectrum: Spectrum, size: tuple[int, ...]) -> Spectrum:
    """Crop a spectrum to the frequencies of a smaller image; the mask has set the others to 0."""
    rows = (size[0] + 1) // 2
    columns = size[1] // 2 + 1
    return np.concatenate(
        [spectrum[:rows, :columns], spectrum[len(spectrum) - size[0] // 2 :, :columns]]
    )


def _widened(spectrum: Spectrum, size: tuple[int, ...]) -> Spectrum:
    """Pad a spectrum with zeros to that of a larger image."""
    out = np.zeros((size[0], size[1] // 2 + 1), spectrum.dtype)
    rows = (len(spectrum) + 1) // 2
    columns = spectrum.shape[1]
    out[:rows, :columns] = spectrum[:rows]
    out[len(out) - len(spectrum) // 2 :, :columns] = spectrum[rows:]
    return out


def _transform(image: Image) -> Spectrum:
    return rfft2(image, norm="forward")


def _image(spectrum: Spectrum, size: tuple[int, ...]) -> Image:
    return irfft2(spectrum, s=size, norm="forward")


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
    return [image, *build(image, levels, orientations)]


def part_names() -> list[str]:
    """Names of `image_parts`; level 1 is the finest, and angles are those along which
    the image changes.
    """
    angles = [180 * i // ORIENTATIONS for i in range(ORIENTATIONS)]
    bands = [
        f"level {level + 1}, {angle} degrees"
        for level in range(LEVELS)
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
    mask = np.asarray(mask, np.float32)
    fractions = {
        shape: _averages(mask.shape[1], shape[1])
        .dot(_averages(mask.shape[0], shape[0]).dot(mask).T)
        .T
        for shape in {*shapes} - {mask.shape}
    }
    fractions[mask.shape] = mask
    return [fractions[shape] for shape in shapes]


@lru_cache(2 * MAX_SHAPES)
def _averages(size: int, count: int) -> csr_array:
    """Matrix (count, size) that averages the neighbourhoods of `count` of `size` entries."""
    width = max(1, round(size / count))
    centres = np.minimum(np.round(np.arange(count) * size / count), size - 1)
    near = centres[:, None] + np.arange(width) - width // 2
    columns = np.clip(near, 0, size - 1).astype(int).ravel()
    rows = np.repeat(np.arange(count), width)
    weights = np.full(len(rows), 1 / width, np.float32)
    return csr_array((weights, (rows, columns)), shape=(count, size))


def members(fraction: Image) -> Mask:
    """Mask of entries whose fraction of a region exceeds half of the largest, since
    coarse ones may only overlap it.
    """
    return fraction > 0.5 * float(fraction.max(initial=0.0))


def quantile_levels() -> Float64:
    """Fractions (QUANTILES,) at which quantile functions are sampled."""
    return (np.arange(QUANTILES) + 0.5) / QUANTILES


def quantile_function(values: Image) -> Float64:
    """Quantiles (QUANTILES,) of values of any shape; NaN if there are none."""
    flat = np.sort(values, axis=None)
    if not len(flat):
        return np.full(QUANTILES, np.nan)
    # the k-th of n sorted values is the quantile of the fraction (k + 0.5) / n
    place = np.clip(quantile_levels() * len(flat) - 0.5, 0, len(flat) - 1)
    below = place.astype(int)
    low = float64(flat[below])
    high = flat[np.minimum(below + 1, len(flat) - 1)]
    return (high - low) * (place - below) + low


def part_members(mask: Image, parts: Sequence[Image]) -> list[Index]:
    """Flat indices of the entries of each part that belong to a region (h, w), see
    `members`, subsampled if there are many.
    """
    shapes = [part.shape for part in parts]
    fractions = dict(zip(shapes, level_fractions(mask, shapes), strict=True))
    index = {}
    for shape, fraction in fractions.items():
        every = np.flatnonzero(members(fraction))
        index[shape] = every[:: max(1, len(every) // MAX_SORTED)]
    return [index[shape] for shape in shapes]


def part_quantiles(parts: Sequence[Image], inside: Sequence[Index]) -> Float64:
    """Quantiles (part, QUANTILES) of the entries with these indices, see `part_members`."""
    pairs = zip(parts, inside, strict=True)
    return np.stack([quantile_function(part.take(index)) for part, index in pairs])


def valid_quantiles(values: Float64) -> Float64:
    """Monotone quantile functions nearest to `values` (..., levels), in the mean square
    over levels.

    Isotonic regression: a monotone quantile function belongs to a non-negative
    histogram of the same mass, and its mean is that of `values`. NaN stays NaN.
    """
    flat = values.reshape(-1, values.shape[-1])
    out = np.array(flat, float)
    decreasing = (np.diff(flat, axis=1) < 0).any(axis=1)
    for i in np.flatnonzero(finite_rows(flat) & decreasing):
        out[i] = isotonic_regression(flat[i]).x
    return out.reshape(values.shape)


def synthesise(
    image: Image,
    regions: Sequence[Image],
    shifts: Float64,
    *,
    measured: Sequence[Image] | None = None,
    iterations: int = 5,
    levels: int = LEVELS,
    orientations: int = ORIENTATIONS,
    noise: float = NOISE,
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
    noise
        Standard deviation of the noise that is added first, so that parts without detail
        can gain some, relative to that of the requested change.
    rng
        Random generator of this noise.
    """
    image = float64(image)
    if not np.nan_to_num(shifts).any():
        return Synthesis(image, (0.0,))
    parts = image_parts(image, levels, orientations)
    matching = _Matching.of(parts, regions, shifts, measured)
    change = float(np.sqrt(np.mean(np.nan_to_num(shifts[:, 0]) ** 2)))
    image = image + noise * change * rng.standard_normal(image.shape)
    trace = []
    for _ in range(iterations):
        image = matching.matched(image, 0, matching.quantiles([image])[:, 0])
        parts = build(image, levels, orientations)
        quantiles = matching.quantiles([image, *parts])
        trace.append(matching.distance(quantiles))
        parts = [
            matching.matched(part, k, quantiles[:, k])
            for k, part in enumerate(parts, start=1)
        ]
        image = reconstruct(parts, orientations)
    image = matching.matched(image, 0, matching.quantiles([image])[:, 0])
    parts = image_parts(image, levels, orientations)
    trace.append(matching.distance(matching.quantiles(parts)))
    return Synthesis(image, tuple(trace))


@dataclass(frozen=True)
class _Matching:
    """Regions at the size of every part, and the quantile functions to reach in them."""

    blend: list[list[Image]]  # fraction of each region at the size of each part
    total: list[Image]  # sum of the fractions over the regions, for each part
    measured: list[list[Index]]  # entries that are measured, see `part_members`
    targets: Float64  # (region, part, QUANTILES)

    @classmethod
    def of(
        cls,
        parts: list[Image],
        regions: Sequence[Image],
        shifts: Float64,
        measured: Sequence[Image] | None,
    ) -> _Matching:
        shapes = [part.shape for part in parts]
        blend = [level_fractions(region, shapes) for region in regions]
        total = [np.maximum(sum(masks), 1e-6) for masks in zip(*blend, strict=True)]
        counted = [part_members(m, parts) for m in measured or regions]
        sources = np.stack([part_quantiles(parts, inside) for inside in counted])
        sums = np.where(np.isfinite(shifts), sources + shifts, sources)
        return cls(blend, total, counted, valid_quantiles(sums))

    def quantiles(self, parts: Sequence[Image]) -> Float64:
        """Quantile functions (region, part, QUANTILES) of the first parts."""
        return np.stack(
            [part_quantiles(parts, inside[: len(parts)]) for inside in self.measured]
        )

    def distance(self, quantiles: Float64) -> float:
        """RMS difference from the targets, by the number of entries of the parts."""
        size = np.array([total.size for total in self.total], float)
        squares = np.nan_to_num(((quantiles - self.targets) ** 2).mean(axis=-1))
        return float(np.sqrt(np.average(squares.mean(axis=0), weights=size)))

    def matched(self, part: Image, k: int, quantiles: Float64) -> Image:
        """Part k, whose values are mapped to the targets by their rank in each region."""
        moved = np.zeros_like(part)
        for masks, source, target in zip(
            self.blend, quantiles, self.targets[:, k], strict=True
        ):
            if np.isfinite(target).all():
                inside = masks[k] > 0
                span = max(float(source[-1] - source[0]), 1e-12)
                ranks = source + np.linspace(0, 1e-9 * span, len(source))
                step = np.interp(part[inside], ranks, target - source)
                moved[inside] += masks[k][inside] * step
        return part + moved / self.total[k]
