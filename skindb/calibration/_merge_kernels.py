"""Kernels that merge the exposures of a view to radiance. A frame is read once, with
the GIL released.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skindb.jit import kernel, single
from skindb.types import (
    ByteMatrix,
    ByteVector,
    Cube32,
    IntMatrix,
    Matrix32,
    Real,
    Vector32,
)

Values = NDArray[np.unsignedinteger]  # uint8 or uint16, of the file
# flags of a merged pixel; samples use the same ones
OK = 0
SATURATED = 1
DARK = 2
# standard deviations of read noise above black; a pixel at or below it is dark
DARK_SIGMA = np.float32(2.0)
# of relative exposure; the weight 1 / variance stays finite
MIN_VARIANCE = np.float32(1e-30)
ZERO = np.float32(0.0)
ONE = np.float32(1.0)
ENDLESS = np.float32(np.inf)
# marks a channel that was saturated in every exposure; larger than any number of
# exposures
NO_USABLE_EXPOSURE = np.float32(100.0)


class ExposureModel(NamedTuple):
    """From the values of the exposures of one camera to radiance."""

    dark: Values  # (e, h, w, 3) dark frames, which are subtracted; or without rows
    # (m, 3, 2) relative exposure and its read variance at value + offset; or (0, 3, 2)
    # for a linear response, (value - zero) / span with `variance`
    curve: Cube32
    offset: int
    zero: float
    span: float
    variance: float
    white: float  # values at or above this level are saturated
    seconds: Vector32  # (e,) exposure times as fractions of the longest one
    # variance of photon noise per relative exposure: 1 / electrons at the white level
    photon: float
    gain: Matrix32  # (h, w) factor of the relative radiance, or (1, 1)
    matrix: Matrix32  # (3, 3) colour matrix, or (0, 3) for none


class RowBuffers(NamedTuple):
    """Values of the channels of a row, 3 w of each."""

    signal: Matrix32  # (e, 3 w) relative exposures
    noise: Matrix32  # (e, 3 w) their read variance, infinite at the white level
    total: Vector32  # sum of the relative exposures, then their weighted mean
    time: Vector32  # sum of the exposure times
    above: Vector32  # number of exposures above the noise
    weights: Vector32
    black: Vector32


@kernel
def _row_buffers(exposures: int, size: int, zero: float) -> RowBuffers:
    """Buffers for rows of `size` values."""
    return RowBuffers(
        np.empty((exposures, size), np.float32),
        np.empty((exposures, size), np.float32),
        np.empty(size, np.float32),
        np.empty(size, np.float32),
        np.empty(size, np.float32),
        np.empty(size, np.float32),
        np.full(size, np.float32(zero), np.float32),
    )


@kernel
def develop(
    frames: tuple[Values, ...] | Values,
    model: ExposureModel,
    spans: IntMatrix,
    radiance: Cube32,
    flag: ByteMatrix,
    error: Cube32,
) -> None:
    """Merge the exposures of one view to radiance; see
    `skindb.calibration.radiance.merge_exposures`.

    The picture is processed row by row, so that intermediate values stay in the cache.
    Loops have few branches and few arrays: LLVM does not vectorise a loop for which it
    would have to compare more than eight pairs of addresses.

    Parameters
    ----------
    frames
        One array (h, w, 3) of uint8 or uint16 per exposure, or one array of them.
    model
        Levels, response and noise.
    spans
        (h, 2) first column of each row to process, and the one after the last.
    radiance
        (h, w, 3) float32 output within the spans: NaN where a channel was saturated in
        every exposure.
    flag
        (h, w) uint8 output; SATURATED outside the spans, where no sample uses the pixel.
    error
        (h, w, 3) float32 output within the spans: standard error of the radiance without
        colour matrix; or (0, 0, 0).
    """
    height, width = flag.shape
    row = _row_buffers(len(frames), 3 * width, model.zero)
    for y in range(height):
        start = spans[y, 0]
        end = max(spans[y, 0], spans[y, 1])
        flag[y, :start] = SATURATED
        flag[y, end:] = SATURATED
        size = 3 * (end - start)
        if size == 0:
            continue
        _sum_exposures(frames, y, start, end, model, row)
        total = row.total[:size]
        for k in range(size):
            expected = total[k] / row.time[k]
            positive = expected if expected > ZERO else ZERO
            total[k] = np.float32(model.photon) * positive
        _average(row.signal, row.noise, model.seconds, total, row.weights[:size])
        if error.shape[0]:
            _write_errors(row.weights[:size], model.gain, y, start, error)
        _finish(y, start, total, row.time, row.above, model, radiance, flag)


@kernel
def develop_linear(
    frame: NDArray[Any], spans: IntMatrix, radiance: Cube32, flag: ByteMatrix
) -> None:
    """Radiance (h, w, 3) and flags (h, w) of linear values (h, w, 3) within spans (h, 2),
    as `develop` writes them; NaN and SATURATED where a channel is not finite.
    """
    for y in range(flag.shape[0]):
        start = spans[y, 0]
        end = max(spans[y, 0], spans[y, 1])
        flag[y, :start] = SATURATED
        flag[y, end:] = SATURATED
        for x in range(start, end):
            red = single(frame[y, x, 0])
            green = single(frame[y, x, 1])
            blue = single(frame[y, x, 2])
            # NaN unless all three are finite
            lost = (red - red) + (green - green) + (blue - blue)
            radiance[y, x, 0] = red + lost
            radiance[y, x, 1] = green + lost
            radiance[y, x, 2] = blue + lost
            flag[y, x] = OK if lost == ZERO else SATURATED


@kernel
def _sum_exposures(
    frames: tuple[Values, ...] | Values,
    y: int,
    start: int,
    end: int,
    model: ExposureModel,
    row: RowBuffers,
) -> None:
    """Write the relative exposures of a part of a row, and their sums."""
    white = np.float32(model.white)
    width = row.total.shape[0]
    begin = 3 * start
    size = 3 * (end - start)
    row.total[:size] = ZERO
    row.time[:size] = ZERO
    row.above[:size] = ZERO
    for e in range(len(frames)):
        value = frames[e][y].reshape(width)[begin : begin + size]
        dark = (
            model.dark[e, y].reshape(width)[begin : begin + size]
            if model.dark.shape[0]
            else model.dark[:0, 0, 0, 0]
        )
        exposure = row.signal[e, :size]
        spread = row.noise[e, :size]
        _relative_exposure(value, dark, row.black, model, exposure, spread)
        _collect(
            value,
            white,
            exposure,
            spread,
            model.seconds[e],
            row.total[:size],
            row.time[:size],
            row.above[:size],
        )


@kernel
def _relative_exposure(
    value: Values,
    dark: Values,
    black: Vector32,
    model: ExposureModel,
    signal: Vector32,
    noise: Vector32,
) -> None:
    """Relative exposure of a part of a row, and its read variance; `dark` is empty
    without dark frames, and otherwise replaces `black`.
    """
    if model.curve.shape[0]:
        _tabulated_response(value, dark, model.curve, model.offset, signal, noise)
        return
    for k in range(dark.shape[0]):  # a copy of arrays would take seconds to compile
        black[k] = dark[k]
    _linear_response(value, black, ONE / np.float32(model.span), signal)
    noise[:] = np.float32(model.variance)


@kernel
def _linear_response(
    value: Values, black: Vector32, slope: Real, signal: Vector32
) -> None:
    for k in range(value.shape[0]):
        signal[k] = (np.float32(value[k]) - black[k]) * slope


@kernel
def _tabulated_response(
    value: Values,
    dark: Values,
    curve: Cube32,
    offset: int,
    signal: Vector32,
    noise: Vector32,
) -> None:
    """Relative exposure by a table; `dark` is empty if the table includes it."""
    for k in range(value.shape[0]):
        row = np.int64(value[k]) + offset - (np.int64(dark[k]) if dark.shape[0] else 0)
        signal[k] = curve[row, k % 3, 0]
        noise[k] = curve[row, k % 3, 1]


@kernel
def _collect(
    value: Values,
    white: Real,
    signal: Vector32,
    noise: Vector32,
    seconds: Real,
    total: Vector32,
    time: Vector32,
    above: Vector32,
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
def _average(
    signal: Matrix32,
    noise: Matrix32,
    seconds: Vector32,
    photons: Vector32,
    weights: Vector32,
) -> None:
    """Write the inverse-variance weighted mean of the exposures to `photons`; 0 / 0
    where none is usable.
    """
    weights[:] = ZERO
    mean = np.zeros_like(weights)
    for e in range(signal.shape[0]):
        second = seconds[e]
        exposure_signal = signal[e]
        spread = noise[e]
        for k in range(weights.shape[0]):
            variance = photons[k] * second + spread[k]
            weight = second / (variance if variance > MIN_VARIANCE else MIN_VARIANCE)
            mean[k] += weight * exposure_signal[k]
            weights[k] += weight * second
    for k in range(weights.shape[0]):
        photons[k] = mean[k] / weights[k]


@kernel
def _write_errors(
    weights: Vector32, gain: Matrix32, y: int, start: int, out: Cube32
) -> None:
    """Write the standard errors of a part of a row from its sums of weights."""
    for k in range(weights.shape[0]):
        x = start + k // 3
        scale = gain[0, 0] if gain.shape[0] == 1 else gain[y, x]
        out[y, x, k % 3] = scale / np.sqrt(weights[k])


@kernel
def _finish(
    y: int,
    start: int,
    value: Vector32,
    time: Vector32,
    above: Vector32,
    model: ExposureModel,
    out: Cube32,
    flag: ByteMatrix,
) -> None:
    """Apply vignette and colour matrix to a row, and set its flags."""
    gain = model.gain
    pixels = value.shape[0] // 3
    row = out[y, start : start + pixels].reshape(value.shape[0])
    if gain.shape[0] == 1:
        scale = gain[0, 0]
        for k in range(value.shape[0]):
            row[k] = value[k] * scale
    else:
        for x in range(pixels):
            factor = gain[y, start + x]
            for k in range(3 * x, 3 * x + 3):
                row[k] = value[k] * factor
    if model.matrix.shape[0]:
        _mix_channels(model.matrix, row)
    for k in range(value.shape[0]):  # sums over channels distinguish the three cases
        above[k] = NO_USABLE_EXPOSURE if time[k] == ZERO else min(above[k], ONE)
    _set_flags(above, flag[y, start : start + pixels])


@kernel
def _mix_channels(matrix: Matrix32, row: Vector32) -> None:
    """Multiply the pixels of a row by a colour matrix (3, 3)."""
    for k in range(0, row.shape[0], 3):
        r = row[k]
        g = row[k + 1]
        b = row[k + 2]
        for c in range(3):
            row[k + c] = matrix[c, 0] * r + matrix[c, 1] * g + matrix[c, 2] * b


@kernel
def _set_flags(above: Vector32, flag: ByteVector) -> None:
    """Flags of pixels; `above` is per channel 0 in the dark, 1 above the noise, or
    NO_USABLE_EXPOSURE.
    """
    for x in range(flag.shape[0]):
        state = above[3 * x] + above[3 * x + 1] + above[3 * x + 2]
        if state >= NO_USABLE_EXPOSURE:
            flag[x] = SATURATED
        else:
            flag[x] = DARK if state == ZERO else OK
