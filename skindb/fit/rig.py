"""Errors of the lights of a rig, from all fitted takes of it together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from skindb.fit.corrections import (
    MIN_GAIN_SPREAD,
    LightErrors,
    LightResiduals,
    aligned,
    estimate_camera_gains,
    gain_spread,
    light_residuals,
)
from skindb.fit.lumitexels import lumitexels
from skindb.numerics.statistics import NORMAL_PER_MEDIAN
from skindb.schema import dataset, label, variables
from skindb.types import Array, finite_rows, lengths

MIN_TAKES = 3  # of a light; the median of two is a mean, which one wrong gain spoils
# variance of a median over that of a mean, of many normal values
MEDIAN_VARIANCE = np.pi / 2
# of the residuals of a held-out take with gains alone: offsets that leave more are not
# used. 0.95 to 0.96 for three to eight faces under strobes; virtual skin: 0.75 to 0.93 under
# lights that are 1 degree off, 0.98 to 1.01 under lights that are where they are stated
MAX_LEFT_BY_OFFSETS = 0.97
# of gains of the cameras that are used: 0.006 are found for perfect cameras of a dome, 0.015
# for twelve over 240 degrees and a strong broad surface
MIN_CAMERA_SPREAD = 0.02


def take_residuals(
    capture: xr.DataTree, model: xr.DataTree, *, rng: np.random.Generator
) -> tuple[LightResiduals, xr.DataArray]:
    """What a fitted take says about its lights and about its cameras, see
    `skindb.fit.light_residuals` and `skindb.fit.estimate_camera_gains`.
    """
    fitted = model["fitted"].to_dataset()
    dome = capture["dome"].to_dataset()
    normal = fitted[variables.SHADING_NORMAL].values
    rows = np.flatnonzero(finite_rows(normal))
    samples = lumitexels(capture).isel(surfel=rows)
    samples = samples.assign(surfel_normal=label("surfel_normal", normal[rows]))
    applied = None
    if variables.LIGHT_GAIN_APPLIED in dome:
        names = (variables.LIGHT_GAIN_APPLIED, variables.LIGHT_OFFSET_APPLIED)
        applied = LightErrors(*(dome[name].values for name in names))
    eta = float(fitted[variables.REFRACTIVE_INDEX])
    cameras = estimate_camera_gains(samples, rng=rng, eta=eta)
    if variables.CAMERA_GAIN_APPLIED in dome:
        cameras = cameras * dome[variables.CAMERA_GAIN_APPLIED]
    return light_residuals(samples, rng=rng, eta=eta, applied=applied), cameras


def common_light_errors(
    takes: Sequence[LightResiduals], *, lights: list[str], positions: Array
) -> xr.Dataset:
    """Gains and offsets of the lights that the takes of a rig have in common, and how
    well they predict a held-out take.

    Parameters
    ----------
    takes
        From `take_residuals`, of the same lights.
    lights
        Ids of the lights.
    positions
        (light, 3) mm.

    Returns
    -------
    Dataset
        Group "rig_calibration". The spreads are NaN if no light has three takes. Gains
        are 1 unless they differ by more than the errors of the estimate, and those of
        other takes lower the spread in a held-out take. Offsets are those that were
        applied, or else 0, unless with new ones the other takes predict a held-out take
        better than with gains alone.
    """
    none = LightErrors(np.ones(len(lights)), np.zeros(positions.shape))
    commons = [Common([take.errors(turned=x) for take in takes]) for x in (False, True)]
    stated, *left = (
        np.array([take.misfit(e) for take, e in zip(takes, errors, strict=True)])
        for errors in ([none] * len(takes), *(common.others for common in commons))
    )
    # a take without information has no residual
    seen = stated > 0
    misfit = [
        float(np.median(x[seen] / stated[seen])) if seen.any() else np.nan for x in left
    ]
    turned = misfit[1] < MAX_LEFT_BY_OFFSETS * misfit[0]
    common = commons[turned]
    distance = lengths(positions)
    logs = commons[0].logs
    spread, spread_left = (
        _median([gain_spread(row, positions / distance[:, None]) for row in rows])
        for rows in (logs, logs - commons[0].others_logs)
    )
    gain, log_error = common.errors.gain, common.log_error
    if not spread_left < spread or spread < MIN_GAIN_SPREAD:
        gain, log_error = np.ones(len(lights)), np.full(len(lights), np.nan)
    return dataset(
        {
            variables.RIG_LIGHT_POSITION: positions,
            variables.RIG_LIGHT_GAIN: gain,
            variables.RIG_LIGHT_GAIN_ERROR: gain * log_error,
            variables.RIG_LIGHT_OFFSET: common.errors.offset,
            variables.RIG_LIGHT_ANGLE_ERROR: np.where(
                np.any(common.errors.offset != 0, axis=1),
                np.degrees(commons[1].offset_error / distance),
                np.nan,
            ),
            variables.RIG_TAKES: common.takes,
            variables.RIG_SPREAD: spread,
            variables.RIG_SPREAD_LEFT: spread_left,
            variables.RIG_MISFIT: misfit,
        },
        coords={
            "light": lights,
            "xyz": ["x", "y", "z"],
            "correction": ["gains", "gains and offsets"],
        },
    )


def common_camera_gains(takes: Sequence[xr.DataArray]) -> xr.Dataset:
    """Gains of the cameras that the takes of a rig have in common.

    Parameters
    ----------
    takes
        Gains (camera, channel) of each take, from `take_residuals`.

    Returns
    -------
    Dataset
        Part of the group "rig_calibration". The gains are 1 unless they are larger than
        the errors of the estimate, and those of the others lower the spread in a
        held-out take.
    """
    gains = xr.concat(takes, "take", join="outer").transpose("take", "camera", ...)
    unmoved = np.zeros((gains.sizes["camera"], 3))
    channels = [
        Common([LightErrors(take, unmoved) for take in channel])
        for channel in np.moveaxis(gains.values, 2, 0)
    ]
    logs, others = (
        np.concatenate([getattr(common, name) for common in channels], axis=1)
        for name in ("logs", "others_logs")
    )
    spread, left = (
        _median([np.nanstd(row) for row in rows if np.isfinite(row).any()])
        for rows in (logs, logs - others)
    )
    gain, log_error = (
        np.stack(columns, axis=1)
        for columns in zip(
            *((c.errors.gain, c.log_error) for c in channels), strict=True
        )
    )
    if not left < MAX_LEFT_BY_OFFSETS * spread or spread < MIN_CAMERA_SPREAD:
        gain, log_error = np.ones(gain.shape), np.full(gain.shape, np.nan)
    return dataset(
        {
            variables.RIG_CAMERA_GAIN: gain,
            variables.RIG_CAMERA_GAIN_ERROR: gain * log_error,
            variables.RIG_CAMERA_SPREAD: spread,
            variables.RIG_CAMERA_SPREAD_LEFT: left,
        },
        coords={name: gains[name].values for name in ("camera", "channel")},
    )


class Common:
    """Median of the errors of the lights over takes, that over the others of each take,
    and their standard errors. Lights of fewer than three takes keep gain 1 and offset 0.
    """

    def __init__(self, takes: Sequence[LightErrors]) -> None:
        gains = np.array([take.gain for take in takes])
        offsets = np.array([take.offset for take in takes])
        self.takes = np.isfinite(gains).sum(axis=0)
        shared = self.takes >= MIN_TAKES
        self.logs = np.full(gains.shape, np.nan)
        self.others_logs = np.full(gains.shape, np.nan)
        self.log_error = np.full(len(shared), np.nan)
        self.offset_error = np.full(len(shared), np.nan)
        log = np.zeros(len(shared))
        offset = np.zeros(offsets.shape[1:])
        others_offset = np.full(offsets.shape, np.nan)
        if shared.any():
            self.logs[:, shared] = aligned(np.log(gains[:, shared]))
            log[shared], self.others_logs[:, shared], self.log_error[shared] = _medians(
                self.logs[:, shared]
            )
            offset[shared], others_offset[:, shared], error = _medians(
                offsets[:, shared]
            )
            self.offset_error[shared] = lengths(error)
        self.errors = LightErrors(np.exp(log), offset)
        self.others = [
            LightErrors(*errors)
            for errors in zip(np.exp(self.others_logs), others_offset, strict=True)
        ]


def _medians(values: Array) -> tuple[Array, Array, Array]:
    """Median over the takes of values (take, light, ...), that over the others of each
    take, and the standard error of the former.
    """
    takes = np.isfinite(values).sum(axis=0)
    others = np.array(
        [np.nanmedian(np.delete(values, k, axis=0), axis=0) for k in range(len(values))]
    )
    deviation = NORMAL_PER_MEDIAN * np.nanmedian(np.abs(values - others), axis=0)
    deviation /= np.sqrt(1 + MEDIAN_VARIANCE / (takes - 1))
    # that of a few takes may be small by chance
    deviation = np.maximum(deviation, np.median(deviation, axis=0))
    error = deviation * np.sqrt(MEDIAN_VARIANCE / takes)
    return np.nanmedian(values, axis=0), others, error


def _median(spreads: Sequence[float]) -> float:
    """Median over the takes that have a spread."""
    known = [spread for spread in spreads if np.isfinite(spread)]
    return float(np.median(known)) if known else np.nan
