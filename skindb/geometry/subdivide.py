"""Loop subdivision as a sparse matrix, which applies to any values of the vertices."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from skindb.geometry.topology import EdgeTable, edge_table
from skindb.types import Array, Faces, Float64, Index, float64


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
    return np.asarray(matrix @ float64(vertices)), current, matrix


def carry_points(
    face: Index, barycentric: Array, n_faces: int, levels: int
) -> tuple[Index, Float64]:
    """Positions of points of a mesh after `levels` levels of subdivision, at the same parameters.

    Parameters
    ----------
    face, barycentric
        (k,) triangles of the old mesh and (k, 3) weights of their corners.
    n_faces
        Triangles of the old mesh.
    levels
        As in `subdivide`.

    Returns
    -------
    face, barycentric
        (k,) triangles of the new mesh and (k, 3) weights of their corners.
    """
    triangle = np.array(face, np.int64)
    weight = np.array(barycentric, np.float64).reshape(-1, 3)
    for level in range(levels):
        corner = weight.argmax(axis=1)
        middle = weight.max(axis=1) < 1 / 2
        # child i has corner i, the middle of the side from it and the middle of the
        # side to it; child 3 the middles
        around = np.take_along_axis(weight, (corner[:, None] + [0, 1, 2]) % 3, axis=1)
        outer = 2 * around - [1, 0, 0]
        weight = np.where(middle[:, None], 1 - 2 * np.roll(weight, 1, axis=1), outer)
        triangle += np.where(middle, 3, corner) * n_faces * 4**level
    return triangle, weight


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
