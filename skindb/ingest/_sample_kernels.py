"""Kernels of ingest: exposures to radiance, radiance to samples. A frame is read once,
with the GIL released.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from skindb.calibration.pixel_flags import DARK, DARK_SIGMA, OK, SATURATED
from skindb.jit import inline_kernel, kernel

# outcomes of a sample besides those of a pixel: usable, but no pixel has two exposures;
# no sample was requested
SINGLE = 3
NONE = 4
NAN_BITS = np.uint16(0x7E00)  # the half float NaN
MAX_HALF_FLOAT = 65504.0  # larger numbers are infinite in half precision
# fraction of dark pixels above which a sample is dark; the rest allows for rounding in
# the sum of weights
MIN_DARK_FRACTION = 0.999
# end of the weight (1 - q / FOOTPRINT_REACH)^2, whose second moments are those of a
# Gaussian
FOOTPRINT_REACH = 8.0
# of relative exposure; the weight 1 / variance stays finite
MIN_VARIANCE = np.float32(1e-30)
ZERO = np.float32(0.0)
ONE = np.float32(1.0)
ENDLESS = np.float32(np.inf)
# marks a channel that was saturated in every exposure; larger than any number of
# exposures
NO_USABLE_EXPOSURE = np.float32(100.0)


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
    usable: Any,
) -> None:
    """Merge the exposures of one view to radiance with the formulas of
    `skindb.calibration.radiance.merge_exposures`.

    The picture is processed row by row, so that intermediate values stay in the cache.
    Loops have few branches and few arrays: LLVM does not vectorise a loop for which it
    would have to compare more than eight pairs of addresses.

    Parameters
    ----------
    frames
        One array (h, w, 3) of uint8 or uint16 per exposure.
    dark
        (e, h, w, 3) dark frames, which are subtracted; or an array without rows.
    curve
        (m, 3, 2) float32 relative exposure and its read variance at value + offset; or
        (0, 3, 2) for a linear response, (value - zero) / span with `variance`.
    offset, zero, span, variance
        See `curve`.
    white
        Values at or above this level are saturated.
    seconds
        (e,) float32 exposure times as fractions of the longest one.
    photon
        Variance of photon noise per relative exposure: 1 / electrons at the white level.
    gain
        (h, w) float32 factor of the relative radiance, or (1, 1).
    matrix
        (3, 3) float32 colour matrix, or (0, 3) for none.
    spans
        (h, 2) first column of each row to process, and the one after the last.
    radiance
        (h, w, 3) float32 output within the spans: NaN where a channel was saturated in
        every exposure.
    flag
        (h, w) uint8 output; SATURATED outside the spans, where no sample uses the pixel.
    usable
        (h, w) uint8 zeros, output: see `skindb.calibration.radiance.usable_exposures`; or (0, 0).
    """
    count, (height, width) = len(frames), flag.shape
    signal = np.empty((count, 3 * width), np.float32)
    noise = np.empty((count, 3 * width), np.float32)
    total = np.empty(3 * width, np.float32)
    time = np.empty(3 * width, np.float32)
    above = np.empty(3 * width, np.float32)
    weights = np.empty(3 * width, np.float32)
    black = np.full(3 * width, np.float32(zero), np.float32)
    slope = ONE / np.float32(span)
    for y in range(height):
        first = spans[y, 0]
        last = max(spans[y, 0], spans[y, 1])
        flag[y, :first], flag[y, last:] = SATURATED, SATURATED
        begin = 3 * first
        size = 3 * (last - first)
        if size == 0:
            continue
        total[:size], time[:size], above[:size] = ZERO, ZERO, ZERO
        for e in range(count):
            value = frames[e][y].reshape(3 * width)[begin : begin + size]
            own = signal[e, :size]
            spread = noise[e, :size]
            if curve.shape[0]:
                shade = (
                    dark[e, y].reshape(3 * width)[begin : begin + size]
                    if dark.shape[0]
                    else dark[:0, 0, 0, 0]
                )
                _tabulated_response(value, shade, curve, offset, own, spread)
            else:
                if dark.shape[0]:
                    black[:size] = dark[e, y].reshape(3 * width)[begin : begin + size]
                _linear_response(value, black, slope, own)
                spread[:] = np.float32(variance)
            if usable.shape[0]:
                _count(value, np.float32(white), own, spread, usable[y, first:last])
            _collect(
                value,
                np.float32(white),
                own,
                spread,
                seconds[e],
                total[:size],
                time[:size],
                above[:size],
            )
        for k in range(size):
            expected = total[k] / time[k]
            total[k] = np.float32(photon) * (expected if expected > ZERO else ZERO)
        _average(signal, noise, seconds, total[:size], weights[:size])
        _finish(y, first, total[:size], time, above, gain, matrix, radiance, flag)


@kernel
def _linear_response(value: Any, black: Any, slope: float, signal: Any) -> None:
    for k in range(value.shape[0]):
        signal[k] = (np.float32(value[k]) - black[k]) * slope


@kernel
def _tabulated_response(
    value: Any, dark: Any, curve: Any, offset: int, signal: Any, noise: Any
) -> None:
    """Relative exposure by a table; `dark` is empty if the table includes it."""
    for k in range(value.shape[0]):
        at = np.int64(value[k]) + offset - (np.int64(dark[k]) if dark.shape[0] else 0)
        signal[k], noise[k] = curve[at, k % 3, 0], curve[at, k % 3, 1]


@kernel
def _count(value: Any, white: float, signal: Any, noise: Any, usable: Any) -> None:
    """Count the exposure at pixels where a channel is above the noise and none is at
    the white level.
    """
    for x in range(usable.shape[0]):
        lit = 0
        white_channels = 0
        for k in range(3 * x, 3 * x + 3):
            lit += 1 if signal[k] > DARK_SIGMA * np.sqrt(noise[k]) else 0
            white_channels += 0 if np.float32(value[k]) < white else 1
        usable[x] += np.uint8(lit > 0 and white_channels == 0)


@kernel
def _collect(
    value: Any,
    white: float,
    signal: Any,
    noise: Any,
    seconds: float,
    total: Any,
    time: Any,
    above: Any,
) -> None:
    """Accumulate sums over the exposures below the white level; at the white level the
    noise is infinite.

    `above` counts the exposures in which a value is above the noise.
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
    """Write the inverse-variance weighted mean of the exposures to `photons`; 0 / 0
    where none is usable.
    """
    weights[:] = ZERO
    mean = np.zeros_like(weights)
    for e in range(signal.shape[0]):
        second = seconds[e]
        own = signal[e]
        spread = noise[e]
        for k in range(weights.shape[0]):
            variance = photons[k] * second + spread[k]
            weight = second / (variance if variance > MIN_VARIANCE else MIN_VARIANCE)
            mean[k] += weight * own[k]
            weights[k] += weight * second
    for k in range(weights.shape[0]):
        photons[k] = mean[k] / weights[k]


