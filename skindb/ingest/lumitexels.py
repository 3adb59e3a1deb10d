"""Samples of every surfel under every light in every camera (Weyrich et al. 2005, eq. 3)."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.geometry.camera import camera_centre
from skindb.geometry.texture import bilinear
from skindb.ingest.devices import CameraRecord, DomeRecord, LightRecord
from skindb.ingest.irradiance import light_falloff
from skindb.ingest.radiance import DARK, OK, SATURATED, Darkroom, Image, radiance_floor, read_view
from skindb.ingest.surfels import SurfelSet

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]
IN_MEMORY = 1 << 30  # bytes of samples; more go through a temporary file
LIT = 0.999  # share of a light's disc: no sample in the penumbra
LEAST_COSINE = 0.1  # towards the camera
LONGEST_SMEAR = 12.0  # mm of surface under one pixel; measured: beyond it samples are 20 % too bright
MOST_RINGS = 3  # of neighbours beside a shadow
LIGHTS_AT_ONCE = 16  # 4 bytes per surfel and light while shadows grow
LINEAR_FLOOR = 1e-4  # sr^-1; of linear files, whose noise nobody told


@dataclass(frozen=True)
class Views:
    """What is seen where."""

    surfels: SurfelSet
    lit: NDArray[np.bool_]  # (n, light) whole disc visible, and no shadow a pixel may touch
    clear: NDArray[np.bool_]  # (n, camera)
    pixels: NDArray[np.float32]  # (n, camera, 2)


@dataclass(frozen=True)
class Lumitexels:
    """Samples and what became of the visible pairs."""

    sample: NDArray[np.float16]  # (n, light, camera, 3) sr^-1; perhaps a file
    sample_count: NDArray[np.int32]
    saturated_count: NDArray[np.int32]
    dark_count: NDArray[np.int32]
    noise_floor: float  # sr^-1
    photographs: Mapping[tuple[int, int], Image]


def fully_lit(
    surfels: SurfelSet, light_share: NDArray[np.float16], cameras: Sequence[CameraRecord]
) -> NDArray[np.bool_]:
    """Where (n, light) the whole disc is visible, also from the neighbours that one pixel may cover.

    Samples beside a shadow mix it in: measured 14 % too dark in the first ring of neighbours.
    """
    spacing = np.sqrt(2 / np.sqrt(3) * float(surfels.area.mean()))
    pixel = float(np.median([_footprint(camera, surfels.position.mean(axis=0)) for camera in cameras]))
    near = surfels.neighbours()
    lit = np.empty_like(light_share, bool)
    for j in range(0, lit.shape[1], LIGHTS_AT_ONCE):
        shadow = light_share[:, j : j + LIGHTS_AT_ONCE] < LIT
        for _ in range(int(np.clip(np.ceil(pixel / spacing), 1, MOST_RINGS))):
            shadow = (near @ shadow.astype(np.float32)) > 0
        lit[:, j : j + LIGHTS_AT_ONCE] = ~shadow
    return lit


@contextmanager
def sample_store(shape: tuple[int, int, int, int], *, limit: int = IN_MEMORY) -> Iterator[NDArray[np.float16]]:
    """An array (surfel, light, camera, channel) for samples, not filled, in a temporary file above `limit` bytes.

    Lights are outermost in memory: they come one after the other, and each would touch every page otherwise.
    """
    surfels, lights, cameras, channels = shape
    inside_out = (lights, surfels, cameras, channels)
    if 2 * math.prod(shape) <= limit:
        yield np.empty(inside_out, np.float16).swapaxes(0, 1)
        return
    with tempfile.TemporaryDirectory(prefix="skindb-") as folder:
        yield np.memmap(Path(folder) / "samples", np.float16, "w+", shape=inside_out).swapaxes(0, 1)


def sample_lumitexels(
    dome: DomeRecord,
    intensity: Array,
    views: Views,
    rooms: Mapping[str, Darkroom],
    store: NDArray[np.float16],
    *,
    kept: Collection[tuple[int, int]] = (),
    pool: Executor,
    progress: Progress | None = None,
) -> Lumitexels:
    """Decode, merge and sample every view once.

    Parameters
    ----------
    dome
        Cameras, lights and frames.
    intensity
        (light, 3) radiant intensity.
    views
        Visibility and projections.
    rooms
        Of every camera by id.
    store
        (n, light, camera, 3), filled here: rho = L d^2 / (I falloff).
    kept
        (light, camera) pairs whose merged radiance is kept.
    pool, progress
        Threads that decode; called with stage, lights done and lights in all.

    Raises
    ------
    InputError
        Every frame that cannot be decoded.
    """
    frontal = _frontal(dome.cameras, views.surfels)
    counts = np.zeros((3, len(store)), np.int32)
    faults: list[Fault] = []
    photographs: dict[tuple[int, int], Image] = {}

    for j, light in enumerate(dome.lights):
        factor, usable = _factors(light, intensity[j], views, j)

        def one(c: int, light: LightRecord = light, j: int = j, f: Array = factor, ok: Any = usable) -> Any:
            try:
                radiance, flag = rooms[dome.cameras[c].id].merge(read_view(dome, light.id, dome.cameras[c]))
            except InputError as error:
                return error.faults
            if (j, c) in kept:
                photographs[j, c] = np.where((flag == SATURATED)[..., None], np.float32(np.nan), radiance)
            at = np.flatnonzero(ok & views.clear[:, c] & frontal[:, c])
            return at, *_sampled(radiance, flag, views.pixels[at, c], f[at])

        block = np.full((len(store), len(dome.cameras), 3), np.nan, np.float16)
        for c, result in enumerate(pool.map(one, range(len(dome.cameras)))):
            if isinstance(result[0], Fault):
                faults += result
                continue
            at, value, became = result
            block[at, c] = value
            for k in range(3):
                counts[k, at] += became == k
        store[:, j] = block
        if progress is not None:
            progress("sample", j + 1, len(dome.lights))
    if faults:
        raise InputError(faults)
    floor = noise_floor(dome, intensity, views.surfels)
    return Lumitexels(store, counts[0], counts[SATURATED], counts[DARK], floor, photographs)


def noise_floor(dome: DomeRecord, intensity: Array, surfels: SurfelSet) -> float:
    """Reflectance [sr^-1] of one sigma of read noise and quantisation, at the median light and distance."""
    radiance = float(np.median([radiance_floor(camera.sensor, dome.exposures) for camera in dome.cameras]))
    middle = surfels.position.mean(axis=0)
    square = np.array([light_falloff(light, middle[None])[0][0] for light in dome.lights])
    floor = radiance * float(np.median(square[:, None] / intensity))
    return floor if floor > 0 else LINEAR_FLOOR


def choose_photographs(dome: DomeRecord, middle: Array, count: int) -> list[tuple[int, int]]:
    """(light, camera) pairs: lights spread evenly over those in front of the face, by the most frontal camera."""
    if count < 1:
        return []
    centres = np.array([camera_centre(camera.R, camera.t) for camera in dome.cameras]) - middle
    camera = int((centres[:, 2] / np.linalg.norm(centres, axis=1)).argmax())
    towards = np.array([light.position for light in dome.lights]) - middle
    direction = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    front = np.flatnonzero(direction[:, 2] > 0.5)
    front = front if len(front) >= count else np.argsort(-direction[:, 2])[:count]
    # farthest first: each next light is the one farthest from all chosen
    chosen = [int(front[direction[front, 2].argmax()])]
    while len(chosen) < min(count, len(front)):
        nearest = (direction[front] @ direction[chosen].T).max(axis=1)
        chosen.append(int(front[nearest.argmin()]))
    return [(light, camera) for light in sorted(chosen)]


def _frontal(cameras: Sequence[CameraRecord], surfels: SurfelSet) -> NDArray[np.bool_]:
    """Where (n, camera) a view is steep enough for a pixel to cover little of the surface."""
    out = np.empty((len(surfels.position), len(cameras)), bool)
    for c, camera in enumerate(cameras):
        way = camera_centre(camera.R, camera.t) - surfels.position
        cosine = np.einsum("ni,ni->n", way, surfels.normal) / np.linalg.norm(way, axis=1)
        out[:, c] = cosine >= max(LEAST_COSINE, _footprint(camera, surfels.position.mean(axis=0)) / LONGEST_SMEAR)
    return out


def _footprint(camera: CameraRecord, point: Array) -> float:
    """Width in mm of a pixel at a point."""
    distance = float(np.linalg.norm(camera_centre(camera.R, camera.t) - point))
    return distance / float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))


def _factors(light: LightRecord, intensity: Array, views: Views, j: int) -> tuple[Array, NDArray[np.bool_]]:
    """d^2 / (I falloff) (n, 3), and where the light reaches the surfel in full."""
    square, falloff = light_falloff(light, views.surfels.position)
    facing = np.einsum("ni,ni->n", light.position - views.surfels.position, views.surfels.normal) > 0
    usable = views.lit[:, j] & facing & (falloff > 0)
    with np.errstate(divide="ignore"):
        return (square / falloff)[:, None] / intensity, usable


def _sampled(
    radiance: Image, flag: NDArray[np.uint8], pixels: NDArray[np.float32], factor: Array
) -> tuple[NDArray[np.float16], NDArray[np.uint8]]:
    """Reflectance (n, 3) at projections, NaN where lost, and what became of it (n,) as the flags of pixels."""
    dark = (flag == DARK).astype(np.float32)[..., None]
    image = np.concatenate([radiance, dark], axis=-1)
    image[flag == SATURATED] = np.nan
    found = bilinear(image, pixels)
    became = np.where(np.isnan(found[:, 3]), SATURATED, np.where(found[:, 3] > LIT, DARK, 0)).astype(np.uint8)
    value = found[:, :3] * factor
    known = (became == OK)[:, None] & (np.abs(value) < np.finfo(np.float16).max)
    return np.where(known, value, np.nan).astype(np.float16), became
