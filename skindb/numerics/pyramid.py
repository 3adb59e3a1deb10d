"""Steerable pyramid of an image in the Fourier domain (Simoncelli and Freeman 1995;
Portilla and Simoncelli 2000).

All masks are functions of the frequency in the whole image, so that images may have any
size and aspect ratio. Transforms use the number of threads set by
`scipy.fft.set_workers`, one by default.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import factorial, pi, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fftfreq, irfft2, rfft2, rfftfreq

Image = NDArray[np.floating[Any]]
Spectrum = NDArray[np.complexfloating[Any, Any]]


@dataclass(frozen=True)
class Pyramid:
    """High-pass residual, oriented bands of every level, and low-pass residual, from
    which the image can be rebuilt.
    """

    high: Image  # (h, w)
    # one (orientations, h_k, w_k) per level, each level half as large as the previous
    # one
    bands: list[Image]
    low: Image  # (h_n, w_n)

    def parts(self) -> list[Image]:
        """High-pass residual, every band, low-pass residual: 2 + levels x orientations images."""
        return [self.high, *(band for level in self.bands for band in level), self.low]

    def with_parts(self, parts: list[Image]) -> Pyramid:
        """A pyramid of this layout with other images, in the order of `parts`."""
        bands = []
        at = 1
        for level in self.bands:
            bands.append(np.stack(parts[at : at + len(level)]))
            at += len(level)
        return Pyramid(parts[0], bands, parts[at])


def build(image: Image, levels: int = 7, orientations: int = 4) -> Pyramid:
    """Decompose an image, which is extended periodically.

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
    Pyramid
        `reconstruct` returns the image to within 1e-12 of its range in double
        precision, 1e-6 in single precision.

    Raises
    ------
    ValueError
        If the image is not two-dimensional and finite, or too small for this number of levels.
    """
    image = np.asarray(image)
    image = image if image.dtype == np.float32 else image.astype(np.float64)
    if image.ndim != 2 or not image.size or not np.isfinite(image).all():
        raise ValueError(
            f"an image must have two dimensions and finite values, not the shape {image.shape}"
        )
    if orientations < 1 or levels < 0 or 2**levels > max(image.shape):
        most = max(image.shape).bit_length() - 1
        raise ValueError(
            f"an image {image.shape} must have 0 to {most} levels of 1 or more "
            f"bands, not {levels} of {orientations}"
        )
    spectrum = _transform(image)
    whole = image.shape
    kind = image.dtype.type
    low, high = _low(whole, whole, 0, kind)
    residual = _image(spectrum * high, whole)
    bands = []
    spectrum *= low
    for level, (size, smaller) in enumerate(_sizes(whole, levels)):
        low, high = _low(size, whole, level + 1, kind)
        ring = spectrum * high * _phase(orientations, kind)
        bands.append(
            np.stack(
                [
                    _image(ring * mask, size)
                    for mask in _angular(size, whole, orientations, kind)
                ]
            )
        )
        spectrum = _cropped(spectrum * low, smaller)
    size = _sizes(image.shape, levels)[-1][1] if levels else image.shape
    return Pyramid(residual, bands, _image(spectrum, size))


def reconstruct(pyramid: Pyramid) -> Image:
    """Rebuild the image of a pyramid as the sum of its parts, filtered with the masks
    of the decomposition.
    """
    whole = pyramid.high.shape
    kind = pyramid.high.dtype.type
    spectrum = _transform(pyramid.low)
    for level in reversed(range(len(pyramid.bands))):
        own = pyramid.bands[level]
        size = own.shape[1:]
        low, high = _low(size, whole, level + 1, kind)
        ring = np.zeros(low.shape, spectrum.dtype)
        for band, mask in zip(own, _angular(size, whole, len(own), kind), strict=True):
            ring += _transform(band) * mask
        ring *= high * np.conj(_phase(len(own), kind))
        spectrum = ring + _widened(spectrum, size) * low
    low, high = _low(whole, whole, 0, kind)
    return _image(spectrum * low + _transform(pyramid.high) * high, whole)


def _sizes(
    shape: tuple[int, ...], levels: int
) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Sizes of each level and of the next one."""
    found = []
    for _ in range(levels):
        smaller = tuple((side + 1) // 2 for side in shape)
        found.append((shape, smaller))
        shape = smaller
    return found


def _frequencies(
    size: tuple[int, ...], whole: tuple[int, ...], kind: Any
) -> tuple[Image, Image]:
    """Frequencies of the spectrum of a level, in cycles per entry of the whole image,
    at most 0.5.
    """
    rows = fftfreq(size[0], 1 / size[0]) / whole[0]
    return rows[:, None].astype(kind), (rfftfreq(size[1], 1 / size[1]) / whole[1])[
        None
    ].astype(kind)


def _low(
    size: tuple[int, ...], whole: tuple[int, ...], level: int, kind: Any
) -> tuple[Image, Image]:
    """Low-pass and high-pass mask, whose squares add up to 1.

    The first is 1 up to half of the highest frequency of a level, 0 above the highest
    frequency, and a cosine of the logarithm of the frequency in between.
    """
    rows, columns = _frequencies(size, whole, kind)
    square = rows * rows + columns * columns
    square *= 4.0 ** (level + 1)
    between = np.flatnonzero((square > 0.25) & (square < 1))
    low = (square <= 0.25).astype(kind)
    high = (square >= 1).astype(kind)
    octave = pi / 4 * np.log2(square.ravel()[between]) + pi / 2
    low.ravel()[between], high.ravel()[between] = np.cos(octave), np.sin(octave)
    return low, high


def _angular(
    size: tuple[int, ...], whole: tuple[int, ...], orientations: int, kind: Any
) -> Iterator[Image]:
    """Oriented masks, powers of the cosine of the angle to each direction, whose
    squares add up to 1.
    """
    rows, columns = _frequencies(size, whole, kind)
    order = orientations - 1
    scale = 2**order * factorial(order) / sqrt(orientations * factorial(2 * order))
    inverse = rows * rows + columns * columns
    inverse.flat[0] = 1  # frequency 0 has no direction; the other masks are 0 there
    inverse = 1 / np.sqrt(inverse)
    for angle in pi * np.arange(orientations) / orientations:
        along = (columns * kind(np.cos(angle)) + rows * kind(np.sin(angle))) * inverse
        mask = np.full_like(along, scale)
        for _ in range(order):
            mask *= along
        yield mask


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
    return np.asarray(rfft2(image, norm="forward"))


def _image(spectrum: Spectrum, size: tuple[int, ...]) -> Image:
    return np.asarray(irfft2(spectrum, s=size, norm="forward"))