@kernel
def _finish(
    y: int,
    first: int,
    value: Any,
    time: Any,
    above: Any,
    gain: Any,
    matrix: Any,
    out: Any,
    flag: Any,
) -> None:
    """Apply vignette and colour matrix to a row, and set its flags."""
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
            r = row[k]
            g = row[k + 1]
            b = row[k + 2]
            row[k] = matrix[0, 0] * r + matrix[0, 1] * g + matrix[0, 2] * b
            row[k + 1] = matrix[1, 0] * r + matrix[1, 1] * g + matrix[1, 2] * b
            row[k + 2] = matrix[2, 0] * r + matrix[2, 1] * g + matrix[2, 2] * b
    for k in range(value.shape[0]):  # sums over channels distinguish the three cases
        above[k] = NO_USABLE_EXPOSURE if time[k] == ZERO else min(above[k], ONE)
    for x in range(pixels):
        found = above[3 * x] + above[3 * x + 1] + above[3 * x + 2]
        flag[y, first + x] = (
            SATURATED if found >= NO_USABLE_EXPOSURE else DARK if found == ZERO else OK
        )


@kernel
def pixel_spans(wanted: Any, pixels: Any, spread: Any, height: int, width: int) -> Any:
    """Spans (h, 2) of the pixels that `gather` reads for the wanted surfels (n,); see `develop`."""
    spans = np.empty((height, 2), np.int64)
    spans[:, 0], spans[:, 1] = width, 0
    for i in range(wanted.shape[0]):
        if wanted[i]:
            if spread.shape[0] and not np.isnan(spread[i, 0]):
                left, right, top, bottom = _footprint_bounds(
                    pixels[i, 0], pixels[i, 1], spread[i], height, width
                )
            else:
                left, right, top, bottom = _bilinear_bounds(
                    pixels[i, 0], pixels[i, 1], height, width
                )
            for row in range(top, bottom + 1):
                spans[row, 0], spans[row, 1] = (
                    min(spans[row, 0], left),
                    max(spans[row, 1], right + 1),
                )
    return spans


