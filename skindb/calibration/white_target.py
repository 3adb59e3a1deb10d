"""Radiant intensity and angular fall-off of one light from its pixels on a white
target, with their errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault, InputError

Array = NDArray[np.float64]
# of incidence and of the angle to the axis; below it, directions are too inaccurate
MIN_COSINE = 0.05
MIN_PIXELS = 50
# robust standard deviations; larger deviations are shadows, dirt or highlights
MAX_DEVIATIONS = 4.0
ROUNDS = 20
MIN_USED = 0.5  # of the pixels; if more are in shadow, the median belongs to the shadow


@dataclass(frozen=True)
class TargetPixels:
    """Pixels of the target under one light: radiance (n, 3), NaN where it is saturated
    or dark, and geometry.

    `points` (n, 3) and `position` (3,) of the light are in mm; `normal` (3,) of the
    target and `axis` (3,) of the light are unit vectors. `reflectance` is that of the
    target.
    """

    radiance: Array
    points: Array
    position: Array
    axis: Array
    normal: Array
    reflectance: float


@dataclass(frozen=True)
class LightFit:
    """Radiant intensity (3,) along the axis in radiance mm2, and exponent of the
    fall-off cos^exponent.

    The errors are standard errors; that of the exponent is part of those of the
    intensity. `used` is the fraction of the usable pixels that are neither shadowed nor
    dirty, `scatter` the relative standard deviation of these.
    """

    intensity: Array
    intensity_error: Array
    falloff: float
    falloff_error: float
    used: float
    scatter: float


def position_sensitivity(target: TargetPixels, *, falloff: float) -> float:
    """Relative change of the intensity per mm by which the light lies elsewhere in the
    direction that matters most.

    This is the length of the gradient of ln(d^2 / (cos cos(angle to the
    axis)^falloff)), averaged over the target, with respect to the position of the
    light. A target or a camera that lies elsewhere has the same effect.
    """

    def mean(position: Array) -> float:
        way = target.points - position
        distance = np.linalg.norm(way, axis=1)
        lit = -(way @ target.normal) / distance
        angle = (way @ target.axis) / distance
        known = (lit > MIN_COSINE) & (angle > MIN_COSINE)
        return float(np.mean(np.log(distance**2 / (lit * angle**falloff)), where=known))

    steps = np.eye(3) / 2  # mm
    return float(
        np.linalg.norm(
            [
                mean(target.position + step) - mean(target.position - step)
                for step in steps
            ]
        )
    )


def fit_light(target: TargetPixels, *, falloff: float | None = None) -> LightFit:
    """Intensity of a light, and its fall-off unless that is given, from ln(pi L d^2 /
    (reflectance cos)).

    The logarithm is linear in ln intensity and in the exponent times ln cos(angle to
    the axis). The fit is by least squares over the three channels with a common
    exponent; deviating pixels are excluded in rounds, which start from the median, so
    that less than half of the target may lie in shadow.

    Parameters
    ----------
    target
        Radiance and geometry.
    falloff
        The exponent, if it is known. A target that covers a small angle as seen from
        the light determines it poorly.

    Raises
    ------
    InputError
        Wrong shapes, too few usable pixels, or more than half of them in shadow.
    """
    radiance = np.asarray(target.radiance, np.float64)
    if (
        radiance.ndim != 2
        or radiance.shape != np.shape(target.points)
        or radiance.shape[1] != 3
    ):
        rule = "radiance and points must have the shape (pixel, 3)"
        cure = "give one row for each pixel of the target"
        raise InputError(
            Fault(
                "white target",
                rule,
                f"{radiance.shape} and {np.shape(target.points)}",
                cure,
            )
        )
    way = target.points - target.position
    distance = np.linalg.norm(way, axis=1)
    lit = -(way @ target.normal) / distance
    angle = (way @ target.axis) / distance
    with np.errstate(invalid="ignore", divide="ignore"):
        value = np.log(
            np.pi * radiance * (distance**2 / (target.reflectance * lit))[:, None]
        )
        slope = np.log(angle)
    good = (lit > MIN_COSINE) & (angle > MIN_COSINE) & np.isfinite(value).all(axis=1)
    if good.sum() < MIN_PIXELS:
        rule = f"at least {MIN_PIXELS} of its pixels must be lit and neither dark nor saturated"
        raise InputError(
            Fault(
                "white target",
                rule,
                f"{int(good.sum())} of {len(good)}",
                "add a suitable exposure",
            )
        )
    return _fit(value[good], slope[good], falloff)


def _fit(value: Array, slope: Array, falloff: float | None) -> LightFit:
    """Robust fit of logarithms (n, 3) over ln cosine (n,)."""
    kept = np.ones(len(value), bool)
    exponent = falloff or 0.0
    level = np.median(value - exponent * slope[:, None], axis=0)
    for _ in range(ROUNDS):
        apart = (value - level - exponent * slope[:, None]).mean(axis=1)
        spread = 1.4826 * float(np.median(np.abs(apart - np.median(apart))))
        chosen = np.abs(apart - np.median(apart[kept])) <= MAX_DEVIATIONS * max(
            spread, 1e-9
        )
        centred = slope[chosen] - slope[chosen].mean()
        if falloff is None:
            exponent = float(centred @ value[chosen].mean(axis=1)) / max(
                float(centred @ centred), 1e-12
            )
        level = value[chosen].mean(axis=0) - exponent * slope[chosen].mean()
        if (chosen == kept).all():
            break
        kept = chosen
    used = float(kept.mean())
    if used < MIN_USED:
        rule = "less than half of the white target may lie in shadow"
        cure = "move the target, or remove the obstacle"
        raise InputError(Fault("white target", rule, f"{used:.0%} agree", cure))
    residual = value[kept] - level - exponent * slope[kept, None]
    count = int(kept.sum())
    common = float(residual.mean(axis=1).std(ddof=2))
    centred = slope[kept] - slope[kept].mean()
    exponent_error = (
        0.0
        if falloff is not None
        else common / np.sqrt(max(float(centred @ centred), 1e-12))
    )
    error = np.hypot(
        residual.std(axis=0, ddof=1) / np.sqrt(count),
        exponent_error * slope[kept].mean(),
    )
    intensity = np.exp(level)
    return LightFit(
        intensity,
        intensity * error,
        exponent,
        float(exponent_error),
        used,
        float(residual.std()),
    )
