"""Landmarks of a scan: what is checked before they are saved, and what is in the files."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh

from skindb.errors import InputError
from skindb.format.scan_checks import crop_path
from skindb.geometry.landmarks import MEAN_FACE
from skindb.geometry.scan import Crop
from skindb.view.landmarks import (
    PLACES,
    landmark_mistakes,
    landmark_task,
    open_questions,
    place_sentence,
    save_landmarks,
)
from skindb.virtual.face import FaceShape
from skindb.virtual.head import parametric_head

BOX = Crop((-100.0, -150.0, -20.0), (100.0, 150.0, 200.0))


@pytest.fixture(scope="module")
def head():
    return parametric_head(FaceShape(), spacing_mm=2.0)


@pytest.fixture
def scan(head, tmp_path):
    path = tmp_path / "scan.ply"
    trimesh.Trimesh(head.vertices, head.faces, process=False).export(path)
    return path


@pytest.fixture
def task(scan, tmp_path):
    return landmark_task(scan, tmp_path / "landmarks.json")


def rules(faults):
    return " ".join(str(fault) for fault in faults)


def test_landmark_mistakes__accepts_the_true_points(task, head):
    assert landmark_mistakes(task, head.landmarks, None) == []
    assert landmark_mistakes(task, head.landmarks, BOX) == []


def moved(head, **places):
    return {
        **head.landmarks,
        **{name: np.asarray(p, float) for name, p in places.items()},
    }


def test_landmark_mistakes__names_each_kind(task, head):
    marks = head.landmarks
    off = moved(head, chin=marks["chin"] + [0, 0, 2.5])
    assert (
        "[chin]: a landmark must be within 1 mm of the scan, of which the "
        "largest component is kept; found a distance of 2.5 mm"
        in rules(landmark_mistakes(task, off, None))
    )
    near = moved(head, chin=marks["chin"] + [0, 0, 0.5])
    assert landmark_mistakes(task, near, None) == []
    unknown = rules(landmark_mistakes(task, moved(head, nose=marks["chin"]), None))
    assert "[nose]: the name of a landmark must be in the list" in unknown
    double = rules(landmark_mistakes(task, moved(head, chin=marks["lip_upper"]), None))
    assert "landmarks must be at least 0.5 mm apart" in double
    swapped = {
        name: marks[{"jaw_left": "jaw_right", "jaw_right": "jaw_left"}.get(name, name)]
        for name in marks
    }
    assert "left must be the subject's left" in rules(
        landmark_mistakes(task, swapped, None)
    )
    upside = {
        name: marks[{"chin": "nasion", "nasion": "chin"}.get(name, name)]
        for name in marks
    }
    assert "must lie above" in rules(landmark_mistakes(task, upside, None))
    small = Crop((-100.0, -60.0, -20.0), (100.0, 150.0, 200.0))
    assert "[chin]: a landmark must be inside the crop box" in rules(
        landmark_mistakes(task, marks, small)
    )
    assert "at least one landmark must be set" in rules(
        landmark_mistakes(task, {}, None)
    )


def test_save_landmarks__is_read_again(task, head, scan):
    save_landmarks(task, head.landmarks, BOX)
    again = landmark_task(scan, task.out)
    assert [*again.points] == [*MEAN_FACE]
    for name, place in again.points.items():
        # three decimals of a mm
        np.testing.assert_allclose(place, head.landmarks[name], atol=0.5e-3)
    assert again.crop == BOX
    assert (again.crop.low, again.crop.high) == ((-100, -150, -20), (100, 150, 200))
    save_landmarks(again, again.points, None)
    assert not crop_path(task.out).exists()
    assert [p.name for p in sorted(task.out.parent.iterdir())] == [
        "landmarks.json",
        "scan.ply",
    ]


def test_save_landmarks__keeps_the_old_file_if_writing_fails(task, head, monkeypatch):
    save_landmarks(task, head.landmarks, None)
    before = task.out.read_bytes()

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("skindb.view.landmarks.os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        save_landmarks(task, {"chin": head.landmarks["chin"]}, None)
    assert task.out.read_bytes() == before
    assert [p.name for p in sorted(task.out.parent.iterdir())] == [
        "landmarks.json",
        "scan.ply",
    ]


def test_save_landmarks__keeps_other_names_of_the_file(scan, tmp_path, head):
    out = tmp_path / "landmarks.json"
    out.write_text(json.dumps({"lip_lower": head.landmarks["lip_upper"].tolist()}))
    task = landmark_task(scan, out)
    assert task.names[-1] == "lip_lower"
    assert (
        place_sentence("lip_lower")
        == "A point from the file that is not one of the 20 landmarks."
    )
    save_landmarks(task, task.points, None)
    assert [*json.loads(out.read_text())] == ["lip_lower"]


def test_open_questions__asks_for_missing_points_and_files_it_did_not_write(task, head):
    assert open_questions(task, head.landmarks, seen="") == []
    some = {
        name: p for name, p in head.landmarks.items() if name not in ("chin", "nasion")
    }
    assert open_questions(task, some, seen="") == [
        "2 of the 20 points are missing: nasion, chin."
    ]
    seen = save_landmarks(task, head.landmarks, None)
    assert open_questions(task, head.landmarks, seen=seen) == []
    assert open_questions(task, head.landmarks, seen="") == [
        f"{task.out} exists and will be replaced."
    ]
    task.out.write_text("{}")  # another program wrote it
    assert open_questions(task, head.landmarks, seen=seen) == [
        f"{task.out} exists and will be replaced."
    ]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[]", "must be a JSON object"),
        ('{"chin": [1, 2]}', r"\[chin\]: a landmark must be \[x, y, z\] in mm"),
        ('{"chin": [1, 2, NaN]}', "a landmark must be"),
        ('{"chin"', "must be JSON"),
    ],
)
def test_landmark_task__refuses_a_damaged_file(scan, tmp_path, text, said):
    out = tmp_path / "landmarks.json"
    out.write_text(text)
    with pytest.raises(InputError, match=said):
        landmark_task(scan, out)


def test_landmark_task__refuses_a_damaged_crop_file_and_a_missing_folder(
    scan, tmp_path
):
    (tmp_path / "landmarks.crop.json").write_text('{"low": [0, 0, 0]}')
    with pytest.raises(InputError, match="a crop box must be"):
        landmark_task(scan, tmp_path / "landmarks.json")
    with pytest.raises(InputError, match="its folder must exist"):
        landmark_task(scan, tmp_path / "none" / "landmarks.json")


def test_place_sentence__is_there_for_all_names():
    assert all(
        place_sentence(name).split(".")[0] in "".join(PLACES.values())
        for name in MEAN_FACE
    )
    assert place_sentence("ala_left").endswith("On the subject's left.")
