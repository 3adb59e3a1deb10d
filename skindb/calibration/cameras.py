"""Calibration of the cameras of a dome: response, noise, vignette, colour and
defect pixels, with their errors; the colour matrix follows from a photographed colour chart.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from skindb.calibration._merge_kernels import OK
from skindb.calibration.lens import fit_vignette
from skindb.calibration.radiance import (
    merge_exposures,
    relative_exposure,
    vignette_gain,
)
from skindb.calibration.response import (
    TABLE_ROWS,
    defect_pixels,
    fit_noise,
    recover_response,
)
from skindb.calibration.setup import (
    FILE,
    CalibrationFrames,
    CameraFrames,
    KnownPoints,
    of_devices,
)
from skindb.errors import Fault, attempt, attempt_all, require
from skindb.format.dome import (
    CameraRecord,
    DomeRecord,
)
from skindb.geometry.camera import Pinhole
from skindb.schema import GROUPS, dataset
from skindb.types import Float32, Float64, finite_rows, float64, lengths

# the manufacturer's reference values, as in colour-science
CHART = "ColorChecker24 - After November 2014"
# usable patches for nine unknowns; three channels leave residuals for the standard
# error
MIN_PATCHES = 9
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
# NaN for every variable of one camera
UNKNOWN: Values = {
    declared.name: np.full(
        [TABLE_ROWS if dim == "response_level" else 3 for dim in declared.dims[1:]],
        np.nan,
    )
    for declared in GROUPS["camera_calibration"]
}


@dataclass(frozen=True)
class ColourFit:
    """Colour matrix of the capture format, its standard error (3, 3) by the scatter of
    the patches, and their CIEDE2000 differences (patch,) after it; NaN if not used.
    """

    matrix: Float64
    error: Float64
    delta_e: Float64


def chart_reference() -> Float64:
    """Linear sRGB (24, 3) of the ColorChecker under D65, row by row, by chromatic
    adaptation from D50.
    """
    import colour  # takes longer to import than the rest of the ingest

    chart = colour.CCS_COLOURCHECKERS[CHART]
    tristimulus = colour.xyY_to_XYZ(np.array(list(chart.data.values())))
    return colour.XYZ_to_sRGB(
        tristimulus, illuminant=chart.illuminant, apply_cctf_encoding=False
    )


def fit_colour_matrix(patches: ArrayLike) -> ColourFit:
    """Matrix that takes linear camera values to linear sRGB, by least squares over the
    patches (Cheung et al. 2004).

    The green of the white patch keeps its value, so that the unit of radiance stays
    that of the white target.

    Parameters
    ----------
    patches
        (patch, 3) mean radiance of each patch over that of a white surface in its
        place, so that uneven light is divided out; NaN where a patch was saturated.
        The patches are those of `chart_reference`, of which the brightest is white.

    Raises
    ------
    InputError
        Too few usable patches, an unusable white patch, or patches of one colour.
    """
    values = float64(patches)
    target = chart_reference()
    good = finite_rows(values)
    white = int(target.sum(axis=1).argmax())
    usable = good.sum() >= MIN_PATCHES and good[white] and values[white, 1] > 0
    require(
        usable and np.linalg.cond(values[good]) <= 1e4,
        "colour chart",
        f"{MIN_PATCHES} patches of different colours must be usable, the white one "
        "among them",
        f"{int(good.sum())} usable patches",
        "expose the chart shorter",
    )
    scale = target[white, 1] / values[white, 1]
    camera = values[good] * scale
    solution, error = _least_squares(camera, target[good])
    level = float(camera[good[:white].sum()] @ solution[:, 1]) / target[white, 1]
    difference = np.full(len(values), np.nan)
    difference[good] = _difference(camera @ solution, target[good])
    return ColourFit(solution.T / level, error / level, difference)


def _least_squares(camera: Float64, target: Float64) -> tuple[Float64, Float64]:
    """Matrix (3, 3) that takes camera values (n, 3) to colours (n, 3), and its standard
    error.
    """
    solution, *_ = np.linalg.lstsq(camera, target)
    residual = target - camera @ solution
    variance = (residual**2).sum(axis=0) / max(len(camera) - 3, 1)
    error = np.sqrt(variance[:, None] * np.diag(np.linalg.inv(camera.T @ camera)))
    return float64(solution), error


def _difference(measured: Float64, expected: Float64) -> Float64:
    """CIEDE2000 (n,) between linear sRGB colours (n, 3)."""
    import colour

    lab = [
        colour.XYZ_to_Lab(colour.sRGB_to_XYZ(c, apply_cctf_decoding=False))
        for c in (measured, expected)
    ]
    return colour.delta_E(*lab, method="CIE 2000")


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

    def calibrated(camera: CameraRecord) -> Values:
        values = dict(UNKNOWN)
        improved = camera
        for name, kind in frames.kinds.items():
            if camera.id not in kind.places:
                continue
            place = f"{name} frames of camera {camera.id}: {{}}"
            call = partial(STEPS[name], frames, kind, improved)
            step = attempt(faults, call, where=place)
            if step is None:
                break
            improved = step[0]
            values |= step[1]
        if camera.id in frames.points:
            place = f"{frames.folder / FILE}[points], camera {camera.id}"
            check = partial(_reprojection, frames.points[camera.id], camera)
            values |= attempt(faults, check, where=place) or {}
        return values

    with ThreadPoolExecutor(THREADS) as pool:
        rows = attempt_all(faults, calibrated, dome.cameras, pool=pool)
    coords = {
        "camera": dome.camera_ids,
        "response_level": np.linspace(0.0, 1.0, TABLE_ROWS),
        "channel": ["R", "G", "B"],
    }
    variables = {name: np.array([row[name] for row in rows]) for name in UNKNOWN}
    return dataset(variables, coords=coords)


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
    ids = dome.camera_ids
    calibrated = of_devices(calibration, "camera", ids, where=where)
    require(
        not dome.cameras or dome.cameras[0].sensor.kind.bits,
        where,
        "a sensor calibration applies to sensor values only",
        "a capture in OpenEXR",
        "calibrate a set-up without its cameras",
    )
    cameras = (
        _calibrated(camera, calibrated.isel(camera=c))
        for c, camera in enumerate(dome.cameras)
    )
    return replace(dome, cameras=tuple(cameras))


def _calibrated(camera: CameraRecord, calibration: xr.Dataset) -> CameraRecord:
    known = {
        str(name): values.values
        for name, values in calibration.items()
        if np.isfinite(values).all()
    }
    sensor = camera.sensor
    if "calibrated_response" in known:
        levels = calibration["response_level"].values
        values = sensor.black + levels * (sensor.white - sensor.black)
        table = np.column_stack([values, known["calibrated_response"]])
        sensor = replace(sensor, response=table, response_file=None)
    if "calibrated_electrons_per_value" in known:
        sensor = replace(
            sensor,
            electrons_per_dn=float(known["calibrated_electrons_per_value"]),
            read_noise=float(known["calibrated_read_noise"]),
        )
    return replace(
        camera,
        sensor=sensor,
        vignette=known.get("calibrated_vignette", camera.vignette),
        colour_matrix=known.get("calibrated_colour_matrix", camera.colour_matrix),
    )


def _dark(
    frames: CalibrationFrames, kind: CameraFrames, camera: CameraRecord
) -> tuple[CameraRecord, Values]:
    (repeats,) = frames.read(kind.frames, camera, repeats=kind.repeats)
    defect = defect_pixels(np.stack(repeats))
    return camera, {"defect_pixels": float(defect.any(axis=-1).sum())}


def _response(
    frames: CalibrationFrames, kind: CameraFrames, camera: CameraRecord
) -> tuple[CameraRecord, Values]:
    sets = frames.read(kind.frames, camera, frames.exposures)
    sensor = camera.sensor
    table = recover_response(
        np.stack([repeats[0] for repeats in sets]),
        [*frames.exposures.values()],
        black=sensor.black,
        white=sensor.white,
    )
    sensor = replace(sensor, response=table, response_file=None)
    return replace(camera, sensor=sensor), {"calibrated_response": table[:, 1:]}


def _flat(
    frames: CalibrationFrames, kind: CameraFrames, camera: CameraRecord
) -> tuple[CameraRecord, Values]:
    """Noise from pairs of equal frames of the green channel, and the vignette from their mean."""
    sensor = camera.sensor
    span = sensor.white - sensor.black
    sets = frames.read(kind.frames, camera, frames.exposures, kind.repeats)
    # in linear values above black; saturated values stay at the white level, so that
    # the fit excludes them
    pairs = [
        [relative_exposure(frame, None, sensor)[0][..., GREEN] for frame in repeats[:2]]
        for repeats in sets
    ]
    noise = fit_noise(
        span * np.array(pairs), black=0.0, white=float(span), step=sensor.step
    )
    sensor = replace(
        sensor, electrons_per_dn=noise.electrons_per_dn, read_noise=noise.read_noise
    )
    equal = []
    for repeats in sets:
        # noise decides which of equal frames is saturated
        highest = np.max(repeats, axis=0)
        equal += [np.where(highest < sensor.white, x, highest) for x in repeats]
    seconds = np.repeat([*frames.exposures.values()], kind.repeats)
    merged, _, flag = merge_exposures(equal, seconds.tolist(), sensor)
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
    chart = _merged(frames, kind.frames, camera)
    white = _merged(frames, kind.white, camera)
    row, column = np.mgrid[: camera.height, : camera.width] + 0.5
    patches = np.full((len(kind.places[camera.id]), 3), np.nan)
    for patch, (x, y) in zip(patches, kind.places[camera.id], strict=True):
        inside = np.hypot(column - x, row - y) <= kind.radius
        if inside.any():
            # a saturated pixel makes its patch NaN: the mean of the other pixels would be biased
            patch[:] = chart[inside].mean(axis=0) / white[inside].mean(axis=0)
    fit = fit_colour_matrix(patches)
    return replace(camera, colour_matrix=fit.matrix), {
        "calibrated_colour_matrix": fit.matrix,
        "calibrated_colour_matrix_error": fit.error,
        "chart_difference": float(np.nanmedian(fit.delta_e)),
    }


def _reprojection(points: KnownPoints, camera: CameraRecord) -> Values:
    error = reprojection_error(points.position, points.pixel, camera)
    rms = float(np.sqrt(np.mean(error**2)))
    width = camera.pixel_width(points.position.mean(axis=0))
    limit = float(np.clip(MAX_REPROJECTION_MM / width, *MAX_REPROJECTIONS_PX))
    require(
        not rms > limit,
        "known points",
        f"known points must be seen within {limit:.2g} px of their projections "
        "(root mean square)",
        f"{rms:.3g} px, {rms * width:.2g} mm at their distance; at "
        f"most {error.max():.3g} px",
        "calibrate K, R, t and distortion of the camera again, or correct "
        "positions and pixels of the points",
    )
    return {"reprojection_rms": rms}


def _merged(frames: CalibrationFrames, template: str, camera: CameraRecord) -> Float32:
    """Radiance (h, w, 3) in the colours of the sensor, NaN where it is saturated."""
    exposures = [sets[0] for sets in frames.read(template, camera, frames.exposures)]
    gain = vignette_gain(camera) if camera.vignette.any() else None
    seconds = tuple(frames.exposures.values())
    return merge_exposures(exposures, seconds, camera.sensor, vignette=gain)[0]


STEPS: dict[str, Step] = {
    "dark": _dark,
    "response": _response,
    "flat": _flat,
    "chart": _chart,
}


def reprojection_error(
    points: ArrayLike, pixels: ArrayLike, camera: Pinhole
) -> Float64:
    """Distances (m,) in px of observed pixels (n, 2) from the projections of known points
    (n, 3) in mm, without points behind the camera.

    Raises
    ------
    InputError
        No point remains.
    """
    length = lengths(float64(pixels) - camera.project(points))
    observed = length[np.isfinite(length)]
    require(
        len(observed),
        "reprojection",
        "at least one known point must be seen",
        f"none of {len(length)}",
        "check the pose of the camera",
    )
    return observed
