"""Correspondences between a bumpy surface and a planted deformation of it, complete or cut."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import Delaunay, cKDTree
from scipy.spatial.transform import Rotation

from skindb.geometry.atlas import DISC_RADIUS, signed_areas
from skindb.geometry.warp import (
    INNER_POINTS,
    MIN_LANDMARK_DISTANCE_MM,
    OUTLINE_POINTS,
    Sheet,
    _weights,
    anchor_vertices,
    corresponding_uv,
)

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
