"""Visibility by splatting compared with rays by hand."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from skindb.geometry import splats
from skindb.geometry.mesh import splat_radius, vertex_normals
from skindb.geometry.splats import THRESHOLD, SplatScene

EDGE = 0.7  # mm; two pixels of the maps below, and the bias seen at the angles below


def plate(x, y, corner, u, v):
    """Discs of a rectangle of x by y points 1 mm apart: positions, normals, radii, and
    their places in the plane.
    """
    place = (
        np.stack(np.meshgrid(np.arange(x), np.arange(y), indexing="ij"), -1)
        .reshape(-1, 2)
        .astype(float)
    )
    u = np.asarray(u, float)
    v = np.asarray(v, float)
    position = np.asarray(corner, float) + place[:, :1] * u + place[:, 1:] * v
    return (
        position,
        np.tile(np.cross(u, v), (len(place), 1)),
        np.full(len(place), 0.7 * np.sqrt(2)),
        place,
    )


def scene_of(*plates):
    return SplatScene(*(np.concatenate([p[i] for p in plates]) for i in range(3)))


def behind_triangles(points, eye, triangles):
    """Whether any of the triangles (k, 3, 3) lies between each point and the eye:
    solved one by one in float64.
    """
    out = np.zeros(len(points), bool)
    for a, b, c in triangles:
        first = np.broadcast_to(b - a, points.shape)
        second = np.broadcast_to(c - a, points.shape)
        matrix = np.stack([first, second, points - eye], axis=2)
        sound = np.abs(np.linalg.det(matrix)) > 1e-12
        u, w, along = np.linalg.solve(matrix[sound], (points - a)[sound, :, None])[
            ..., 0
        ].T
        out[sound] |= (u >= 0) & (w >= 0) & (u + w <= 1) & (along > 1e-3) & (along < 1)
    return out


@pytest.mark.parametrize("angle", [0, 30, 60])
def test_visible_fraction__shadow_of_a_plate_on_a_plate(angle):
    """A small plate 10 mm above a large one: its shadow is its picture by central projection."""
    ground = plate(81, 81, [-40, -40, 0], [1, 0, 0], [0, 1, 0])
    roof = plate(21, 21, [-10, -10, 10], [1, 0, 0], [0, 1, 0])
    eye = 300 * np.array([np.sin(np.radians(angle)), 0, np.cos(np.radians(angle))])
    share = scene_of(ground, roof).visible_fraction(eye)
    assert (share[len(ground[0]) :] == 1).all()
    # where the line to the eye crosses the height of the roof
    crossing = ground[0] + (10 / eye[2]) * (eye - ground[0])
    outside = np.abs(crossing[:, :2]).max(axis=1) - 10
    # the roof's discs reach 0.7 sqrt 2 beyond the outermost centres
    sure = (outside < -EDGE) | (outside > 1 + EDGE)
    np.testing.assert_array_equal(
        share[: len(ground[0])][sure] > THRESHOLD, outside[sure] > 0
    )
    assert sure.mean() > 0.85


def test_visible_fraction__crossing_plates():
    """Two plates through each other in the line x = z = 0: each hides what is beyond it."""
    u = np.array([np.cos(0.5), 0, np.sin(0.5)])
    one = plate(41, 41, -20 * u - [0, 20, 0], u, [0, 1, 0])
    v = u * [1, 1, -1]
    two = plate(41, 41, -20 * v - [0, 20, 0], v, [0, 1, 0])
    seen = scene_of(one, two).visible_fraction(np.array([0, 0, 500.0])) > THRESHOLD
    # from above only the upper half of each shows: x > 0 of the one that rises, x < 0
    # of the one that falls
    position = np.concatenate([one[0], two[0]])
    upper = position[:, 2] > 0
    # 2 z apart from the other plate; less than the bias and the slope of a pixel counts as seen
    clear = (np.abs(position[:, 2]) > 0.7) & (np.abs(position[:, 1]) < 18)
    np.testing.assert_array_equal(seen[clear], upper[clear])
    assert seen[upper].all()


def test_visible_fraction__agrees_with_brute_force_on_a_mesh():
    """A ball in a bowl: points against each of some 3,000 triangles; the rim of a
    shadow is half a disc uncertain.
    """
    ball = trimesh.creation.icosphere(2, radius=15)
    bowl = trimesh.creation.icosphere(4, radius=40)
    bowl.invert()  # its inside is visible
    faces = bowl.faces[bowl.triangles_center[:, 2] < -10]
    vertices = np.concatenate([ball.vertices, bowl.vertices])
    faces = np.concatenate([ball.faces, faces + len(ball.vertices)])
    normal = vertex_normals(vertices, faces)
    radius = splat_radius(vertices, faces)
    eye = np.array([60.0, -40, 300])
    seen = SplatScene(vertices, normal, radius).visible_fraction(eye) > THRESHOLD
    facing = ((eye - vertices) * normal).sum(axis=1) / np.linalg.norm(
        eye - vertices, axis=1
    )
    at = np.flatnonzero(facing > 0.2)
    hidden = behind_triangles(vertices[at] + 0.05 * normal[at], eye, vertices[faces])
    # the line of sight passes the middle of the ball at this distance; nothing else casts a shadow
    way = (eye - vertices[at]) / np.linalg.norm(eye - vertices[at], axis=1)[:, None]
    miss = np.linalg.norm(np.cross(way, vertices[at]), axis=1) - 15
    away = np.abs(miss) > radius[at]
    assert (hidden & away).sum() > 15
    np.testing.assert_array_equal(seen[at][away], ~hidden[away])
    assert not seen[facing < 0].any()


def test_visible_fraction__back_of_an_open_surface_hides_too():
    roof = plate(21, 21, [-10, -10, 20], [0, 1, 0], [1, 0, 0])
    ground = plate(9, 9, [-4, -4, 0], [1, 0, 0], [0, 1, 0])
    share = scene_of(roof, ground).visible_fraction(np.array([0, 0, 500.0]))
    assert (share == 0).all()


def test_visible_fraction__all_round_an_eye_in_the_middle():
    ball = trimesh.creation.icosphere(4, radius=80)
    outside = SplatScene(
        ball.vertices, ball.vertex_normals, splat_radius(ball.vertices, ball.faces)
    )
    inside = SplatScene(
        ball.vertices, -ball.vertex_normals, splat_radius(ball.vertices, ball.faces)
    )
    for eye in ([0, 0, 0], [30.0, -20, 10], [0, 0, 79]):
        assert (outside.visible_fraction(eye) == 0).all()
    assert (inside.visible_fraction([0, 0, 0]) > 0.9).all()
    assert (inside.visible_fraction([30.0, -20, 10]) > THRESHOLD).all()


def test_visible_fraction__asked_for_some_is_the_answer_for_all():
    ground = plate(31, 31, [-15, -15, 0], [1, 0, 0], [0, 1, 0])
    roof = plate(9, 9, [-4, -4, 5], [1, 0, 0], [0, 1, 0])
    scene = scene_of(ground, roof)
    eye = np.array([20.0, 5, 200])
    at = np.array([700, 3, 3, 1000, 480])
    np.testing.assert_array_equal(
        scene.visible_fraction(eye, at), scene.visible_fraction(eye)[at]
    )
    np.testing.assert_array_equal(
        scene.visible_fraction(eye, at, maps=scene.draw(eye)),
        scene.visible_fraction(eye)[at],
    )
    assert scene.visible_fraction(eye, np.zeros(0, int)).shape == (0,)


def test_visible_fraction__does_not_depend_on_the_place_of_the_subject():
    ground = plate(31, 31, [-15, -15, 0], [1, 0, 0], [0, 1, 0])
    roof = plate(9, 9, [-4, -4, 5], [1, 0, 0], [0, 1, 0])
    eye = np.array([20.0, 5, 200])
    far = np.array([4096.0, -8192, 2048])
    moved = [(p[0] + far, *p[1:]) for p in (ground, roof)]
    np.testing.assert_array_equal(
        scene_of(ground, roof).visible_fraction(eye),
        scene_of(*moved).visible_fraction(eye + far),
    )


def test_visible_fraction__unsound_discs_are_hidden_and_hide_nothing():
    ground = plate(21, 21, [-10, -10, 0], [1, 0, 0], [0, 1, 0])
    bad = np.array([[np.nan, 0, 5], [0, 0, 5], [0, 0, 5], [0, 0, 5], [np.inf, 0, 5]])
    normal = np.array([[0, 0, 1], [np.nan, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 1.0]])
    radius = np.array([5, 5, np.nan, -5, 5.0])
    share = scene_of(ground, (bad, normal, radius)).visible_fraction(
        np.array([0, 0, 300.0])
    )
    assert (share[: len(ground[0])] == 1).all()
    assert (share[len(ground[0]) :] == 0).all()


@pytest.mark.parametrize("radius", [0.0, 3.0])
def test_visible_fraction__one_disc(radius):
    scene = SplatScene(
        np.array([[1.0, 2, 3]]), np.array([[0, 0, 1.0]]), np.array([radius])
    )
    assert scene.visible_fraction([1, 2, 400]).tolist() == [1]
    assert scene.visible_fraction([1, 2, -400]).tolist() == [0]
    assert scene.visible_fraction([np.nan, 2, 400]).tolist() == [0]


def test_visible_fraction__discs_without_size_are_seen():
    position = np.random.default_rng(0).normal(size=(200, 3)) * [20, 20, 0]
    scene = SplatScene(position, np.tile([0, 0, 1.0], (200, 1)), np.zeros(200))
    assert (scene.visible_fraction([0, 0, 500]) == 1).all()


def test_visible_fraction__no_discs():
    assert SplatScene(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)).visible_fraction(
        [0, 0, 1]
    ).shape == (0,)


def test_visible_fraction__maps_stay_below_the_largest(monkeypatch):
    """A thousand times finer than a map can be: coarser pixels, the same answer."""
    ground = plate(41, 41, [-20, -20, 0], [1, 0, 0], [0, 1, 0])
    monkeypatch.setattr(splats, "MAX_MAP_SIDE_PX", 64)
    fine = SplatScene(*ground[:3], pixel_mm=1e-4)
    assert max(fine.draw(np.array([0, 0, 300.0]))[0].depth.shape) <= 64
    assert (fine.visible_fraction([0, 0, 300]) == 1).all()


@pytest.mark.parametrize("height", [300.0, 0.5], ids=["one map", "six maps"])
def test_coarsening__is_how_much_wider_pixels_are_than_wanted(monkeypatch, height):
    ground = plate(41, 41, [-20, -20, 0], [1, 0, 0], [0, 1, 0])[:3]
    eye = np.array([0, 0, height])
    scene = SplatScene(*ground, pixel_mm=0.05)
    enough = scene.draw(eye)[0].focal
    assert scene.coarsening(eye) == 1
    monkeypatch.setattr(splats, "MAX_MAP_SIDE_PX", 64)
    assert scene.coarsening(eye) == pytest.approx(enough / scene.draw(eye)[0].focal)
    assert scene.coarsening(eye) > 8  # of 800 px and more
    assert scene.coarsening([0, 0, np.nan]) == 1
