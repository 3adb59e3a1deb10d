"""Ray casting against a triangle mesh with Embree: first hits and occlusion."""

from __future__ import annotations

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from skindb.geometry._ray_kernels import aim
from skindb.types import (
    Array,
    Faces,
    Float32,
    Float64,
    Index,
    Index32,
    Mask,
    contiguous,
    dots,
    finite_rows,
    float64,
    lengths,
)

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

    def __init__(self, vertices: Array, faces: Faces) -> None:
        """Build the tree over vertices (v, 3) in mm and faces (f, 3)."""
        self._faces = np.asarray(faces, np.int64)
        is_corner = np.zeros(len(vertices), bool)
        is_corner[self._faces] = True
        corners = float64(vertices)[is_corner]
        if not len(corners) or not np.isfinite(corners).all():
            raise ValueError("rays need at least one triangle, and finite vertices")
        self._centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
        self._corners = float64(vertices) - self._centre
        self._scene = EmbreeScene()
        # triangles by value: vertices of no triangle may be invalid
        TriangleMesh(self._scene, self._corners.astype(np.float32)[self._faces])

    def occluded(
        self,
        origin: Array,
        target: Array,
        *,
        normal: Array | None = None,
        chosen: Index | None = None,
    ) -> Mask:
        """Whether the mesh stands between points of its surface and targets.

        Parameters
        ----------
        origin, target
            (n, 3) mm; they broadcast against each other.
        normal
            (n, 3) unit normals at the origins. With them a ray starts RAY_OFFSET_MM
            above the surface, and a smooth surface casts no shadow on itself where
            light grazes it; without them it starts that far along the ray. Every ray
            ends RAY_OFFSET_MM before its target.
        chosen
            (m,) indices of the origins and normals to use; targets are then (m, 3) or a
            single one. Default all.

        Returns
        -------
        ndarray
            (n,) or (m,) bool. Origins or targets that are not finite count as hidden.
        """
        begin = contiguous(origin)
        end = contiguous(target)
        lift = np.zeros((1, 3))
        ahead = RAY_OFFSET_MM
        if normal is not None:
            lift = contiguous(normal)
            ahead = 0.0
        if chosen is None:
            chosen = np.arange(np.broadcast_shapes(begin.shape, end.shape)[0])
        hidden = np.empty(len(chosen), bool)
        size = min(RAYS_PER_BLOCK, len(chosen))
        memory = np.empty((2, size, 3), np.float32)
        lengths = np.empty(size, np.float32)
        for i in range(0, len(chosen), RAYS_PER_BLOCK):
            block = slice(i, i + RAYS_PER_BLOCK)
            part = chosen[block]
            start, way = memory[:, : len(part)]
            reach = lengths[: len(part)]
            aims = end[block] if len(end) > 1 else end
            points = (begin, part, aims, lift, self._centre)
            aim(*points, RAY_OFFSET_MM, ahead, RAY_OFFSET_MM, start, way, reach)
            invalid = ~np.isfinite(reach)  # Embree overwrites its input
            hidden[block] = (self._run("OCCLUDED", start, way, reach) >= 0) | invalid
        return hidden

    def first_hit(
        self, origin: Array, direction: Array
    ) -> tuple[Index32, Float64, Float64]:
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
        begin, towards = np.broadcast_arrays(float64(origin), float64(direction))
        face = np.full(len(begin), -1, np.int32)
        barycentric = np.zeros((len(begin), 3))
        distance = np.full(len(begin), np.inf)
        for i in range(0, len(begin), RAYS_PER_BLOCK):
            part = slice(i, i + RAYS_PER_BLOCK)
            start = begin[part] - self._centre
            with np.errstate(invalid="ignore", divide="ignore"):
                length = np.sqrt(dots(towards[part], towards[part]))
                way = towards[part] / length[:, None]
            faces = self._first(start, way)
            face[part] = faces
            hit = np.flatnonzero(faces >= 0)
            triangles = self._corners[self._faces[faces[hit]]]
            refined = _refine(triangles, start[hit], way[hit])
            barycentric[i + hit], distance[i + hit] = refined
        return face, barycentric, distance

    def distances(self, origin: Array, direction: Array) -> Float32:
        """Distances (n,) in mm from one origin (3,) to the first triangle along unit
        directions (n, 3).

        Infinity where a ray misses or is not finite. The precision is that of float32,
        and one in a hundred rays that aim exactly at a vertex misses the mesh: use this
        for depth maps; `first_hit` is exact.
        """
        start = (float64(origin) - self._centre).astype(np.float32)
        distance = np.empty(len(direction), np.float32)
        for i in range(0, len(direction), RAYS_PER_BLOCK):
            block = slice(i, i + RAYS_PER_BLOCK)
            way = direction[block].astype(np.float32, copy=False)
            origins = np.ascontiguousarray(np.broadcast_to(start, way.shape))
            distance[block] = self._scene.run(origins, way, query="DISTANCE")
        distance[~(distance < NO_HIT_DISTANCE_MM)] = np.inf
        return distance

    def _first(self, start: Array, way: Array) -> Index32:
        face = self._run("INTERSECT", start, way)
        # one in a hundred rays that aim exactly at a vertex misses the mesh: misses are
        # repeated with a small shift
        missed = np.flatnonzero((face < 0) & finite_rows(start + way))
        face[missed] = self._run("INTERSECT", start[missed] + NUDGE, way[missed])
        return face

    def _run(
        self,
        query: str,
        start: Array,
        way: Array,
        reach: Float32 | None = None,
    ) -> Index32:
        if len(start) == 0:
            return np.zeros(0, np.int32)
        length = np.full(len(start), 1e37, np.float32) if reach is None else reach
        single = (rays.astype(np.float32, copy=False) for rays in (start, way))
        return self._scene.run(*single, length, query=query)


def _refine(
    triangles: Array, origin: Array, direction: Array
) -> tuple[Float64, Float64]:
    """Barycentric (n, 3) and distance (n,) in float64 of rays that meet their triangles
    (Moller and Trumbore 1997).
    """
    a, b, c = np.moveaxis(triangles, 1, 0)
    ab = b - a
    ac = c - a
    from_a = origin - a
    p = np.cross(direction, ac)
    q = np.cross(from_a, ab)
    determinant = dots(ab, p)
    # edge-on in float64 although Embree reports a hit: corner a replaces the hit
    safe = np.where(np.abs(determinant) > 0, determinant, np.inf)
    u = dots(from_a, p) / safe
    v = dots(direction, q) / safe
    weight = np.clip(np.stack([1 - u - v, u, v], axis=1), 0.0, 1.0)
    weight /= weight.sum(axis=1, keepdims=True)
    point = np.einsum("nk,nki->ni", weight, triangles)
    return weight, lengths(point - origin)
