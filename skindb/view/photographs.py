"""Kept photographs for the viewer's page, as seen by cameras without distortion."""

from dataclasses import replace
from typing import Any

import numpy as np
import PIL.Image
import xarray as xr
from scipy.ndimage import map_coordinates

from skindb.render.image import auto_exposure, image_url, tone_map
from skindb.render.photographs import held_out_names, kept_photographs
from skindb.render.scene import Camera, cameras_from_dome, lights_from_dome
from skindb.schema import variables
from skindb.types import Array, finite_rows, float64, unit

MAX_SIDE = 720  # px of a picture
MARGIN = 0.03  # of the face's size, around it
QUALITY = 92  # of WebP: errors of about 1 % of the displayed range


def photograph_records(
    model: xr.DataTree, capture: xr.DataTree
) -> list[dict[str, Any]]:
    """The photographs that ingest kept, each with its light, and a camera without
    distortion that sees the face alone.

    Photographs through two polarisers are skipped, because the page has no polarisation.

    Parameters
    ----------
    model, capture
        Versions of kinds "model" and "capture" of one take.

    Returns
    -------
    list of dict
        name, held_out, picture (an address that contains sRGB, transparent where the
        radiance is unknown), exposure, light (position [mm], intensity) and camera (K, R,
        t, eye, width, height).
    """
    if "photographs" not in capture.children:
        return []
    dome = model["dome"].to_dataset().load()
    cameras, lights = cameras_from_dome(dome), lights_from_dome(dome)
    unseen = held_out_names(model, "light") | held_out_names(model, "camera")
    points = float64(model["fitted"].dataset[variables.SURFEL_POSITION].values)
    records = []
    for photograph in kept_photographs(capture):
        i = int(photograph[variables.PHOTOGRAPH_LIGHT])
        j = int(photograph[variables.PHOTOGRAPH_CAMERA])
        if variables.LIGHT_POLARISATION in dome and (
            dome[variables.LIGHT_POLARISATION][i]
            * dome[variables.CAMERA_POLARISATION][j]
        ):
            continue
        camera = _camera_of_face(cameras[j], points)
        if camera is None:
            continue
        radiance = photograph[variables.PHOTOGRAPH_RADIANCE].values
        seen = _seen_by(
            camera, cameras[j], radiance[: cameras[j].height, : cameras[j].width]
        )
        exposure = auto_exposure(seen)
        shown = tone_map(seen, exposure=exposure)
        scale = min(1.0, MAX_SIDE / max(camera.width, camera.height))
        camera = camera.scaled(scale)
        alpha = np.where(finite_rows(seen), 255, 0).astype(np.uint8)
        picture = PIL.Image.fromarray(np.dstack([shown, alpha])).resize(
            (camera.width, camera.height), PIL.Image.Resampling.BOX
        )
        light = lights.select(i)
        axis = unit(points.mean(axis=0) - light.position[0])
        facing = max(float(axis @ light.axis[0]), 0.0) ** light.falloff[0]
        names = [str(dome[dim].values[k]) for dim, k in (("light", i), ("camera", j))]
        records.append(
            {
                "name": f"light {names[0]}, camera {names[1]}",
                "held_out": bool(unseen.intersection(names)),
                "picture": image_url(np.asarray(picture), quality=QUALITY),
                "exposure": exposure,
                "light": {
                    "position": light.position[0].tolist(),
                    "intensity": (light.intensity[0] * facing).tolist(),
                    "power": 1,
                },
                "camera": {
                    "K": camera.K.tolist(),
                    "R": camera.R.tolist(),
                    "t": camera.t.tolist(),
                    "eye": camera.centre.tolist(),
                    "width": camera.width,
                    "height": camera.height,
                },
            }
        )
    return records


def _camera_of_face(camera: Camera, points: Array) -> Camera | None:
    """A camera without distortion whose picture is the face (n, 3); None if it is not seen."""
    ideal = replace(camera, distortion=np.zeros(5))
    seen = ideal.project(points)[np.isfinite(camera.project(points)).all(axis=1)]
    if not len(seen):
        return None
    low, high = seen.min(axis=0), seen.max(axis=0)
    margin = MARGIN * (high - low)
    low = np.maximum(np.floor(low - margin), 0)
    high = np.minimum(np.ceil(high + margin), (camera.width, camera.height))
    if (high - low).min() < 1:
        return None
    K = camera.K.copy()
    K[:2, 2] -= low
    return replace(
        ideal, K=K, width=int(high[0] - low[0]), height=int(high[1] - low[1])
    )


def _seen_by(camera: Camera, photographer: Camera, radiance: Array) -> Array:
    """Radiance (h, w, 3) in the pixels of another camera at the same place."""
    columns, rows = np.meshgrid(
        np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
    )
    rays = camera.rays(np.stack([columns, rows], axis=-1))
    at = np.moveaxis(photographer.project(camera.centre + rays)[..., ::-1] - 0.5, -1, 0)
    planes = [
        map_coordinates(plane, np.nan_to_num(at, nan=-1), order=1, cval=np.nan)
        for plane in np.moveaxis(float64(radiance), -1, 0)
    ]
    return np.stack(planes, axis=-1)
