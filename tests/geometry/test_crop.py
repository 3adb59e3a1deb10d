"""Cropping by a box and around landmarks, against loops over faces and corners."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from skindb.errors import InputError
from skindb.geometry.crop import Crop, crop_faces

BALL = trimesh.creation.icosphere(2, radius=80.0)
V = np.asarray(BALL.vertices)
F = np.asarray(BALL.faces)
MARKS = np.array([[0.0, 0, 80], [60, 0, 50]])


def inside(p, crop):
    low_ok = crop.low is None or all(p[i] >= crop.low[i] for i in range(3))
    high_ok = crop.high is None or all(p[i] <= crop.high[i] for i in range(3))
    near = (
        crop.reach_mm is None
        or min(np.linalg.norm(p - m) for m in MARKS) <= crop.reach_mm
    )
    return low_ok and high_ok and near


@pytest.mark.parametrize(
    "crop",
    [
        Crop((-30, -99, 0), (99, 40, 99)),
        Crop(low=(-99, -99, 10.0)),
        Crop(high=(99, 0, 99.0)),
        Crop(reach_mm=35.0),
        Crop((-99, -99, 60), None, 35.0),
    ],
)
def test_crop_faces__keeps_faces_with_all_corners_inside(crop):
    expected = [all(inside(V[c], crop) for c in face) for face in F]
    assert 0 < sum(expected) < len(F)
    assert crop_faces(V, F, crop, landmarks=MARKS).tolist() == expected


@pytest.mark.parametrize(
    ("limits", "match"),
    [
        ({"low": (0, 0, 0), "high": (1, 0, 1)}, "lower corner must lie below"),
        ({"reach_mm": 0.0}, "must be positive"),
        ({"reach_mm": float("nan")}, "must be positive"),
        ({"low": (0, 0, 0), "high": (1, float("nan"), 1)}, "lower corner"),
    ],
)
def test_crop__refuses_what_keeps_nothing(limits, match):
    with pytest.raises(InputError, match=match):
        Crop(**limits)


def test_crop_faces__around_no_landmarks():
    with pytest.raises(ValueError, match="needs landmarks"):
        crop_faces(V, F, Crop(reach_mm=30.0))
