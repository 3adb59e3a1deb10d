"""Gains of the lights of a rig, from all fitted takes of it together."""

from __future__ import annotations

import numpy as np
import xarray as xr

from skindb.fit.corrections import estimate_light_gains
from skindb.fit.lumitexels import lumitexels
from skindb.numerics.statistics import NORMAL_PER_MEDIAN
from skindb.schema import dataset, label, variables
from skindb.types import Array

MIN_TAKES = 3  # of a light; the median of two is a mean, which one wrong gain spoils
ROUNDS = 3  # in which takes that show different lights are made relative to each other
# variance of a median over that of a mean, of many normal values
MEDIAN_VARIANCE = np.pi / 2


def take_light_gains(
    capture: xr.DataTree, model: xr.DataTree, *, rng: np.random.Generator
) -> Array:
    """True over stated intensity (light,) of the lights of a fitted take, see
    `skindb.fit.estimate_light_gains`; NaN for lights without usable surfels.

    A gain that the capture was ingested with is divided out: the result is relative to
    the intensities without it.
    """
    fitted = model["fitted"].to_dataset()
    normal = fitted[variables.SHADING_NORMAL].values
    rows = np.flatnonzero(np.isfinite(normal).all(axis=1))
    samples = lumitexels(capture)
    gain = np.full(samples.sizes["light"], np.nan)
    if rows.size:
        samples = samples.isel(surfel=rows).assign(
            surfel_normal=label("surfel_normal", normal[rows])
        )
        eta = float(fitted[variables.REFRACTIVE_INDEX])
        estimated = estimate_light_gains(samples, rng=rng, eta=eta, unseen=np.nan)
        gain = estimated[variables.LIGHT_GAIN].values
    applied = capture["dome"].to_dataset().get(variables.LIGHT_GAIN_APPLIED)
    return gain if applied is None else gain * applied.values


def common_light_gains(
    gains: Array, *, lights: list[str], positions: Array
) -> xr.Dataset:
    """Common gains of the lights of a rig, and how well they predict a held-out take.

    Parameters
    ----------
    gains
        (take, light) from `take_light_gains`; NaN where unknown.
    lights
        Ids of the lights.
    positions
        (light, 3) mm.

    Returns
    -------
    Dataset
        Group "rig_calibration". The spreads are NaN if no light has three takes.
    """
    count = np.isfinite(gains).sum(axis=0)
    shared = count >= MIN_TAKES
    gain = np.ones(len(lights))
    error = np.full(len(lights), np.nan)
    spread = spread_left = np.nan
    if shared.any():
        logs = _aligned(np.log(gains[:, shared]))
        takes = count[shared]
        others = [
            np.nanmedian(np.delete(logs, k, axis=0), axis=0) for k in range(len(logs))
        ]
        left = logs - np.array(others)
        deviation = NORMAL_PER_MEDIAN * np.nanmedian(np.abs(left), axis=0)
        deviation /= np.sqrt(1 + MEDIAN_VARIANCE / (takes - 1))
        # that of a few takes may be small by chance
        deviation = np.maximum(deviation, np.median(deviation))
        gain[shared] = np.exp(np.nanmedian(logs, axis=0))
        error[shared] = gain[shared] * deviation * np.sqrt(MEDIAN_VARIANCE / takes)
        spread = _median_spread(logs)
        spread_left = _median_spread(left)
    return dataset(
        {
            variables.RIG_LIGHT_POSITION: positions,
            variables.RIG_LIGHT_GAIN: gain,
            variables.RIG_LIGHT_GAIN_ERROR: error,
            variables.RIG_TAKES: count,
            variables.RIG_SPREAD: spread,
            variables.RIG_SPREAD_LEFT: spread_left,
        },
        coords={"light": lights, "xyz": ["x", "y", "z"]},
    )


def _aligned(logs: Array) -> Array:
    """Logarithms (take, light) of gains of takes with gains, relative to those that all
    takes have in common: each take may show other lights.
    """
    known = logs[np.isfinite(logs).any(axis=1)]
    known = known - np.nanmedian(known, axis=1, keepdims=True)
    for _ in range(ROUNDS):
        middle = np.nanmedian(known, axis=0)
        middle -= np.median(middle)
        known = known - np.nanmedian(known - middle, axis=1, keepdims=True)
    return known


def _median_spread(logs: Array) -> float:
    """Median over the takes of the standard deviation over the lights (take, light)."""
    rows = logs[np.isfinite(logs).sum(axis=1) > 1]
    return float(np.median(np.nanstd(rows, axis=1))) if len(rows) else np.nan
