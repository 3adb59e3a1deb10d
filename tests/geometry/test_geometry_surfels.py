"""Morton order compared with interleaved strings; areas and normals compared with
spheres and loops.
"""

from __future__ import annotations

import numpy as np
import trimesh

from skindb.geometry.surfels import (
    MORTON_BITS,
    morton_order,
    splat_radius,
    vertex_areas,
    vertex_normals,
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
