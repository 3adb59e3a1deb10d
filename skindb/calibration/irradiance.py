"""Irradiance of points by the lights, and intensities of the lights from photographs of a
white target (Weyrich et al. 2005, section 5).
"""

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from skindb.calibration._merge_kernels import OK
from skindb.calibration.frame_checks import checked_white_view
from skindb.calibration.radiance import FrameMerger
from skindb.errors import attempt_all, require
from skindb.format.dome import CameraRecord, DomeRecord, LightRecord, WhiteRecord
from skindb.format.frames import Digests
from skindb.numerics.statistics import robust_deviation
from skindb.types import Float64, Index, Mask, dots, finite_rows, float64, lengths

# of the half size: a disc inside the square, however the square is rotated
TARGET_INTERIOR_FRACTION = 0.8
# neither dark nor saturated; the median and spread of fewer are unreliable
MIN_TARGET_PIXELS = 12
# cosine of incidence below which a light does not illuminate the target
MIN_COSINE_TARGET = 0.05
# neighbouring pixels that are averaged before their spread is measured
PIXELS_PER_GROUP = 16
# R_d that a pixel at the white level shows if no intensity is known
RELATIVE_WHITE = 0.5
# relative spread of the intensity over the target: 0.02 in captures, 0.35 and more if a
# face stands in its place
MAX_UNEVENNESS = 0.2
PIXELS_PER_BLOCK = 1 << 16  # pixels whose rays are in memory at a time: 130 bytes each
# of incidence and of the angle to the axis; below it, directions are too inaccurate
MIN_COSINE = 0.05
MIN_PIXELS = 50
# robust standard deviations from the median; larger deviations are dirt or highlights
MAX_DEVIATIONS = 4.0
ROUNDS = 20
MIN_USED = 0.5  # of the pixels; if more are in shadow, the median belongs to the shadow


def light_falloff(light: LightRecord, points: Float64) -> tuple[Float64, Float64]:
    """Squared distance (n,) mm2 of points (n, 3) from a light and its angular fall-off
    (n,) towards them.
    """
    way = points - light.position
    square = dots(way, way)
    if light.falloff == 0:
        return square, np.ones(len(points))
    cosine = np.maximum(way @ light.axis, 0.0) / np.sqrt(square)
    return square, cosine**light.falloff


def light_intensities(
    dome: DomeRecord,
    mergers: Mapping[str, FrameMerger],
    pool: Executor,
    digests: Digests | None = None,
    *,
    centre: ArrayLike = (0.0, 0.0, 0.0),
) -> Float64:
    """Radiant intensity (light, 3) in radiance mm2: given, or I = pi L d^2 /
    (reflectance cos falloff) by the target; without both, that of `relative_intensity`.
    It is multiplied by the gain of the light.

    Raises
    ------
    InputError
        With every light that does not illuminate the target, and every frame that
        cannot be decoded.
    """
    white = dome.white
    targets = []
    if white is not None:
        targets = [
            target_pixels(c, white) for c in dome.cameras if c.id in white.cameras
        ]

    def intensity(light: LightRecord) -> Float64:
        if light.intensity is not None:
            return light.intensity * light.gain
        if white is None:
            middle = float64(centre)
            return relative_intensity(dome, middle) * light.gain
        values = [np.zeros((0, 3))]
        for target in targets:
            merger = mergers[target.camera]
            values.append(_intensities(dome, light, merger, target, digests))
        mean = robust_mean(np.concatenate(values))
        require(
            (mean > 0).all(),
            f"{dome.file}[lights], light {light.id}",
            "every light must illuminate the white target",
            "no usable pixel",
            "check its position, or give its intensity",
        )
        return mean * light.gain

    return np.array(attempt_all([], intensity, dome.lights, pool=pool))


def relative_intensity(dome: DomeRecord, centre: Float64) -> Float64:
    """Intensity (3,) of every light where none is known.

    The median light makes a matt surface of R_d 0.5 at `centre` that faces it as bright
    as the white level of the longest exposure, or radiance 1 of linear files. So
    reflectance is relative, but the same in all captures of a dome with these exposures.
    """
    levels = [
        1.0 if camera.sensor.kind.bits == 0 else 1 / max(dome.exposures.values())
        for camera in dome.cameras
    ]
    square = np.median([light_falloff(x, centre[None])[0] for x in dome.lights])
    return np.full(3, np.pi / RELATIVE_WHITE * max(levels) * float(square))


