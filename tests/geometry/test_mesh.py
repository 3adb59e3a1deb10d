"""Morton order compared with interleaved strings; areas and normals compared with
spheres and loops.
"""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import scipy.sparse as sp
import trimesh

from skindb.geometry._mesh_kernels import grown, mixed
from skindb.geometry.mesh import (
    MORTON_BITS,
    closest_on_mesh,
    morton_order,
    splat_radius,
    vertex_areas,
    vertex_normals,
    winding_number,
)

ROUNDING = 1e-12


def sphere(level: int = 3, radius: float = 80.0) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(level, radius=radius)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64)


def morton_key(point: np.ndarray, low: np.ndarray, side: float) -> int:
    cells = [
        min(int((x - a) / side * 2**MORTON_BITS), 2**MORTON_BITS - 1)
        for x, a in zip(point, low, strict=True)
    ]
    return int(
        "".join(
            a + b + c
            for a, b, c in zip(
                *(f"{cell:0{MORTON_BITS}b}" for cell in cells), strict=True
            )
        ),
        2,
    )


def test_morton_order__sorts_interleaved_bits():
    points = np.random.default_rng(0).normal(size=(300, 3)) * [1, 5, 0.1]
    low = points.min(axis=0)
    keys = [morton_key(p, low, float(np.ptp(points, axis=0).max())) for p in points]
    assert morton_order(points).tolist() == sorted(range(300), key=keys.__getitem__)


def test_morton_order__keeps_neighbours_together():
    points = sphere(4)[0]
    shuffled = np.random.default_rng(0).permutation(points)
    step = np.linalg.norm(np.diff(shuffled[morton_order(shuffled)], axis=0), axis=1)
    assert np.median(step) < 0.1 * np.median(
        np.linalg.norm(np.diff(shuffled, axis=0), axis=1)
    )


def test_morton_order__equal_and_no_points():
    assert morton_order(np.ones((4, 3))).tolist() == [0, 1, 2, 3]
    assert morton_order(np.zeros((0, 3))).tolist() == []


def test_vertex_normals__of_a_sphere_are_radial():
    v, f = sphere()
    # the area weight is off the radius by less than the angle a face spans squared, (0.15 rad)^2
    np.testing.assert_allclose(vertex_normals(v, f), v / 80, atol=0.15**2)


def test_vertex_normals__weigh_by_area():
    v = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 1]], float)
    normal = vertex_normals(v, np.array([[0, 1, 2], [0, 2, 3]]))[0]
    np.testing.assert_allclose(normal, np.array([1, 0, 2]) / 5**0.5, atol=ROUNDING)


def test_vertex_normals__nan_without_a_face():
    v = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [5, 5, 5]], float)
    normal = vertex_normals(v, np.array([[0, 1, 2]]))
    assert np.isnan(normal).any(axis=1).tolist() == [False, False, False, True]


def test_vertex_areas__give_each_corner_a_third():
    v, f = sphere(2)
    expected = np.zeros(len(v))
    for a, b, c in f:
        sides = [
            float(np.linalg.norm(v[i] - v[j])) for i, j in ((a, b), (b, c), (c, a))
        ]
        half = sum(sides) / 2
        # Heron
        area = (half * (half - sides[0]) * (half - sides[1]) * (half - sides[2])) ** 0.5
        expected[[a, b, c]] += area / 3
    np.testing.assert_allclose(vertex_areas(v, f), expected, rtol=1e-10)