@kernel
def _bilinear_bounds(column: float, row: float, height: int, width: int) -> Any:
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
def _footprint_bounds(
    column: float, row: float, spread: Any, height: int, width: int
) -> Any:
    """First and last column and row of the pixels inside a footprint; an empty range if
    it leaves the picture.

    The mean over a part of a footprint would belong to another position.
    """
    xx = float(spread[0])
    xy = float(spread[1])
    yy = float(spread[2])
    inside = column >= 0 and column <= width and row >= 0 and row <= height
    if not (xx * yy - xy * xy > 0 and inside):
        return 0, -1, 0, -1
    left = int(np.ceil(column - 0.5 - np.sqrt(FOOTPRINT_REACH * xx)))
    right = int(np.floor(column - 0.5 + np.sqrt(FOOTPRINT_REACH * xx)))
    top = int(np.ceil(row - 0.5 - np.sqrt(FOOTPRINT_REACH * yy)))
    bottom = int(np.floor(row - 0.5 + np.sqrt(FOOTPRINT_REACH * yy)))
    if left < 0 or top < 0 or right >= width or bottom >= height:
        return 0, -1, 0, -1
    return left, right, top, bottom


@kernel
def gather(
    radiance: Any,
    flag: Any,
    usable: Any,
    wanted: Any,
    light_fraction: Any,
    pixels: Any,
    spread: Any,
    position: Any,
    normal: Any,
    light: Any,
    axis: Any,
    falloff: float,
    intensity: Any,
    out: Any,
    outcome: Any,
) -> None:
    """Reflectance rho = L d^2 / (I falloff fraction) of every surfel in one view
    (Weyrich et al. 2005, eq. 3).

    Parameters
    ----------
    radiance, flag, usable
        (h, w, 3) float32 and twice (h, w) uint8, from `develop`.
    wanted
        (n,) bool; surfels to sample. Those that face away from the light get no sample.
    light_fraction
        (n,) float32 visible fraction of the light's disc, 0 for no sample; or (0,) if
        all of it is visible.
    pixels
        (n, 2) float32 projections.
    spread
        (n, 3) float32 variances xx, xy, yy [px^2] of the footprint: weights (1 - q /
        8)^2, where q is the squared distance in units of these variances. NaN, or (0,
        3), for bilinear interpolation.
    position, normal
        (n, 3) float64 in mm, and unit vectors.
    light, axis, falloff, intensity
        Position (3,) mm, axis (3,), exponent of the cosine to the axis, and intensity
        (3,) in radiance mm^2.
    out
        (3, n) uint16 output: half floats, NaN where there is no sample.
    outcome
        (n,) uint8 output: OK, SINGLE (no contributing pixel has two exposures), NONE,
        SATURATED (a contributing pixel was saturated), DARK (all contributing pixels
        were dark).
    """
    found = np.empty(5)
    factor = 1.0 / intensity
    out[:], outcome[:] = NAN_BITS, NONE
    for i in range(wanted.shape[0]):
        if not wanted[i] or (light_fraction.shape[0] and light_fraction[i] <= 0):
            continue
        x = position[i, 0] - light[0]
        y = position[i, 1] - light[1]
        z = position[i, 2] - light[2]
        # also rejects NaN
        if not x * normal[i, 0] + y * normal[i, 1] + z * normal[i, 2] < 0:
            continue
        scale = x * x + y * y + z * z
        if falloff:
            cosine = (x * axis[0] + y * axis[1] + z * axis[2]) / np.sqrt(scale)
            if cosine <= 0:
                continue
            scale /= cosine**falloff
        if light_fraction.shape[0]:
            scale /= light_fraction[i]
        if spread.shape[0] and not np.isnan(spread[i, 0]):
            state = _footprint(
                radiance, flag, usable, pixels[i, 0], pixels[i, 1], spread[i], found
            )
        else:
            state = _bilinear(radiance, flag, usable, pixels[i, 0], pixels[i, 1], found)
        outcome[i] = SINGLE if state == OK and found[4] < 2.0 else state
        if state == OK:
            r = found[0] * scale * factor[0]
            g = found[1] * scale * factor[1]
            b = found[2] * scale * factor[2]
            out[0, i], out[1, i], out[2, i] = (
                _half_or_nan(r),
                _half_or_nan(g),
                _half_or_nan(b),
            )


