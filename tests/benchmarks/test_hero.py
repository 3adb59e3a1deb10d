"""The hero's head: its mesh, its relief and its skin."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.distance import pdist

from benchmarks import hero
from skindb.geometry.mesh import boundary_loops, face_crosses
from skindb.types import dots


@pytest.fixture(scope="module")
def head():
    """The hero without the finest relief."""
    return hero.build_hero(3.0, 0)


def test_build_hero__is_a_disc_with_the_cut_of_the_neck_as_outline(head):
    faces = head.faces
    sides = np.concatenate([faces, faces[:, [1, 2, 0]], faces[:, [2, 0, 1]]])[:, :2]
    assert len(np.unique(sides, axis=0)) == len(sides)  # oriented and manifold
    (outline,) = boundary_loops(faces)
    assert np.ptp(head.vertices[outline, 1]) < 2.5  # mm, of the relief
    edges = (len(sides) + len(outline)) / 2
    assert len(head.vertices) - edges + len(faces) == 1  # without handles


def test_build_hero__no_triangle_is_turned_over(head):
    outward = hero.normals(head.vertices)[head.faces].sum(axis=1)
    assert (dots(face_crosses(head.vertices, head.faces), outward) > 0).all()


def test_build_hero__skin_reflects_less_than_it_receives(head):
    assert (head.diffuse > 0).all()
    assert (head.diffuse < 1).all()
    assert (head.weights >= 0).all()
    hair = head.vertices[:, 1] > 140
    cheek = np.linalg.norm(head.vertices - [45, -10, 80], axis=1) < 10
    assert head.diffuse[hair].mean() < 0.4 * head.diffuse[cheek].mean()


def test_pores__are_apart_and_as_deep_as_drawn_at_their_centres():
    line = np.arange(0, 12, 0.25)
    points = np.stack([*np.meshgrid(line, line), np.zeros((48, 48))], -1).reshape(-1, 3)
    area = np.full(len(points), 0.25**2)
    rng = np.random.default_rng(0)
    centres = points[hero.spread(points, area, np.full(len(points), 0.8), 0.75, rng)]
    assert len(centres) > 30
    assert pdist(centres).min() > 0.75
    depth = hero.pore_depth(points, centres, rng).reshape(48, 48)
    middle = np.round(centres[:, :2] / 0.25).astype(int)
    assert depth[middle[:, 1], middle[:, 0]].min() > 0.3
    fine = depth - gaussian_filter(depth, 4)
    assert fine.std() > 0.15
