"""Rays compared with brute force in float64; shadows of a sphere on itself."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from skindb.geometry._ray_kernels import aim
from skindb.geometry.mesh import vertex_normals
from skindb.geometry.rays import RayScene

HEAD = 80.0  # mm
SINGLE = 1e-6  # of float32, some steps of 6e-8
REFINED = 1e-9  # hits are recomputed in float64


def sphere(
    level: int, radius: float = HEAD, centre: tuple[float, float, float] = (10, -30, 50)
):
    mesh = trimesh.creation.icosphere(level, radius=radius)
    return np.asarray(mesh.vertices) + np.array(centre), np.asarray(
        mesh.faces, np.int64
    )


def brute_force(
    v: np.ndarray, f: np.ndarray, origin: np.ndarray, direction: np.ndarray
):
    """Nearest face and distance of one ray: solve for (u, v, distance) with every triangle."""
    best = (np.inf, -1)
    for i, (a, b, c) in enumerate(v[f]):
        matrix = np.stack([b - a, c - a, -direction], axis=1)
        if abs(np.linalg.det(matrix)) < 1e-12:
            continue
        u, w, distance = np.linalg.solve(matrix, origin - a)
        if u >= 0 and w >= 0 and u + w <= 1 and 0 < distance < best[0]:
            best = (distance, i)
    return best


def tangents(
    normal: np.ndarray, elevation: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Unit directions at `elevation` (rad) above the plane of each normal."""
    along = np.cross(normal, rng.normal(size=normal.shape))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return np.cos(elevation)[:, None] * along + np.sin(elevation)[:, None] * normal


def on_facets(v: np.ndarray, f: np.ndarray, n: int, rng: np.random.Generator):
    """Points on triangles and their interpolated unit normals."""
    face = rng.integers(0, len(f), n)
    weight = rng.dirichlet([1, 1, 1], n)
    normal = np.einsum("nk,nkc->nc", weight, vertex_normals(v, f)[f[face]])
    return np.einsum("nk,nkc->nc", weight, v[f[face]]), normal / np.linalg.norm(
        normal, axis=1, keepdims=True
    )


def test_first_hit__agrees_with_brute_force():
    v, f = sphere(1)
    rng = np.random.default_rng(0)
    origin = rng.normal(size=(150, 3)) * 200
    direction = v.mean(0) + rng.normal(size=(150, 3)) * 60 - origin
    face, weight, distance = RayScene(v, f).first_hit(origin, 3 * direction)
    unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    expected = [brute_force(v, f, o, d) for o, d in zip(origin, unit, strict=True)]
    assert face.tolist() == [i for _, i in expected]
    np.testing.assert_allclose(distance, [d for d, _ in expected], rtol=REFINED)
    assert 20 < (face >= 0).sum() < 150
    hit = face >= 0
    point = np.einsum("nk,nkc->nc", weight[hit], v[f[face[hit]]])
    np.testing.assert_allclose(
        point, origin[hit] + distance[hit, None] * unit[hit], atol=HEAD * REFINED
    )
    np.testing.assert_array_equal(weight[~hit], 0)


def test_first_hit__finds_every_vertex_and_edge_it_aims_at():
    v, f = sphere(5, centre=(0, 0, 0))  # Embree alone misses 96 of these vertices
    middle = (v[f[:, 0]] + v[f[:, 1]]) / 2
    face, _, distance = RayScene(v, f).first_hit(
        np.zeros((1, 3)), np.concatenate([v, middle])
    )
    assert (face >= 0).all()
    np.testing.assert_allclose(distance[: len(v)], HEAD, rtol=REFINED)


def test_first_hit__passes_over_rays_that_are_not_finite():
    scene = RayScene(*sphere(1, centre=(0, 0, 0)))
    origin = np.array([[np.nan, 0, 0], [0, 0, 0], [0, 0, 500], [0, 0, 0]])
    face, weight, distance = scene.first_hit(
        origin, np.array([[0, 0, 1.0], [0, 0, 0], [0, 0, 1], [0, 0.1, 1]])
    )
    assert (face >= 0).tolist() == [False, False, False, True]
    assert np.isinf(distance[:3]).all()
    assert weight[:3].max() == 0


def test_first_hit__no_rays():
    face, weight, distance = RayScene(*sphere(0)).first_hit(
        np.zeros((0, 3)), np.zeros((0, 3))
    )
    assert (face.shape, weight.shape, distance.shape) == ((0,), (0, 3), (0,))


def test_distances__are_those_of_the_first_hit(monkeypatch):
    v, f = sphere(2)
    rng = np.random.default_rng(0)
    origin = np.array([40.0, 20, 700])
    direction = rng.normal(size=(500, 3)) * 60 + v.mean(0)
    direction = (direction - origin) / np.linalg.norm(direction - origin, axis=1)[
        :, None
    ]
    direction[::50] = np.nan
    monkeypatch.setattr("skindb.geometry.rays.RAYS_PER_BLOCK", 70)
    found = RayScene(v, f).distances(origin, direction)
    _, _, expected = RayScene(v, f).first_hit(
        np.broadcast_to(origin, direction.shape), direction
    )
    assert 50 < np.isfinite(expected).sum() < 450
    assert np.isinf(found[::50]).all()
    np.testing.assert_allclose(found, expected, atol=700 * SINGLE)


