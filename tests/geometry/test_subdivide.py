"""Loop subdivision compared with an implementation by dictionaries, and its laws."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh

from skindb.geometry.mesh import carry_points, loop_matrix, subdivide

ROUNDING = 1e-12


def open_sphere() -> tuple[np.ndarray, np.ndarray]:
    """A bumpy sphere with a hole, so valences of 5 and 6 and a ragged boundary with corners."""
    mesh = trimesh.creation.icosphere(2, radius=80.0)
    v = np.asarray(mesh.vertices) + np.random.default_rng(0).normal(size=(162, 3))
    f = np.asarray(mesh.faces, np.int64)
    f = f[v[f].mean(axis=1)[:, 2] > -20]
    used, inverse = np.unique(f, return_inverse=True)
    return v[used], inverse.reshape(-1, 3)


def grid(n: int = 4) -> tuple[np.ndarray, np.ndarray]:
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    v = np.stack([j.ravel(), i.ravel(), np.zeros(n * n)], axis=1).astype(float)
    a = (i * n + j)[:-1, :-1].ravel()
    return v, np.concatenate(
        [np.stack([a, a + 1, a + n + 1], 1), np.stack([a, a + n + 1, a + n], 1)]
    )


def loop_twin(v: np.ndarray, f: np.ndarray) -> dict[frozenset[int], np.ndarray]:
    """Loop 1987 vertex by vertex; keys are {i} for old vertices and {i, j} for edges."""
    across: dict[frozenset[int], list[int]] = {}
    for a, b, c in f.tolist():
        for i, j, k in ((a, b, c), (b, c, a), (c, a, b)):
            across.setdefault(frozenset((i, j)), []).append(k)
    new = {}
    for edge, opposite in across.items():
        i, j = edge
        if len(opposite) == 2:
            new[edge] = (3 * v[i] + 3 * v[j] + v[opposite[0]] + v[opposite[1]]) / 8
        else:
            new[edge] = (v[i] + v[j]) / 2
    for i in range(len(v)):
        ring = [(edge - {i}).__iter__().__next__() for edge in across if i in edge]
        rim = [
            (edge - {i}).__iter__().__next__()
            for edge, o in across.items()
            if i in edge and len(o) == 1
        ]
        n = len(ring)
        if n == 2:  # the corner of a single face
            new[frozenset((i,))] = v[i]
        elif rim:
            new[frozenset((i,))] = 3 / 4 * v[i] + (v[rim[0]] + v[rim[1]]) / 8
        else:
            beta = (5 / 8 - (3 / 8 + math.cos(2 * math.pi / n) / 4) ** 2) / n
            new[frozenset((i,))] = (1 - n * beta) * v[i] + beta * sum(
                v[k] for k in ring
            )
    return new


@pytest.mark.parametrize("mesh", [open_sphere(), grid()], ids=["sphere", "grid"])
def test_loop_matrix__agrees_with_the_twin(mesh):
    v, f = mesh
    matrix, children = loop_matrix(f, len(v))
    positions = matrix @ v
    twin = loop_twin(v, f)
    assert matrix.shape == (len(twin), len(v))
    for i in range(len(v)):
        np.testing.assert_allclose(
            positions[i], twin[frozenset((i,))], atol=ROUNDING * 80
        )
    for i, (a, b, c) in enumerate(f.tolist()):
        middle = children[3 * len(f) + i]
        for at, edge in zip(middle, ((a, b), (b, c), (c, a)), strict=True):
            np.testing.assert_allclose(
                positions[at], twin[frozenset(edge)], atol=ROUNDING * 80
            )


def bumpy(
    mesh: trimesh.Trimesh, faces: slice = slice(None)
) -> tuple[np.ndarray, np.ndarray]:
    v = np.asarray(mesh.vertices)
    return v + np.random.default_rng(1).normal(size=v.shape), np.asarray(
        mesh.faces, np.int64
    )[faces]


@pytest.mark.parametrize(
    "mesh",
    [
        bumpy(trimesh.creation.icosphere(2, radius=80.0)),  # valences 5 and 6
        # open
        bumpy(
            trimesh.creation.icosphere(0, radius=80.0).subdivide_loop(1), slice(0, -9)
        ),
        bumpy(trimesh.creation.box([80, 80, 80])),  # 4 and 5
        bumpy(
            trimesh.Trimesh(
                [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]],
                [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]],
            )
        ),  # 3
    ],
    ids=["sphere", "open", "box", "tetrahedron"],
)
def test_loop_matrix__agrees_with_libigl_in_the_interior(mesh):
    """libigl has Warren's even weights: those of Loop at valences 3 and 6, 3/8 for the
    ring at every other.
    """
    igl = pytest.importorskip("igl")
    v, f = mesh
    theirs, their_faces = igl.loop_matrix(f, len(v))
    theirs = theirs.toarray()
    ours = loop_matrix(f, len(v))[0].toarray()
    assert theirs.shape == ours.shape
    edges, count = np.unique(
        np.sort(f[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1),
        axis=0,
        return_counts=True,
    )
    rim = np.unique(edges[count == 1])
    valence = np.bincount(edges.ravel(), minlength=len(v))
    for i in np.setdiff1d(np.unique(f), rim):
        ring = np.setdiff1d(np.flatnonzero(ours[i]), i)
        expected = ours[i].copy()
        if valence[i] not in (3, 6):
            expected[ring], expected[i] = 3 / 8 / valence[i], 5 / 8
        np.testing.assert_allclose(theirs[i], expected, atol=1e-15)
    # new vertices in any order: rows of the matrices as sets, boundary and interior alike
    key = [np.lexsort(rows[len(v) :].round(6).T) for rows in (ours, theirs)]
    np.testing.assert_allclose(
        ours[len(v) :][key[0]], theirs[len(v) :][key[1]], atol=1e-15
    )
    assert len(their_faces) == 4 * len(f)


def test_carry_points__stay_at_their_parameter():
    """Without smoothing (new vertices in the middle of their edges) a carried point
    does not move.
    """
    v, f = open_sphere()
    rng = np.random.default_rng(2)
    face = rng.integers(0, len(f), 200)
    weight = rng.dirichlet([1, 1, 1], 200)
    weight[:4] = [[1, 0, 0], [0, 0.5, 0.5], [0.5, 0.25, 0.25], [1 / 3, 1 / 3, 1 / 3]]
    there = np.einsum("kc,kci->ki", weight, v[f[face]])
    flat = v
    faces = f
    for levels in range(4):
        at, share = carry_points(face, weight, len(f), levels)
        np.testing.assert_allclose(
            np.einsum("kc,kci->ki", share, flat[faces[at]]), there, atol=1e-10
        )
        np.testing.assert_allclose(share.sum(axis=1), 1)
        assert share.min() >= -1e-12
        matrix, children = loop_matrix(faces, len(flat))
        middle = np.zeros((matrix.shape[0] - len(flat), 3))
        # the middle child's corners: one on each side of its parent
        corner = children[3 * len(faces) :] - len(flat)
        for side in range(3):
            middle[corner[:, side]] = (
                flat[faces[:, side]] + flat[faces[:, (side + 1) % 3]]
            ) / 2
        flat = np.concatenate([flat, middle])
        faces = children


def test_loop_matrix__children_tile_the_parent_and_keep_its_winding():
    v, f = grid()
    matrix, children = loop_matrix(f, len(v))
    flat = matrix @ v
    a, b, c = (flat[children[:, i]] for i in range(3))
    area = np.cross(b - a, c - a)[:, 2] / 2
    assert (area > 0).all()
    # the two ears with one face keep their corners; the two with two faces are rounded
    # by a known amount
    assert area.sum() == pytest.approx(9 - 2 * loss_at_a_rounded_corner())
    assert np.unique(np.sort(children, axis=1), axis=0).shape == children.shape


def loss_at_a_rounded_corner() -> float:
    """Area between a unit corner and the chain of its B-spline: (1/2, 0), (1/8, 1/8), (0, 1/2)."""
    return 0.5 * (0.5 * 0.125 + 0.125 * 0.5)


def test_loop_matrix__is_an_average():
    v, f = open_sphere()
    matrix, _ = loop_matrix(f, len(v))
    assert matrix.data.min() > 0
    np.testing.assert_allclose(np.asarray(matrix.sum(axis=1)).ravel(), 1, atol=ROUNDING)


def test_loop_matrix__boundary_depends_on_the_boundary_alone():
    v, f = open_sphere()
    matrix, children = loop_matrix(f, len(v))
    sides = np.sort(children[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edge, count = np.unique(sides, axis=0, return_counts=True)
    old = np.sort(f[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    old_edge, old_count = np.unique(old, axis=0, return_counts=True)
    rim = np.unique(edge[count == 1])
    inner = np.setdiff1d(np.arange(len(v)), old_edge[old_count == 1])
    assert matrix[rim][:, inner].nnz == 0


def test_loop_matrix__vertex_without_a_face_stays():
    matrix, _ = loop_matrix(np.array([[0, 1, 2]]), 5)
    np.testing.assert_array_equal(matrix.toarray()[3:5], np.eye(5)[3:5])


def test_loop_matrix__three_faces_at_an_edge():
    with pytest.raises(ValueError, match="more than two faces"):
        loop_matrix(np.array([[0, 1, 2], [0, 1, 3], [1, 0, 4]]), 5)


def test_subdivide__matrix_carries_any_attribute():
    v, f = open_sphere()
    new, children, matrix = subdivide(v, f, 2)
    assert len(children) == 16 * len(f)
    np.testing.assert_allclose(matrix @ v, new, atol=ROUNDING * 80)
    # e.g. texture coordinates affine in position
    linear = v @ np.array([[0.1, 0.2], [-0.3, 0.1], [0.2, 0.5]]) + 3
    np.testing.assert_allclose(
        matrix @ linear,
        new @ np.array([[0.1, 0.2], [-0.3, 0.1], [0.2, 0.5]]) + 3,
        atol=1e-10,
    )


def test_subdivide__no_level_changes_nothing():
    v, f = open_sphere()
    new, children, matrix = subdivide(v, f, 0)
    np.testing.assert_array_equal(new, v)
    np.testing.assert_array_equal(children, f)
    assert matrix.shape == (len(v), len(v))


def test_subdivide__closed_surface_stays_closed_and_smooth():
    mesh = trimesh.creation.icosphere(1, radius=80.0)
    new, children, _ = subdivide(np.asarray(mesh.vertices), np.asarray(mesh.faces), 3)
    assert len(new) - len(children) // 2 == 2  # Euler: v - e + f = 2 with e = 3 f / 2
    radius = np.linalg.norm(new, axis=1)
    assert np.ptp(radius) < 0.02 * radius.mean()
