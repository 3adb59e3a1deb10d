"""The formulas of `merge_exposures` in NumPy, exposure by exposure."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skindb.calibration._merge_kernels import DARK, DARK_SIGMA, OK, SATURATED
from skindb.calibration.radiance import read_sigma, relative_exposure


def merged_by_numpy(frames, seconds, sensor, *, dark=None, vignette=None):
    """Radiance, its standard error, and flags, as of `merge_exposures`."""
    shape = frames[0].shape
    # times are relative to it: their squares stay within single precision
    longest = np.float32(max(seconds))
    exposures = []
    is_dark = np.ones(shape[:2], bool)
    total = np.zeros(shape, np.float32)
    time = np.zeros(shape, np.float32)
    for i, frame in enumerate(frames):
        black = None if dark is None else dark[i]
        signal, slope = relative_exposure(frame, black, sensor)
        sigma = read_sigma(slope, sensor)
        usable = frame < sensor.white
        is_dark &= (signal <= DARK_SIGMA * sigma).all(axis=-1)
        relative_seconds = np.float32(seconds[i] / max(seconds))
        exposure = _Exposure(
            np.where(usable, signal, 0), sigma, usable, relative_seconds
        )
        exposures.append(exposure)
        total += exposure.signal
        time += usable * relative_seconds
    with np.errstate(invalid="ignore", divide="ignore"):
        expected = np.maximum(total / time, 0)
        radiance, error = _weighted_mean(exposures, expected, sensor)
    saturated = np.any(time == 0, axis=-1)
    flag = np.where(saturated, SATURATED, np.where(is_dark, DARK, OK))
    gain = longest if vignette is None else vignette * longest
    return radiance / gain, error / gain, flag.astype(np.uint8)


class _Exposure(NamedTuple):
    """One exposure of a view, in relative units."""

    signal: np.ndarray  # (h, w, 3) relative exposure, 0 where it is not usable
    sigma: np.ndarray  # (h, w, 3) of the read noise
    usable: np.ndarray  # (h, w, 3)
    seconds: np.float32


def _weighted_mean(exposures, expected, sensor):
    """Mean of the exposures per second, weighted by their inverse variance, and its
    standard error; `expected` (h, w, 3) is the relative exposure per second.
    """
    weighted = np.zeros(expected.shape, np.float32)
    weights = np.zeros(expected.shape, np.float32)
    for signal, sigma, usable, seconds in exposures:
        shot = expected * seconds / np.float32(sensor.full_electrons)
        variance = np.maximum(shot + sigma**2, np.float32(1e-30))
        weight = np.where(usable, seconds * seconds / variance, 0)
        weighted += weight * signal / seconds
        weights += weight
    return weighted / weights, np.asarray(1 / np.sqrt(weights), np.float32)
