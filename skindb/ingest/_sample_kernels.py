"""Kernels of ingest: exposures to radiance, radiance to samples. A frame is read once, without the interpreter lock."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from skindb._compiled import inline_kernel, kernel
from skindb.ingest.pixel_flags import DARK, DARK_SIGMA, OK, SATURATED

NONE = 3  # what became of a sample, besides what becomes of pixels: none was to be taken
NAN_BITS = np.uint16(0x7E00)  # a half float that is no number
MAX_HALF_FLOAT = 65504.0  # larger numbers are infinite in half precision
MIN_DARK_FRACTION = (
    0.999  # fraction of a sample's pixels from which on it is dark; less is the rounding of the weights' sum
)
FOOTPRINT_REACH = 8.0  # where the weight (1 - q / FOOTPRINT_REACH)^2 ends; its second moments are those of exp(-q / 2)
MIN_VARIANCE = np.float32(1e-30)  # of relative exposure; the weight 1 / variance stays finite
ZERO, ONE, ENDLESS = np.float32(0.0), np.float32(1.0), np.float32(np.inf)
NO_USABLE_EXPOSURE = np.float32(
    100.0
)  # marks a channel that was saturated in every exposure; no count of exposures comes near


@kernel
def develop(
    frames: Any,
    dark: Any,
    curve: Any,
    offset: int,
    zero: float,
    span: float,
    variance: float,
    white: float,
    seconds: Any,
    photon: float,
    gain: Any,
    matrix: Any,
    spans: Any,
    radiance: Any,
    flag: Any,
) -> None:
    """Radiance of the exposures of one view; the formulas are those of `skindb.ingest.radiance.merge_exposures`.

    Row by row, so that what is between the exposures stays in the cache. Every loop is short of branches, and of
    arrays: LLVM makes no vectors where it would have to compare more than eight pairs of addresses.

    Parameters
    ----------
    frames
        Per exposure (h, w, 3) uint8 or uint16.
    dark
        (e, h, w, 3), subtracted; or of no rows.
    curve
        (m, 3, 2) float32 relative exposure and its read variance at value + offset; or (0, 3, 2): linear,
        (value - zero) / span with `variance`.
    offset, zero, span, variance
        See curve.
    white
        Values from here on are saturated.
    seconds
        (e,) float32 shares of the longest exposure.
    photon
        Variance of photons per relative exposure: 1 / electrons at white.
    gain
        (h, w) float32 what relative radiance is multiplied by, or (1, 1).
    matrix
        (3, 3) float32 of the colours, or (0, 3).
    spans
        (h, 2) first column of each row to develop, and the one after the last.
    radiance
        (h, w, 3) float32, written in the spans: NaN where a channel was saturated in every exposure.
    flag
        (h, w) uint8, written; SATURATED beside the spans: no sample takes such a pixel.
    """
    count, (height, width) = len(frames), flag.shape
    signal, noise = np.empty((count, 3 * width), np.float32), np.empty((count, 3 * width), np.float32)
    total, time = np.empty(3 * width, np.float32), np.empty(3 * width, np.float32)
    above, weights = np.empty(3 * width, np.float32), np.empty(3 * width, np.float32)
    black = np.full(3 * width, np.float32(zero), np.float32)
    slope = ONE / np.float32(span)
    for y in range(height):
        first, last = spans[y, 0], max(spans[y, 0], spans[y, 1])
        flag[y, :first], flag[y, last:] = SATURATED, SATURATED
        begin, size = 3 * first, 3 * (last - first)
        if size == 0:
            continue
        total[:size], time[:size], above[:size] = ZERO, ZERO, ZERO
        for e in range(count):
            value = frames[e][y].reshape(3 * width)[begin : begin + size]
            own, spread = signal[e, :size], noise[e, :size]
            if curve.shape[0]:
                shade = dark[e, y].reshape(3 * width)[begin : begin + size] if dark.shape[0] else dark[:0, 0, 0, 0]
                _bent(value, shade, curve, offset, own, spread)
            else:
                if dark.shape[0]:
                    black[:size] = dark[e, y].reshape(3 * width)[begin : begin + size]
                _straight(value, black, slope, own)
                spread[:] = np.float32(variance)
            _collect(value, np.float32(white), own, spread, seconds[e], total[:size], time[:size], above[:size])
        for k in range(size):
            expected = total[k] / time[k]
            total[k] = np.float32(photon) * (expected if expected > ZERO else ZERO)
        _average(signal, noise, seconds, total[:size], weights[:size])
        _finish(y, first, total[:size], time, above, gain, matrix, radiance, flag)


@kernel
def _straight(value: Any, black: Any, slope: float, signal: Any) -> None:
    for k in range(value.shape[0]):
        signal[k] = (np.float32(value[k]) - black[k]) * slope


@kernel
def _bent(value: Any, dark: Any, curve: Any, offset: int, signal: Any, noise: Any) -> None:
    """The same by a table; `dark` is empty where it is in the table."""
    for k in range(value.shape[0]):
        at = np.int64(value[k]) + offset - (np.int64(dark[k]) if dark.shape[0] else 0)
        signal[k], noise[k] = curve[at, k % 3, 0], curve[at, k % 3, 1]


@kernel
def _collect(
    value: Any, white: float, signal: Any, noise: Any, seconds: float, total: Any, time: Any, above: Any
) -> None:
    """Sums over exposures below the white level, whose noise is infinite from there on.

    `above`: in how many a value is more than noise.
    """
    for k in range(value.shape[0]):
        above[k] += ONE if signal[k] > DARK_SIGMA * np.sqrt(noise[k]) else ZERO
    for k in range(value.shape[0]):
        noise[k] = noise[k] if np.float32(value[k]) < white else ENDLESS
    for k in range(value.shape[0]):
        total[k] += signal[k] if noise[k] < ENDLESS else ZERO
        time[k] += seconds if noise[k] < ENDLESS else ZERO


@kernel
def _average(signal: Any, noise: Any, seconds: Any, photons: Any, weights: Any) -> None:
    """Mean of the exposures, weighted by inverse variance, in place of `photons`; 0 / 0 where none is usable."""
    weights[:] = ZERO
    mean = np.zeros_like(weights)
    for e in range(signal.shape[0]):
        second, own, spread = seconds[e], signal[e], noise[e]
        for k in range(weights.shape[0]):
            variance = photons[k] * second + spread[k]
            weight = second / (variance if variance > MIN_VARIANCE else MIN_VARIANCE)
            mean[k] += weight * own[k]
            weights[k] += weight * second
    for k in range(weights.shape[0]):
        photons[k] = mean[k] / weights[k]


@kernel
def _finish(y: int, first: int, value: Any, time: Any, above: Any, gain: Any, matrix: Any, out: Any, flag: Any) -> None:
    """Vignette, colours and flags of a row."""
    pixels = value.shape[0] // 3
    row = out[y, first : first + pixels].reshape(value.shape[0])
    if gain.shape[0] == 1:
        scale = gain[0, 0]
        for k in range(value.shape[0]):
            row[k] = value[k] * scale
    else:
        for x in range(pixels):
            factor = gain[y, first + x]
            for k in range(3 * x, 3 * x + 3):
                row[k] = value[k] * factor
    if matrix.shape[0]:
        for k in range(0, value.shape[0], 3):
            r, g, b = row[k], row[k + 1], row[k + 2]
            row[k] = matrix[0, 0] * r + matrix[0, 1] * g + matrix[0, 2] * b
            row[k + 1] = matrix[1, 0] * r + matrix[1, 1] * g + matrix[1, 2] * b
            row[k + 2] = matrix[2, 0] * r + matrix[2, 1] * g + matrix[2, 2] * b
    for k in range(value.shape[0]):  # sums over channels tell the three cases apart
        above[k] = NO_USABLE_EXPOSURE if time[k] == ZERO else min(above[k], ONE)
    for x in range(pixels):
        found = above[3 * x] + above[3 * x + 1] + above[3 * x + 2]
        flag[y, first + x] = SATURATED if found >= NO_USABLE_EXPOSURE else DARK if found == ZERO else OK


@kernel
def touched(wanted: Any, pixels: Any, spread: Any, height: int, width: int) -> Any:
    """Spans (h, 2) of the pixels that `gather` takes for the wanted surfels (n,); see `develop`."""
    spans = np.empty((height, 2), np.int64)
    spans[:, 0], spans[:, 1] = width, 0
    for i in range(wanted.shape[0]):
        if wanted[i]:
            if spread.shape[0] and not np.isnan(spread[i, 0]):
                left, right, top, bottom = _around(pixels[i, 0], pixels[i, 1], spread[i], height, width)
            else:
                left, right, top, bottom = _between(pixels[i, 0], pixels[i, 1], height, width)
            for row in range(top, bottom + 1):
                spans[row, 0], spans[row, 1] = min(spans[row, 0], left), max(spans[row, 1], right + 1)
    return spans


@kernel
def _between(column: float, row: float, height: int, width: int) -> Any:
    """First and last column and row of the four pixels around a place, or of none outside the picture."""
    if not (column >= 0 and column <= width and row >= 0 and row <= height):
        return 0, -1, 0, -1
    left, top = int(max(column - 0.5, 0.0)), int(max(row - 0.5, 0.0))
    return min(left, width - 1), min(left + 1, width - 1), min(top, height - 1), min(top + 1, height - 1)


@kernel
def _around(column: float, row: float, spread: Any, height: int, width: int) -> Any:
    """First and last column and row of pixels with their centres inside a footprint; of none if it leaves the picture.

    Half a footprint would be the mean of another place.
    """
    xx, xy, yy = float(spread[0]), float(spread[1]), float(spread[2])
    inside = column >= 0 and column <= width and row >= 0 and row <= height
    if not (xx * yy - xy * xy > 0 and inside):
        return 0, -1, 0, -1
    left, right = (
        int(np.ceil(column - 0.5 - np.sqrt(FOOTPRINT_REACH * xx))),
        int(np.floor(column - 0.5 + np.sqrt(FOOTPRINT_REACH * xx))),
    )
    top, bottom = (
        int(np.ceil(row - 0.5 - np.sqrt(FOOTPRINT_REACH * yy))),
        int(np.floor(row - 0.5 + np.sqrt(FOOTPRINT_REACH * yy))),
    )
    if left < 0 or top < 0 or right >= width or bottom >= height:
        return 0, -1, 0, -1
    return left, right, top, bottom


@kernel
def gather(
    radiance: Any,
    flag: Any,
    wanted: Any,
    share: Any,
    pixels: Any,
    spread: Any,
    position: Any,
    normal: Any,
    light: Any,
    axis: Any,
    falloff: float,
    intensity: Any,
    out: Any,
    became: Any,
) -> None:
    """Reflectance rho = L d^2 / (I falloff share) of every surfel in one view (Weyrich et al. 2005, eq. 3).

    Parameters
    ----------
    radiance, flag
        (h, w, 3) float32 and (h, w) uint8, of `develop`.
    wanted
        (n,) bool; only these, and of them those that the light reaches from the front.
    share
        (n,) float32 visible share of the light's disc, 0: no sample; or (0,): all of it.
    pixels
        (n, 2) float32 projections.
    spread
        (n, 3) float32 variances xx, xy, yy [px^2] of the footprint: weights (1 - q / 8)^2, where q is the square
        distance in units of them; NaN, or (0, 3): bilinear.
    position, normal
        (n, 3) float64 mm and directions.
    light, axis, falloff, intensity
        (3,) mm, (3,), exponent of the cosine to the axis, (3,) radiance mm^2.
    out
        (3, n) uint16, written: half floats, NaN where there is no sample.
    became
        (n,) uint8, written: OK, NONE, SATURATED (a pixel that takes part was), DARK (all were).
    """
    found = np.empty(4)
    factor = 1.0 / intensity
    out[:], became[:] = NAN_BITS, NONE
    for i in range(wanted.shape[0]):
        if not wanted[i] or (share.shape[0] and share[i] <= 0):
            continue
        x, y, z = position[i, 0] - light[0], position[i, 1] - light[1], position[i, 2] - light[2]
        if not x * normal[i, 0] + y * normal[i, 1] + z * normal[i, 2] < 0:  # NaN neither
            continue
        scale = x * x + y * y + z * z
        if falloff:
            cosine = (x * axis[0] + y * axis[1] + z * axis[2]) / np.sqrt(scale)
            if cosine <= 0:
                continue
            scale /= cosine**falloff
        if share.shape[0]:
            scale /= share[i]
        if spread.shape[0] and not np.isnan(spread[i, 0]):
            state = _footprint(radiance, flag, pixels[i, 0], pixels[i, 1], spread[i], found)
        else:
            state = _bilinear(radiance, flag, pixels[i, 0], pixels[i, 1], found)
        became[i] = state
        if state == OK:
            r, g, b = found[0] * scale * factor[0], found[1] * scale * factor[1], found[2] * scale * factor[2]
            out[0, i], out[1, i], out[2, i] = _half_or_nan(r), _half_or_nan(g), _half_or_nan(b)


@kernel
def tally(became: Any, counts: Any) -> int:
    """Add what became of each surfel (n,) to its counts (state, n); how many became OK."""
    usable = 0
    for i in range(became.shape[0]):
        if became[i] < counts.shape[0]:
            counts[became[i], i] += 1
            usable += became[i] == OK
    return usable


@kernel
def _bilinear(radiance: Any, flag: Any, column: float, row: float, found: Any) -> int:
    """Between the four pixels around a place; in the outer half pixel the nearest edge."""
    height, width = flag.shape
    if not (column >= 0 and column <= width and row >= 0 and row <= height):
        return NONE
    x, y = min(max(column - 0.5, 0.0), width - 1.0), min(max(row - 0.5, 0.0), height - 1.0)
    left, top = int(x), int(y)
    found[:] = 0.0
    for down in range(2):
        for right in range(2):
            weight = (x - left if right else 1.0 - (x - left)) * (y - top if down else 1.0 - (y - top))
            # a neighbour of weight 0 may lie outside
            if weight > 0 and _add(radiance, flag, left + right, top + down, weight, found) == SATURATED:
                return SATURATED
    return DARK if found[3] > MIN_DARK_FRACTION else OK


@kernel
def _footprint(radiance: Any, flag: Any, column: float, row: float, spread: Any, found: Any) -> int:
    """Weighted mean over an ellipse of pixels (Heckbert 1989, the elliptical weighted average)."""
    left, right, top, bottom = _around(column, row, spread, *flag.shape)
    xx, xy, yy = float(spread[0]), float(spread[1]), float(spread[2])
    found[:] = 0.0
    total = 0.0
    scale = 1.0 / (FOOTPRINT_REACH * (xx * yy - xy * xy))
    for v in range(top, bottom + 1):
        dy = v + 0.5 - row
        for u in range(left, right + 1):
            dx = u + 0.5 - column
            rest = 1.0 - (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) * scale
            if rest > 0:
                weight = rest * rest
                total += weight
                if _add(radiance, flag, u, v, weight, found) == SATURATED:
                    return SATURATED
    if total == 0:
        return NONE
    for k in range(4):
        found[k] /= total
    return DARK if found[3] > MIN_DARK_FRACTION else OK


@inline_kernel
def _add(radiance: Any, flag: Any, u: int, v: int, weight: float, found: Any) -> int:
    """One more pixel of a sample; what became of the pixel."""
    state = flag[v, u]
    found[0] += weight * radiance[v, u, 0]
    found[1] += weight * radiance[v, u, 1]
    found[2] += weight * radiance[v, u, 2]
    found[3] += weight if state == DARK else 0.0
    return int(state)


@intrinsic
def _half_bits(_typing: Any, number: Any) -> Any:
    """The bits of the half float nearest to a double, by the processor; rounded once more on the way, to a float."""

    def codegen(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        single = builder.fptrunc(arguments[0], ir.FloatType())
        return builder.bitcast(builder.fptrunc(single, ir.HalfType()), ir.IntType(16))

    return types.uint16(number), codegen


@kernel
def _half_or_nan(number: float) -> Any:
    return _half_bits(np.float64(number)) if abs(number) < MAX_HALF_FLOAT else NAN_BITS
