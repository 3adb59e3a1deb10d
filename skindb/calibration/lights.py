"""Calibration of the lights of a dome: intensities from its white target, positions from
highlights on a mirror ball, and their application to a capture.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import xarray as xr

from skindb.calibration._merge_kernels import OK, SATURATED
from skindb.calibration.frame_checks import checked_view
from skindb.calibration.irradiance import (
    TARGET_INTERIOR_FRACTION,
    LightFit,
    Target,
    TargetPixels,
    fit_light,
    position_sensitivity,
    target_pixels,
)
from skindb.calibration.mirror_ball import (
    LightPosition,
    Outline,
    ball_centre,
    highlight_centre,
    light_position,
    reflected_ray,
)
from skindb.calibration.radiance import FrameMerger, frame_mergers
from skindb.calibration.setup import PLACE, BallFrames, of_devices
from skindb.errors import Fault, InputError, attempt, attempt_all, require
from skindb.format.dome import (
    CameraRecord,
    DomeRecord,
    LightRecord,
    WhiteRecord,
)
from skindb.format.frame_paths import CAMERA, LIGHT, filled
from skindb.format.frames import read_frame
from skindb.parameters import POSITION_ERROR_MM
from skindb.schema import dataset
from skindb.types import Float64, Mask

# half diagonals of the target: light farther from its centre is not that of its blurred
# corners
BESIDE_TARGET = 1.05
THREADS = 2


def calibrate_lights(
    dome: DomeRecord,
    *,
    fit_falloff: bool = False,
    position_error: float = POSITION_ERROR_MM,
) -> xr.Dataset:
    """Radiant intensity of every light, and perhaps its fall-off, with standard errors.

    The systematic error of an intensity is that of the position of the light relative
    to the target, and glare: the light that the pictures show beside the target. If the
    surroundings of the target are black, the lens has scattered it there, and the
    intensity is too low by this fraction. It is not corrected, because pictures of a
    face lose about as much.

    Parameters
    ----------
    dome
        From `read_setup_dome`.
    fit_falloff
        Also fit the exponents of the angular fall-off, instead of using those of
        dome.json. A target that covers a small angle as seen from the light determines
        them poorly.
    position_error
        Standard error of the position of a light relative to the target along each axis, in mm.

    Returns
    -------
    Dataset
        Group "light_calibration".

    Raises
    ------
    InputError
        With every light that does not illuminate the target, and every frame that
        cannot be decoded.
    """
    white = dome.white
    if white is None:
        rule = "a calibration needs one"
        raise InputError(Fault("white target", rule, "none", "photograph it"))
    faults = list[Fault]()
    mergers = frame_mergers(dome, faults)
    views = [
        _view(camera, mergers[camera.id], white)
        for camera in dome.cameras
        if camera.id in white.cameras
    ]

    def calibrated(light: LightRecord) -> tuple[LightFit, float, float]:
        """Fit of a light, the relative error by positions, and the light beside the
        target over that on the target.
        """
        pixels, beside = _pixels(dome, white, light, views)
        fit = fit_light(pixels, falloff=None if fit_falloff else light.falloff)
        sensitivity = position_sensitivity(pixels, falloff=fit.falloff)
        return fit, position_error * sensitivity, beside

    with ThreadPoolExecutor(THREADS) as pool:
        results = attempt_all(
            faults,
            calibrated,
            dome.lights,
            pool=pool,
            where=lambda light: f"{dome.file}[lights], light {light.id}: {{}}",
        )
    fits, position_errors, glare = zip(*results, strict=True)
    return dataset(
        {
            "calibrated_intensity": [fit.intensity for fit in fits],
            "calibrated_intensity_error": [fit.intensity_error for fit in fits],
            "calibrated_intensity_position_error": list(position_errors),
            "glare_fraction": list(glare),
            "calibrated_falloff": [fit.falloff for fit in fits],
            "calibrated_falloff_error": [fit.falloff_error for fit in fits],
            "target_used_fraction": [fit.used for fit in fits],
        },
        coords={
            "light": [light.id for light in dome.lights],
            "channel": ["R", "G", "B"],
        },
    )


@dataclass(frozen=True)
class _View:
    """A camera that sees the target: its pixels on the target, those beside it (h, w),
    and the target's area in px.
    """

    merger: FrameMerger
    target: Target
    beside: Mask
    area: float


def _view(camera: CameraRecord, merger: FrameMerger, white: WhiteRecord) -> _View:
    target = target_pixels(camera, white)
    corner = BESIDE_TARGET * np.sqrt(2) * white.half_size
    near = replace(white, half_size=corner / TARGET_INTERIOR_FRACTION)
    beside = np.ones(camera.height * camera.width, bool)
    beside[target_pixels(camera, near).at] = False
    square_over_disc = 4 / (np.pi * TARGET_INTERIOR_FRACTION**2)
    return _View(
        merger,
        target,
        beside.reshape(camera.height, camera.width),
        len(target.at) * square_over_disc,
    )


def _pixels(
    dome: DomeRecord, white: WhiteRecord, light: LightRecord, views: list[_View]
) -> tuple[TargetPixels, float]:
    """Pixels of the target under one light, of all cameras together, and the fraction
    of light beside the target.
    """
    radiance = [np.zeros((0, 3))]
    points = [np.zeros((0, 3))]
    beside = [0.0]
    for view in views:
        frames = checked_view(dome, light.id, view.merger, white=True)
        merged, flag = view.merger.merge(frames)
        usable = flag.ravel()[view.target.at] == OK
        values = merged.reshape(-1, 3)[view.target.at].astype(np.float64)
        values[~usable] = np.nan
        radiance.append(values)
        points.append(view.target.points)
        if usable.any():
            scattered = merged[view.beside & (flag != SATURATED)]
            total = np.nansum(scattered, dtype=np.float64) / 3
            beside.append(total / (float(np.nanmean(values)) * view.area))
    pixels = TargetPixels(
        np.concatenate(radiance),
        np.concatenate(points),
        light.position,
        light.axis,
        white.normal,
        white.reflectance,
    )
    return pixels, max(beside)


def calibrated_dome(
    dome: DomeRecord, calibration: xr.Dataset, *, where: str
) -> DomeRecord:
    """The dome with intensities and fall-offs of a calibration.

    Raises
    ------
    InputError
        If the calibration lacks a light.
    """
    ids = [light.id for light in dome.lights]
    lights = of_devices(calibration, "light", ids, where=where)
    intensities = lights["calibrated_intensity"].values
    exponents = lights["calibrated_falloff"].values
    calibrated = (
        replace(light, intensity=intensity, falloff=float(exponent))
        for light, intensity, exponent in zip(
            dome.lights, intensities, exponents, strict=True
        )
    )
    return replace(dome, lights=tuple(calibrated))


def calibrate_positions(dome: DomeRecord, ball: BallFrames) -> xr.Dataset:
    """Position of every light from its highlights on the ball, with standard errors.

    A light needs its highlight in two frames, of different cameras or places of the
    ball. Frames without a highlight are skipped: the light may be hidden, or behind the
    ball.

    Returns
    -------
    Dataset
        Group "position_calibration".

    Raises
    ------
    InputError
        With every frame that cannot be read, and every light that is seen in fewer than two frames.
    """
    cameras = {camera.id: camera for camera in dome.cameras}
    centres = dict[str, Float64]()
    faults = list[Fault]()
    for place, circles in ball.outlines.items():
        views = [cameras[name] for name in circles]
        centre = attempt(
            faults,
            partial(ball_centre, views, list(circles.values()), ball.radius),
            where=f"{{}}, place {place}",
        )
        if centre is None:
            raise InputError(faults)
        centres[place] = centre.centre

    def calibrated(light: LightRecord) -> tuple[LightPosition, int]:
        rays = list(_rays(dome, ball, centres, light))
        require(
            len(rays) >= 2,
            "mirror ball",
            "its highlight must appear in two frames",
            f"{len(rays)}",
            "expose them longer, or add a place of the ball",
        )
        return light_position(*zip(*rays, strict=True)), len(rays)

    with ThreadPoolExecutor(THREADS) as pool:
        results = attempt_all(
            faults,
            calibrated,
            dome.lights,
            pool=pool,
            where=lambda light: f"light {light.id}, {{}}",
        )
    positions, counts = zip(*results, strict=True)
    return dataset(
        {
            "calibrated_position": [fit.position for fit in positions],
            "calibrated_position_error": [
                np.sqrt(np.diag(fit.covariance)) for fit in positions
            ],
            "position_ray_count": list(counts),
            "position_miss": [np.sqrt(np.mean(fit.miss**2)) for fit in positions],
        },
        coords={"light": [light.id for light in dome.lights], "xyz": ["x", "y", "z"]},
    )


def _rays(
    dome: DomeRecord,
    ball: BallFrames,
    centres: Mapping[str, Float64],
    light: LightRecord,
) -> Iterator[tuple[Float64, Float64]]:
    """Points of the ball, and directions from them to the light, of all frames that
    show its highlight.
    """
    for place, circles in ball.outlines.items():
        for camera in dome.cameras:
            if camera.id not in circles:
                continue
            names = {PLACE: place, LIGHT: light.id, CAMERA: camera.id}
            file = ball.folder / filled(ball.frames, **names)
            frame = read_frame(file, camera.sensor.kind)
            column, row, radius = circles[camera.id]
            outline = Outline(np.array([column, row]), radius)
            highlight = attempt([], partial(highlight_centre, frame, outline))
            if highlight is not None:
                yield reflected_ray(camera, centres[place], ball.radius, highlight)


def positioned_dome(
    dome: DomeRecord, calibration: xr.Dataset, *, where: str
) -> DomeRecord:
    """The dome with the light positions of a calibration; the axes of the lights are unchanged.

    Raises
    ------
    InputError
        If the calibration lacks a light.
    """
    ids = [light.id for light in dome.lights]
    positions = of_devices(calibration, "light", ids, where=where)[
        "calibrated_position"
    ]
    lights = (
        replace(light, position=position)
        for light, position in zip(dome.lights, positions.values, strict=True)
    )
    return replace(dome, lights=tuple(lights))
