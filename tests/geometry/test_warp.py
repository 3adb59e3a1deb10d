"""Thin-plate warps compared with SciPy's, without folds; nearest points and mean shapes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import RBFInterpolator
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation
from trimesh.triangles import closest_point

from skindb.geometry.landmarks import mean_shape, similarity, width
from skindb.geometry.mesh import closest_on_mesh
from skindb.geometry.warp import (
    MIN_AREA_RATIO,
    MIN_WIDTH_RATIO,
    SAME_POINT_FRACTION,
    SMOOTHING,
    WEAK_SMOOTHING_FACTOR,
    apply_warp,
    area_factor,
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


def test_fit_warp__condition_is_that_of_the_bending_energy():
    warp = fit_warp(FACE, _moved(2), smoothing=0.02)
    x = (FACE - FACE.mean(axis=0)) / np.sqrt(FACE.var(axis=0).sum())
    r = np.linalg.norm(x[:, None] - x, axis=2)
    kernel = r**2 * np.log(np.where(r > 0, r, 1)) + 0.02 * np.eye(len(x))
    linear = np.column_stack([np.ones(len(x)), x])
    away = np.eye(len(x)) - linear @ np.linalg.pinv(linear)
    value = np.linalg.svd(away @ kernel @ away, compute_uv=False)[: len(x) - 3]
    assert warp.condition == pytest.approx(value[0] / value[-1], rel=1e-9)


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
    assert len(warp.centre) == 20
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
    # the largest eigenvalue of 21 points is about 6, the least is not below 0
    assert warp.condition < 70
    assert fit_warp(source, target, smoothing=0.0).condition > 2500
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
    value = np.linalg.eigvalsh(
        _projected(every, warp, np.repeat([1.0, WEAK_SMOOTHING_FACTOR], [20, 39]))
    )[3:]
    assert warp.condition == pytest.approx(
        (value[-1] + 0.02) / (value[0] + 0.02), rel=1e-6
    )


def _projected(points, warp, loose):
    """The divided kernel on the complement of the divided affine maps, with three zeros."""
    x = (points - warp.origin) / warp.scale
    root = np.sqrt(loose)
    r = np.linalg.norm(x[:, None] - x, axis=2)
    kernel = r**2 * np.log(np.where(r > 0, r, 1)) / np.outer(root, root)
    linear = np.column_stack([np.ones(len(x)), x]) / root[:, None]
    away = np.eye(len(x)) - linear @ np.linalg.pinv(linear)
    return away @ kernel @ away


def test_fit_warp__weak_points_give_way_first():
    """Two weak points exchange their places; the others move by less than a tenth of a click."""
    weak = np.array([[0.95, 0.5], [1.05, 0.5]])
    crossed = fit_warp(
        FACE, _moved(15), weak=(weak, np.array([[1.15, 0.5], [0.85, 0.5]]))
    )
    assert (crossed.kind, crossed.smoothing) == ("thin plate", SMOOTHING)
    assert crossed.loose[-1] > WEAK_SMOOTHING_FACTOR
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
    assert (warp.kind, warp.condition >= 1) == (kind, True)
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
