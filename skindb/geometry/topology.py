"""Connectivity of triangle meshes: edges, boundary loops, components, winding, fans."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import breadth_first_order, connected_components

from skindb.types import Array, Faces, Float64, Index, Mask


@dataclass(frozen=True)
class EdgeTable:
    """The edges of a mesh; side i of a face runs from its corner i to corner i + 1."""

    edges: Index  # (e, 2) lower vertex first, sorted
    of_face: Index  # (f, 3) edge of each side
    count: Index  # (e,) faces at the edge


def edge_table(faces: Faces) -> EdgeTable:
    """Edges of faces (f, 3)."""
    corner = np.asarray(faces, np.int64).reshape(-1, 3)
    sides = np.sort(np.stack([corner, np.roll(corner, -1, axis=1)], axis=-1), axis=-1)
    n = int(corner.max(initial=0)) + 1
    key, inverse, count = np.unique(
        sides[..., 0] * n + sides[..., 1], return_inverse=True, return_counts=True
    )
    return EdgeTable(
        np.stack([key // n, key % n], axis=1), inverse.reshape(corner.shape), count
    )


def boundary_loops(faces: Faces) -> list[Index]:
    """Boundary loops of an oriented mesh without bow-ties, that of the most vertices first.

    Each runs along its faces: the mesh lies to its left, seen from outside.
    """
    corner = np.asarray(faces, np.int64)
    table = edge_table(corner)
    face, side = np.nonzero(table.count[table.of_face] == 1)
    ends = corner[face, (side + 1) % 3]
    after = dict(zip(corner[face, side].tolist(), ends.tolist(), strict=True))
    if len(after) != len(face):
        raise ValueError(
            "two boundaries meet at a vertex, or the winding is inconsistent; clean the mesh first"
        )
    loops = []
    while after:
        start, step = after.popitem()
        loop = [start]
        while step != start:
            loop.append(step)
            step = after.pop(step)
        loops.append(np.array(loop, np.int64))
    # longest first; ties are resolved by the lowest vertex, so that results are reproducible
    loops = [np.roll(loop, -int(loop.argmin())) for loop in loops]
    return sorted(loops, key=lambda loop: (-len(loop), int(loop[0])))


def simple_loops(loop: Index) -> list[Index]:
    """Split a closed path (n,) at repeated vertices into parts that pass no vertex twice."""
    parts = list[Index]()
    path = list[int]()
    place = dict[int, int]()
    for vertex in loop.tolist():
        if vertex in place:
            start = place[vertex]
            parts.append(np.array(path[start:], np.int64))
            for passed in path[start:]:
                del place[passed]
            del path[start:]
        place[vertex] = len(path)
        path.append(vertex)
    return [*parts, np.array(path, np.int64)]


def side_lengths(path: Array) -> Float64:
    """Length of each side of a closed path (n, d)."""
    return np.asarray(np.linalg.norm(np.roll(path, -1, axis=0) - path, axis=1))


def outline_first(points: Array, loops: list[Index]) -> list[Index]:
    """Loops by their length in mm: the outline of the surface, then its holes."""
    return sorted(loops, key=lambda loop: -float(side_lengths(points[loop]).sum()))


def face_components(faces: Faces) -> Index:
    """Label (f,) of the component each face belongs to; faces touch where exactly two
    share an edge.
    """
    face, neighbour, _ = _pairs(faces)
    return pair_components(face, neighbour, len(faces))


def pair_components(a: Index, b: Index, n: int) -> Index:
    """Label (n,) of the component of each of n items, of which the pairs (a, b) belong together."""
    graph = sp.coo_matrix((np.ones(len(a)), (a, b)), shape=(n, n))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def winding_flips(faces: Faces) -> Mask:
    """Mask (f,) of faces to turn over for a consistent winding; in each component the
    minority is turned.
    """
    face, neighbour, alike = _pairs(faces)
    n = len(faces)
    parity = sp.csr_matrix((np.where(alike, 1, 2), (face, neighbour)), shape=(n, n))
    parity = parity.maximum(parity.T).tocsr()
    flip = np.zeros(n, bool)
    for members in _groups(face_components(faces)):
        if len(members) == 1:
            continue
        order, parent = breadth_first_order(parity, int(members[0]), directed=False)
        step = np.asarray(parity[order[1:], parent[order[1:]]]).ravel() == 2
        for node, turned in zip(order[1:].tolist(), step.tolist(), strict=True):
            flip[node] = flip[parent[node]] ^ turned
        if 2 * flip[members].sum() > len(members):
            flip[members] ^= True
    return flip


def fans(faces: Faces) -> Index:
    """Label (f, 3) of the fan each corner belongs to: corners of one vertex joined
    across edges of two faces.

    A vertex with more than one fan is a bow-tie.
    """
    vertex = np.asarray(faces, np.int64).ravel()
    start, other = _shared_sides(faces)
    end, other_end = (side // 3 * 3 + (side + 1) % 3 for side in (start, other))
    opposite = vertex[start] != vertex[other]
    at_start = np.where(opposite, other_end, other)
    at_end = np.where(opposite, other, other_end)
    rows = np.concatenate([start, end])
    columns = np.concatenate([at_start, at_end])
    return pair_components(rows, columns, len(vertex)).reshape(-1, 3)


def _shared_sides(faces: Faces) -> tuple[Index, Index]:
    """The two sides, as 3 face + side, at every edge of exactly two faces."""
    table = edge_table(faces)
    order = np.argsort(table.of_face.ravel(), kind="stable")
    start = (np.cumsum(table.count) - table.count)[table.count == 2]
    return order[start], order[start + 1]


def _pairs(faces: Faces) -> tuple[Index, Index, Mask]:
    """Pairs of faces that share an edge, and whether they traverse it in opposite
    directions, as they should.
    """
    side, other = _shared_sides(faces)
    start = np.asarray(faces, np.int64).ravel()
    return side // 3, other // 3, start[side] != start[other]


def _groups(labels: Index) -> list[Index]:
    order = np.argsort(labels, kind="stable")
    cuts = np.flatnonzero(np.diff(labels[order])) + 1
    return np.split(order, cuts)
