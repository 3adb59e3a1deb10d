"""Steerable pyramid of an image in the Fourier domain (Simoncelli and Freeman 1995; Portilla and Simoncelli 2000).

All masks are functions of the frequency in the whole image, so that any size works, also odd ones and oblong ones.
Transforms use the threads of `scipy.fft.set_workers`, one by default.
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
    """High-pass residual, oriented bands of every level and low-pass residual, which together determine the image."""

    high: Image  # (h, w)
    bands: list[Image]  # of each level (orientations, h_k, w_k), each level half as large as the one before
    low: Image  # (h_n, w_n)

    def parts(self) -> list[Image]:
        """High-pass residual, every band, low-pass residual: 2 + levels x orientations images."""
        return [self.high, *(band for level in self.bands for band in level), self.low]

    def with_parts(self, parts: list[Image]) -> Pyramid:
        """A pyramid of this layout with other images, in the order of `parts`."""
        bands, at = [], 1
        for level in self.bands:
            bands.append(np.stack(parts[at : at + len(level)]))
            at += len(level)
        return Pyramid(parts[0], bands, parts[at])


def build(image: Image, levels: int = 7, orientations: int = 4) -> Pyramid:
    """Decompose an image, which is continued periodically.

    Parameters
    ----------
    image
        (h, w), in single precision or, if it is of any other type, in double precision.
    levels
        Octaves; each halves both sides, rounded up. At most as many as leave a low-pass residual of one entry.
    orientations
        Bands of each level; the first one answers to changes along w, the others follow in steps of pi / orientations.

    Returns
    -------
    Pyramid
        `reconstruct` gives the image back: within 1e-12 of its range in double precision, 1e-6 in single precision.

    Raises
    ------
    ValueError
        If the image is not two-dimensional and finite, or too small for so many levels.
    """
    image = np.asarray(image)
    image = image if image.dtype == np.float32 else image.astype(np.float64)
    if image.ndim != 2 or not image.size or not np.isfinite(image).all():
        raise ValueError(f"an image must have two dimensions and finite values, not the shape {image.shape}")
    if orientations < 1 or levels < 0 or 2**levels > max(image.shape):
        most = max(image.shape).bit_length() - 1
        raise ValueError(
            f"{levels} levels of {orientations} bands: {image.shape} has up to {most} levels, of 1 or more"
        )
    spectrum = _transform(image)
    whole, kind = image.shape, image.dtype.type
    low, high = _low(whole, whole, 0, kind)
    residual, bands = _image(spectrum * high, whole), []
    spectrum *= low
    for level, (size, smaller) in enumerate(_sizes(whole, levels)):
        low, high = _low(size, whole, level + 1, kind)
        ring = spectrum * high * _phase(orientations, kind)
        bands.append(np.stack([_image(ring * mask, size) for mask in _angular(size, whole, orientations, kind)]))
        spectrum = _cropped(spectrum * low, smaller)
    size = _sizes(image.shape, levels)[-1][1] if levels else image.shape
    return Pyramid(residual, bands, _image(spectrum, size))


def reconstruct(pyramid: Pyramid) -> Image:
    """The image of a pyramid, the sum of its parts through the masks that made them."""
    whole, kind = pyramid.high.shape, pyramid.high.dtype.type
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


def _sizes(shape: tuple[int, ...], levels: int) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Size of each level, and of the next one."""
    found = []
    for _ in range(levels):
        smaller = tuple((side + 1) // 2 for side in shape)
        found.append((shape, smaller))
        shape = smaller
    return found


def _frequencies(size: tuple[int, ...], whole: tuple[int, ...], kind: Any) -> tuple[Image, Image]:
    """Cycles per entry of the whole image at which a level of some size has its spectrum, 0.5 at the most."""
    rows = fftfreq(size[0], 1 / size[0]) / whole[0]
    return rows[:, None].astype(kind), (rfftfreq(size[1], 1 / size[1]) / whole[1])[None].astype(kind)


def _low(size: tuple[int, ...], whole: tuple[int, ...], level: int, kind: Any) -> tuple[Image, Image]:
    """Two masks whose squares add up to 1.

    The first is 1 up to half of the highest frequency of a level, 0 from that frequency on, and a cosine of the
    frequency's logarithm between.
    """
    rows, columns = _frequencies(size, whole, kind)
    square = rows * rows + columns * columns
    square *= 4.0 ** (level + 1)
    between = np.flatnonzero((square > 0.25) & (square < 1))
    low, high = (square <= 0.25).astype(kind), (square >= 1).astype(kind)
    octave = pi / 4 * np.log2(square.ravel()[between]) + pi / 2
    low.ravel()[between], high.ravel()[between] = np.cos(octave), np.sin(octave)
    return low, high


def _angular(size: tuple[int, ...], whole: tuple[int, ...], orientations: int, kind: Any) -> Iterator[Image]:
    """Masks whose squares add up to 1: powers of the cosine to each direction."""
    rows, columns = _frequencies(size, whole, kind)
    order = orientations - 1
    scale = 2**order * factorial(order) / sqrt(orientations * factorial(2 * order))
    inverse = rows * rows + columns * columns
    inverse.flat[0] = 1  # no direction: other masks are 0 there
    inverse = 1 / np.sqrt(inverse)
    for angle in pi * np.arange(orientations) / orientations:
        along = (columns * kind(np.cos(angle)) + rows * kind(np.sin(angle))) * inverse
        mask = np.full_like(along, scale)
        for _ in range(order):
            mask *= along
        yield mask


def _phase(orientations: int, kind: Any) -> Any:
    """What makes bands real: odd powers of the cosine change their sign with that of the frequency."""
    return np.result_type(kind, np.complex64).type((-1j) ** (orientations - 1))


def _cropped(spectrum: Spectrum, size: tuple[int, ...]) -> Spectrum:
    """The frequencies of a smaller image; the others are 0 by the mask."""
    rows, columns = (size[0] + 1) // 2, size[1] // 2 + 1
    return np.concatenate([spectrum[:rows, :columns], spectrum[len(spectrum) - size[0] // 2 :, :columns]])


def _widened(spectrum: Spectrum, size: tuple[int, ...]) -> Spectrum:
    """The spectrum in that of a larger image."""
    out = np.zeros((size[0], size[1] // 2 + 1), spectrum.dtype)
    rows, columns = (len(spectrum) + 1) // 2, spectrum.shape[1]
    out[:rows, :columns] = spectrum[:rows]
    out[len(out) - len(spectrum) // 2 :, :columns] = spectrum[rows:]
    return out


def _transform(image: Image) -> Spectrum:
    return np.asarray(rfft2(image, norm="forward"))


def _image(spectrum: Spectrum, size: tuple[int, ...]) -> Image:
    return np.asarray(irfft2(spectrum, s=size, norm="forward"))
