"""Loops, components, fans and winding on very small meshes."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from skindb.geometry.mesh import (
    boundary_loops,
    edge_table,
    face_components,
    fans,
    winding_flips,
)

SQUARE = np.array([[0, 1, 2], [0, 2, 3]])  # counter-clockwise, 0 1 2 3 around
TWO_SQUARES = np.concatenate([SQUARE, SQUARE + 4])


def test_edge_table__square():
    table = edge_table(SQUARE)
    assert table.edges.tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]]
    assert table.count.tolist() == [1, 2, 1, 1, 1]
    assert table.edges[table.of_face].tolist() == [
        [[0, 1], [1, 2], [0, 2]],
        [[0, 2], [2, 3], [0, 3]],
    ]


def test_boundary_loops__run_along_the_faces_longest_first():
    assert [loop.tolist() for loop in boundary_loops(SQUARE)] == [[0, 1, 2, 3]]
    both = boundary_loops(np.concatenate([SQUARE, [[4, 5, 6]]]))
    assert [loop.tolist() for loop in both] == [[0, 1, 2, 3], [4, 5, 6]]


def test_boundary_loops__none_on_a_closed_surface():
    assert boundary_loops(np.asarray(trimesh.creation.icosphere(1).faces)) == []


@pytest.mark.parametrize(
    "faces",
    [[[0, 1, 2], [0, 3, 4]], [[0, 1, 2], [0, 3, 2]]],
    ids=["bow-tie", "winding"],
)
def test_boundary_loops__refuse_what_has_no_loops(faces):
    with pytest.raises(ValueError, match="clean the mesh first"):
        boundary_loops(np.array(faces))


def test_face_components__need_an_edge():
    assert len(set(face_components(TWO_SQUARES))) == 2
    assert len(set(face_components(np.array([[0, 1, 2], [0, 3, 4]])))) == 2
    assert len(set(face_components(SQUARE))) == 1


def test_winding_flips__turn_the_fewer_in_each_piece():
    sphere = np.asarray(trimesh.creation.icosphere(2).faces)
    turned = np.random.default_rng(0).random(2 * len(sphere)) < 0.3
    faces = np.concatenate([sphere, sphere + sphere.max() + 1])
    spoilt = np.where(turned[:, None], faces[:, ::-1], faces)
    np.testing.assert_array_equal(winding_flips(spoilt), turned)


def test_fans__tell_bow_ties():
    bow = fans(np.array([[0, 1, 2], [0, 3, 4]]))
    assert bow[0, 0] != bow[1, 0]
    label = fans(SQUARE)
    assert (label[0, 0], label[0, 2]) == (label[1, 0], label[1, 1])
    assert len(np.unique(label)) == 4


@pytest.mark.parametrize("turn", [False, True])
def test_fans__do_not_depend_on_the_winding(turn):
    sphere = np.array(trimesh.creation.icosphere(2).faces)
    if turn:
        sphere[::3] = sphere[::3, ::-1]
    label = fans(sphere)
    assert len(np.unique(label)) == sphere.max() + 1
    assert all(
        len(set(sphere.ravel()[label.ravel() == fan])) == 1 for fan in np.unique(label)
    )