@dataclass(frozen=True)
class Target:
    """Pixels of a camera that lie well inside the white target."""

    camera: str
    at: Index  # (n,) index into the flattened picture
    # (h, 2) first column in each row, and the one after the last
    spans: Index
    points: Float64  # (n, 3) mm on the target


def target_pixels(camera: CameraRecord, white: WhiteRecord) -> Target:
    """Pixels at which a camera sees the interior of the white target."""
    step = max(PIXELS_PER_BLOCK // camera.width, 1)
    masks, points = zip(
        *(
            _target_rows(camera, white, top, min(top + step, camera.height))
            for top in range(0, camera.height, step)
        ),
        strict=True,
    )
    inside = np.concatenate(masks)
    left = inside.argmax(axis=1)
    right = camera.width - inside[:, ::-1].argmax(axis=1)
    spans = np.stack([left, np.where(inside.any(axis=1), right, left)], axis=1)
    return Target(camera.id, np.flatnonzero(inside), spans, np.concatenate(points))


def _target_rows(
    camera: CameraRecord, white: WhiteRecord, top: int, bottom: int
) -> tuple[Mask, Float64]:
    """Mask (rows, width) of the pixels on the target in rows top to bottom - 1, and
    their points (n, 3) in mm.
    """
    row, column = np.mgrid[top:bottom, : camera.width]
    ray = camera.rays(np.stack([column, row], axis=-1) + 0.5)
    centre = camera.centre
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (white.point - centre) @ white.normal / (ray @ white.normal)
        points = centre + distance[..., None] * ray
        radius = lengths(points - white.point)
        inside = (distance > 0) & (radius < TARGET_INTERIOR_FRACTION * white.half_size)
    return inside, points[inside]


def robust_mean(values: Float64) -> Float64:
    """Mean (c,) of values (n, c) without outliers; NaN if there are too few values."""
    usable = values[finite_rows(values)]
    if len(usable) < MIN_TARGET_PIXELS:
        return np.full(values.shape[1], np.nan)
    columns = np.ascontiguousarray(usable.T)  # medians are taken along rows
    middle = np.median(columns, axis=1, keepdims=True)
    apart = columns - middle
    spread = robust_deviation(apart, axis=1)[:, None]
    good = (np.abs(apart) <= MAX_DEVIATIONS * spread).all(axis=0)
    return columns[:, good].mean(axis=1) if good.any() else middle[:, 0]


def _intensities(
    dome: DomeRecord,
    light: LightRecord,
    merger: FrameMerger,
    target: Target,
    digests: Digests | None,
) -> Float64:
    """Intensity (m, 3) computed from each usable pixel of the target."""
    white = dome.white
    if white is None or not len(target.at):
        return np.zeros((0, 3))
    frames = checked_white_view(dome, light.id, merger, digests=digests)
    radiance, flag = merger.merge(frames, target.spans)
    # gains of a calibration from takes are relative to what the stated position gives
    stated = replace(light, position=light.position - np.array(light.offset))
    square, falloff = light_falloff(stated, target.points)
    towards = (stated.position - target.points) @ white.normal
    cosine = falloff * towards / np.sqrt(square)
    usable = (cosine > MIN_COSINE_TARGET) & (flag.ravel()[target.at] == OK)
    factor = np.pi / white.reflectance * square[usable] / cosine[usable]
    values = radiance.reshape(-1, 3)[target.at[usable]] * factor[:, None]
    variation = unevenness(values)
    require(
        not variation > MAX_UNEVENNESS,
        f"{dome.file}[white]",
        "the white target must be evenly bright: radiance * d^2 / cos varies by "
        f"at most {MAX_UNEVENNESS:.0%}",
        f"camera {merger.camera.id}, light {light.id}: by {variation:.0%}",
        "point, normal and half_size must be those of the target, and its frames "
        "must show it and not the face",
    )
    return float64(values)


def unevenness(values: Float64) -> float:
    """Relative robust standard deviation of values (n, c) in the order of the pixels; 0
    if there are too few.

    It is that of means over groups of neighbours, which suppresses the noise of single pixels.
    """
    count = len(values) // PIXELS_PER_GROUP
    if count < MIN_TARGET_PIXELS:
        return 0.0
    groups = values[: count * PIXELS_PER_GROUP].reshape(count, PIXELS_PER_GROUP, -1)
    means = groups.mean(axis=1)
    middle = np.median(means, axis=0)
    spread = robust_deviation(means - middle, axis=0)
    return float((spread / np.maximum(np.abs(middle), 1e-300)).max())


@dataclass(frozen=True)
class TargetPixels:
    """Pixels of the target under one light: radiance (n, 3), NaN where it is saturated
    or dark, and geometry.

    `points` (n, 3) and `position` (3,) of the light are in mm; `normal` (3,) of the
    target and `axis` (3,) of the light are unit vectors. `reflectance` is that of the
    target.
    """

    radiance: Float64
    points: Float64
    position: Float64
    axis: Float64
    normal: Float64
    reflectance: float


@dataclass(frozen=True)
class LightFit:
    """Radiant intensity (3,) along the axis in radiance mm2, its standard error, and the
    fraction of the usable pixels that are neither shadowed nor dirty.
    """

    intensity: Float64
    intensity_error: Float64
    used: float


def position_sensitivity(target: TargetPixels, *, falloff: float) -> float:
    """Relative change of the intensity per mm by which the light lies elsewhere in the
    direction that matters most.

    This is the length of the gradient of ln(d^2 / (cos cos(angle to the
    axis)^falloff)), averaged over the target, with respect to the position of the
    light. A target or a camera that lies elsewhere has the same effect.
    """

    def mean(position: Float64) -> float:
        distance, lit, angle = _light_geometry(target, position)
        usable = (lit > MIN_COSINE) & (angle > MIN_COSINE)
        return float(
            np.mean(np.log(distance**2 / (lit * angle**falloff)), where=usable)
        )

    position = target.position
    half_mm = np.eye(3) / 2
    gradient = [mean(position + step) - mean(position - step) for step in half_mm]
    return float(np.linalg.norm(gradient))


def _light_geometry(
    target: TargetPixels, position: Float64
) -> tuple[Float64, Float64, Float64]:
    """Distance of the pixels (n,) from a light, and their cosines of incidence and of
    the angle to the axis of the light.
    """
    way = target.points - position
    distance = lengths(way)
    return distance, -(way @ target.normal) / distance, (way @ target.axis) / distance


def fit_light(target: TargetPixels, *, falloff: float) -> LightFit:
    """Intensity of a light from ln(pi L d^2 / (reflectance cos cos(angle to the
    axis)^falloff)).

    Deviating pixels are excluded in rounds, which start from the median, so that less
    than half of the target may lie in shadow.

    Parameters
    ----------
    target
        Radiance and geometry.
    falloff
        Exponent of the angular fall-off.

    Raises
    ------
    InputError
        Too few usable pixels, or more than half of them in shadow.
    """
    distance, lit, angle = _light_geometry(target, target.position)
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = distance**2 / (target.reflectance * lit * angle**falloff)
        value = np.log(np.pi * target.radiance * factor[:, None])
    good = (lit > MIN_COSINE) & (angle > MIN_COSINE) & finite_rows(value)
    require(
        good.sum() >= MIN_PIXELS,
        "white target",
        f"at least {MIN_PIXELS} of its pixels must be lit and neither dark nor saturated",
        f"{int(good.sum())} of {len(good)}",
        "add a suitable exposure",
    )
    value = value[good]
    inliers = np.ones(len(value), bool)
    level = np.median(value, axis=0)
    for _ in range(ROUNDS):
        apart = (value - level).mean(axis=1)
        spread = float(robust_deviation(apart - np.median(apart)))
        limit = MAX_DEVIATIONS * max(spread, 1e-9)
        chosen = np.abs(apart - np.median(apart[inliers])) <= limit
        level = value[chosen].mean(axis=0)
        if (chosen == inliers).all():
            break
        inliers = chosen
    used = float(inliers.mean())
    require(
        used >= MIN_USED,
        "white target",
        "less than half of the white target may lie in shadow",
        f"{used:.0%} agree",
        "move the target, or remove the obstacle",
    )
    intensity = np.exp(level)
    error = value[inliers].std(axis=0, ddof=1) / np.sqrt(inliers.sum())
    return LightFit(intensity, intensity * error, used)