@kernel
def pixel_counts(
    wanted: Any, pixels: Any, spread: Any, height: int, width: int, out: Any
) -> None:
    """Effective number of pixels (n,) that `gather` averages for each surfel; NaN where
    it takes no sample.
    """
    out[:] = np.nan
    for i in range(wanted.shape[0]):
        if not wanted[i]:
            continue
        column = pixels[i, 0]
        row = pixels[i, 1]
        if spread.shape[0] and not np.isnan(spread[i, 0]):
            total, square = _footprint_weights(column, row, spread[i], height, width)
            if total > 0:
                out[i] = total * total / square
        elif column >= 0 and column <= width and row >= 0 and row <= height:
            x = min(max(column - 0.5, 0.0), width - 1.0)
            y = min(max(row - 0.5, 0.0), height - 1.0)
            x = x - int(x)
            y = y - int(y)
            out[i] = 1.0 / (
                (x * x + (1.0 - x) * (1.0 - x)) * (y * y + (1.0 - y) * (1.0 - y))
            )


@kernel
def _footprint_weights(
    column: float, row: float, spread: Any, height: int, width: int
) -> tuple[float, float]:
    """Sum of the weights of `_footprint`, and sum of their squares."""
    left, right, top, bottom = _footprint_bounds(column, row, spread, height, width)
    xx = float(spread[0])
    xy = float(spread[1])
    yy = float(spread[2])
    scale = 1.0 / (FOOTPRINT_REACH * (xx * yy - xy * xy))
    total = 0.0
    square = 0.0
    for v in range(top, bottom + 1):
        dy = v + 0.5 - row
        for u in range(left, right + 1):
            dx = u + 0.5 - column
            rest = 1.0 - (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) * scale
            if rest > 0:
                total += rest * rest
                square += rest**4
    return total, square


@kernel
def tally(outcome: Any, counts: Any) -> int:
    """Add the outcome of each surfel (n,) to its counts (state, n), SINGLE also to OK;
    return how many are usable.
    """
    usable = 0
    for i in range(outcome.shape[0]):
        if outcome[i] < counts.shape[0]:
            counts[outcome[i], i] += 1
            counts[OK, i] += outcome[i] == SINGLE
            usable += outcome[i] == OK or outcome[i] == SINGLE
    return usable


@kernel
def _bilinear(
    radiance: Any, flag: Any, usable: Any, column: float, row: float, found: Any
) -> int:
    """Interpolate bilinearly between the four pixels around a position; the outer half
    pixel repeats the edge.
    """
    height, width = flag.shape
    if not (column >= 0 and column <= width and row >= 0 and row <= height):
        return NONE
    x = min(max(column - 0.5, 0.0), width - 1.0)
    y = min(max(row - 0.5, 0.0), height - 1.0)
    left = int(x)
    top = int(y)
    found[:] = 0.0
    for down in range(2):
        for right in range(2):
            weight = (x - left if right else 1.0 - (x - left)) * (
                y - top if down else 1.0 - (y - top)
            )
            # a neighbour of weight 0 may lie outside
            if (
                weight > 0
                and _add(
                    radiance, flag, usable, left + right, top + down, weight, found
                )
                == SATURATED
            ):
                return SATURATED
    return DARK if found[3] > MIN_DARK_FRACTION else OK


@kernel
def _footprint(
    radiance: Any,
    flag: Any,
    usable: Any,
    column: float,
    row: float,
    spread: Any,
    found: Any,
) -> int:
    """Weighted mean over an ellipse of pixels (Heckbert 1989, the elliptical weighted average)."""
    left, right, top, bottom = _footprint_bounds(column, row, spread, *flag.shape)
    xx = float(spread[0])
    xy = float(spread[1])
    yy = float(spread[2])
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
                if _add(radiance, flag, usable, u, v, weight, found) == SATURATED:
                    return SATURATED
    if total == 0:
        return NONE
    for k in range(4):
        found[k] /= total
    return DARK if found[3] > MIN_DARK_FRACTION else OK


@inline_kernel
def _add(
    radiance: Any, flag: Any, usable: Any, u: int, v: int, weight: float, found: Any
) -> int:
    """Add one pixel to a sample, and return the flag of the pixel."""
    state = flag[v, u]
    found[0] += weight * radiance[v, u, 0]
    found[1] += weight * radiance[v, u, 1]
    found[2] += weight * radiance[v, u, 2]
    found[3] += weight if state == DARK else 0.0
    found[4] = max(found[4], float(usable[v, u]))
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
def _half_or_nan(number: float) -> Any:
    return _half_bits(np.float64(number)) if abs(number) < MAX_HALF_FLOAT else NAN_BITS
