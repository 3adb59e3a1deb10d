"""Slivers are removed without tearing, pinching or doubling the surface."""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay

from skindb.geometry.holes import sliver_mask
from skindb.geometry.slivers import repair_slivers
from skindb.geometry.topology import edge_table, fans


def assert_manifold(faces: np.ndarray) -> None:
    assert edge_table(faces).count.max() <= 2
    assert len(np.unique(fans(faces))) == len(np.unique(faces))


def test_repair_slivers__needle_collapses():
    v = np.array(
        [[0, 0, 0], [1e-5, 0, 0], [1, 9, 0], [1, -9, 0], [-8, 0, 0], [8, 0, 0]], float
    )
    f = np.array([[0, 1, 2], [1, 0, 3], [4, 0, 2], [4, 3, 0], [5, 2, 1], [5, 1, 3]])
    left, repaired, stay = repair_slivers(v, f)
    assert (len(left), len(repaired), len(stay)) == (4, 1, 0)
    assert not sliver_mask(v, left).any()
    assert_manifold(left)


def test_repair_slivers__cap_gives_up_its_long_side():
    v = np.array([[0, 0, 0], [10, 0, 0], [5, 1e-5, 0], [5, -8, 0]], float)
    left, repaired, stay = repair_slivers(v, np.array([[0, 1, 2], [1, 0, 3]]))
    assert (len(repaired), len(stay)) == (1, 0)
    assert sorted(map(sorted, left.tolist())) == [[0, 2, 3], [1, 2, 3]]
    a, b, c = (v[left[:, i]] for i in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()  # wound as before


def test_repair_slivers__no_collapse_that_doubles_faces():
    # both ends of the short side are neighbours of vertex 4, and no face has all three
    v = np.array(
        [[0, 0, 0], [1e-7, 0, 0], [10, 5, 0], [10, -5, 0], [-5, 0, 3.0], [-5, 0, -3.0]]
    )
    f = np.array(
        [[0, 1, 2], [1, 0, 3], [0, 2, 4], [2, 1, 5], [1, 3, 4], [1, 4, 5], [0, 4, 3]]
    )
    assert_manifold(f)
    left, _, _ = repair_slivers(v, f)
    assert edge_table(left).count.max() <= 2
    assert len(np.unique(np.sort(left, axis=1), axis=0)) == len(left)


def test_repair_slivers__no_collapse_that_pinches_a_waist():
    # two sheets joined by a waist as narrow as the short side, whose ends both lie on the boundary
    v = np.array(
        [[0, 0, 0], [0, 1e-5, 0], [9, 0, 0], [-9, 0, 0], [5, -5, 0], [-5, -5, 0]], float
    )
    f = np.array([[1, 0, 2], [0, 1, 3], [0, 4, 2], [0, 3, 5]])
    assert_manifold(f)
    left, repaired, stay = repair_slivers(v, f)
    np.testing.assert_array_equal(left, f)
    assert (len(repaired), len(stay)) == (0, 2)


def test_repair_slivers__cap_with_an_open_long_side_is_dropped():
    v = np.array([[0, 0, 0], [10, 0, 0], [5, 1e-5, 0], [5, 8, 1]], float)
    left, repaired, stay = repair_slivers(
        v, np.array([[0, 2, 3], [2, 1, 3], [0, 1, 2]])
    )
    assert (left.tolist(), len(repaired), len(stay)) == ([[0, 2, 3], [2, 1, 3]], 1, 0)
    alone, repaired, stay = repair_slivers(v, np.array([[0, 1, 2]]))
    assert (len(alone), len(repaired), len(stay)) == (0, 1, 0)


def test_repair_slivers__no_flip_onto_an_edge_that_exists():
    v = np.array([[0, 0, 0], [10, 0, 0], [5, 1e-5, 0], [5, -8, 3]], float)
    tetrahedron = np.array([[0, 1, 2], [1, 0, 3], [0, 2, 3], [2, 1, 3]])
    left, repaired, stay = repair_slivers(v, tetrahedron)
    np.testing.assert_array_equal(left, tetrahedron)
    assert (len(repaired), len(stay)) == (0, 1)


def test_repair_slivers__nothing_to_do():
    v = np.array([[0, 0, 0], [10, 0, 0], [5, 5, 0]], float)
    left, repaired, stay = repair_slivers(v, np.array([[0, 1, 2]]))
    assert (left.tolist(), len(repaired), len(stay)) == ([[0, 1, 2]], 0, 0)


def test_repair_slivers__many_that_touch():
    """Points in pairs and on lines: repairs change the faces that later ones look at."""
    for seed in range(8):
        rng = np.random.default_rng(seed)
        flat = np.concatenate(
            [rng.integers(0, 6, (40, 2)), rng.normal(size=(20, 2)) * 3]
        )
        flat = flat + rng.normal(size=flat.shape) * 10 ** rng.uniform(-6, -4, (60, 1))
        f = Delaunay(flat).simplices.astype(np.int64)
        v = np.c_[flat, np.zeros(60)]
        left, repaired, stay = repair_slivers(v, f)
        assert len(repaired) > 10
        assert_manifold(left)
        assert sliver_mask(v, left).sum() == len(stay) < len(repaired)
        # one sheet without holes, as before: needles take a vertex with them, caps none
        assert len(np.unique(left)) - len(edge_table(left).edges) + len(left) == 1
