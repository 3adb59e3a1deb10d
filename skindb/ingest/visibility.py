"""Which lights and cameras a surfel sees, and where photographs show it without an edge beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from itertools import product
from typing import Literal

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from skindb.geometry.camera import camera_centre, pixel_rays, project
from skindb.geometry.rays import RayScene
from skindb.geometry.splats import THRESHOLD, SplatScene
from skindb.ingest.devices import CameraRecord, LightRecord
from skindb.ingest.surfels import SurfelSet

Array = NDArray[np.float64]
Half = NDArray[np.float16]
Bools = NDArray[np.bool_]
Places = NDArray[np.int64]
Method = Literal["rays", "splats"]
Sees = Callable[[Array, Places], Bools]  # eye (3,) mm, surfels (m,) -> (m,)
RING = 4  # points of a light's disc besides its centre: five equal parts of its area
SEED = 32  # one surfel in so many is asked by all points of a disc wherever it lies: a penumbra may lie by itself
EDGE_PX = 1.5  # pixels this near take part in a sample, or nearly
DEPTH_SLACK = 2.0  # mm of scan error between neighbouring pixels
STEEPEST = 10.0  # depth per width: what cos 0.1 allows; more is another surface


def light_visibility(
    surfels: SurfelSet, lights: Sequence[LightRecord], scene: RayScene, pool: Executor, *, method: Method = "rays"
) -> Half:
    """Visible share (n, light) of the lights' discs; 0 where the surfel faces away from the centre.

    All points of a disc are asked for only where the answer may differ between them: beside the edge of the shadow
    of its centre, and on beyond as long as a penumbra is found.
    """
    sees = _eyesight(surfels, scene, method)
    near = surfels.neighbours()
    degree = np.diff(near.indptr)

    def one(light: LightRecord) -> Half:
        share = np.zeros(len(surfels.position), np.float16)
        facing = np.einsum("ni,ni->n", light.position - surfels.position, surfels.normal) > 0
        at = np.flatnonzero(facing)
        points = disc_points(light)
        share[at] = sees(points[0], at)
        if len(points) > 1:
            seen = near @ share.astype(np.float32)
            start = (seen > 0) & (seen < degree)
            start[::SEED] = True
            _soften(share, np.flatnonzero(start), near, facing, lambda at: [sees(point, at) for point in points[1:]])
        return share

    out = np.empty((len(surfels.position), len(lights)), np.float16)
    for j, share in enumerate(pool.map(one, lights)):
        out[:, j] = share
    return out


def _soften(
    share: Half, start: Places, near: sp.csr_matrix, facing: Bools, others: Callable[[Places], list[Bools]]
) -> None:
    """Write the share of a disc into `share` (n,), which holds that of its centre: at `start` (m,), and on from there.

    The neighbours of every surfel in a penumbra are asked as well, until no more of it is found.
    """
    known, front = ~facing, start
    while len(front := front[~known[front]]):
        known[front] = True
        total = share[front] + np.sum(others(front), axis=0)
        share[front] = total / (RING + 1)
        front = np.unique(near[front[(total > 0) & (total < RING + 1)]].indices)


def _eyesight(surfels: SurfelSet, scene: RayScene, method: Method) -> Sees:
    """The rule by which a point sees surfels that face it."""
    if method == "rays":
        return lambda eye, at: ~scene.occluded(surfels.position[at], eye[None], normal=surfels.normal[at])
    if method == "splats":
        splats = SplatScene(surfels.position, surfels.normal, surfels.radius)
        return lambda eye, at: splats.visible_share(eye, at) >= THRESHOLD
    raise ValueError(f'visibility is by "rays" or "splats", not {method!r}')


def disc_points(light: LightRecord) -> Array:
    """Five points (5, 3) that stand for equal parts of a light's disc; one for a point light."""
    if light.disc_radius == 0:
        return light.position[None]
    helper = np.eye(3)[np.abs(light.axis).argmin()]
    u = np.cross(light.axis, helper)
    u /= np.linalg.norm(u)
    v = np.cross(light.axis, u)
    # the centre stands for a fifth of the area, the ring lies where it halves the rest
    radius = light.disc_radius * np.sqrt(0.6)
    angle = 2 * np.pi * np.arange(RING) / RING
    ring = light.position + radius * (np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v)
    return np.concatenate([light.position[None], ring])