def test_ray_scene__blocks_give_what_single_rays_give(monkeypatch):
    v, f = sphere(2)
    rng = np.random.default_rng(0)
    origin = rng.normal(size=(101, 3)) * 200
    direction = rng.normal(size=(101, 3))
    scene = RayScene(v, f)
    whole = scene.first_hit(origin, direction)
    hidden = scene.occluded(origin, -origin)
    monkeypatch.setattr("skindb.geometry.rays.RAYS_PER_BLOCK", 7)
    for a, b in zip(whole, scene.first_hit(origin, direction), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(hidden, scene.occluded(origin, -origin))


@pytest.mark.parametrize("level", [4, 5, 6])  # edges of 6, 3 and 1.5 mm
@pytest.mark.parametrize("elevation", [0.05, 0.5, 5.0])
def test_occluded__smooth_surface_casts_no_shadow_on_itself(level, elevation):
    v, f = sphere(level)
    rng = np.random.default_rng(level)
    scene = RayScene(v, f)
    corner = rng.integers(0, len(v), 10_000)
    for point, normal in (
        (v[corner], vertex_normals(v, f)[corner]),
        on_facets(v, f, 10_000, rng),
    ):
        way = tangents(normal, np.full(10_000, np.radians(elevation)), rng)
        assert scene.occluded(point, point + 1000 * way, normal=normal).sum() == 0


def test_occluded__everything_below_the_horizon_is_hidden():
    v, f = sphere(5)
    rng = np.random.default_rng(0)
    point, normal = on_facets(v, f, 10_000, rng)
    # a point 0.05 mm above a sphere of 80 mm sees 2 deg below the horizon
    way = tangents(normal, np.radians(rng.uniform(-90, -2.5, 10_000)), rng)
    assert RayScene(v, f).occluded(point, point + 1000 * way, normal=normal).all()


def test_occluded__target_on_the_surface_does_not_hide_itself():
    v, f = sphere(4)
    normal = vertex_normals(v, f)
    seen = np.flatnonzero(normal[:, 2] > 0.5)
    eye = np.array([[10.0, -30.0, 900.0]])
    assert not RayScene(v, f).occluded(np.repeat(eye, len(seen), axis=0), v[seen]).any()


def test_occluded__plate_between():
    plate = np.array([[-50, -50, 0], [50, -50, 0], [0, 80, 0]], float)
    scene = RayScene(plate, np.array([[0, 1, 2]]))
    origin = np.array(
        [
            [0, 0, -10],
            [0, 0, 10],
            [200, 0, -10],
            [0, 0, np.nan],
            [0, 0, -10],
            [0, 0, -10],
        ],
        float,
    )
    target = np.array(
        [[0, 0, 10], [0, 0, 20], [200, 0, 10], [0, 0, 1], [0, 0, -10], [0, 0, -1]],
        float,
    )
    assert scene.occluded(origin, target).tolist() == [
        True,
        False,
        False,
        True,
        False,
        False,
    ]


@pytest.mark.parametrize("lifted", [False, True])
@pytest.mark.parametrize("one", [False, True])
def test_aim__as_by_numpy(lifted, one):
    rng = np.random.default_rng(6)
    origin = rng.normal(size=(50, 3)) * 80
    normal = rng.normal(size=(50, 3))
    centre = np.array([3.0, -2, 1])
    at = rng.permutation(50)[:30]
    target = rng.normal(size=(1 if one else 30, 3)) * 500
    # too near for the offset, and without a position
    target[-1], origin[at[2]] = origin[at[-1]], np.nan
    lift, ahead = (normal, 0.0) if lifted else (np.zeros((1, 3)), 0.7)
    start = np.empty((30, 3), np.float32)
    way = np.empty((30, 3), np.float32)
    reach = np.empty(30, np.float32)
    aim(origin, at, target, lift, centre, 0.3, ahead, 0.3, start, way, reach)
    begin = origin[at] - centre + 0.3 * (normal[at] if lifted else 0)
    path = target - centre - begin
    length = np.linalg.norm(path, axis=1)
    with np.errstate(invalid="ignore"):
        unit = path / length[:, None]
    np.testing.assert_allclose(way, unit, atol=SINGLE)
    np.testing.assert_allclose(start, begin + ahead * unit, rtol=SINGLE)
    np.testing.assert_allclose(
        reach, np.where(length < ahead + 0.3, 0, length - ahead - 0.3), rtol=SINGLE
    )
    assert np.isnan(reach[2])


def test_occluded__chosen_origins_are_those_origins(monkeypatch):
    v, f = sphere(3)
    normal = vertex_normals(v, f)
    eye = np.array([[10.0, -30, 900]])
    rng = np.random.default_rng(7)
    at = rng.integers(0, len(v), 200)
    target = eye + rng.normal(size=(200, 3)) * 500
    monkeypatch.setattr("skindb.geometry.rays.RAYS_PER_BLOCK", 64)
    scene = RayScene(v, f)
    for aims in (eye, target):
        found = scene.occluded(v, aims, normal=normal, chosen=at)
        np.testing.assert_array_equal(
            found, scene.occluded(v[at], aims, normal=normal[at])
        )
        assert 0 < found.sum() < 200


def test_ray_scene__far_from_the_origin_loses_nothing():
    v, f = sphere(3, centre=(5000, 0, 0))
    origin = np.array([5003.3, 7.1, 900])
    way = np.array([0, 0, -1.0])
    face, _, distance = RayScene(v, f).first_hit(origin[None], way[None])
    expected, near = brute_force(v, f, origin, way)
    assert face[0] == near
    assert distance[0] == pytest.approx(expected, rel=REFINED)


def test_ray_scene__refuses_what_it_cannot_trace():
    with pytest.raises(ValueError, match="at least one triangle"):
        RayScene(np.zeros((3, 3)), np.zeros((0, 3), int))
    with pytest.raises(ValueError, match="finite vertices"):
        RayScene(np.full((3, 3), np.nan), np.array([[0, 1, 2]]))
