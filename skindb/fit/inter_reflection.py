"""Inter-reflection: light that is reflected diffusely from one part of the face to
another, with one bounce.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.sparse import csr_array

from skindb.errors import Fault, InputError
from skindb.fit._arrays import cosines, directions
from skindb.geometry.rays import RAY_OFFSET_MM, RayScene
from skindb.optics.fresnel import fresnel_transmittance
from skindb.schema import check

Array = NDArray[np.float64]
# per surfel, cosine distributed: the error of the incoming light is an eighth of its
# standard deviation
RAYS = 64
SURFELS_PER_BLOCK = 2048
FARTHEST_MM = 300.0  # mm; a head is smaller
NEEDED = ("surfel_position", "surfel_normal", "light_position", "camera_position")


def bounced_light(
    lumitexels: xr.Dataset,
    diffuse: NDArray[Any],
    visible: NDArray[Any],
    triangles: NDArray[Any],
    *,
    eta: float = 1.3,
) -> NDArray[np.float32]:
    """Light that reaches each surfel after one diffuse reflection elsewhere, relative
    to the direct light facing it.

    Rays are traced from every surfel to the first hit, where light of each lamp that is
    not in shadow enters by F_t, leaves by R_d / pi and F_t, and enters the surfel by
    F_t. The intensity of a lamp is assumed equal towards the whole face, its distance
    is not.

    Parameters
    ----------
    lumitexels
        `surfel_position`, `surfel_normal`, `light_position`.
    diffuse
        R_d (surfel, channel); NaN is replaced by the median.
    visible
        (surfel, light) visible fraction of the lights' discs.
    triangles
        (f, 3) of the surfels.
    eta
        Refractive index of F_t.

    Returns
    -------
    ndarray
        (surfel, light, channel): transmitted irradiance over that of a surface that
        faces the light.
    """
    check(lumitexels, NEEDED, where="lumitexels")
    position, normal, light = (
        lumitexels[name].values.astype(np.float64) for name in NEEDED[:3]
    )
    if len(position) != len(visible) or len(position) != len(diffuse):
        found = f"{len(position)}, {len(visible)} and {len(diffuse)} surfels"
        rule = "samples, visibility and R_d must be of the same surfels"
        raise InputError(
            Fault("inter-reflection", rule, found, "ingest the capture again")
        )
    known = np.where(
        np.isfinite(diffuse), diffuse, np.nanmedian(diffuse, axis=0)
    ).astype(np.float32)
    scene = RayScene(position, triangles)
    rays = _cosine_rays()
    square = np.square(position[:, None] - light).sum(axis=2)
    lit = cosines(normal, directions(position, light))
    enters = (
        np.maximum(lit, 0)
        * fresnel_transmittance(np.clip(lit, 1e-3, 1), eta)
        * np.nan_to_num(visible)
    )
    # transmitted light of each lamp over its intensity
    sent = (enters / square).astype(np.float32)
    out = np.zeros((len(position), len(light), known.shape[1]), np.float32)
    for first in range(0, len(position), SURFELS_PER_BLOCK):
        part = slice(first, first + SURFELS_PER_BLOCK)
        at, met, weight = _meetings(
            scene, position[part], normal[part], rays, triangles, normal, eta
        )
        for c in range(known.shape[1]):
            shape = (len(position[part]), len(position))
            out[part, :, c] = (
                csr_array((weight * known[met, c], (at, met)), shape=shape)
                @ sent
                * square[part]
            )
    return out


def without_bounce(
    lumitexels: xr.Dataset,
    bounced: NDArray[np.float32],
    diffuse: NDArray[Any],
    *,
    eta: float = 1.3,
) -> xr.Dataset:
    """The samples minus the contribution of `bounced_light`, which is F_t R_d / pi of
    it towards each camera.
    """
    position, normal, camera = (
        lumitexels[name].values.astype(np.float64)
        for name in ("surfel_position", "surfel_normal", "camera_position")
    )
    seen = cosines(normal, directions(position, camera))
    leaves = (fresnel_transmittance(np.clip(seen, 1e-3, 1), eta) / np.pi).astype(
        np.float32
    )
    back = bounced * np.nan_to_num(diffuse)[:, None].astype(np.float32)
    sample = lumitexels["reflectance_sample"]
    arrives = xr.Variable(("surfel", "light", "channel"), back)
    towards = xr.Variable(("surfel", "camera"), leaves)
    # otherwise the contribution to all samples would be computed at once
    if sample.chunks is not None:
        arrives, towards = (
            one.chunk({"surfel": sample.chunksizes["surfel"]})
            for one in (arrives, towards)
        )
    direct = (
        (sample.astype(np.float32) - arrives * towards)
        .clip(min=0)
        .astype(sample.dtype)
        .transpose(*sample.dims)
    )
    return lumitexels.assign(reflectance_sample=direct.assign_attrs(sample.attrs))


def _meetings(
    scene: RayScene,
    position: Array,
    normal: Array,
    rays: Array,
    triangles: NDArray[Any],
    normals: Array,
    eta: float,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """Pairs of surfels (m,) of a block and the surfels (m,) that their rays hit, with
    weights (m,).
    """
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    frame = np.stack([first, np.cross(normal, first), normal], axis=1)
    way = np.einsum("rk,nkj->nrj", rays, frame).reshape(-1, 3)
    start = np.repeat(position + RAY_OFFSET_MM * normal, len(rays), axis=0)
    face, corner, distance = scene.first_hit(start, way)
    hit = np.flatnonzero((face >= 0) & (distance < FARTHEST_MM))
    met = triangles[face[hit], corner[hit].argmax(axis=1)].astype(np.int64)
    leaving = -np.einsum("nk,nk->n", way[hit], normals[met])
    arriving = rays[hit % len(rays), 2]
    weight = (
        fresnel_transmittance(np.clip(leaving, 1e-3, 1), eta)
        * fresnel_transmittance(arriving, eta)
        / len(rays)
    )
    weight[leaving <= 0] = 0
    return hit // len(rays), met, weight.astype(np.float32)


def _cosine_rays() -> Array:
    """Cosine-distributed directions (RAYS, 3) above z = 0, evenly spread (Vogel's spiral)."""
    i = np.arange(RAYS) + 0.5
    radius = np.sqrt(i / RAYS)
    angle = np.pi * (3 - np.sqrt(5)) * i
    return np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)], axis=1
    )
