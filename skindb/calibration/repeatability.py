"""Repeatability of the contact probe: variance between placements, drift, and effect of
the pressure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from skindb.errors import Fault, InputError

Array = NDArray[np.float64]
MIN_PLACEMENTS = 3
# of a fibre in every placement; logarithms of noisier signals are biased
MIN_SIGNAL_TO_NOISE = 5.0
FLAG_P_VALUE = 0.003  # below which a trend is flagged: three standard deviations


@dataclass(frozen=True)
class Repeatability:
    """Relative standard deviations between placements of the probe, per channel.

    `level` (3,) is common to all fibres (contact, gain); `shape` (3,) is the scatter of
    single fibres in excess of the measurement error, zero if there is none. `levels`
    (placement, 3) are logarithms relative to their mean. `mean` (fibre, 3) is the
    profile of all placements (geometric mean) and `error` its standard error by the
    scatter of the placements. Fibres without a clear signal are NaN.
    """

    level: Array
    shape: Array
    levels: Array
    mean: Array
    error: Array


@dataclass(frozen=True)
class Trend:
    """Relative change (3,) of the level per unit of a covariate, with standard error, p
    value and flag.
    """

    slope: Array
    error: Array
    p_value: Array
    flag: NDArray[np.bool_]


def placement_variance(value: ArrayLike, error: ArrayLike) -> Repeatability:
    """Variance components of repeated placements at one site, by the method of moments.

    ln R = profile of the fibre + level of the placement + residual. The variance of the
    residuals, minus that of the measurement, is the shape component; the variance of
    the levels, minus the contribution of the residuals to their means, is the level
    component (Searle, Casella and McCulloch 1992, section 4.5, crossed without
    interaction).

    Parameters
    ----------
    value, error
        (placement, fibre, 3) profiles and their standard errors.

    Raises
    ------
    InputError
        Wrong shapes, fewer than three placements, or fewer than two fibres with a clear signal.
    """
    profile = np.asarray(value, np.float64)
    sigma = np.asarray(error, np.float64)
    if (
        profile.ndim != 3
        or profile.shape != sigma.shape
        or profile.shape[-1] != 3
        or len(profile) < MIN_PLACEMENTS
    ):
        rule = (
            "profiles and errors must have the shape (placement, fibre, 3), with "
            f"{MIN_PLACEMENTS} or more placements"
        )
        raise InputError(
            Fault(
                "repeated placements",
                rule,
                f"{profile.shape} and {sigma.shape}",
                "place it again",
            )
        )
    with np.errstate(invalid="ignore"):
        clear = np.asarray(
            (sigma >= 0) & (profile > MIN_SIGNAL_TO_NOISE * sigma) & (profile > 0)
        ).all(axis=(0, 2))
    if clear.sum() < 2:
        rule = "at least two fibres must have a clear signal in all placements"
        cure = "add longer exposures"
        raise InputError(
            Fault("repeated placements", rule, f"{int(clear.sum())}", cure)
        )
    log = np.log(profile[:, clear])
    noise = (sigma[:, clear] / profile[:, clear]) ** 2
    placements, fibres, _ = log.shape
    centred = log - log.mean(axis=0)
    levels = centred.mean(axis=1)
    rest = (centred - levels[:, None]).reshape(-1, 3)
    rest_variance = (rest**2).sum(axis=0) / ((placements - 1) * (fibres - 1))
    level_variance = (levels**2).sum(axis=0) / (placements - 1) - rest_variance / fibres
    mean = np.full(profile.shape[1:], np.nan)
    spread = np.full(profile.shape[1:], np.nan)
    mean[clear] = np.exp(log.mean(axis=0))
    spread[clear] = mean[clear] * centred.std(axis=0, ddof=1) / np.sqrt(placements)
    shape_variance = rest_variance - noise.mean(axis=(0, 1))
    return Repeatability(
        np.sqrt(np.maximum(level_variance, 0)),
        np.sqrt(np.maximum(shape_variance, 0)),
        levels,
        mean,
        spread,
    )


def level_trend(levels: ArrayLike, covariate: ArrayLike) -> Trend:
    """Line through the levels of placements over time (drift) or pressure, with a t test.

    Parameters
    ----------
    levels
        (placement, 3) logarithms, from `placement_variance`.
    covariate
        (placement,) time in hours or pressure in kPa; the slope is per unit of it.

    Raises
    ------
    InputError
        Wrong shapes, values that are not finite, fewer than three placements, or a
        covariate that does not vary.
    """
    y = np.asarray(levels, np.float64)
    x = np.asarray(covariate, np.float64)
    good = (
        x.ndim == 1
        and y.shape == (len(x), 3)
        and len(x) >= MIN_PLACEMENTS
        and np.isfinite(y).all()
    )
    if not good or not np.isfinite(x).all() or np.ptp(x) == 0:
        rule = (
            f"levels (placement, 3) and a covariate that varies over {MIN_PLACEMENTS} "
            "placements or more are needed"
        )
        raise InputError(
            Fault(
                "trend of the probe",
                rule,
                f"{y.shape} and {x.shape}",
                "log it for every placement",
            )
        )
    centred = x - x.mean()
    square = float(centred @ centred)
    slope = centred @ y / square
    rest = y - y.mean(axis=0) - centred[:, None] * slope
    error = np.sqrt((rest**2).sum(axis=0) / (len(x) - 2) / square)
    with np.errstate(divide="ignore", invalid="ignore"):
        p_value = np.where(
            slope == 0, 1.0, 2 * stats.t.sf(np.abs(slope) / error, len(x) - 2)
        )
    return Trend(slope, error, p_value, p_value < FLAG_P_VALUE)
