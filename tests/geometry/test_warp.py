"""Thin-plate warps compared with SciPy's, without folds; correspondences between a bumpy surface
and a planted deformation of it, complete or cut.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import RBFInterpolator
from scipy.spatial import Delaunay, cKDTree
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation
from trimesh.triangles import closest_point

from skindb.geometry.atlas import DISC_RADIUS, signed_areas
from skindb.geometry.landmarks import mean_shape, similarity, width
from skindb.geometry.mesh import closest_on_mesh
from skindb.geometry.warp import (
    INNER_POINTS,
    MIN_AREA_RATIO,
    MIN_LANDMARK_DISTANCE_MM,
    MIN_WIDTH_RATIO,
    OUTLINE_POINTS,
    SAME_POINT_FRACTION,
    SMOOTHING,
    WEAK_SMOOTHING_FACTOR,
    Sheet,
    _weights,
    anchor_vertices,
    apply_warp,
    area_factor,
    corresponding_uv,
    fit_warp,
    left_out_error,
)

FACE = np.array(
    [
        [0.50, 0.12],
        [0.35, 0.15],
        [0.66, 0.16],
        [0.39, 0.25],
        [0.62, 0.25],
        [0.50, 0.33],
        [0.50, 0.43],
        [0.50, 0.53],
        [0.41, 0.52],
        [0.59, 0.52],
        [0.32, 0.37],
        [0.41, 0.36],
        [0.59, 0.35],
        [0.69, 0.37],
        [0.37, 0.60],
        [0.63, 0.60],
        [0.50, 0.555],
        [0.50, 0.71],
        [0.23, 0.68],
        [0.77, 0.67],
    ]
)
# two ways to the same solution of a system of condition below 1e4, numbers of the order
# of 1
ROUNDED = 1e-10
EVERYWHERE = np.stack(np.meshgrid(*2 * [np.linspace(-0.3, 1.3, 211)]), axis=-1).reshape(
    -1, 2
)


def _moved(seed: int, by: float = 0.01, points=FACE):
    return points + np.random.default_rng(seed).normal(size=points.shape) * by


def _factor(warp, uv, step=1e-6):
    """Determinant of the Jacobian by central differences."""
    columns = [
        (apply_warp(warp, uv + e) - apply_warp(warp, uv - e)) / (2 * step)
        for e in step * np.eye(2)
    ]
    return np.linalg.det(np.stack(columns, axis=2))


@pytest.mark.parametrize("smoothing", [0.0, 0.05])
def test_fit_warp__is_the_thin_plate_of_scipy(smoothing):
    target = _moved(1)
    warp = fit_warp(FACE, target, smoothing=smoothing)
    assert (warp.kind, warp.smoothing, warp.used.all()) == (
        "thin plate",
        smoothing,
        True,
    )
    other = RBFInterpolator(
        FACE, target, kernel="thin_plate_spline", smoothing=smoothing * warp.scale**2
    )
    np.testing.assert_allclose(
        apply_warp(warp, EVERYWHERE), other(EVERYWHERE), atol=ROUNDED
    )
    if not smoothing:
        np.testing.assert_allclose(apply_warp(warp, FACE), target, atol=ROUNDED)


def test_fit_warp__affine_maps_come_back_exactly():
    matrix = np.array([[1.1, 0.2], [-0.1, 0.8]])
    shift = np.array([0.03, -0.2])
    warp = fit_warp(FACE, FACE @ matrix + shift)
    np.testing.assert_allclose(
        apply_warp(warp, EVERYWHERE), EVERYWHERE @ matrix + shift, atol=ROUNDED
    )
    np.testing.assert_allclose(
        area_factor(warp, EVERYWHERE), np.linalg.det(matrix), atol=ROUNDED
    )


def test_area_factor__is_the_determinant():
    warp = fit_warp(FACE, _moved(3))
    points = EVERYWHERE[::97]
    # central differences of 1e-6 are good to some 1e-9
    np.testing.assert_allclose(
        area_factor(warp, points), _factor(warp, points), atol=1e-7
    )
    assert area_factor(warp, np.zeros((0, 2))).shape == (0,)


def test_fit_warp__skips_a_missing_point():
    source = FACE.copy()
    target = _moved(4)
    source[3], target[7, 1] = np.nan, np.inf
    warp = fit_warp(source, target)
    known = np.delete(np.arange(20), [3, 7])
    assert warp.used.tolist() == [i in known for i in range(20)]
    without = fit_warp(source[known], target[known])
    np.testing.assert_allclose(
        apply_warp(warp, EVERYWHERE), apply_warp(without, EVERYWHERE), atol=ROUNDED
    )


def test_fit_warp__far_points_that_belong_together_are_one():
    """Every map that moves both points there folds around them; the other points keep
    their places.
    """
    target = _moved(12)
    target[16] = target[7] + 1e-4
    warp = fit_warp(FACE, target, smoothing=0.0)
    assert np.flatnonzero(~warp.used).tolist() == [16]
    others = np.delete(np.arange(20), [7, 16])
    np.testing.assert_allclose(
        apply_warp(warp, FACE[others]), target[others], atol=ROUNDED
    )


@pytest.mark.parametrize("which", ["source", "target", "both"])
def test_fit_warp__points_that_nearly_coincide_are_one(which):
    source = np.vstack([FACE, FACE[5]])
    target = np.vstack([_moved(5), _moved(5)[5]])
    tiny = (
        0.3
        * SAME_POINT_FRACTION
        * np.sqrt(FACE.var(axis=0).sum())
        * np.array([0.6, -0.8])
    )
    if which != "target":
        source[20] += tiny
    if which != "source":
        target[20] -= tiny  # turned over: through both the map would fold
    warp = fit_warp(source, target, smoothing=0.0)
    assert np.flatnonzero(~warp.used).tolist() == [20]
    assert len(warp.spline.centre) == 20
    middle = (source[5] + source[20]) / 2
    np.testing.assert_allclose(
        apply_warp(warp, middle[None])[0], (target[5] + target[20]) / 2, atol=ROUNDED
    )


def test_fit_warp__is_regularised_where_points_are_near():
    """Two points at a distance of 1.5 % of the spread, moved by a typical error of a click."""
    away = 1.5 * SAME_POINT_FRACTION * np.sqrt(FACE.var(axis=0).sum())
    source = np.vstack([FACE, FACE[6] + [away, 0]])
    target = np.vstack([_moved(6), _moved(6)[6] + [0.9 * away, 0]])
    warp = fit_warp(source, target)
    assert (warp.used.all(), warp.smoothing) == (True, SMOOTHING)
    # the targets are wrong by 0.01 in each direction: the remainder is smaller
    assert np.sqrt(((apply_warp(warp, source) - target) ** 2).mean()) < 0.01


WEAKER = np.random.default_rng(20).uniform(-0.2, 1.2, (40, 2))


def test_fit_warp__weak_points_are_smoothed_more():
    target = _moved(13)
    there = _moved(14, points=WEAKER)
    there[5] = np.nan
    warp = fit_warp(FACE, target, smoothing=0.02, weak=(WEAKER, there))
    known = np.delete(np.arange(40), 5)
    smoothing = 0.02 * warp.scale**2 * np.repeat([1.0, WEAK_SMOOTHING_FACTOR], [20, 39])
    every = np.vstack([FACE, WEAKER[known]])
    goal = np.vstack([target, there[known]])
    other = RBFInterpolator(
        every, goal, kernel="thin_plate_spline", smoothing=smoothing
    )
    np.testing.assert_allclose(
        apply_warp(warp, EVERYWHERE), other(EVERYWHERE), atol=ROUNDED
    )
    assert warp.used.shape == (20,)


def test_fit_warp__weak_points_give_way_first():
    """Two weak points exchange their places; the others move by less than a tenth of a click."""
    weak = np.array([[0.95, 0.5], [1.05, 0.5]])
    crossed = fit_warp(
        FACE, _moved(15), weak=(weak, np.array([[1.15, 0.5], [0.85, 0.5]]))
    )
    assert (crossed.kind, crossed.smoothing) == ("thin plate", SMOOTHING)
    assert crossed.spline.loose[-1] > WEAK_SMOOTHING_FACTOR
    assert _factor(crossed, EVERYWHERE).min() > 0
    none = apply_warp(fit_warp(FACE, _moved(15)), FACE)
    assert np.abs(apply_warp(crossed, FACE) - none).max() < 0.001


@pytest.mark.parametrize("points", [0, 1, 2])
def test_fit_warp__weak_points_alone_do_not_count(points):
    target = _moved(16)[:points]
    warp = fit_warp(FACE[:points], target, weak=(WEAKER, WEAKER + 1))
    without = fit_warp(FACE[:points], target)
    assert warp.kind == without.kind
    np.testing.assert_array_equal(
        apply_warp(warp, EVERYWHERE), apply_warp(without, EVERYWHERE)
    )


@pytest.mark.parametrize("smoothing", [0.0, 0.05])
def test_left_out_error__is_that_of_maps_without_the_point(smoothing):
    target = _moved(11)
    target[4] = np.nan
    found = left_out_error(fit_warp(FACE, target, smoothing=smoothing))
    for i in np.delete(np.arange(20), 4):
        # smoothing is in units of the spread, which changes without the point
        scaled = smoothing * np.var(np.delete(FACE, 4, 0), axis=0).sum()
        scaled /= np.var(np.delete(FACE, [4, i], 0), axis=0).sum()
        others = fit_warp(
            np.where(np.arange(20)[:, None] == i, np.nan, FACE),
            target,
            smoothing=scaled,
        )
        assert found[i] == pytest.approx(
            np.linalg.norm(apply_warp(others, FACE[i : i + 1]) - target[i]), rel=1e-6
        )
        one = left_out_error(
            fit_warp(FACE, target, smoothing=smoothing, weak=(WEAKER, WEAKER))
        )[i]
        others = fit_warp(
            np.where(np.arange(20)[:, None] == i, np.nan, FACE),
            target,
            smoothing=scaled,
            weak=(WEAKER, WEAKER),
        )
        assert one == pytest.approx(
            np.linalg.norm(apply_warp(others, FACE[i : i + 1]) - target[i]), rel=1e-6
        )
    assert np.isnan(found[4])
    assert np.isnan(left_out_error(fit_warp(FACE[:3], target[:3]))).all()


def test_left_out_error__of_the_only_point_beside_a_line_is_unknown():
    points = np.array([[0.5, 0.1], [0.5, 0.4], [0.5, 0.8], [0.3, 0.5]])
    warp = fit_warp(points, points + 0.01 * np.eye(4, 2))
    assert warp.kind == "thin plate"
    np.testing.assert_array_equal(
        np.isfinite(left_out_error(warp)), [True, True, True, False]
    )


@pytest.mark.parametrize(
    ("points", "kind"),
    [
        (0, "identity"),
        (1, "shift"),
        (2, "similarity"),
        (3, "affine"),
        (4, "thin plate"),
    ],
)
def test_fit_warp__of_few_points(points, kind):
    some = FACE[[10, 13, 17, 0]][:points]
    warp = fit_warp(some, some + [0.1, 0.02] + 0.01 * some[:, ::-1])
    assert warp.kind == kind
    np.testing.assert_allclose(
        apply_warp(warp, some), some + [0.1, 0.02] + 0.01 * some[:, ::-1], atol=0.01
    )
    assert area_factor(warp, EVERYWHERE).min() > 0


def test_fit_warp__of_points_on_a_line():
    line = np.linspace(0, 1, 7)[:, None] * [
        [0.3, 0.4]
    ] + 0.01 * MIN_WIDTH_RATIO * _moved(7, 1.0, np.zeros((7, 2)))
    warp = fit_warp(line, 1.1 * line + 0.05)
    assert warp.kind == "similarity"
    np.testing.assert_allclose(area_factor(warp, EVERYWHERE), 1.21, rtol=1e-3)


@pytest.mark.parametrize("swapped", ["two", "sides"])
def test_fit_warp__of_swapped_points_does_not_fold(swapped):
    if swapped == "two":
        target = FACE.copy()
        target[[14, 15]] = FACE[[15, 14]]
    else:  # left and right are exchanged: a mirrored face has no map without folds
        target = FACE * [-1, 1] + [1, 0]
    warp = fit_warp(FACE, target, smoothing=0.0)
    assert (warp.kind == "similarity") == (swapped == "sides")
    assert warp.smoothing > 0 or swapped == "sides"
    assert _factor(warp, EVERYWHERE).min() > 0


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(0, 20),
    wrong=st.floats(0, 0.3),
    scale=st.floats(0.01, 100),
)
def test_fit_warp__of_any_face_does_not_fold(seed, count, wrong, scale):
    """Clicks are wrong by up to a third of the face: the warp becomes smoother, and never folds."""
    rng = np.random.default_rng(seed)
    keep = rng.permutation(20)[:count]
    source = scale * _moved(seed, 0.02)[keep]
    target = _moved(seed + 1, wrong)[keep]
    warp = fit_warp(source, target)
    factor = area_factor(warp, scale * EVERYWHERE)
    unit = (
        np.linalg.det(similarity(source[warp.used], target[warp.used])[0])
        if warp.used.sum() > 1
        else 1.0
    )
    # half of what is asked for at the watched points, for what lies between them
    assert factor.min() > 0.5 * MIN_AREA_RATIO * unit


def test_similarity__is_the_least_squares_one():
    rng = np.random.default_rng(8)
    source, target = rng.normal(size=(2, 6, 2))
    matrix, shift = similarity(source, target)
    (x, y), zero, one = source.T, np.zeros(6), np.ones(6)
    # u = p x - q y + s, v = q x + p y + t
    system = np.vstack(
        [np.column_stack([x, -y, one, zero]), np.column_stack([y, x, zero, one])]
    )
    p, q, s, t = np.linalg.lstsq(system, target.T.ravel(), rcond=None)[0]
    np.testing.assert_allclose(matrix, [[p, q], [-q, p]], atol=1e-12)
    np.testing.assert_allclose(shift, [s, t], atol=1e-12)


def test_similarity__in_space_brings_back_a_planted_one():
    rng = np.random.default_rng(18)
    turn = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix()
    points = rng.normal(size=(5, 3))
    matrix, shift = similarity(points, 1.3 * points @ turn + [1, 2, 3])
    np.testing.assert_allclose(matrix, 1.3 * turn, atol=1e-12)
    np.testing.assert_allclose(shift, [1, 2, 3], atol=1e-12)
    # three points are flat: not mirrored
    found, _ = similarity(points[:3], points[:3] @ turn)
    np.testing.assert_allclose(found, turn, atol=1e-12)
    mirrored, _ = similarity(points, points * [-1, 1, 1])
    assert np.linalg.det(mirrored) > 0
    for few in (points[:1], np.tile(points[0], (4, 1))):
        matrix, shift = similarity(few, few + 2)
        np.testing.assert_allclose(
            (matrix, np.tile(shift, (3, 1))),
            (np.eye(3), np.full((3, 3), 2.0)),
            atol=1e-12,
        )


def test_width__is_that_of_the_box_of_a_line_and_a_cross():
    assert width(
        np.array([[-2.0, 0, 0], [2, 0, 0], [0, 1, 0], [0, -1, 0]])
    ) == pytest.approx(0.5)
    assert width(np.linspace(0, 1, 5)[:, None] * [1.0, 2, 3]) == pytest.approx(
        0, abs=1e-12
    )
    assert width(np.ones((1, 3))) == width(np.ones((4, 2))) == 0


def test_mean_shape__of_turned_copies_is_their_shape():
    rng = np.random.default_rng(9)
    copies = []
    for _ in range(5):
        angle = rng.uniform(-0.3, 0.3)
        scale = rng.uniform(0.8, 1.2)
        turn = scale * np.array(
            [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
        )
        copies.append(FACE @ turn + rng.normal(size=2))
    full = np.stack(copies)
    shapes = full.copy()
    shapes[0, 4], shapes[:, 9] = np.nan, np.nan
    found = mean_shape(shapes)
    assert np.isnan(found[9]).all()
    known = np.delete(np.arange(20), 9)
    np.testing.assert_allclose(
        pdist(found[known]) / pdist(found[known])[0],
        pdist(FACE[known]) / pdist(FACE[known])[0],
    )
    alike = mean_shape(full)
    assert pdist(alike).mean() == pytest.approx(
        pdist(full.mean(axis=0)).mean(), rel=1e-9
    )


def test_mean_shape__does_not_depend_on_the_order_and_settles():
    shapes = np.stack([_moved(s, 0.03) for s in range(4)])
    shapes[1, 2] = np.nan
    found = mean_shape(shapes)
    np.testing.assert_allclose(mean_shape(shapes[::-1]), found, atol=1e-11)
    known = [np.isfinite(s).all(axis=1) for s in shapes]
    onto = [
        s @ m + t
        for s, k in zip(shapes, known, strict=True)
        for m, t in [similarity(s[k], found[k])]
    ]
    again = np.nanmean(onto, axis=0)
    matrix, shift = similarity(again, found)
    np.testing.assert_allclose(again @ matrix + shift, found, atol=1e-9)


def test_closest_on_mesh__is_the_nearest_of_all_triangles():
    rng = np.random.default_rng(10)
    vertices = rng.normal(size=(60, 3)) * [3, 1, 1]
    faces = rng.integers(0, 60, (90, 3))
    faces[0], faces[1] = [5, 5, 5], [6, 7, 6]  # a point and a line
    points = rng.normal(size=(200, 3)) * 3
    points[:60] = vertices
    face, corner, distance = closest_on_mesh(vertices, faces, points)
    proper = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    for i, point in enumerate(points):
        every = closest_point(vertices[proper], np.tile(point, (len(proper), 1)))
        assert distance[i] <= np.linalg.norm(every - point, axis=1).min() + 1e-9
    at = np.einsum("nk,nkc->nc", corner, vertices[faces[face]])
    np.testing.assert_allclose(
        np.linalg.norm(at - points, axis=1), distance, atol=1e-12
    )
    assert corner.min() >= 0
    np.testing.assert_allclose(corner.sum(axis=1), 1, atol=1e-12)
    used = np.isin(np.arange(60), proper)
    np.testing.assert_allclose(distance[:60][used], 0, atol=1e-9)


TURN = 1.1 * Rotation.from_rotvec([0.2, 0.5, -0.1]).as_matrix()
MARKS = np.array(
    [[0.0, 0.0], [0.2, 0.15], [-0.2, 0.15], [0.15, -0.2], [-0.15, -0.2], [0.0, 0.3]]
)
SPACING = 5.0  # mm, of the surfaces


def _disc(seed: int) -> np.ndarray:
    """Points (n, 2) of the unit disc, the outline even, the others differently for each seed."""
    rng = np.random.default_rng(seed)
    n = 2500
    r = np.sqrt((np.arange(n) + 0.5) / n) * 0.97
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(n) + 6 * rng.random()
    ring = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    rim = np.column_stack([np.cos(ring), np.sin(ring)])
    return np.concatenate(
        [np.column_stack([r * np.cos(angle), r * np.sin(angle)]), rim]
    )


def _lifted(plane: np.ndarray) -> np.ndarray:
    """Points in mm of a cap 200 mm wide with a nose, and with ears far from any landmark."""
    x, y = 100 * plane.T
    z = -(x**2 + y**2) / 150
    for cx, cy, high, wide in (
        (0, 0, 25, 12),
        (70, 10, 20, 9),
        (-70, 10, 20, 9),
        (0, -60, 8, 25),
        (20, 65, 8, 25),
    ):
        z = z + high * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * wide**2))
    return np.column_stack([x, y, z])


def _bent(points: np.ndarray) -> np.ndarray:
    """Up to 6 mm of difference between two heads, smooth over 80 mm, then another pose and size."""
    x, y = points.T[:2] / 40
    moved = points + 3 * np.column_stack(
        [np.sin(x + 1) + np.sin(y), np.cos(x) * np.sin(y), 0.5 * np.sin(x - y)]
    )
    return moved @ TURN + [5, -3, 20]


def _sheet(
    seed: int, change=lambda points: points, kept=lambda plane: plane[:, 0] < 9
) -> tuple[Sheet, np.ndarray]:
    """A surface deformed by `change` with its own triangles, and the places of its
    vertices on the disc.
    """
    plane = _disc(seed)
    faces = Delaunay(plane).simplices
    faces = faces[np.argsort(faces.min(axis=1), kind="stable")]
    uv = 0.5 + DISC_RADIUS * plane * [1, -1]
    faces = np.where((signed_areas(uv, faces) < 0)[:, None], faces[:, ::-1], faces)
    faces = faces[kept(plane)[faces].all(axis=1)]
    used, faces = np.unique(faces, return_inverse=True)
    plane = plane[used]
    faces = faces.reshape(-1, 3)
    landmark = change(_lifted(MARKS))
    return Sheet.of(change(_lifted(plane)), uv[used], faces, landmark), plane


def _away(found: np.ndarray, chosen: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """mm on the template between where points are found on the disc and where they are."""
    at = (found - 0.5) / DISC_RADIUS * [1, -1]
    return np.linalg.norm(_lifted(at) - _lifted(plane[chosen]), axis=1)


def test_corresponding_uv__follows_a_planted_deformation():
    template, plane = _sheet(1)
    take, _ = _sheet(2, _bent)
    chosen = anchor_vertices(template)
    away = _away(corresponding_uv(template, chosen, take), chosen, plane)
    assert np.isfinite(away).mean() > 0.75  # those beside the rim may leave the other
    near = (
        cKDTree(template.landmark).query(template.position[chosen])[0]
        < MIN_LANDMARK_DISTANCE_MM
    )
    assert near.sum() > 10
    assert np.isnan(away[near]).all()  # landmarks are more accurate
    # a tenth of the deformation's slope over a spacing; without bending, the similarity
    # alone leaves 5 mm
    assert np.nanmedian(away) < 1.5
    ears = (np.abs(np.abs(plane[chosen, 0]) - 0.7) < 0.1) & (
        np.abs(plane[chosen, 1] - 0.1) < 0.1
    )
    assert ears.sum() >= 4
    assert np.nanmax(away[ears]) < 3.5
    # outlines at the same place correspond by their angle
    assert np.nanmax(away[template.rim[chosen]]) < 1e-6 * 100


def test_corresponding_uv__of_the_same_surface_in_another_pose_is_exact():
    template, plane = _sheet(1)
    take, _ = _sheet(3, lambda points: points @ TURN + 7)
    chosen = anchor_vertices(template)
    away = _away(corresponding_uv(template, chosen, take), chosen, plane)
    # triangles of 5 mm on bumps of 9 mm lie up to 0.3 mm below the surface
    assert np.nanmedian(away) < 0.2
    assert np.nanquantile(away, 0.95) < 1.0


def test_corresponding_uv__of_removed_parts_is_nan():
    template, plane = _sheet(1)
    take, _ = _sheet(2, _bent, kept=lambda plane: plane[:, 1] > -0.45)
    # any other uv: its outline is no circle here
    take = replace(take, uv=0.5 + DISC_RADIUS * (take.uv - 0.5))
    chosen = anchor_vertices(template)
    found = corresponding_uv(template, chosen, take)
    gone = plane[chosen, 1] < -0.5
    assert gone.sum() > 20
    assert np.isnan(found[gone | template.rim[chosen]]).all()
    inside = (plane[chosen, 1] > -0.3) & ~template.rim[chosen]
    assert np.isfinite(found[inside]).mean() > 0.6
    at = 0.5 + (found - 0.5) / DISC_RADIUS
    # beyond the landmarks, and without an outline
    assert np.nanmedian(_away(at, chosen, plane)) < 3.0


@pytest.mark.parametrize("unknown", [slice(2, None), slice(0, None)])
def test_corresponding_uv__without_a_pose_is_nan(unknown):
    template, _ = _sheet(1)
    chosen = anchor_vertices(template)[::50]
    landmark = template.landmark.copy()
    landmark[unknown] = np.nan
    assert np.isnan(
        corresponding_uv(template, chosen, replace(template, landmark=landmark))
    ).all()
    line = np.where(
        np.isfinite(landmark), landmark, np.linspace(0, 1, 6)[:, None] * [50.0, 20, 0]
    )
    flat = replace(template, landmark=line if unknown == slice(0, None) else landmark)
    assert np.isnan(corresponding_uv(flat, chosen, flat)).all()


def test_anchor_vertices__are_far_from_each_other_and_the_landmarks():
    template, _ = _sheet(1)
    chosen = anchor_vertices(template)
    assert len(np.unique(chosen)) == len(chosen) == INNER_POINTS + OUTLINE_POINTS
    assert template.rim[chosen].sum() == OUTLINE_POINTS
    inner = template.position[chosen[:INNER_POINTS]]
    near = cKDTree(np.vstack([inner, template.landmark])).query(inner, 2)[0][:, 1]
    # 200 discs of half that distance cover at most the area, which is 1.2 to 1.5 of the disc's
    assert near.min() > 0.5 * np.sqrt(1.2 * np.pi * 100**2 / INNER_POINTS)


def test_sheet__area_and_whether_it_can_be_aligned():
    whole = _sheet(1)[0]
    larger = _sheet(1, lambda points: points @ TURN)[0]
    assert larger.area() == pytest.approx(1.1**2 * whole.area(), rel=1e-9)
    assert whole.alignable()
    line = np.outer(np.arange(3.0), [1, 2, 3])
    for landmark in (whole.landmark[:2], line):
        assert not replace(whole, landmark=landmark).alignable()


def test_weights__of_equal_errors_are_those_of_each_axis():
    rng = np.random.default_rng(4)
    points = rng.normal(size=(7, 3))
    pull = rng.normal(size=(7, 3))
    kernel = np.exp(-np.linalg.norm(points[:, None] - points, axis=2))
    found = _weights(kernel, pull, np.tile(0.3 * np.eye(3), (7, 1, 1)))
    np.testing.assert_allclose(
        found, np.linalg.solve(kernel + 0.3 * np.eye(7), pull), atol=1e-12
    )
    # what is free along x is not pulled along x
    loose = np.tile(np.diag([1e12, 0.3, 0.3]), (7, 1, 1))
    found = _weights(kernel, pull, loose)
    np.testing.assert_allclose(found[:, 0], 0, atol=1e-9)
    np.testing.assert_allclose(
        found[:, 1:], np.linalg.solve(kernel + 0.3 * np.eye(7), pull[:, 1:]), atol=1e-9
    )