def camera_visibility(
    surfels: SurfelSet, cameras: Sequence[CameraRecord], scene: RayScene, pool: Executor, *, method: Method = "rays"
) -> tuple[Half, NDArray[np.bool_], NDArray[np.float32]]:
    """What each camera sees.

    Returns
    -------
    visible : ndarray
        (n, camera) 1 where the camera sees the surfel inside its picture, else 0.
    clear : ndarray
        (n, camera) visible, and no silhouette or step in depth within EDGE_PX.
    pixels : ndarray
        (n, camera, 2) distorted projections.
    """
    sees = _eyesight(surfels, scene, method)

    def one(camera: CameraRecord) -> tuple[NDArray[np.bool_], NDArray[np.bool_], Array]:
        pixels, _ = project(surfels.position, camera.K, camera.R, camera.t, camera.distortion)
        centre = np.asarray(camera_centre(camera.R, camera.t), np.float64)
        way = centre - surfels.position
        within = ((pixels >= 0.5) & (pixels <= np.array([camera.width, camera.height]) - 0.5)).all(axis=1)
        seen = within & (np.einsum("ni,ni->n", way, surfels.normal) > 0)
        at = np.flatnonzero(seen)
        seen[at] = sees(centre, at)
        at, clear = np.flatnonzero(seen), seen.copy()
        clear[at] = _clear(camera, scene, surfels.position[at], surfels.normal[at], pixels[at])
        return seen, clear, pixels

    run: Callable[[CameraRecord], tuple[NDArray[np.bool_], NDArray[np.bool_], Array]] = one
    seen, clear, pixels = zip(*pool.map(run, cameras), strict=True)
    shares = np.stack(seen, axis=1).astype(np.float16)
    return shares, np.stack(clear, axis=1), np.stack(pixels, axis=1).astype(np.float32)


def depth_map(camera: CameraRecord, scene: RayScene) -> tuple[Array, Array]:
    """Distance (h, w) mm of the surface along the rays (h, w, 3) through the pixel centres; infinity beside it."""
    row, column = np.indices((camera.height, camera.width))
    rays = pixel_rays(np.stack([column, row], axis=-1) + 0.5, camera.K, camera.R, camera.distortion)
    centre = np.broadcast_to(camera_centre(camera.R, camera.t), (camera.height * camera.width, 3))
    _, _, distance = scene.first_hit(centre, rays.reshape(-1, 3))
    return distance.reshape(camera.height, camera.width), rays


def _clear(camera: CameraRecord, scene: RayScene, points: Array, normals: Array, pixels: Array) -> NDArray[np.bool_]:
    """Whether the pixels around each point show the surface that its tangent plane foretells."""
    distance, rays = depth_map(camera, scene)
    way = points - camera_centre(camera.R, camera.t)
    own = np.linalg.norm(way, axis=1)
    footprint = own / np.sqrt(camera.K[0, 0] * camera.K[1, 1])
    level = np.einsum("ni,ni->n", way, normals)
    first = np.floor(pixels - 0.5).astype(np.int64)
    clear = np.ones(len(points), bool)
    for dx, dy in product(range(-1, 3), range(-1, 3)):
        column, row = first[:, 0] + dx, first[:, 1] + dy
        near = np.hypot(column + 0.5 - pixels[:, 0], row + 0.5 - pixels[:, 1]) <= EDGE_PX
        near &= (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        at = np.flatnonzero(near & clear)
        found, ray = distance[row[at], column[at]], rays[row[at], column[at]]
        with np.errstate(divide="ignore", invalid="ignore"):
            foretold = level[at] / np.einsum("ni,ni->n", ray, normals[at])
        step = np.abs(foretold - own[at])
        smooth = np.abs(found - foretold) <= DEPTH_SLACK + step
        clear[at] = smooth & (np.abs(found - own[at]) <= DEPTH_SLACK + EDGE_PX * STEEPEST * footprint[at])
    return clear
