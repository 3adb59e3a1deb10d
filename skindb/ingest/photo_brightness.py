"""Brightness of photographs relative to a prediction for a matte face: by camera, by
light and of the face.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skindb.ingest.photo_offsets import FLOOR, ReducedView, bilinear

Array = NDArray[np.float64]
# of the largest irradiance in a view, above which a surfel is compared
LIT_FRACTION = 0.3
# of the medians of cameras and lights in turn; three change factors by less than 1 %
POLISH_ROUNDS = 10


@dataclass(frozen=True)
class Brightness:
    """Factors of the radiance over that of a matte face of reflectance 1; NaN where too
    little is visible.
    """

    reflectance: Array  # (3,) of the face, the factor of the median camera and light
    camera: Array  # (camera, 3) relative to the median camera
    light: Array  # (light,) relative to the median light


def view_factors(
    view: ReducedView,
    picture: NDArray[np.float32],
    pixels: Array,
    irradiance: Array,
    albedo: Array,
) -> Array:
    """Median factor (3,) of the radiance of a view over that of a matte face.

    Parameters
    ----------
    view
        The surfels that the camera sees.
    picture
        (h, w, 3) downsampled radiance.
    pixels
        (n, 2) px of the surfels in it.
    irradiance
        (n, 3) at the surfels, 0 in shadow.
    albedo
        (n,) of the surfels, relative to the median.
    """
    grey = irradiance.mean(axis=1)
    at = view.clear & (grey > LIT_FRACTION * grey.max())
    planes = np.moveaxis(np.asarray(picture, np.float64), -1, 0)
    radiance = np.stack([bilinear(plane, pixels[at]) for plane in planes], axis=1)
    return np.asarray(
        np.pi * np.median(radiance / (irradiance[at] * albedo[at, None]), axis=0)
    )


def relative_brightness(
    factors: Array,
    lights: Sequence[int],
    cameras: Sequence[int],
    *,
    shape: tuple[int, int],
) -> Brightness:
    """Split the factors of views into those of lights and cameras, by medians of
    logarithms in turn (Tukey 1977).

    Parameters
    ----------
    factors
        (view, 3), see `view_factors`.
    lights, cameras
        Light and camera of each view.
    shape
        Number of lights and of cameras.
    """
    log = np.log(np.maximum(factors, FLOOR)).reshape(-1, 3)
    light_of = np.asarray(lights, np.int64)
    camera_of = np.asarray(cameras, np.int64)
    by_light = np.full((shape[0], 3), np.nan)
    by_camera = np.full((shape[1], 3), np.nan)
    if not len(log):
        return Brightness(np.full(3, np.nan), by_camera, by_light[:, 0])
    by_light[light_of] = 0.0
    for _ in range(POLISH_ROUNDS):
        for c in np.unique(camera_of):
            mine = camera_of == c
            by_camera[c] = np.median(log[mine] - by_light[light_of[mine]], axis=0)
        by_camera -= np.nanmedian(by_camera, axis=0)
        for j in np.unique(light_of):
            mine = light_of == j
            by_light[j] = np.median(log[mine] - by_camera[camera_of[mine]], axis=0)
    level = np.nanmedian(by_light, axis=0)
    return Brightness(
        np.exp(level), np.exp(by_camera), np.exp((by_light - level).mean(axis=1))
    )
