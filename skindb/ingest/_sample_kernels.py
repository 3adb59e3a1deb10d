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
    above, weights = np.empty(row, np.float32), np.empty(row, np.float32)
    black = np.full(row, np.float32(zero), np.float32)
    slope = ONE / np.float32(span)
    noise[:] = np.float32(variance)
    for y in range(height):
        total[:], time[:], above[:] = ZERO, ZERO, ZERO
        for e in range(count):
            value = frames[e, y].reshape(row)
            if curve.shape[0]:
                _bent(value, dark[e, y].reshape(row) if dark.shape[0] else dark[:0, 0, 0, 0], curve, offset,
                      signal[e], noise[e])  # fmt: skip
            else:
                if dark.shape[0]:
                    black[:] = dark[e, y].reshape(row)
                _straight(value, black, slope, signal[e])
            _collect(value, np.float32(white), signal[e], noise[e], seconds[e], usable[e], total, time, above)
        for k in range(row):
            expected = total[k] / time[k]
            total[k] = np.float32(photon) * (expected if expected > ZERO else ZERO)
        _average(signal, noise, usable, seconds, total, weights)
        _finish(y, total, time, above, gain, matrix, radiance, flag)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _straight(value: Any, black: Any, slope: float, signal: Any) -> None:
    for k in range(value.shape[0]):
        signal[k] = (np.float32(value[k]) - black[k]) * slope


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _bent(value: Any, dark: Any, curve: Any, offset: int, signal: Any, noise: Any) -> None:
    """The same by a table; `dark` is empty where it is in the table."""
    for k in range(value.shape[0]):
        at = np.int64(value[k]) + offset - (np.int64(dark[k]) if dark.shape[0] else 0)
        signal[k], noise[k] = curve[at, k % 3, 0], curve[at, k % 3, 1]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _collect(
    value: Any, white: float, signal: Any, noise: Any, seconds: float, usable: Any, total: Any, time: Any, above: Any
) -> None:
    """Sums over exposures below the white level; `above`: in how many a value is more than noise."""
    for k in range(value.shape[0]):
        use = ONE if np.float32(value[k]) < white else ZERO
        usable[k] = use
        total[k] += use * signal[k]
        time[k] += use * seconds
    for k in range(value.shape[0]):
        above[k] += ONE if signal[k] > DARK_SIGMA * np.sqrt(noise[k]) else ZERO


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _average(signal: Any, noise: Any, usable: Any, seconds: Any, photons: Any, weights: Any) -> None:
    """Mean of the exposures, weighted by inverse variance, in place of `photons`; 0 / 0 where none is usable."""
    weights[:] = ZERO
    mean = np.zeros_like(weights)
    for e in range(signal.shape[0]):
        second, own, spread, use = seconds[e], signal[e], noise[e], usable[e]
        for k in range(weights.shape[0]):
            variance = photons[k] * second + spread[k]
            weight = use[k] * second / (variance if variance > LEAST else LEAST)
            mean[k] += weight * own[k]
            weights[k] += weight * second
    for k in range(weights.shape[0]):
        photons[k] = mean[k] / weights[k]


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
