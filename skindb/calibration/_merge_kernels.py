"""Kernels that merge the exposures of a view to radiance. A frame is read once, with
the GIL released.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skindb.jit import kernel
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


@kernel
def develop(
    frames: tuple[Values, ...],
    model: ExposureModel,
    spans: IntMatrix,
    radiance: Cube32,
    flag: ByteMatrix,
    usable: ByteMatrix,
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
    model
        Levels, response and noise.
    spans
        (h, 2) first column of each row to process, and the one after the last.
    radiance
        (h, w, 3) float32 output within the spans: NaN where a channel was saturated in
        every exposure.
    flag
        (h, w) uint8 output; SATURATED outside the spans, where no sample uses the pixel.
    usable
        (h, w) uint8 zeros, output: see `skindb.calibration.radiance.FrameMerger.merge`; or (0, 0).
    """
    count = len(frames)
    height, width = flag.shape
    white = np.float32(model.white)
    signal = np.empty((count, 3 * width), np.float32)
    noise = np.empty((count, 3 * width), np.float32)
    total = np.empty(3 * width, np.float32)
    time = np.empty(3 * width, np.float32)
    above = np.empty(3 * width, np.float32)
    weights = np.empty(3 * width, np.float32)
    black = np.full(3 * width, np.float32(model.zero), np.float32)
    for y in range(height):
        start = spans[y, 0]
        end = max(spans[y, 0], spans[y, 1])
        flag[y, :start] = SATURATED
        flag[y, end:] = SATURATED
        begin = 3 * start
        size = 3 * (end - start)
        if size == 0:
            continue
        total[:size] = ZERO
        time[:size] = ZERO
        above[:size] = ZERO
        for e in range(count):
            value = frames[e][y].reshape(3 * width)[begin : begin + size]
            dark = (
                model.dark[e, y].reshape(3 * width)[begin : begin + size]
                if model.dark.shape[0]
                else model.dark[:0, 0, 0, 0]
            )
            exposure = signal[e, :size]
            spread = noise[e, :size]
            _relative_exposure(value, dark, black, model, exposure, spread)
            if usable.shape[0]:
                _count(value, white, exposure, spread, usable[y, start:end])
            _collect(
                value,
                white,
                exposure,
                spread,
                model.seconds[e],
                total[:size],
                time[:size],
                above[:size],
            )
        for k in range(size):
            expected = total[k] / time[k]
            positive = expected if expected > ZERO else ZERO
            total[k] = np.float32(model.photon) * positive
        _average(signal, noise, model.seconds, total[:size], weights[:size])
        _finish(y, start, total[:size], time, above, model, radiance, flag)


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
    if dark.shape[0]:
        black[: dark.shape[0]] = dark
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
def _count(
    value: Values, white: Real, signal: Vector32, noise: Vector32, usable: ByteVector
) -> None:
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
    matrix = model.matrix
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
        state = above[3 * x] + above[3 * x + 1] + above[3 * x + 2]
        if state >= NO_USABLE_EXPOSURE:
            flag[y, start + x] = SATURATED
        else:
            flag[y, start + x] = DARK if state == ZERO else OK
