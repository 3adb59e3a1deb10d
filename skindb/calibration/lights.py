"""Intensities of the lights of a dome from its white target; calibrations of a rig in a capture."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from skindb.calibration._merge_kernels import OK, SATURATED
from skindb.calibration.frame_checks import checked_white_view
from skindb.calibration.irradiance import (
    TARGET_INTERIOR_FRACTION,
    LightFit,
    Target,
    TargetPixels,
    fit_light,
    position_sensitivity,
    target_pixels,
)
from skindb.calibration.radiance import FrameMerger, frame_mergers
from skindb.calibration.setup import of_devices
from skindb.errors import (
    Fault,
    attempt_all,
    input_error,
    require,
)
from skindb.format.dome import (
    CameraRecord,
    DomeRecord,
    LightRecord,
    WhiteRecord,
)
from skindb.parameters import POSITION_ERROR_MM
from skindb.schema import dataset
from skindb.types import Float64, Mask

# half diagonals of the target: light farther from its centre is not that of its blurred
# corners
BESIDE_TARGET = 1.05
THREADS = 2
# between lights of one rig: more than the rounding of files, less than a lamp that was moved
SAME_POSITION_MM = 1.0
SAME_ANGLE = float(np.radians(0.1))
SAME_FRACTION = 0.8  # a few lamps may have failed
MIN_SHARED = 3  # lights; one or two of two rigs may have the same places


def calibrate_lights(
    dome: DomeRecord, *, position_error: float = POSITION_ERROR_MM
) -> xr.Dataset:
    """Radiant intensity of every light, with standard errors.

    The systematic error of an intensity is that of the position of the light relative
    to the target, and glare: the light that the pictures show beside the target. If the
    surroundings of the target are black, the lens has scattered it there, and the
    intensity is too low by this fraction. It is not corrected, because pictures of a
    face lose about as much.

    Parameters
    ----------
    dome
        From `read_setup_dome`.
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
        raise input_error(
            "white target", "a calibration needs one", "none", "photograph it"
        )
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
        fit = fit_light(pixels, falloff=light.falloff)
        sensitivity = position_sensitivity(pixels, falloff=light.falloff)
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
            "calibrated_falloff": [light.falloff for light in dome.lights],
            "target_used_fraction": [fit.used for fit in fits],
        },
        coords={
            "light": dome.light_ids,
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
        frames = checked_white_view(dome, light.id, view.merger)
        merged, flag = view.merger.merge(frames)
        usable = flag.ravel()[view.target.at] == OK
        values = merged.reshape(-1, 3)[view.target.at].astype(float)
        values[~usable] = np.nan
        radiance.append(values)
        points.append(view.target.points)
        if usable.any():
            scattered = merged[view.beside & (flag != SATURATED)]
            total = np.nansum(scattered, dtype=float) / 3
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
    ids = dome.light_ids
    lights = of_devices(calibration, "light", ids, where=where)
    intensities = lights["calibrated_intensity"].values
    exponents = lights["calibrated_falloff"].values
    calibrated = (
        replace(light, intensity=intensity, falloff=float(exponent))
        for light, intensity, exponent in zip(
            dome.lights, intensities, exponents, strict=True
        )
    )
    return replace(dome, lights=tuple(calibrated), relative=False)


def is_same_rig(
    positions: Mapping[str, Float64], others: Mapping[str, Float64]
) -> bool:
    """Whether two sets of lights are of one rig, see `moved_lights`: at least three,
    and 80 % of the smaller set, are in both, and none of these is elsewhere.
    """
    shared = positions.keys() & others.keys()
    smaller = min(len(positions), len(others))
    enough = len(shared) >= max(MIN_SHARED, SAME_FRACTION * smaller)
    return enough and not moved_lights(positions, others)


def moved_lights(
    positions: Mapping[str, Float64], others: Mapping[str, Float64]
) -> list[str]:
    """Ids that are in both sets of lights, with positions (3,) mm that differ by more
    than 1 mm, and 0.1 degrees as seen from the origin.
    """
    return [
        name
        for name, position in positions.items()
        if name in others
        and np.linalg.norm(position - others[name])
        > max(SAME_POSITION_MM, SAME_ANGLE * float(np.linalg.norm(position)))
    ]


def rig_positions(rig: xr.Dataset) -> dict[str, Float64]:
    """Position (3,) mm of each light of the group "rig_calibration"."""
    positions = rig["rig_light_position"].values
    return dict(zip(map(str, rig["light"].values), positions, strict=True))


def rig_dome(dome: DomeRecord, calibration: xr.Dataset, *, where: str) -> DomeRecord:
    """The dome with the gains and offsets of the lights, gains of the cameras, and lobes
    of the skin, by a calibration from takes; lights and cameras that it does not have
    keep their own.

    Raises
    ------
    InputError
        If the lights are not those of the calibration.
    """
    require(
        is_same_rig(
            {light.id: light.position for light in dome.lights},
            rig_positions(calibration),
        ),
        where,
        "a calibration from takes applies to captures with its lights, at least "
        f"{SAME_FRACTION:.0%} of them, within {SAME_POSITION_MM:g} mm or "
        f"{np.degrees(SAME_ANGLE):.1f} degrees",
        "other ids or positions of the lights",
        "remove the key calibration of capture.json, or calibrate from takes of this dome",
    )
    own = calibration.reindex(light=dome.light_ids)
    gains = own["rig_light_gain"].fillna(1.0).values
    offsets = own["rig_light_offset"].fillna(0.0).values
    lights = (
        replace(
            light,
            gain=float(gain),
            position=light.position + offset,
            offset=tuple(offset.tolist()),
        )
        for light, gain, offset in zip(dome.lights, gains, offsets, strict=True)
    )
    names = dome.camera_ids
    sensitivity = calibration["rig_camera_gain"].reindex(camera=names, fill_value=1.0)
    cameras = (
        replace(camera, gain=tuple(gain.tolist()))
        for camera, gain in zip(dome.cameras, sensitivity.values, strict=True)
    )
    return replace(
        dome,
        lights=tuple(lights),
        cameras=tuple(cameras),
        lobes=rig_lobes(calibration),
    )


def rig_lobes(rig: xr.Dataset) -> dict[str, tuple[float, ...]]:
    """Strengths (lobe,) of the face and of the regions that have them."""
    strength = rig["rig_lobe_strength"].dropna("region")
    rows = map(tuple, strength.values.tolist())
    return dict(zip(map(str, strength["region"].values), rows, strict=True))


def positioned_dome(
    dome: DomeRecord, calibration: xr.Dataset, *, where: str
) -> DomeRecord:
    """The dome with the light positions of a calibration; the axes of the lights are unchanged.

    Raises
    ------
    InputError
        If the calibration lacks a light.
    """
    ids = dome.light_ids
    positions = of_devices(calibration, "light", ids, where=where)[
        "calibrated_position"
    ]
    lights = (
        replace(light, position=position)
        for light, position in zip(dome.lights, positions.values, strict=True)
    )
    return replace(dome, lights=tuple(lights))