def test_splat_radius__is_of_the_longest_edge():
    vertices = np.array([[0.0, 0, 0], [3, 0, 0], [0, 4, 0], [0, 0, 1], [9, 9, 9]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    np.testing.assert_allclose(
        splat_radius(vertices, faces), 0.7 * np.array([4, 5, 5, np.sqrt(17), 0])
    )


def every_distance(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(n, f): trimesh answers for pairs of triangle and point, by another algorithm
    (Ericson's regions).
    """
    nearest = [
        trimesh.triangles.closest_point(triangles, np.tile(p, (len(triangles), 1)))
        for p in points
    ]
    return np.linalg.norm(np.stack(nearest) - points[:, None], axis=2)


def test_closest_on_mesh__agrees_with_trimesh():
    rng = np.random.default_rng(0)
    ball = trimesh.creation.icosphere(2, radius=50.0)
    points = rng.normal(size=(60, 3)) * 50
    faces = np.asarray(ball.faces)
    face, weight, distance = closest_on_mesh(np.asarray(ball.vertices), faces, points)
    np.testing.assert_allclose(
        distance, every_distance(ball.triangles, points).min(axis=1), rtol=1e-12
    )
    np.testing.assert_allclose(weight.sum(axis=1), 1, rtol=1e-14)
    assert weight.min() >= 0
    there = np.einsum("nk,nki->ni", weight, ball.vertices[faces[face]])
    np.testing.assert_allclose(
        np.linalg.norm(there - points, axis=1), distance, rtol=1e-12
    )


def test_closest_on_mesh__corner_side_plane_and_degenerate_triangles():
    v = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [9, 9, 9.0]])
    points = np.array([[1, 1, 2], [-3, -4, 0], [2, -5, 0], [4, 4, 0]], float)
    face, weight, distance = closest_on_mesh(
        v, np.array([[3, 3, 3], [0, 1, 2]]), points
    )
    assert face.tolist() == [1] * 4
    np.testing.assert_allclose(
        weight, [[0.5, 0.25, 0.25], [1, 0, 0], [0.5, 0.5, 0], [0, 0.5, 0.5]], atol=1e-15
    )
    np.testing.assert_allclose(distance, [2, 5, 5, np.sqrt(8)])
    assert closest_on_mesh(v, np.array([[0, 1, 2]]), np.zeros((0, 3)))[1].shape == (
        0,
        3,
    )


@pytest.mark.parametrize(
    ("height", "expected"),
    [(0.0, 0.5), (30.0, 0.5 - 0.5 * 30 / 50), (-30.0, 0.5 + 0.5 * 30 / 50)],
)
def test_winding_number__of_an_open_cap_is_the_solid_angle_of_its_rim(height, expected):
    """A hemisphere of radius r seen from the axis: the rim as a disc in closed form."""
    ball = trimesh.creation.icosphere(5, radius=40.0)
    keep = (ball.vertices[ball.faces][..., 2] < 1e-9).all(axis=1)
    found = winding_number(
        np.asarray(ball.vertices),
        np.asarray(ball.faces)[keep],
        np.array([[0, 0, height]]),
    )
    # chords: the rim lies 1 % inside
    assert found == pytest.approx([expected], abs=5e-3)


def test_winding_number__closed():
    ball = trimesh.creation.icosphere(2, radius=40.0)
    points = np.array([[1, 2, 3], [0, 0, 45], [500, 0, 0.0]])
    found = winding_number(np.asarray(ball.vertices), np.asarray(ball.faces), points)
    np.testing.assert_allclose(found, [1, 0, 0], atol=1e-12)


def test_closest_on_mesh__a_large_triangle_whose_middle_is_far():
    big = [[0, 0, 0], [100, 0, 0], [0, 100, 0]]
    small = [[97, 1, 3], [98, 1, 3], [97, 2, 3]]
    face, _, distance = closest_on_mesh(
        np.array(big + small, float),
        np.array([[3, 4, 5], [0, 1, 2]]),
        np.array([[97, 1, 1.0]]),
    )
    assert (face[0], distance[0]) == (1, pytest.approx(1))


@pytest.mark.parametrize("reach", [1e-6, 1e-3, 1.0])
def test_closest_on_mesh__needles_down_to_no_height(reach):
    """The distance is that to the foot of a perpendicular, or less; and no edge is nearer."""
    rng = np.random.default_rng(2)
    for height in 10 ** rng.uniform(-17, -1, 500):
        along, across, up = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        v = np.outer([0, *rng.uniform(0, 5, 2)], along) + np.outer(
            [0, 0, height], across
        )
        v = rng.permutation(v)
        foot = rng.dirichlet([0.3, 0.3, 0.3]) @ v
        point = foot + rng.normal(scale=reach) * up
        _, weight, distance = closest_on_mesh(v, np.array([[0, 1, 2]]), point[None])
        edge = np.roll(v, -1, axis=0) - v
        away = point - v
        t = np.clip((away * edge).sum(axis=1) / (edge**2).sum(axis=1), 0, 1)
        others = [
            np.linalg.norm(point - foot),
            *np.linalg.norm(t[:, None] * edge - away, axis=1),
        ]
        assert distance[0] <= min(others) + 1e-14  # ten roundings of 5 mm
        assert weight.min() >= 0


def test_closest_on_mesh__triangles_of_all_sizes():
    rng = np.random.default_rng(1)
    size = 10 ** rng.uniform(-3, 2, (200, 1, 1))
    triangles = rng.normal(size=(200, 1, 3)) * 20 + size * rng.normal(size=(200, 3, 3))
    points = rng.normal(size=(50, 3)) * 20
    face, _, distance = closest_on_mesh(
        triangles.reshape(-1, 3), np.arange(600).reshape(-1, 3), points
    )
    every = every_distance(triangles, points)
    np.testing.assert_array_equal(face, every.argmin(axis=1))  # none touch: no ties
    # small triangles at 20 mm: 1e-14 mm of 1e-3
    np.testing.assert_allclose(distance, every.min(axis=1), rtol=1e-9)


def test_closest_on_mesh__one_long_triangle_costs_the_others_nothing():
    side = np.meshgrid(*2 * [np.arange(100.0)])
    step = np.arange(100 * 100).reshape(100, 100)
    a, b, c, d = (
        step[i : i + 99, j : j + 99].ravel()
        for i, j in ((0, 0), (0, 1), (1, 0), (1, 1))
    )
    plain = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    v = np.stack([*(x.ravel() / 2 for x in side), np.zeros(100 * 100)], axis=1)
    v = np.concatenate([v, [[-60, 0, 0], [0, -60, 0]]])
    points = np.random.default_rng(0).uniform(5, 45, (20, 3)) * [1, 1, 0] + [0, 0, 1]
    peak = []
    for faces in (plain, plain, np.concatenate([plain, [[0, len(v) - 2, len(v) - 1]]])):
        tracemalloc.start()
        closest_on_mesh(v, faces, points)
        peak.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # 40 times if all are searched up to the longest distance
    assert peak[2] < 1.2 * peak[1]


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 1.0])
def test_grown_and_mixed__as_by_the_matrix_of_neighbours(share):
    """Compared with a count of the vertices in the mask among each vertex and its neighbours."""
    rng = np.random.default_rng(8)
    faces = rng.integers(0, 200, (150, 3))
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    a, b, c = faces.T
    edges = sp.coo_matrix(
        (np.ones(3 * len(a)), (np.r_[a, b, c], np.r_[b, c, a])), shape=(210, 210)
    ).tocsr()
    near = ((edges + edges.T + sp.eye(210)) > 0).astype(int)
    mask = rng.random(210) < share
    found = near @ mask.astype(int)
    np.testing.assert_array_equal(grown(faces, mask), found > 0)
    np.testing.assert_array_equal(
        mixed(faces, mask), (found > 0) & (found < np.asarray(near.sum(1)).ravel())
    )
