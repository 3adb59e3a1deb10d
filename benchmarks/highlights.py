"""Highlights of a fit: errors of predictions beside the mirror direction, and fitted peaks
that the true surface does not have.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.reflectance.kinds import even_diffuse, surface_model
from skindb.reflectance.model import Lamp, Points, ReflectanceModel
from skindb.render.surfels import reflectance_errors
from skindb.schema import variables
from skindb.types import Array

# between the half vector and the true normal [rad]
NEAR_MIRROR = np.radians(1.5)
# from the normal to both directions [rad], where fitted and true peaks are compared
PEAK_ANGLE = np.radians(25.0)
MIN_COSINE = 0.15  # to light and camera, above which stated errors are compared
NORMAL_95 = 1.96
DISTANCE = 1000.0  # mm, of the light from the point whose peak is evaluated


class NearMirror(NamedTuple):
    """Sums over samples and channels; the relative RMS error is sqrt(error / signal)."""

    samples: int
    error: float  # sum of squares [sr^-2]
    signal: float

    @property
    def relative(self) -> float:
        """Relative RMS error; NaN without samples."""
        return float(np.sqrt(self.error / self.signal)) if self.samples else np.nan


def near_mirror(
    samples: xr.Dataset,
    model: xr.DataTree,
    true_normal: Array,
    used: NDArray[np.bool],
) -> NearMirror:
    """Errors of the predictions of held-out samples beside the mirror direction.

    Parameters
    ----------
    samples
        From `lumitexels` of the capture.
    model
        Fit of the capture with lights held out.
    true_normal
        (n, 3) of the surfels.
    used
        (n,) surfels to compare.
    """
    held = np.flatnonzero(model["held_out"]["light_held_out"].values)
    part = samples.isel(light=held)
    observed = part[variables.REFLECTANCE_SAMPLE].values
    position = part[variables.SURFEL_POSITION].values.astype(np.float64)
    cameras = [_away(position, place) for place in part["camera_position"].values]
    fitted = model["fitted"].to_dataset()
    surface = surface_model(model["basis"].to_dataset())
    eta = float(fitted[variables.REFRACTIVE_INDEX])
    even = fitted.get(variables.EVEN_REFLECTION, 0.0)
    diffuse = (fitted[variables.DIFFUSE_REFLECTANCE] + even).values
    shading_normal = fitted[variables.SHADING_NORMAL].values
    parameters = surface.parameters_of(fitted)
    count, error, signal = 0, 0.0, 0.0
    for i, light in enumerate(part["light_position"].values):
        to_light = _away(position, light)
        for j, to_camera in enumerate(cameras):
            half = to_light + to_camera
            half /= np.linalg.norm(half, axis=1, keepdims=True)
            near = (half * true_normal).sum(axis=1) > np.cos(NEAR_MIRROR)
            near &= used & np.isfinite(observed[:, i, j]).all(axis=1)
            arrays = (position, shading_normal, to_camera, diffuse, parameters)
            points = Points(*(array[near] for array in arrays))
            predicted = predict(surface, points, light, eta=eta)
            sample = observed[near, i, j].astype(np.float64)
            count += len(sample)
            error += float(((predicted - sample) ** 2).sum())
            signal += float((sample**2).sum())
    return NearMirror(count, error, signal)


class Stated(NamedTuple):
    """Counts of held-out values, and of those within 1.96 times `evaluate_error`."""

    measured: int  # with half vectors at least as far from the normal as a fitted one
    measured_inside: int
    extrapolated: int
    extrapolated_inside: int


def stated_errors(
    samples: xr.Dataset, model: xr.DataTree, used: NDArray[np.bool]
) -> Stated:
    """Held-out samples of the surfels `used` (n,) within their stated intervals, above
    cosines of MIN_COSINE.
    """
    held = np.flatnonzero(model["held_out"]["light_held_out"].values)
    fitted = model["fitted"].to_dataset().isel(surfel=used)
    part = samples.isel(light=held, surfel=used)
    observed = part[variables.REFLECTANCE_SAMPLE].values
    position = part[variables.SURFEL_POSITION].values.astype(np.float64)
    surface = surface_model(model["basis"].to_dataset())
    eta = float(fitted[variables.REFRACTIVE_INDEX])
    normal = fitted[variables.SHADING_NORMAL].values.astype(np.float64)
    seen = np.radians(fitted[variables.SMALLEST_HALF_ANGLE].values)
    counts = np.zeros((2, 2), np.int64)
    for j, camera in enumerate(part["camera_position"].values):
        to_camera = _away(position, camera)
        for i, light in enumerate(part["light_position"].values):
            to_light = _away(position, light)
            cosine = (normal * to_light).sum(axis=1)
            lowest = np.minimum(cosine, (normal * to_camera).sum(axis=1))
            known = np.isfinite(observed[:, i, j]).all(axis=1) & (lowest > MIN_COSINE)
            rows = fitted.isel(surfel=known)
            points = Points(
                position[known],
                normal[known],
                to_camera[known],
                even_diffuse(rows),
                surface.parameters_of(rows),
            )
            sample = observed[known, i, j].astype(np.float64)
            wrong = predict(surface, points, light, eta=eta) - sample
            stated = reflectance_errors(
                rows, surface, to_light[known], to_camera[known]
            )
            inside = np.abs(wrong) < NORMAL_95 * stated * cosine[known, None]
            half = to_light + to_camera
            half /= np.linalg.norm(half, axis=1, keepdims=True)
            nearer = ((half * normal).sum(axis=1) > np.cos(seen))[known]
            for row, chosen in enumerate((~nearer, nearer)):
                counts[row] += inside[chosen].size, inside[chosen].sum()
    return Stated(*counts.ravel().tolist())


def predict(
    surface: ReflectanceModel, points: Points, light: Array, *, eta: float
) -> Array:
    """Samples (n, 3) [sr^-1] of points under a point light at `light` (3,) [mm]."""
    count = len(points.position)
    lamp = Lamp(
        np.broadcast_to(light.astype(np.float64), (count, 1, 3)),
        np.ones((count, 1), np.float32),
        axis=np.array([0.0, 0.0, 1.0]),
        falloff=0.0,
    )
    square = ((points.position - light) ** 2).sum(axis=1, keepdims=True)
    return np.asarray(surface.shade(points, lamp, eta=eta) * square)


def fitted_peaks(surface: ReflectanceModel, parameters: Array, *, eta: float) -> Array:
    """Fitted BRDFs (n,) [sr^-1] where the half vector is the normal."""
    across, along = np.sin(PEAK_ANGLE), np.cos(PEAK_ANGLE)
    shape = (len(parameters), 3)
    points = Points(
        np.zeros(shape),
        np.broadcast_to([0.0, 0.0, 1.0], shape),
        np.broadcast_to([across, 0.0, along], shape),
        np.zeros(shape),
        parameters,
    )
    light = DISTANCE * np.array([-across, 0.0, along])
    return np.asarray(predict(surface, points, light, eta=eta).mean(axis=1) / along)


def _away(position: Array, place: Array) -> Array:
    """Unit directions (n, 3) from positions to a place."""
    way = place - position
    return np.asarray(way / np.linalg.norm(way, axis=1, keepdims=True))
