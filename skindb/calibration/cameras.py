"""Calibration of the cameras of a dome: response, noise, vignette, colour, lens and
dark level, with their errors.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.calibration.colour_chart import fit_colour_matrix
from skindb.calibration.lens import fit_edge, fit_vignette, veiling_glare
from skindb.calibration.mirror_ball import Pinhole, reprojection_error
from skindb.calibration.pixel_flags import OK
from skindb.calibration.radiance import (
    merge_exposures,
    relative_exposure,
    vignette_gain,
)
from skindb.calibration.response import TABLE_ROWS, recover_response
from skindb.calibration.sensor_noise import average_dark, fit_noise
from skindb.calibration.setup import (
    FILE,
    CalibrationFrames,
    CameraFrames,
    KnownPoints,
    regions,
)
from skindb.errors import Fault, InputError
from skindb.format.dome import CameraRecord, DomeRecord, pixel_width
from skindb.schema import dataset

Array = NDArray[np.float64]
Values = dict[str, Any]
Step = Callable[
    [CalibrationFrames, CameraFrames, CameraRecord], tuple[CameraRecord, Values]
]
THREADS = 2
GREEN = 1
# rms of the known points: at this distance on the face ingest would warn of every
# photograph; but not less than the error with which points are found in a coarse
# picture, nor more than ten times that of a poor calibration
MAX_REPROJECTION_MM = 2.5
MAX_REPROJECTIONS_PX = (2.0, 10.0)
UNKNOWN: Values = {
    "calibrated_response": np.full((TABLE_ROWS, 3), np.nan),
    "calibrated_read_noise": np.nan,
    "calibrated_read_noise_error": np.nan,
    "calibrated_electrons_per_value": np.nan,
    "calibrated_electrons_per_value_error": np.nan,
    "noise_chi_square": np.nan,
    "calibrated_vignette": np.full(3, np.nan),
    "calibrated_vignette_error": np.full(3, np.nan),
    "vignette_residual": np.nan,
    "calibrated_colour_matrix": np.full((3, 3), np.nan),
    "calibrated_colour_matrix_error": np.full((3, 3), np.nan),
    "chart_difference": np.nan,
    "edge_blur": np.nan,
    "edge_blur_error": np.nan,
    "veiling_glare": np.nan,
    "reprojection_rms": np.nan,
    "reprojection_max": np.nan,
    "dark_level": np.full(3, np.nan),
    "dark_level_error": np.full(3, np.nan),
    "defect_pixels": np.nan,
}


def calibrate_cameras(dome: DomeRecord, frames: CalibrationFrames) -> xr.Dataset:
    """Estimate the parameters of each camera from the frames of a set-up; NaN where
    frames are missing.

    Each step uses the results of the steps before it: the response linearises the flat
    frames, their noise weights the exposures, and the chart is photographed through the
    vignette.

    Parameters
    ----------
    dome
        From `read_setup_dome`.
    frames
        From `read_calibration_frames`.

    Returns
    -------
    Dataset
        Group "camera_calibration".

    Raises
    ------
    InputError
        With the faults of the frames of every camera.
    """
    faults = list[Fault]()

    def one(camera: CameraRecord) -> Values:
        values = dict(UNKNOWN)
        known = camera
        for name, step in STEPS.items():
            kind: CameraFrames | None = getattr(frames, name)
            if kind is None or (
                kind.places is not None and camera.id not in kind.places
            ):
                continue
            try:
                known, found = step(frames, kind, known)
            except InputError as error:
                where = f"{name} frames of camera {camera.id}"
                faults.extend(
                    Fault(f"{where}: {f.where}", f.rule, f.found, f.cure)
                    for f in error.faults
                )
                break
            values |= found
        if camera.id in frames.points:
            try:
                values |= _reprojection(frames.points[camera.id], camera)
            except InputError as error:
                where = f"{frames.folder / FILE}[points], camera {camera.id}"
                faults.extend(replace(fault, where=where) for fault in error.faults)
        return values

    with ThreadPoolExecutor(THREADS) as pool:
        rows = list(pool.map(one, dome.cameras))
    if faults:
        raise InputError(sorted(faults, key=str))
    levels = np.linspace(0.0, 1.0, TABLE_ROWS)
    coords = {
        "camera": [c.id for c in dome.cameras],
        "response_level": levels,
        "channel": ["R", "G", "B"],
    }
    return dataset(
        {name: np.array([row[name] for row in rows]) for name in UNKNOWN}, coords=coords
    )


def calibrated_cameras(
    dome: DomeRecord, calibration: xr.Dataset, *, where: str
) -> DomeRecord:
    """The dome with the camera parameters of a calibration; parameters that the
    calibration lacks are unchanged.

    Raises
    ------
    InputError
        If the calibration lacks a camera, or the frames of the capture are not values of a sensor.
    """
    known = calibration.load()
    names = set(map(str, known["camera"].values))
    if missing := [camera.id for camera in dome.cameras if camera.id not in names]:
        found = f"none of {', '.join(missing[:5])}"
        raise InputError(
            Fault(
                where,
                "a calibration must have every camera of the capture",
                found,
                "calibrate again",
            )
        )
    if dome.cameras and dome.cameras[0].sensor.kind.bits == 0:
        rule = "a sensor calibration applies to sensor values only"
        cure = "calibrate a set-up without its cameras"
        raise InputError(Fault(where, rule, "a capture in OpenEXR", cure))
    return replace(
        dome,
        cameras=tuple(
            _calibrated(camera, known.sel(camera=camera.id)) for camera in dome.cameras
        ),
    )


def _calibrated(camera: CameraRecord, known: xr.Dataset) -> CameraRecord:
    sensor = camera.sensor
    response = known["calibrated_response"].values
    if np.isfinite(response).all():
        values = sensor.black + known["response_level"].values * (
            sensor.white - sensor.black
        )
        sensor = replace(
            sensor, response=np.column_stack([values, response]), response_file=None
        )
    if np.isfinite(gain := float(known["calibrated_electrons_per_value"])):
        sensor = replace(
            sensor,
            electrons_per_dn=gain,
            read_noise=float(known["calibrated_read_noise"]),
        )
    vignette = known["calibrated_vignette"].values
    colours = known["calibrated_colour_matrix"].values
    return replace(
        camera,
        sensor=sensor,
        vignette=vignette if np.isfinite(vignette).all() else camera.vignette,
        colour_matrix=colours if np.isfinite(colours).all() else camera.colour_matrix,
    )


def _dark(
    frames: CalibrationFrames, kind: CameraFrames, camera: CameraRecord
) -> tuple[CameraRecord, Values]:
    found = average_dark(
        np.stack(frames.read(kind.frames, camera, repeats=kind.repeats)[0])
    )
    good = ~found.defect
    level = np.array([found.mean[..., c][good[..., c]].mean() for c in range(3)])
    error = np.array(
        [
            np.sqrt((found.error[..., c][good[..., c]] ** 2).sum()) / good[..., c].sum()
            for c in range(3)
        ]
    )
    defects = float(found.defect.any(axis=-1).sum())
    return camera, {
        "dark_level": level,
        "dark_level_error": error,
        "defect_pixels": defects,
    }


def _response(
    frames: CalibrationFrames, kind: CameraFrames, camera: CameraRecord
) -> tuple[CameraRecord, Values]:
    stack = np.stack(
        [own[0] for own in frames.read(kind.frames, camera, [*frames.exposures])]
    )
    sensor = camera.sensor
    found = recover_response(
        stack, [*frames.exposures.values()], black=sensor.black, white=sensor.white
    )
    known = replace(
        camera, sensor=replace(sensor, response=found.table, response_file=None)
    )
    return known, {"calibrated_response": found.table[:, 1:]}


def _flat(
    frames: CalibrationFrames, kind: CameraFrames, camera: CameraRecord
) -> tuple[CameraRecord, Values]:
    """Noise from pairs of equal frames of the green channel, and the vignette from their mean."""
    sensor = camera.sensor
    span = camera.sensor.white - camera.sensor.black
    sets = frames.read(kind.frames, camera, [*frames.exposures], kind.repeats)
    # in linear values above black; saturated values stay at the white level, so that
    # the fit excludes them
    pairs = [
        [
            relative_exposure(frame, None, sensor)[0][..., GREEN] * span
            for frame in own[:2]
        ]
        for own in sets
    ]
    noise = fit_noise(np.array(pairs), black=0.0, white=float(span), step=sensor.step)
    sensor = replace(
        sensor, electrons_per_dn=noise.electrons_per_dn, read_noise=noise.read_noise
    )
    means = [np.mean(own, axis=0).astype(np.float32) for own in sets]
    for mean, own in zip(means, sets, strict=True):
        # a mean hides that one of them was saturated
        mean[np.max(own, axis=0) >= sensor.white] = sensor.white
    merged, _, flag = merge_exposures(means, tuple(frames.exposures.values()), sensor)
    shade = fit_vignette(
        np.where(flag == OK, merged[..., GREEN], np.nan), camera.K[:2, 2]
    )
    return replace(camera, sensor=sensor, vignette=shade.coefficients), {
        "calibrated_read_noise": noise.read_noise,
        "calibrated_read_noise_error": noise.read_noise_error,
        "calibrated_electrons_per_value": noise.electrons_per_dn,
        "calibrated_electrons_per_value_error": noise.electrons_per_dn_error,
        "noise_chi_square": noise.chi_square,
        "calibrated_vignette": shade.coefficients,
        "calibrated_vignette_error": np.sqrt(np.diag(shade.covariance)),
        "vignette_residual": shade.residual,
    }


def _chart(
    frames: CalibrationFrames, kind: CameraFrames, camera: CameraRecord
) -> tuple[CameraRecord, Values]:
    chart, white = (
        _merged(frames, template, camera) for template in (kind.frames, kind.white)
    )
    row, column = np.mgrid[: camera.height, : camera.width] + 0.5
    places = {} if kind.places is None else kind.places
    patches = np.full((len(places[camera.id]), 3), np.nan)
    for patch, (x, y) in enumerate(places[camera.id]):
        inside = np.hypot(column - x, row - y) <= kind.radius
        if inside.any():
            # a saturated pixel makes its patch NaN: the mean of the other pixels would be biased
            patches[patch] = chart[inside].mean(axis=0) / white[inside].mean(axis=0)
    found = fit_colour_matrix(patches)
    return replace(camera, colour_matrix=found.matrix), {
        "calibrated_colour_matrix": found.matrix,
        "calibrated_colour_matrix_error": found.error,
        "chart_difference": float(np.nanmedian(found.delta_e_after)),
    }


def _edge(
    frames: CalibrationFrames, kind: CameraFrames, camera: CameraRecord
) -> tuple[CameraRecord, Values]:
    picture = _merged(frames, kind.frames, camera)[..., GREEN].astype(np.float64)
    place = {} if kind.places is None else kind.places
    found = fit_edge(picture[regions(place[camera.id])])
    glare = veiling_glare(
        found, mean=float(np.nanmean(picture)), contrast=kind.contrast
    )
    return camera, {
        "edge_blur": found.blur,
        "edge_blur_error": found.blur_error,
        "veiling_glare": glare,
    }


def _reprojection(points: KnownPoints, camera: CameraRecord) -> Values:
    pinhole = Pinhole(camera.K, camera.R, camera.t, camera.distortion)
    found = reprojection_error(points.position, points.pixel, pinhole)
    width = pixel_width(camera, points.position.mean(axis=0))
    limit = float(np.clip(MAX_REPROJECTION_MM / width, *MAX_REPROJECTIONS_PX))
    if found.rms > limit:
        rule = (
            f"known points must be seen within {limit:.2g} px of their projections "
            "(root mean square)"
        )
        cure = (
            "calibrate K, R, t and distortion of the camera again, or correct "
            "positions and pixels of the points"
        )
        said = (
            f"{found.rms:.3g} px, {found.rms * width:.2g} mm at their distance; at "
            f"most {found.largest:.3g} px"
        )
        raise InputError(Fault("known points", rule, said, cure))
    return {"reprojection_rms": found.rms, "reprojection_max": found.largest}


def _merged(
    frames: CalibrationFrames, template: str, camera: CameraRecord
) -> NDArray[np.float32]:
    """Radiance (h, w, 3) in the colours of the sensor, NaN where it is saturated."""
    sets = frames.read(template, camera, [*frames.exposures])
    gain = vignette_gain(camera) if camera.vignette.any() else None
    own = [exposure[0] for exposure in sets]
    return merge_exposures(
        own, tuple(frames.exposures.values()), camera.sensor, vignette=gain
    )[0]


# ordered by dependence: a step uses the results of the steps before it
STEPS: dict[str, Step] = {
    "dark": _dark,
    "response": _response,
    "flat": _flat,
    "chart": _chart,
    "edge": _edge,
}
