"""Calibration of the lights of a dome from its white target, and its application to a capture."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.ingest.devices import DomeRecord, LightRecord, read_dome
from skindb.ingest.fields import Fields
from skindb.ingest.frame_checks import view_faults
from skindb.ingest.irradiance import Target, target_pixels
from skindb.ingest.json_file import read_json
from skindb.ingest.pixel_flags import OK
from skindb.ingest.radiance import FrameMerger, frame_mergers, read_view
from skindb.ingest.white_target import LightFit, TargetPixels, fit_light
from skindb.schema import dataset

THREADS = 2


def read_setup_dome(folder: Path, *, white: bool = True, dark: bool = True) -> DomeRecord:
    """The dome of a set-up folder, which has no frames of a face; frames of a `white` target are required by default.

    Without `dark`, the dark frames and the sequence of the file are ignored, because a session takes its own.

    Raises
    ------
    InputError
        With every fault of `dome/dome.json` and of the frames, or without a white target.
    """
    faults, file = list[Fault](), folder / "dome/dome.json"
    data = read_json(file, faults)
    if data is None:
        raise InputError(faults)
    if not dark and isinstance(data, dict):
        data = {key: value for key, value in data.items() if key not in ("dark", "sequence")}
    dome = read_dome(folder, Fields(data, str(file), faults), face=False, calibrated=True)
    if white and dome.white is None and not faults:
        rule, cure = "a calibration needs the frames of a white target", "photograph it, see docs/capture_format.md"
        faults.append(Fault(f"{file}[white]", rule, "none", cure))
    if faults:
        raise InputError(faults)
    return dome


def calibrate_lights(dome: DomeRecord, *, fit_falloff: bool = False) -> xr.Dataset:
    """Radiant intensity of every light, and perhaps its fall-off, with standard errors.

    Parameters
    ----------
    dome
        From `read_setup_dome`.
    fit_falloff
        Also fit the exponents of the angular fall-off, instead of using those of dome.json. A target that covers a
        small angle as seen from the light determines them poorly.

    Returns
    -------
    Dataset
        Group "light_calibration".

    Raises
    ------
    InputError
        With every light that does not illuminate the target, and every frame that cannot be decoded.
    """
    faults = list[Fault]()
    mergers = frame_mergers(dome, faults)
    own = () if dome.white is None else dome.white.cameras
    targets = [target_pixels(c, dome.white) for c in dome.cameras if dome.white is not None and c.id in own]

    def one(light: LightRecord) -> LightFit | None:
        try:
            pixels = _pixels(dome, light, [(mergers[target.camera], target) for target in targets])
            return fit_light(pixels, falloff=None if fit_falloff else light.falloff)
        except InputError as error:
            where = f"{dome.file}[lights], light {light.id}"
            faults.extend(
                Fault(f"{where}: {fault.where}", fault.rule, fault.found, fault.cure) for fault in error.faults
            )
            return None

    with ThreadPoolExecutor(THREADS) as pool:
        fits = [fit for fit in pool.map(one, dome.lights) if fit is not None]
    if faults:
        raise InputError(sorted(faults, key=str))
    return dataset(
        {
            "calibrated_intensity": [fit.intensity for fit in fits],
            "calibrated_intensity_error": [fit.intensity_error for fit in fits],
            "calibrated_falloff": [fit.falloff for fit in fits],
            "calibrated_falloff_error": [fit.falloff_error for fit in fits],
            "target_used_fraction": [fit.used for fit in fits],
        },
        coords={"light": [light.id for light in dome.lights], "channel": ["R", "G", "B"]},
    )


def _pixels(dome: DomeRecord, light: LightRecord, views: list[tuple[FrameMerger, Target]]) -> TargetPixels:
    """Pixels of the target under one light, of all cameras together."""
    white = dome.white
    if white is None:
        raise InputError(Fault("white target", "a calibration needs one", "none", "photograph it"))
    radiance, points = list[NDArray[np.float64]](), list[NDArray[np.float64]]()
    for merger, target in views:
        frames = read_view(dome, light.id, merger.camera, white=True)
        if faults := view_faults(dome, light.id, merger, frames, white=True):
            raise InputError(faults)
        merged, flag = merger.merge(frames, target.spans)
        known = flag.ravel()[target.at] == OK
        radiance.append(np.where(known[:, None], merged.reshape(-1, 3)[target.at], np.nan).astype(np.float64))
        points.append(target.points)
    return TargetPixels(
        np.concatenate(radiance) if radiance else np.zeros((0, 3)),
        np.concatenate(points) if points else np.zeros((0, 3)),
        light.position,
        light.axis,
        white.normal,
        white.reflectance,
    )


def calibrated_dome(dome: DomeRecord, calibration: xr.Dataset, *, where: str) -> DomeRecord:
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
        raise InputError(Fault(where, "a calibration must have every light of the capture", found, "calibrate again"))
    intensity, falloff = known["calibrated_intensity"], known["calibrated_falloff"]
    lights = (
        replace(light, intensity=intensity.sel(light=light.id).values, falloff=float(falloff.sel(light=light.id)))
        for light in dome.lights
    )
    return replace(dome, lights=tuple(lights))
