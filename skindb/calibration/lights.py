"""Calibration of the lights of a dome: intensities from its white target, positions from
highlights on a mirror ball, and their application to a capture.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.calibration.frame_checks import view_faults
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
    Pinhole,
    ball_centre,
    highlight_centre,
    light_position,
    reflected_ray,
)
from skindb.calibration.pixel_flags import OK, SATURATED
from skindb.calibration.radiance import FrameMerger, frame_mergers, read_view
from skindb.calibration.setup import PLACE, BallFrames
from skindb.errors import Fault, InputError
from skindb.format.dome import (
    CameraRecord,
    DomeRecord,
    LightRecord,
    WhiteRecord,
)
from skindb.format.frame_paths import CAMERA, LIGHT, filled
from skindb.format.frames import read_frame
from skindb.schema import dataset

Array = NDArray[np.float64]

# Standard error of a light relative to the target along each axis, chosen in advance
# for a careful calibration. In generated captures with errors of 0.6 mm of lights and
# of cameras, intensities have z-scores of 0.9 to 1.2 with it.
POSITION_ERROR_MM = 1.0
# half diagonals of the target: light farther from its centre is not that of its blurred
# corners
BESIDE_TARGET = 1.05
THREADS = 2


@dataclass(frozen=True)
class _Calibrated:
    """Fit of a light, the relative error by positions, and the light beside the target
    over that on the target.
    """

    fit: LightFit
    position_error: float
    beside: float


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
    faults = list[Fault]()
    mergers = frame_mergers(dome, faults)
    own = () if dome.white is None else dome.white.cameras
    views = [
        _view(c, mergers[c.id], dome.white)
        for c in dome.cameras
        if dome.white is not None and c.id in own
    ]

    def one(light: LightRecord) -> _Calibrated | None:
        try:
            pixels, beside = _pixels(dome, light, views)
            fit = fit_light(pixels, falloff=None if fit_falloff else light.falloff)
            return _Calibrated(
                fit,
                position_error * position_sensitivity(pixels, falloff=fit.falloff),
                beside,
            )
        except InputError as error:
            where = f"{dome.file}[lights], light {light.id}"
            faults.extend(
                Fault(f"{where}: {fault.where}", fault.rule, fault.found, fault.cure)
                for fault in error.faults
            )
            return None

    with ThreadPoolExecutor(THREADS) as pool:
        found = [
            one_light
            for one_light in pool.map(one, dome.lights)
            if one_light is not None
        ]
    if faults:
        raise InputError(sorted(faults, key=str))
    fits = [one_light.fit for one_light in found]
    return dataset(
        {
            "calibrated_intensity": [fit.intensity for fit in fits],
            "calibrated_intensity_error": [fit.intensity_error for fit in fits],
            "calibrated_intensity_position_error": [
                one_light.position_error for one_light in found
            ],
            "glare_fraction": [one_light.beside for one_light in found],
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
    beside: NDArray[np.bool_]
    area: float


def _view(camera: CameraRecord, merger: FrameMerger, white: WhiteRecord) -> _View:
    target = target_pixels(camera, white)
    beside = np.ones(camera.height * camera.width, bool)
    near = replace(
        white,
        half_size=BESIDE_TARGET
        * np.sqrt(2)
        * white.half_size
        / TARGET_INTERIOR_FRACTION,
    )
    beside[target_pixels(camera, near).at] = False
    square_over_disc = 4 / (np.pi * TARGET_INTERIOR_FRACTION**2)
    return _View(
        merger,
        target,
        beside.reshape(camera.height, camera.width),
        len(target.at) * square_over_disc,
    )


def _pixels(
    dome: DomeRecord, light: LightRecord, views: list[_View]
) -> tuple[TargetPixels, float]:
    """Pixels of the target under one light, of all cameras together, and the fraction
    of light beside the target.
    """
    white = dome.white
    if white is None:
        raise InputError(
            Fault("white target", "a calibration needs one", "none", "photograph it")
        )
    radiance = list[NDArray[np.float64]]()
    points = list[NDArray[np.float64]]()
    beside = [0.0]
    for view in views:
        frames = read_view(dome, light.id, view.merger.camera, white=True)
        if faults := view_faults(dome, light.id, view.merger, frames, white=True):
            raise InputError(faults)
        merged, flag = view.merger.merge(frames)
        at = view.target.at
        known = flag.ravel()[at] == OK
        radiance.append(
            np.where(known[:, None], merged.reshape(-1, 3)[at], np.nan).astype(
                np.float64
            )
        )
        points.append(view.target.points)
        if known.any():
            scattered = (
                np.nansum(merged[view.beside & (flag != SATURATED)], dtype=np.float64)
                / 3
            )
            beside.append(scattered / (float(np.nanmean(radiance[-1])) * view.area))
    pixels = TargetPixels(
        np.concatenate(radiance) if radiance else np.zeros((0, 3)),
        np.concatenate(points) if points else np.zeros((0, 3)),
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
    known = calibration.load()
    names = set(map(str, known["light"].values))
    if missing := [light.id for light in dome.lights if light.id not in names]:
        found = f"none of {', '.join(missing[:5])}"
        raise InputError(
            Fault(
                where,
                "a calibration must have every light of the capture",
                found,
                "calibrate again",
            )
        )
    intensity = known["calibrated_intensity"]
    falloff = known["calibrated_falloff"]
    lights = (
        replace(
            light,
            intensity=intensity.sel(light=light.id).values,
            falloff=float(falloff.sel(light=light.id)),
        )
        for light in dome.lights
    )
    return replace(dome, lights=tuple(lights))


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
    cameras = {
        camera.id: Pinhole(camera.K, camera.R, camera.t, camera.distortion)
        for camera in dome.cameras
    }
    centres = dict[str, Array]()
    for place, circles in ball.outlines.items():
        try:
            seen = [cameras[name] for name in circles]
            centres[place] = ball_centre(
                seen, list(circles.values()), ball.radius
            ).centre
        except InputError as error:
            raise InputError(
                [
                    replace(fault, where=f"{fault.where}, place {place}")
                    for fault in error.faults
                ]
            ) from None
    faults = list[Fault]()

    def one(light: LightRecord) -> tuple[LightPosition | None, int]:
        try:
            rays = list(_rays(dome, ball, centres, light))
            if len(rays) < 2:
                rule = "its highlight must appear in two frames"
                cure = "expose them longer, or add a place of the ball"
                raise InputError(Fault("mirror ball", rule, f"{len(rays)}", cure))
            return light_position(*zip(*rays, strict=True)), len(rays)
        except InputError as error:
            faults.extend(
                replace(fault, where=f"light {light.id}, {fault.where}")
                for fault in error.faults
            )
            return None, 0

    with ThreadPoolExecutor(THREADS) as pool:
        pairs = list(pool.map(one, dome.lights))
    if faults:
        raise InputError(sorted(faults, key=str))
    found = [position for position, _ in pairs if position is not None]
    return dataset(
        {
            "calibrated_position": [one.position for one in found],
            "calibrated_position_error": [
                np.sqrt(np.diag(one.covariance)) for one in found
            ],
            "position_ray_count": [count for _, count in pairs],
            "position_miss": [np.sqrt(np.mean(one.miss**2)) for one in found],
        },
        coords={"light": [light.id for light in dome.lights], "xyz": ["x", "y", "z"]},
    )


def _rays(
    dome: DomeRecord, ball: BallFrames, centres: Mapping[str, Array], light: LightRecord
) -> Iterator[tuple[Array, Array]]:
    """Points of the ball, and directions from them to the light, of all frames that
    show its highlight.
    """
    for place, circles in ball.outlines.items():
        for camera in dome.cameras:
            if camera.id not in circles:
                continue
            names = {PLACE: place, LIGHT: light.id, CAMERA: camera.id}
            frame = read_frame(
                ball.folder / filled(ball.frames, **names), camera.sensor.kind
            )
            column, row, radius = circles[camera.id]
            try:
                highlight = highlight_centre(
                    frame, Outline(np.array([column, row]), radius)
                )
            except InputError:
                continue
            pinhole = Pinhole(camera.K, camera.R, camera.t, camera.distortion)
            yield reflected_ray(pinhole, centres[place], ball.radius, highlight)


def positioned_dome(
    dome: DomeRecord, calibration: xr.Dataset, *, where: str
) -> DomeRecord:
    """The dome with the light positions of a calibration; the axes of the lights are unchanged.

    Raises
    ------
    InputError
        If the calibration lacks a light.
    """
    known = calibration["calibrated_position"].load()
    names = set(map(str, known["light"].values))
    if missing := [light.id for light in dome.lights if light.id not in names]:
        found = f"none of {', '.join(missing[:5])}"
        raise InputError(
            Fault(
                where,
                "a calibration must have every light of the capture",
                found,
                "calibrate again",
            )
        )
    lights = (
        replace(light, position=known.sel(light=light.id).values)
        for light in dome.lights
    )
    return replace(dome, lights=tuple(lights))
