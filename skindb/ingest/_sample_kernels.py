"""Kernels of ingest: exposures to radiance, radiance to samples. A frame is read once, without the interpreter lock."""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np

OK, SATURATED, DARK = 0, 1, 2  # what became of a pixel or a sample
DARK_SIGMA = np.float32(2.0)  # above black; at or below it a pixel is dark
LEAST = np.float32(1e-30)  # variance; a weight stays finite
ZERO, ONE = np.float32(0.0), np.float32(1.0)


@nb.njit(cache=True, nogil=True, error_model="numpy")
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
    radiance: Any,
    flag: Any,
) -> None:
    """Radiance of the exposures of one view; the formulas are those of `skindb.ingest.radiance.merge_exposures`.

    Row by row, so that what is between the exposures stays in the cache, and without branches inside a row.

    Parameters
    ----------
    frames
        (e, h, w, 3) uint8 or uint16.
    dark
        As frames, subtracted; or of no rows.
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
    radiance
        (h, w, 3) float32, written: NaN where a channel was saturated in every exposure.
    flag
        (h, w) uint8, written.
    """
    count, height, width, _ = frames.shape
    row = 3 * width
    signal, noise = np.empty((count, row), np.float32), np.empty((count, row), np.float32)
    usable = np.empty((count, row), np.float32)
    total, time = np.empty(row, np.float32), np.empty(row, np.float32)
    bright, above = np.empty(row, np.float32), np.empty(row, np.float32)
    zero32, slope, plain, top = np.float32(zero), np.float32(ONE / np.float32(span)), np.float32(variance), white
    per_photon = np.float32(photon)
    for y in range(height):
        total[:], time[:], above[:] = ZERO, ZERO, ZERO
        for e in range(count):
            value = frames[e, y].reshape(row)
            if curve.shape[0]:
                for k in range(row):
                    at = np.int64(value[k]) + offset
                    if dark.shape[0]:
                        at -= np.int64(dark[e, y, k // 3, k % 3])
                    signal[e, k], noise[e, k] = curve[at, k % 3, 0], curve[at, k % 3, 1]
            elif dark.shape[0]:
                black = dark[e, y].reshape(row)
                for k in range(row):
                    signal[e, k] = (np.float32(value[k]) - np.float32(black[k])) * slope
                    noise[e, k] = plain
            else:
                for k in range(row):
                    signal[e, k] = (np.float32(value[k]) - zero32) * slope
                    noise[e, k] = plain
            for k in range(row):
                usable[e, k] = ONE if value[k] < top else ZERO
                total[k] += usable[e, k] * signal[e, k]
                time[k] += usable[e, k] * seconds[e]
                above[k] += ONE if signal[e, k] > DARK_SIGMA * np.sqrt(noise[e, k]) else ZERO
        for k in range(row):
            expected = total[k] / time[k]
            bright[k] = per_photon * (expected if expected > ZERO else ZERO)
            total[k] = ZERO
        for e in range(count):
            for k in range(row):
                # `time` is needed for the flag; the sum of weights takes the place of `usable`
                spread = bright[k] * seconds[e] + noise[e, k]
                weight = usable[e, k] * seconds[e] / (spread if spread > LEAST else LEAST)
                total[k] += weight * signal[e, k]
                usable[e, k] = weight * seconds[e]
        for e in range(1, count):
            for k in range(row):
                usable[0, k] += usable[e, k]
        for k in range(row):
            total[k] /= usable[0, k]
        _finish(y, total, time, above, gain, matrix, radiance, flag)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _finish(y: int, value: Any, time: Any, above: Any, gain: Any, matrix: Any, radiance: Any, flag: Any) -> None:
    """Vignette, colours and flags of a row."""
    everywhere = gain.shape[0] == 1
    for x in range(flag.shape[1]):
        factor = gain[0, 0] if everywhere else gain[y, x]
        r, g, b = value[3 * x] * factor, value[3 * x + 1] * factor, value[3 * x + 2] * factor
        if matrix.shape[0]:
            radiance[y, x, 0] = matrix[0, 0] * r + matrix[0, 1] * g + matrix[0, 2] * b
            radiance[y, x, 1] = matrix[1, 0] * r + matrix[1, 1] * g + matrix[1, 2] * b
            radiance[y, x, 2] = matrix[2, 0] * r + matrix[2, 1] * g + matrix[2, 2] * b
        else:
            radiance[y, x, 0], radiance[y, x, 1], radiance[y, x, 2] = r, g, b
        lost = time[3 * x] == ZERO or time[3 * x + 1] == ZERO or time[3 * x + 2] == ZERO
        unlit = above[3 * x] + above[3 * x + 1] + above[3 * x + 2] == ZERO
        flag[y, x] = SATURATED if lost else DARK if unlit else OK
