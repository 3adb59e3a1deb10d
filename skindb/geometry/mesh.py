"""Triangle meshes: connectivity, order, normals and areas of vertices, nearest points, and
Loop subdivision.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from skindb.types import Array, Faces, Float64, Index, Mask, dots, float64, lengths

MORTON_BITS = 21  # per axis: 63 bits in all
POINTS_PER_BLOCK = 1 << 10  # each point may have a hundred candidate triangles


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
    return lengths(np.roll(path, -1, axis=0) - path)


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
    n = len(faces)
    face, neighbour, alike = _pairs(faces)
    # every face twice, as it is and turned over, each joined to the sides that it fits
    fitting = np.where(alike, neighbour, neighbour + n)
    turned = (fitting + n) % (2 * n)
    rows = np.concatenate([face, face + n])
    sides = pair_components(rows, np.concatenate([fitting, turned]), 2 * n)
    component = np.minimum(sides[:n], sides[n:])
    flip = sides[:n] != component
    total = np.bincount(component)
    fewer = 2 * np.bincount(component, flip) <= total
    return flip == fewer[component]


def fans(faces: Faces) -> Index:
    """Label (f, 3) of the fan each corner belongs to: corners of one vertex joined
    across edges of two faces.

    A vertex with more than one fan is a bow-tie.
    """
    vertex = np.asarray(faces, np.int64).ravel()
    start, opposite_side = _shared_sides(faces)
    end, other_end = (side // 3 * 3 + (side + 1) % 3 for side in (start, opposite_side))
    opposite = vertex[start] != vertex[opposite_side]
    at_start = np.where(opposite, other_end, opposite_side)
    at_end = np.where(opposite, opposite_side, other_end)
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
    side, opposite_side = _shared_sides(faces)
    start = np.asarray(faces, np.int64).ravel()
    return side // 3, opposite_side // 3, start[side] != start[opposite_side]


def morton_order(points: Array) -> Index:
    """Permutation (n,) that puts points (n, 3) along the Morton curve; ties keep their order.

    Neighbours in this order are neighbours in space: ray tracing and table lookups stay
    in the cache. The cells are cubes, 2^21 along the longest side of the box of the
    points.
    """
    p = float64(points)
    if len(p) == 0:
        return np.zeros(0, np.int64)
    low = p.min(axis=0)
    side = max(float((p.max(axis=0) - low).max()), np.finfo(np.float64).tiny)
    cell = np.minimum((p - low) / side * 2.0**MORTON_BITS, 2.0**MORTON_BITS - 1)
    spread = _spread_bits(cell.astype(np.uint64))
    key = spread[:, 0] << np.uint64(2) | spread[:, 1] << np.uint64(1) | spread[:, 2]
    return np.argsort(key, kind="stable")


def face_crosses(vertices: Array, faces: Faces) -> Float64:
    """Normals (f, 3) of triangles by the right-hand rule, of length twice the area in mm2."""
    a, b, c = float64(vertices)[faces.T]
    return np.cross(b - a, c - a)


def vertex_normals(vertices: Array, faces: Faces) -> Float64:
    """Unit normals (v, 3), the mean of the triangles' weighted by area, outwards if the winding is.

    NaN at a vertex of no triangle, or whose triangles cancel.
    """
    total = _sum_at_vertices(face_crosses(vertices, faces), faces, len(vertices))
    length = lengths(total)[..., None]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(length > 0, total / length, np.nan)


def lattice_spacing(area: ArrayLike) -> Array:
    """Distance [mm] of neighbours in even triangular lattices with `area` mm2 per point."""
    return np.sqrt(2 / np.sqrt(3) * float64(area))


def vertex_areas(vertices: Array, faces: Faces) -> Float64:
    """Areas (v,) in mm2: a third of each triangle goes to each corner, so that the sum
    is the area of the mesh.
    """
    area = lengths(face_crosses(vertices, faces))[..., None] / 6
    return _sum_at_vertices(area, faces, len(vertices))[:, 0]


def _sum_at_vertices(values: Array, faces: Faces, count: int) -> Float64:
    corners = np.asarray(faces).ravel()
    columns = [
        np.bincount(corners, np.repeat(column, 3), minlength=count)
        for column in values.T
    ]
    return np.stack(columns, axis=1)


def _spread_bits(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Each of the lower 21 bits moved to three times its place."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        x = (x | x << np.uint64(shift)) & np.uint64(mask)
    return x


def closest_on_mesh(
    vertices: Array, faces: Faces, points: Array
) -> tuple[Index, Float64, Float64]:
    """The nearest point of a mesh, exactly.

    Parameters
    ----------
    vertices, faces
        (v, 3) mm and (f, 3); degenerate triangles count as their sides.
    points
        (n, 3) mm, finite.

    Returns
    -------
    face : ndarray
        (n,) index of the triangle the nearest point lies on.
    barycentric : ndarray
        (n, 3) weights of its corners, each in [0, 1], sum 1.
    distance : ndarray
        (n,) mm.
    """
    p = float64(points).reshape(-1, 3)
    triangles = float64(vertices)[faces]
    is_corner = np.zeros(len(vertices), np.bool_)
    is_corner[faces] = True
    near = cKDTree(float64(vertices)[is_corner]).query(p)[0]
    classes = _by_reach(triangles)
    face = np.empty(len(p), np.int64)
    barycentric = np.empty((len(p), 3))
    for start in range(0, len(p), POINTS_PER_BLOCK):
        block = slice(start, start + POINTS_PER_BLOCK)
        row, candidate = _candidates(classes, p[block], near[block])
        point = p[block][row]
        weight = _closest(point, triangles[candidate])
        place = np.einsum("nk,nkc->nc", weight, triangles[candidate])
        distance = lengths(place - point)
        order = np.lexsort((candidate, distance, row))
        best = order[np.searchsorted(row[order], np.arange(len(p[block])))]
        face[block] = candidate[best]
        barycentric[block] = weight[best]
    place = np.einsum("nk,nkc->nc", barycentric, triangles[face])
    return face, barycentric, lengths(place - p)


@dataclass(frozen=True)
class _Class:
    """Triangles of similar size: none extends farther from its centre than `reach`."""

    face: Index
    middles: cKDTree
    reach: float


def _by_reach(triangles: Array) -> list[_Class]:
    """Classes of triangles (f, 3, 3) by their radius, in powers of two, so that long
    ones do not slow the others.
    """
    middle = triangles.mean(axis=1)
    reach = lengths(triangles - middle[:, None]).max(axis=1)
    octave = np.frexp(np.maximum(reach, np.median(reach)))[1]
    classes = [np.flatnonzero(octave == size) for size in np.unique(octave)]
    return [
        _Class(face, cKDTree(middle[face]), float(reach[face].max()))
        for face in classes
    ]


def _candidates(
    classes: list[_Class], points: Array, near: Array
) -> tuple[Index, Index]:
    """Pairs (m,) of a point and a triangle that may be nearest to it; `near` is the
    distance of some vertex.
    """
    rows = []
    faces = []
    for size in classes:
        # no point of a triangle is nearer than its centre minus its radius
        reach = (near + size.reach) * (1 + 1e-12)
        lists = size.middles.query_ball_point(points, reach)
        rows.append(np.repeat(np.arange(len(points)), [len(list_) for list_ in lists]))
        faces.append(size.face[np.concatenate(lists).astype(np.int64)])
    return np.concatenate(rows), np.concatenate(faces)


def _closest(point: Array, triangles: Array) -> Float64:
    """Barycentric (n, 3) of the point of each triangle (n, 3, 3) nearest to a point (n,
    3): inside, or on an edge.
    """
    a = triangles[:, 0]
    ab = triangles[:, 1] - a
    ac = triangles[:, 2] - a
    away = point - a
    # by orthogonalisation: Gram determinants are squared quantities, which lose
    # precision for needles
    base = _square(ab)
    along = dots(ab, ac) / base
    ahead = dots(ab, away) / base
    height = ac - along[:, None] * ab
    v = dots(height, away - ahead[:, None] * ab) / _square(height)
    u = ahead - v * along
    inside = (u >= 0) & (v >= 0) & (u + v <= 1)
    weights = [np.stack([1 - u - v, u, v], axis=1)]
    off = u[:, None] * ab + v[:, None] * ac - away
    squared = [np.where(inside, dots(off, off), np.inf)]
    for i, j in ((0, 1), (1, 2), (2, 0)):
        start = triangles[:, i]
        edge = triangles[:, j] - triangles[:, i]
        t = np.clip(dots(point - start, edge) / _square(edge), 0.0, 1.0)
        weight = np.zeros((len(t), 3))
        weight[:, i] = 1 - t
        weight[:, j] = t
        weights.append(weight)
        off = start + t[:, None] * edge - point
        squared.append(dots(off, off))
    best = np.argmin(squared, axis=0)
    return np.stack(weights)[best, np.arange(len(best))]


def _square(a: Array) -> Float64:
    """Squared lengths (n,) to divide by."""
    return np.maximum(dots(a, a), np.finfo(np.float64).tiny)


def winding_number(vertices: Array, faces: Faces, points: Array) -> Float64:
    """Winding numbers of a mesh around points (k, 3): solid angle of its back over 4 pi
    (Jacobson et al. 2013).

    1 inside a closed surface, 0 outside. For an open surface, the fraction of
    directions in which its inner side is visible minus that of its outer side, at most
    one half outside the convex hull.
    """
    triangles = float64(vertices)[faces]
    numbers = []
    for point in float64(points).reshape(-1, 3):
        a, b, c = (triangles[:, i] - point for i in range(3))
        la, lb, lc = (lengths(side) for side in (a, b, c))
        # van Oosterom and Strackee 1983
        volume = dots(a, np.cross(b, c))
        scale = la * lb * lc + dots(a, b) * lc + dots(b, c) * la + dots(c, a) * lb
        numbers.append(2 * np.arctan2(volume, scale).sum() / (4 * np.pi))
    return np.array(numbers, np.float64)


def loop_matrix(faces: Faces, n_vertices: int) -> tuple[sp.csr_matrix, Index]:
    """One level of Loop subdivision (Loop 1987; boundaries as cubic B-splines, Hoppe et al. 1994).

    Parameters
    ----------
    faces
        (f, 3), manifold.
    n_vertices
        Number of vertices v.

    Returns
    -------
    matrix : csr_matrix
        (v + e, v) of non-negative rows that sum to 1: the old vertices, then one per
        edge in the order of (low, high).
    faces : ndarray
        (4 f, 3): the children of face i are i, f + i, 2 f + i (at its corners) and 3 f
        + i (its middle).
    """
    corner = np.asarray(faces, np.int64)
    table = edge_table(corner)
    if (table.count > 2).any():
        raise ValueError("an edge belongs to more than two faces; clean the mesh first")
    even = _even_rows(table, n_vertices)
    odd = _odd_rows(table, np.roll(corner, 1, axis=1), n_vertices)
    middle = table.of_face + n_vertices
    children = [
        np.column_stack([corner[:, i], middle[:, i], middle[:, i - 1]])
        for i in range(3)
    ]
    return sp.vstack([even, odd]).tocsr(), np.concatenate([*children, middle])


def subdivide(
    vertices: Array, faces: Faces, levels: int
) -> tuple[Float64, Index, sp.csr_matrix]:
    """`levels` levels of Loop subdivision.

    Parameters
    ----------
    vertices, faces
        (v, 3) mm and (f, 3), manifold.
    levels
        Number of levels, each of which splits a triangle into four.

    Returns
    -------
    vertices, faces : ndarray
        (v', 3) mm and (4^levels f, 3).
    matrix : csr_matrix
        (v', v): apply it to any value of the old vertices (texture coordinates, masks)
        for that of the new.
    """
    matrix = sp.identity(len(vertices), format="csr")
    current = np.asarray(faces, np.int64)
    for _ in range(levels):
        level, current = loop_matrix(current, matrix.shape[0])
        matrix = level @ matrix
    return matrix @ float64(vertices), current, matrix


def split_longest(
    vertices: Array, faces: Faces, count: int
) -> tuple[Index, sp.csr_matrix]:
    """Split the `count` longest edges in the middle, each at most once.

    Parameters
    ----------
    vertices, faces
        (v, 3) mm and (f, 3), manifold.
    count
        Number of edges; all if it is larger than their number.

    Returns
    -------
    faces : ndarray
        (f', 3).
    matrix : csr_matrix
        (v + count, v): the old vertices, then the middles of edges.
    """
    corner = np.asarray(faces, np.int64)
    table = edge_table(corner)
    length = lengths(np.diff(float64(vertices)[table.edges], axis=1)[:, 0])
    longest = np.argsort(-length, kind="stable")[:count]
    middle = np.full(len(length), -1)
    middle[longest] = len(vertices) + np.arange(len(longest))
    rows = np.repeat(np.arange(len(longest)), 2)
    halves = sp.csr_matrix(
        (np.full(len(rows), 0.5), (rows, table.edges[longest].ravel())),
        shape=(len(longest), len(vertices)),
    )
    matrix = sp.vstack([sp.identity(len(vertices)), halves]).tocsr()
    return _split_faces(corner, middle[table.of_face]), matrix


def _split_faces(corner: Index, middle: Index) -> Index:
    """Faces (f', 3) that replace `corner` (f, 3), with vertices `middle` (f, 3) on their
    sides, or -1.
    """
    count = (middle >= 0).sum(axis=1)
    # the first side is split, and after it the others; of two, the second is not the last
    turn = np.argmax(middle >= 0, axis=1)
    turn[(count == 2) & (middle[:, 1] < 0)] = 2
    around = (turn[:, None] + [0, 1, 2]) % 3
    a, b, c = np.take_along_axis(corner, around, axis=1).T
    ab, bc, ca = np.take_along_axis(middle, around, axis=1).T
    # children by the number of split sides
    children = (
        [(a, b, c)],
        [(a, ab, c), (ab, b, c)],
        [(ab, b, bc), (a, ab, c), (ab, bc, c)],
        [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)],
    )
    parts = [
        np.stack(child, axis=1)[count == number]
        for number, triangles in enumerate(children)
        for child in triangles
    ]
    return np.concatenate(parts)


def _odd_rows(table: EdgeTable, opposite: Faces, n: int) -> sp.csr_matrix:
    """New vertices: 3/8 of both ends and 1/8 of both vertices across; the middle of a
    boundary edge.
    """
    on_boundary = table.count == 1
    ends = np.where(on_boundary, 1 / 2, 3 / 8)
    row = np.arange(len(ends))
    side = table.of_face.ravel()
    inner = ~on_boundary[side]
    rows = np.concatenate([row, row, side[inner]])
    columns = np.concatenate(
        [table.edges[:, 0], table.edges[:, 1], opposite.ravel()[inner]]
    )
    values = np.concatenate([ends, ends, np.full(int(inner.sum()), 1 / 8)])
    return sp.csr_matrix((values, (rows, columns)), shape=(len(ends), n))


def _even_rows(table: EdgeTable, n: int) -> sp.csr_matrix:
    """Old vertices: beta of each neighbour inside; 3/4, 1/8, 1/8 along a boundary;
    corners and isolated ones stay.
    """
    neighbours = _adjacency(table.edges, n)
    rim = _adjacency(table.edges[table.count == 1], n)
    valence, rim_valence = (np.diff(a.indptr) for a in (neighbours, rim))
    safe = np.maximum(valence, 1)
    beta = (5 / 8 - (3 / 8 + np.cos(2 * np.pi / safe) / 4) ** 2) / safe
    beta = np.where((rim_valence == 0) & (valence > 0), beta, 0.0)
    # the vertex of a single face is a corner of the outline and stays, as does a bow-tie
    smooth = (rim_valence == 2) & (valence > 2)
    diagonal = sp.diags(np.where(smooth, 3 / 4, 1 - beta * valence))
    along_rim = sp.diags(np.where(smooth, 1 / 8, 0.0)) @ rim
    return sp.csr_matrix(diagonal + sp.diags(beta) @ neighbours + along_rim)


def _adjacency(edges: Faces, n: int) -> sp.csr_matrix:
    both = np.concatenate([edges, edges[:, ::-1]])
    return sp.csr_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(n, n))
