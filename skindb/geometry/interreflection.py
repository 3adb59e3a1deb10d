"""Light that parts of a surface send to each other with one diffuse reflection."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.sparse import csr_array, vstack

from skindb.geometry.rays import RAY_OFFSET_MM, RayScene
from skindb.types import Array, Faces, Index, dots, unit

# per vertex, cosine distributed: the error of the incoming light is an eighth of its
# standard deviation
RAYS = 64
VERTICES_PER_BLOCK = 2048
FARTHEST_MM = 300.0  # mm; a head is smaller


def bounce_transfer(
    vertices: Array,
    normals: Array,
    faces: Faces,
    transmittance: Callable[[Array], Array],
    *,
    receivers: Index,
) -> csr_array:
    """Matrix W from the radiant exitance under the boundary to the irradiance under the
    boundary that it causes elsewhere.

    Rays with a density proportional to the cosine are traced from every receiver, so that
    W_ij is the mean over the rays that hit the mesh next to vertex j of the transmittance
    there, times that at the receiver. Without a boundary it is the form factor from i to j.

    Parameters
    ----------
    vertices, normals
        (v, 3) mm and (v, 3) unit normals; light leaves and arrives on their side.
    faces
        (f, 3).
    transmittance
        Fraction of light that a boundary transmits, from cosines (n,) of the angle to the
        normal, in (0, 1].
    receivers
        (m,) vertices that receive light.

    Returns
    -------
    csr_array
        (m, v) float32. Its columns of vertices that no ray hits are empty.
    """
    scene = RayScene(vertices, faces)
    rays = _cosine_rays()
    shape = (0, len(vertices))
    blocks = [csr_array(shape, dtype=np.float32)]
    for begin in range(0, len(receivers), VERTICES_PER_BLOCK):
        block = receivers[begin : begin + VERTICES_PER_BLOCK]
        way = np.einsum("rk,nkj->nrj", rays, tangent_frames(normals[block]))
        way = way.reshape(-1, 3)
        start = vertices[block] + RAY_OFFSET_MM * normals[block]
        face, corner, distance = scene.first_hit(
            np.repeat(start, len(rays), axis=0), way
        )
        hit = np.flatnonzero((face >= 0) & (distance < FARTHEST_MM))
        sender = np.asarray(faces)[face[hit], corner[hit].argmax(axis=1)]
        leaving = -dots(way[hit], normals[sender])
        front = np.flatnonzero(leaving > 0)
        row, ray = np.divmod(hit[front], len(rays))
        leaves = transmittance(np.minimum(leaving[front], 1.0))
        enters = transmittance(rays[:, 2])[ray]
        weight = (leaves * enters / len(rays)).astype(np.float32)
        entries = (weight, (row, sender[front]))
        blocks.append(csr_array(entries, shape=(len(block), len(vertices))))
    return csr_array(vstack(blocks, format="csr"))


def tangent_frames(normal: Array) -> Array:
    """Two tangents and the normal of each of n normals, in the rows of (n, 3, 3)."""
    tangent = np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
    tangent = unit(tangent)
    return np.stack([tangent, np.cross(normal, tangent), normal], axis=1)


def _cosine_rays() -> Array:
    """Cosine-distributed directions (RAYS, 3) above z = 0, evenly spread (Vogel's spiral)."""
    i = np.arange(RAYS) + 0.5
    radius = np.sqrt(i / RAYS)
    angle = np.pi * (3 - np.sqrt(5)) * i
    return np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)], axis=1
    )
