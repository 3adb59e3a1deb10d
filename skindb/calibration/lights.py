"""Calibration of the lights of a dome from its white target, and its application to a capture."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

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
from skindb.calibration.pixel_flags import OK, SATURATED
from skindb.calibration.radiance import FrameMerger, frame_mergers, read_view
from skindb.errors import Fault, InputError
from skindb.format.dome import (
    CameraRecord,
    DomeRecord,
    LightRecord,
    WhiteRecord,
    read_dome,
)
from skindb.format.fields import Fields
from skindb.format.json_file import read_json
from skindb.schema import dataset

THREADS = 2
# Standard error of a light relative to the target along each axis, chosen in advance
# for a careful calibration. In generated captures with errors of 0.6 mm of lights and
# of cameras, intensities have z-scores of 0.9 to 1.2 with it.
POSITION_ERROR_MM = 1.0
# half diagonals of the target: light farther from its centre is not that of its blurred
# corners
BESIDE_TARGET = 1.05


def read_setup_dome(
    folder: Path, *, white: bool = True, dark: bool = True
) -> DomeRecord:
    """The dome of a set-up folder, which has no frames of a face; frames of a `white`
    target are required by default.

    Without `dark`, the dark frames and the sequence of the file are ignored, because a
    session takes its own.

    Raises
    ------
    InputError
        With every fault of `dome/dome.json` and of the frames, or without a white target.
    """
    faults = list[Fault]()
    file = folder / "dome/dome.json"
    data = read_json(file, faults)
    if data is None:
        raise InputError(faults)
    if not dark and isinstance(data, dict):
        data = {
            key: value for key, value in data.items() if key not in ("dark", "sequence")
        }
    dome = read_dome(
        folder, Fields(data, str(file), faults), face=False, calibrated=True
    )
    if white and dome.white is None and not faults:
        rule = "a calibration needs the frames of a white target"
        cure = "photograph it, see docs/capture_format.md"
        faults.append(Fault(f"{file}[white]", rule, "none", cure))
    if faults:
        raise InputError(faults)
    return dome


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
