"""Intensities of the lights from photographs of a white target (Weyrich et al. 2005, section 5)."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.geometry.camera import camera_centre, pixel_rays
from skindb.ingest.devices import CameraRecord, DomeRecord, LightRecord, WhiteRecord
from skindb.ingest.frames import Digests
from skindb.ingest.radiance import OK, Darkroom, read_view

Array = NDArray[np.float64]
INTERIOR = 0.8  # of the half size: a disc that stays off the border whichever way the square is turned
LEAST_PIXELS = 12
GRAZING = 0.05  # cosine below which a light does not light the target
OUTLIER = 4.0  # robust standard deviations


def light_falloff(light: LightRecord, points: Array) -> tuple[Array, Array]:
    """Squared distance (n,) mm2 of points (n, 3) from a light and its angular fall-off (n,) towards them."""
    way = points - light.position
    square = np.einsum("ni,ni->n", way, way)
    if light.falloff == 0:
        return square, np.ones(len(points))
    cosine = np.maximum(way @ light.axis, 0.0) / np.sqrt(square)
    return square, np.asarray(cosine**light.falloff)


def light_intensities(
    dome: DomeRecord, rooms: Mapping[str, Darkroom], pool: Executor, digests: Digests | None = None
) -> Array:
    """Radiant intensity (light, 3) in radiance mm2: as given, or I = pi L d^2 / (reflectance cos falloff).

    Raises
    ------
    InputError
        Every light the target does not show, and every frame that cannot be decoded.
    """
    pixels = {c.id: target_pixels(c, dome.white) for c in dome.cameras if dome.white and c.id in dome.white.cameras}

    faults: list[Fault] = []

    def one(light: LightRecord) -> Array:
        if light.intensity is not None:
            return light.intensity
        parts = [np.zeros((0, 3))]
        try:
            parts += [_intensities(dome, light, rooms[camera], *pixels[camera], digests) for camera in pixels]
        except InputError as error:
            faults.extend(error.faults)
            return np.ones(3)
        found = robust_mean(np.concatenate(parts))
        if not (found > 0).all():
            rule = "the white target must show every light"
            faults.append(
                Fault(f"light {light.id}", rule, "no usable pixel", "check its position, or give its intensity")
            )
        return found

    intensities = np.array(list(pool.map(one, dome.lights)))
    if faults:
        raise InputError(sorted(faults, key=str))
    return intensities


def target_pixels(camera: CameraRecord, white: WhiteRecord | None) -> tuple[NDArray[np.bool_], Array]:
    """Pixels (h, w) of a camera that lie well inside the target, and their points (n, 3) on it."""
    if white is None:
        return np.zeros((camera.height, camera.width), bool), np.zeros((0, 3))
    row, column = np.indices((camera.height, camera.width))
    ray = pixel_rays(np.stack([column, row], axis=-1) + 0.5, camera.K, camera.R, camera.distortion)
    centre = camera_centre(camera.R, camera.t)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (white.point - centre) @ white.normal / (ray @ white.normal)
        points = centre + distance[..., None] * ray
        inside = (distance > 0) & (np.linalg.norm(points - white.point, axis=-1) < INTERIOR * white.half_size)
    return inside, points[inside]


def robust_mean(values: Array) -> Array:
    """Mean (c,) of values (n, c) without outliers; NaN where there are too few."""
    known = values[np.isfinite(values).all(axis=1)]
    if len(known) < LEAST_PIXELS:
        return np.full(values.shape[1], np.nan)
    middle = np.median(known, axis=0)
    spread = 1.4826 * np.median(np.abs(known - middle), axis=0)
    good = (np.abs(known - middle) <= OUTLIER * spread).all(axis=1)
    return np.asarray(known[good].mean(axis=0) if good.any() else middle)


def _intensities(
    dome: DomeRecord,
    light: LightRecord,
    room: Darkroom,
    inside: NDArray[np.bool_],
    points: Array,
    digests: Digests | None,
) -> Array:
    """Intensity (n, 3) that each pixel of the target says."""
    white = dome.white
    if white is None or not len(points):
        return np.zeros((0, 3))
    frames = read_view(dome, light.id, room.camera, white=True, digests=digests)
    radiance, flag = room.merge(frames, _spans(inside))
    square, falloff = light_falloff(light, points)
    cosine = (light.position - points) @ white.normal / np.sqrt(square)
    factor = np.where(cosine * falloff > GRAZING, np.pi * square / (white.reflectance * cosine * falloff), np.nan)
    return np.asarray(np.where((flag[inside] == OK)[:, None], radiance[inside] * factor[:, None], np.nan), np.float64)


def _spans(inside: NDArray[np.bool_]) -> NDArray[np.int64]:
    """First column of each row (h, 2) that is inside, and the one after the last."""
    found = inside.any(axis=1)
    first, last = inside.argmax(axis=1), inside.shape[1] - inside[:, ::-1].argmax(axis=1)
    return np.stack([first, np.where(found, last, first)], axis=1)
