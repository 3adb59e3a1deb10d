"""Kernels of ingest: pictures to values at many positions, and radiance to samples."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from skindb.calibration._merge_kernels import DARK, OK, SATURATED
from skindb.jit import inline_kernel, kernel, single
from skindb.types import (
    BoolVector,
    ByteMatrix,
    ByteVector,
    Cube,
    Cube32,
    IntMatrix,
    IntMatrix32,
    Matrix,
    Matrix32,
    Vector,
    Vector32,
)

Halves = np.ndarray[tuple[int, int], np.dtype[np.uint16]]  # bits of half floats
NONE = 3  # outcome besides those of a pixel: no sample was requested
NAN_BITS = np.uint16(0x7E00)  # the half float NaN
MAX_HALF_FLOAT = 65504.0  # larger numbers are infinite in half precision
# fraction of dark pixels above which a sample is dark; the rest allows for rounding in
# the sum of weights
MIN_DARK_FRACTION = 0.999
FLOOR = 1e-30  # keeps quotients finite where a picture is black


class MergedView(NamedTuple):
    """The merged exposures of a view, from `develop`."""

    radiance: Cube32  # (h, w, 3)
    flag: ByteMatrix  # (h, w)


class PointLight(NamedTuple):
    """A light as it reaches a point."""

    position: Vector  # (3,) mm
    axis: Vector  # (3,) unit direction in which it shines
    falloff: float  # exponent of the cosine to the axis
    intensity: Vector  # (3,) radiance mm^2


@kernel
def pixel_spans(
    surfels: BoolVector, pixels: Matrix32, height: int, width: int
) -> IntMatrix:
    """Spans (h, 2) of the pixels that `gather` reads for surfels (n,) bool; see `develop`."""
    spans = np.empty((height, 2), np.int64)
    spans[:, 0] = width
    spans[:, 1] = 0
    for i in range(surfels.shape[0]):
        if surfels[i]:
            left, right, top, bottom = _bilinear_bounds(
                pixels[i, 0], pixels[i, 1], height, width
            )
            for row in range(top, bottom + 1):
                spans[row, 0] = min(spans[row, 0], left)
                spans[row, 1] = max(spans[row, 1], right + 1)
    return spans


@kernel
def _bilinear_bounds(
    column: float, row: float, height: int, width: int
) -> tuple[int, int, int, int]:
    """First and last column and row of the four pixels around a position; an empty
    range outside the picture.
    """
    if not (column >= 0 and column <= width and row >= 0 and row <= height):
        return 0, -1, 0, -1
    left = int(max(column - 0.5, 0.0))
    top = int(max(row - 0.5, 0.0))
    return (
        min(left, width - 1),
        min(left + 1, width - 1),
        min(top, height - 1),
        min(top + 1, height - 1),
    )


@kernel
def gather(
    view: MergedView,
    surfels: BoolVector,
    pixels: Matrix32,
    position: Matrix,
    normal: Matrix,
    light: PointLight,
    out: Halves,
    outcome: ByteVector,
) -> None:
    """Reflectance rho = L d^2 / (I falloff) of every surfel in one view
    (Weyrich et al. 2005, eq. 3).

    Parameters
    ----------
    view
        Radiance and flags.
    surfels
        (n,) bool; those to sample. Those that face away from the light get no sample.
    pixels
        (n, 2) float32 projections.
    position, normal
        (n, 3) float64 in mm, and unit vectors.
    light
        The light of the view.
    out
        (3, n) uint16 output: half floats, NaN where there is no sample.
    outcome
        (n,) uint8 output: OK, NONE, SATURATED (a contributing pixel was saturated), DARK
        (all contributing pixels were dark).
    """
    pixel = np.empty(4)
    factor = 1.0 / light.intensity
    out[:] = NAN_BITS
    outcome[:] = NONE
    for i in range(surfels.shape[0]):
        if not surfels[i]:
            continue
        scale = _square_over_falloff(light, position[i], normal[i])
        if scale == 0.0:
            continue
        state = _bilinear(view, pixels[i, 0], pixels[i, 1], pixel)
        outcome[i] = state
        if state == OK:
            for c in range(3):
                out[c, i] = _half_or_nan(pixel[c] * scale * factor[c])


@kernel
def _square_over_falloff(light: PointLight, position: Vector, normal: Vector) -> float:
    """Squared distance of a light over its fall-off; 0 where it does not reach the
    front of a surfel.
    """
    x = position[0] - light.position[0]
    y = position[1] - light.position[1]
    z = position[2] - light.position[2]
    # also rejects NaN
    if not x * normal[0] + y * normal[1] + z * normal[2] < 0:
        return 0.0
    square = x * x + y * y + z * z
    if not light.falloff:
        return square
    axis = light.axis
    cosine = (x * axis[0] + y * axis[1] + z * axis[2]) / np.sqrt(square)
    return square / cosine**light.falloff if cosine > 0 else 0.0


@kernel
def pixel_counts(
    surfels: BoolVector, pixels: Matrix32, height: int, width: int, out: Vector32
) -> None:
    """Effective number of pixels (n,) that `gather` averages for each surfel; NaN where
    it takes no sample.
    """
    out[:] = np.nan
    for i in range(surfels.shape[0]):
        if not surfels[i]:
            continue
        column = pixels[i, 0]
        row = pixels[i, 1]
        if column >= 0 and column <= width and row >= 0 and row <= height:
            x = min(max(column - 0.5, 0.0), width - 1.0)
            y = min(max(row - 0.5, 0.0), height - 1.0)
            x = x - int(x)
            y = y - int(y)
            out[i] = 1.0 / (
                (x * x + (1.0 - x) * (1.0 - x)) * (y * y + (1.0 - y) * (1.0 - y))
            )


@kernel
def tally(outcome: ByteVector, counts: IntMatrix32) -> int:
    """Add the outcome of each surfel (n,) to its counts (state, n); return how many are
    usable.
    """
    usable = 0
    for i in range(outcome.shape[0]):
        if outcome[i] < counts.shape[0]:
            counts[outcome[i], i] += 1
            usable += outcome[i] == OK
    return usable


@kernel
def view_levels(
    samples: Halves, outcome: ByteVector, bright: float
) -> tuple[int, bool, float, float]:
    """Number of usable samples of a view, whether one of their channels is positive,
    median of the channels, and fraction with a channel above `bright`.

    `samples` (3, n) are bits of half floats; NaN, beyond half precision, counts as
    infinite. The median is found by counting the values in their order.
    """
    counts = np.zeros(1 << 16, np.int32)
    usable = 0
    too_bright = 0
    for i in range(outcome.shape[0]):
        if outcome[i] != OK:
            continue
        usable += 1
        above = False
        for c in range(3):
            bits = samples[c, i]
            # in the order of the values: negative ones reversed, below the others
            counts[0xFFFF - bits if bits & 0x8000 else 0x8000 + bits] += 1
            above = above or not single(bits) <= bright
        too_bright += above
    lit = bool(counts[0x8001:].any())
    if usable == 0:
        return 0, lit, np.nan, 0.0
    total = 0
    below = -1
    middle = 0.0
    for k in range(counts.shape[0]):
        total += counts[k]
        if below < 0 and 2 * total >= 3 * usable:
            below = k
        if 2 * total > 3 * usable:
            middle = 0.5 * (_ordered_half(below) + _ordered_half(k))
            break
    return usable, lit, middle, too_bright / usable


@kernel
def _ordered_half(place: int) -> float:
    """Value of the half float at this place in the order of all."""
    bits = place - 0x8000 if place >= 0x8000 else 0xFFFF - place
    value = np.float64(single(np.uint16(bits)))
    return np.inf if np.isnan(value) else value


@kernel
def block_means(image: Cube32, factor: int, out: Cube32) -> None:
    """Means (h // factor, w // factor, c) of square blocks of a picture (h, w, c); NaN
    and inf count as its maximum, which is at least 0, and -inf as 0.
    """
    height, width, channels = out.shape
    missing = np.zeros((height, width, channels), np.float32)
    top = np.float32(0.0)
    out[:] = 0.0
    for y in range(height * factor):
        v = y // factor
        for u in range(width):
            for x in range(u * factor, (u + 1) * factor):
                for c in range(channels):
                    value = image[y, x, c]
                    if not value < np.inf:
                        missing[v, u, c] += 1.0
                    elif value > -np.inf:
                        out[v, u, c] += value
                        top = max(top, value)
    for v in range(height):
        for u in range(width):
            for c in range(channels):
                out[v, u, c] = (out[v, u, c] + missing[v, u, c] * top) / factor**2


@kernel
def _bilinear(view: MergedView, column: float, row: float, pixel: Vector) -> int:
    """Interpolate bilinearly between the four pixels around a position; the outer half
    pixel repeats the edge.
    """
    height, width = view.flag.shape
    if not (column >= 0 and column <= width and row >= 0 and row <= height):
        return NONE
    x = min(max(column - 0.5, 0.0), width - 1.0)
    y = min(max(row - 0.5, 0.0), height - 1.0)
    left = int(x)
    top = int(y)
    pixel[:] = 0.0
    for down in range(2):
        for right in range(2):
            weight = (x - left if right else 1.0 - (x - left)) * (
                y - top if down else 1.0 - (y - top)
            )
            # a neighbour of weight 0 may lie outside
            if weight > 0:
                state = _add(view, left + right, top + down, weight, pixel)
                if state == SATURATED:
                    return SATURATED
    return DARK if pixel[3] > MIN_DARK_FRACTION else OK


@inline_kernel
def _add(view: MergedView, u: int, v: int, weight: float, pixel: Vector) -> int:
    """Add one pixel to a sample, and return the flag of the pixel."""
    state = view.flag[v, u]
    pixel[0] += weight * view.radiance[v, u, 0]
    pixel[1] += weight * view.radiance[v, u, 1]
    pixel[2] += weight * view.radiance[v, u, 2]
    pixel[3] += weight if state == DARK else 0.0
    return int(state)


@intrinsic
def _half_bits(_typing: Any, number: Any) -> Any:
    """Bits of the half float nearest to a double, by a CPU instruction that rounds to
    single precision first.
    """

    def codegen(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        single = builder.fptrunc(arguments[0], ir.FloatType())
        return builder.bitcast(builder.fptrunc(single, ir.HalfType()), ir.IntType(16))

    return types.uint16(number), codegen


@kernel
def _half_or_nan(number: float) -> np.uint16:
    return _half_bits(np.float64(number)) if abs(number) < MAX_HALF_FLOAT else NAN_BITS


@kernel
def interpolate(images: Cube, pixels: Matrix, out: Matrix) -> None:
    """Bilinear values (n, picture) of pictures (h, w, picture) at pixels (n, 2); 0
    outside, also where these are NaN.
    """
    for k in range(len(pixels)):
        _picture_values(images, pixels[k, 0], pixels[k, 1], out[k])


@kernel
def _picture_values(images: Cube, x: float, y: float, out: Vector) -> None:
    """Bilinear values (picture,) of pictures (h, w, picture) at one position."""
    height, width, count = images.shape
    inside = x >= 0 and x <= width and y >= 0 and y <= height
    if not inside or width == 0 or height == 0:
        out[:] = 0.0
        return
    column = min(max(x - 0.5, 0.0), width - 1.0)
    row = min(max(y - 0.5, 0.0), height - 1.0)
    left = min(int(column), max(width - 2, 0))
    top = min(int(row), max(height - 2, 0))
    right = min(left + 1, width - 1)
    below = min(top + 1, height - 1)
    a = column - left
    b = row - top
    for i in range(count):
        upper = images[top, left, i] * (1 - a) + images[top, right, i] * a
        lower = images[below, left, i] * (1 - a) + images[below, right, i] * a
        out[i] = upper * (1 - b) + lower * b


@kernel
def shift_moments(
    images: Cube, pixels: Matrix, shifts: Matrix, shade: Matrix, out: Matrix
) -> None:
    """Sum of the values of pictures (h, w, picture) at pixels (n, 2) plus each shift
    (m, 2), of their squares, and of their products with `shade` (n, picture), in `out` (m, 3).
    """
    values = np.empty(images.shape[2])
    for s in range(len(shifts)):
        total = 0.0
        square = 0.0
        product = 0.0
        for k in range(len(pixels)):
            x = pixels[k, 0] + shifts[s, 0]
            _picture_values(images, x, pixels[k, 1] + shifts[s, 1], values)
            for i in range(len(values)):
                total += values[i]
                square += values[i] * values[i]
                product += values[i] * shade[k, i]
        out[s, 0] = total
        out[s, 1] = square
        out[s, 2] = product


@kernel
def alignment_rows(
    images: Cube, pixels: Matrix, moves: Cube, shade: Matrix, rows: Cube, rest: Matrix
) -> None:
    """Linear equations for the parameters that move pixels so that pictures show a shade.

    The gain of each picture is eliminated: a row is orthogonal to the shade.

    Parameters
    ----------
    images, pixels
        (h, w, picture) and (n, 2).
    moves
        (n, 2, 4) change of the pixels by each parameter.
    shade
        (n, picture) expected values, in any unit.
    rows, rest
        (n, picture, 4) and (n, picture) output: derivatives of the values, and what
        they lack.
    """
    count = images.shape[2]
    gain = np.zeros(count)
    along = np.zeros((count, 4))
    square = np.full(count, FLOOR)
    values = np.empty((4, count))
    for k in range(len(pixels)):
        x = pixels[k, 0]
        y = pixels[k, 1]
        _picture_values(images, x, y, rest[k])
        _picture_values(images, x + 0.5, y, values[0])
        _picture_values(images, x - 0.5, y, values[1])
        _picture_values(images, x, y + 0.5, values[2])
        _picture_values(images, x, y - 0.5, values[3])
        for i in range(count):
            square[i] += shade[k, i] * shade[k, i]
            gain[i] += rest[k, i] * shade[k, i]
            across = values[0, i] - values[1, i]
            down = values[2, i] - values[3, i]
            for m in range(4):
                rows[k, i, m] = across * moves[k, 0, m] + down * moves[k, 1, m]
                along[i, m] += shade[k, i] * rows[k, i, m]
    for k in range(len(pixels)):
        for i in range(count):
            part = shade[k, i] / square[i]
            rest[k, i] = gain[i] * part - rest[k, i]
            for m in range(4):
                rows[k, i, m] -= along[i, m] * part
