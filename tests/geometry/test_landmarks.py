"""Suggested landmarks on virtual heads whose true landmarks are known."""

import numpy as np
import pytest

from skindb.geometry.landmarks import (
    MEAN_FACE,
    mate,
    nose_tip,
    suggest_landmarks,
)
from skindb.virtual.head import parametric_head
from skindb.virtual.person import default_people, face_shape

SEVEN = (
    "nose_tip",
    "nasion",
    "chin",
    "eye_outer_left",
    "eye_outer_right",
    "forehead_centre",
    "mouth_corner_left",
)


@pytest.fixture(scope="module")
def heads():
    return [
        parametric_head(face_shape(person), spacing_mm=4.0)
        for person in default_people()[2:]
    ]


def errors(head, given):
    """Distances in mm of the suggestions to the truth, by name."""
    found = suggest_landmarks(
        head.vertices, head.faces, {name: head.landmarks[name] for name in given}
    )
    return {
        name: float(np.linalg.norm(p - head.landmarks[name]))
        for name, p in found.items()
    }


def test_nose_tip__is_near_the_true_one(heads):
    # vertices are 4 mm apart, and the foremost point of a round tip is not exactly its named one
    for head in heads:
        assert np.linalg.norm(nose_tip(head.vertices) - head.landmarks["nose_tip"]) < 6


def test_suggest_landmarks__names_exactly_those_that_are_not_set(heads):
    head = heads[0]
    assert (
        {*suggest_landmarks(head.vertices, head.faces, {})}
        == {*head.landmarks}
        == {*MEAN_FACE}
    )
    found = suggest_landmarks(
        head.vertices, head.faces, {name: head.landmarks[name] for name in SEVEN}
    )
    assert {*found} == {*head.landmarks} - {*SEVEN}
    assert suggest_landmarks(head.vertices, head.faces, head.landmarks) == {}


def test_suggest_landmarks__come_nearer_as_points_are_set(heads):
    none = np.concatenate([[*errors(head, ()).values()] for head in heads])
    seven = np.concatenate([[*errors(head, SEVEN).values()] for head in heads])
    # measured on these heads: median 4.1 and 2.3 mm, largest 16.3 and 9.6 mm. The mean
    # face is half that of scanned people; that of virtual heads alone has 4.9 mm
    assert np.median(none) < 4.6
    assert none.max() < 18
    assert np.median(seven) < 2.6
    assert seven.max() < 11


def test_suggest_landmarks__mirrors_a_point_whose_mate_is_set(heads):
    given = [*SEVEN, "jaw_left", "brow_left", "ala_left"]
    for head in heads:
        found = errors(head, given)
        # faces are not quite symmetric: measured 1.0 mm, and 1.7 to 4.1 mm without mirroring
        assert (
            max(found[mate(name)] for name in ("jaw_left", "brow_left", "ala_left"))
            < 1.5
        ), found


def test_suggest_landmarks__follows_a_turned_and_scaled_head(heads):
    head = heads[1]
    turn = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    given = {name: 1.3 * head.landmarks[name] @ turn + 7 for name in SEVEN}
    turned = suggest_landmarks(1.3 * head.vertices @ turn + 7, head.faces, given)
    plain = suggest_landmarks(
        head.vertices, head.faces, {name: head.landmarks[name] for name in SEVEN}
    )
    for name, place in plain.items():
        np.testing.assert_allclose(turned[name], 1.3 * place @ turn + 7, atol=1e-6)


def test_mean_face__is_symmetric():
    for name, place in MEAN_FACE.items():
        np.testing.assert_array_equal(MEAN_FACE[mate(name)], place * (-1, 1, 1))
