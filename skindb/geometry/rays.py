"""Ray casting against a triangle mesh with Embree: first hits and occlusion."""

from __future__ import annotations

from typing import Any

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from skindb.geometry._ray_kernels import aim

Float = NDArray[np.floating[Any]]
Faces = NDArray[np.integer[Any]]
RAYS_PER_BLOCK = 1 << 15  # so that the arrays of the rays stay in the cache
NUDGE = 1e-3 * np.array([0.62, 0.55, -0.56])  # mm
NO_HIT_DISTANCE_MM = 1e36  # mm; Embree's own start, returned for a miss, is 1e37
# mm; more than the sag of a 5 mm edge on a head (r = 80 mm), less than any fold of skin
RAY_OFFSET_MM = 0.05


class RayScene:
    """A mesh prepared for rays; immutable, shared freely between threads (Embree releases the GIL).

    Rays whose origins follow each other in space (Morton order, image rows) are 2.5 to
    6 times faster than shuffled ones. Embree computes in float32: the mesh is centred
    first, and hits are refined in float64.
    """

    def __init__(self, vertices: Float, faces: Faces) -> None:
        """Build the tree over vertices (v, 3) in mm and faces (f, 3)."""
        corners = np.asarray(vertices, np.float64)
        index = np.asarray(faces, np.int64)
        mask = np.zeros(len(corners), bool)
        mask[index] = True
        used = corners[mask]
        if not len(used) or not np.isfinite(used).all():
            raise ValueError("rays need at least one triangle, and finite vertices")
        self._centre = (used.min(axis=0) + used.max(axis=0)) / 2
        self._corners = corners - self._centre
        self._faces = index
        self._scene = EmbreeScene()
        # triangles by value: vertices of no triangle may be invalid
        TriangleMesh(self._scene, self._corners.astype(np.float32)[index])

    def occluded(
        self,
        origin: Float,
        target: Float,
        *,
        normal: Float | None = None,
        at: NDArray[np.integer[Any]] | None = None,
        offset_mm: float = RAY_OFFSET_MM,
    ) -> NDArray[np.bool_]:
        """Whether the mesh stands between points of its surface and targets.

        Parameters
        ----------
        origin, target
            (n, 3) mm; they broadcast against each other.
        normal
            (n, 3) unit normals at the origins. With them a ray starts above the
            surface, and a smooth surface casts no shadow on itself where light grazes
            it; without them it starts along the ray.
        at
            (m,) indices of the origins and normals to use; targets are then (m, 3) or a
            single one. Default all.
        offset_mm
            Distance by which the start is moved, and by which the ray ends before the target.

        Returns
        -------
        ndarray
            (n,) or (m,) bool. Origins or targets that are not finite count as hidden.
        """
        begin, end = (
            np.ascontiguousarray(points, np.float64) for points in (origin, target)
        )
        lift = (
            np.zeros((1, 3))
            if normal is None
            else np.ascontiguousarray(normal, np.float64)
        )
        ahead = offset_mm if normal is None else 0.0
        which = (
            np.arange(np.broadcast_shapes(begin.shape, end.shape)[0])
            if at is None
            else np.asarray(at, np.int64)
        )
        hidden = np.empty(len(which), bool)
        size = min(RAYS_PER_BLOCK, len(which))
        start = np.empty((size, 3), np.float32)
        way = np.empty((size, 3), np.float32)
        reach = np.empty(size, np.float32)
        for i in range(0, len(which), RAYS_PER_BLOCK):
            part = which[i : i + RAYS_PER_BLOCK]
            aims = end[i : i + RAYS_PER_BLOCK] if len(end) > 1 else end
            rays = (start[: len(part)], way[: len(part)], reach[: len(part)])
            aim(
                begin,
                part,
                aims,
                lift,
                self._centre,
                offset_mm,
                ahead,
                offset_mm,
                *rays,
            )
            found = ~np.isfinite(rays[2])  # Embree overwrites its input
            hidden[i : i + RAYS_PER_BLOCK] = (self._run("OCCLUDED", *rays) >= 0) | found
        return hidden

    def first_hit(
        self, origin: Float, direction: Float
    ) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.float64]]:
        """First triangle along rays, from either side.

        Parameters
        ----------
        origin, direction
            (n, 3) mm and (n, 3) of any length.

        Returns
        -------
        face : ndarray
            (n,) index of the triangle; -1 where the ray misses or is not finite.
        barycentric : ndarray
            (n, 3) weights of the triangle's corners, each in [0, 1], sum 1; 0 for a miss.
        distance : ndarray
            (n,) mm; infinity for a miss.
        """
        begin, towards = np.broadcast_arrays(
            np.asarray(origin, np.float64), np.asarray(direction, np.float64)
        )
        face = np.full(len(begin), -1, np.int32)
        barycentric = np.zeros((len(begin), 3))
        distance = np.full(len(begin), np.inf)
        for i in range(0, len(begin), RAYS_PER_BLOCK):
            part = slice(i, i + RAYS_PER_BLOCK)
            start = begin[part] - self._centre
            with np.errstate(invalid="ignore", divide="ignore"):
                way = towards[part] / _length(towards[part])[:, None]
            found = face[part] = self._first(start, way)
            hit = np.flatnonzero(found >= 0)
            barycentric[i + hit], distance[i + hit] = _refine(
                self._corners[self._faces[found[hit]]], start[hit], way[hit]
            )
        return face, barycentric, distance

    def distances(self, origin: Float, direction: Float) -> NDArray[np.float32]:
        """Distances (n,) in mm from one origin (3,) to the first triangle along unit
        directions (n, 3).

        Infinity where a ray misses or is not finite. The precision is that of float32,
        and one in a hundred rays that aim exactly at a vertex misses the mesh: use this
        for depth maps; `first_hit` is exact.
        """
        start = (np.asarray(origin, np.float64) - self._centre).astype(np.float32)
        found = np.empty(len(direction), np.float32)
        for i in range(0, len(direction), RAYS_PER_BLOCK):
            way = direction[i : i + RAYS_PER_BLOCK].astype(np.float32, copy=False)
            origins = np.broadcast_to(start, way.shape)
            found[i : i + RAYS_PER_BLOCK] = self._scene.run(
                np.ascontiguousarray(origins), way, query="DISTANCE"
            )
        found[~(found < NO_HIT_DISTANCE_MM)] = np.inf
        return found

    def _first(self, start: Float, way: Float) -> NDArray[np.int32]:
        found = self._run("INTERSECT", start, way)
        # one in a hundred rays that aim exactly at a vertex misses the mesh: misses are
        # repeated with a small shift
        missed = np.flatnonzero((found < 0) & np.isfinite(start + way).all(axis=1))
        found[missed] = self._run("INTERSECT", start[missed] + NUDGE, way[missed])
        return found

    def _run(
        self,
        query: str,
        start: Float,
        way: Float,
        reach: NDArray[np.float32] | None = None,
    ) -> NDArray[np.int32]:
        if len(start) == 0:
            return np.zeros(0, np.int32)
        length = np.full(len(start), 1e37, np.float32) if reach is None else reach
        single = (rays.astype(np.float32, copy=False) for rays in (start, way))
        return np.asarray(self._scene.run(*single, length, query=query))


def _length(vectors: Float) -> Float:
    return np.asarray(np.sqrt(np.einsum("ni,ni->n", vectors, vectors)))


def _refine(triangles: Float, origin: Float, direction: Float) -> tuple[Float, Float]:
    """Barycentric (n, 3) and distance (n,) in float64 of rays that meet their triangles
    (Moller and Trumbore 1997).
    """
    a = triangles[:, 0]
    b = triangles[:, 1]
    c = triangles[:, 2]
    first = b - a
    second = c - a
    from_a = origin - a
    p = np.cross(direction, second)
    q = np.cross(from_a, first)
    determinant = np.einsum("ni,ni->n", first, p)
    # edge-on in float64 although Embree reports a hit: corner a replaces the hit
    safe = np.where(np.abs(determinant) > 0, determinant, np.inf)
    u = np.einsum("ni,ni->n", from_a, p) / safe
    v = np.einsum("ni,ni->n", direction, q) / safe
    weight = np.clip(np.stack([1 - u - v, u, v], axis=1), 0.0, 1.0)
    weight /= weight.sum(axis=1, keepdims=True)
    point = np.einsum("nk,nki->ni", weight, triangles)
    return weight, np.linalg.norm(point - origin, axis=1)
