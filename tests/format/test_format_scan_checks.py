"""Captures that cannot be of a face are refused with one line and its cure; unusual
ones that can be are not.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from sphere import RADIUS, half_sphere, look_at

from skindb.errors import InputError
from skindb.format.scan_checks import (
    coincidence_faults,
    landmark_faults,
    order_faults,
    scan_faults,
    swapped_faults,
)
from skindb.geometry.clean import CleanMesh, clean_mesh
from skindb.geometry.mesh import closest_on_mesh
from skindb.geometry.scan import Crop
from skindb.ingest import read_capture
from skindb.ingest.surfels import build_surfels, site_positions, transferred_landmarks
from skindb.store import Database
from skindb.workflow import ingest_take

FLAT = {  # x to the subject's left, y up, of a face on the unit sphere
    "forehead_centre": (0.0, 0.7),
    "brow_right": (-0.4, 0.4),
    "brow_left": (0.4, 0.4),
    "eye_outer_right": (-0.5, 0.25),
    "eye_outer_left": (0.5, 0.25),
    "nose_tip": (0.0, 0.0),
    "mouth_corner_right": (-0.3, -0.4),
    "mouth_corner_left": (0.3, -0.4),
    "chin": (0.0, -0.8),
}
FACE = {
    name: RADIUS * np.array([x, y, np.sqrt(1 - x * x - y * y)])
    for name, (x, y) in FLAT.items()
}
MIRRORED = {
    name: FACE[name.replace("left", "*").replace("right", "left").replace("*", "right")]
    for name in FACE
}  # names exchanged


def write(folder, name, record):
    (folder / name).write_text(json.dumps(record))


def dome(folder):
    return json.loads((folder / "dome/dome.json").read_text())


def put_scan(folder, vertices, faces):
    trimesh.Trimesh(vertices, faces, process=False).export(folder / "scan.ply")


def put_landmarks(folder, points):
    write(
        folder,
        "landmarks.json",
        {name: list(map(float, p)) for name, p in points.items()},
    )


def only_fault(folder):
    with pytest.raises(InputError) as caught:
        read_capture(folder)
    (fault,) = caught.value.faults
    return str(fault)


@pytest.mark.parametrize(
    ("scale", "cure"),
    [
        (1000, "micrometres: divide by 1000"),
        (1e-3, "metres: multiply by 1000"),
        (1 / 25.4, "inches: multiply by 25.4"),
    ],
)
def test_read_capture__scan_of_another_unit_is_one_fault(capture_folder, scale, cure):
    vertices, faces = half_sphere()
    put_scan(capture_folder, vertices * scale, faces)
    put_landmarks(capture_folder, FACE)
    fault = only_fault(capture_folder)
    assert "scan.ply (mesh): lengths must be in mm, and a scan must be" in fault
    assert fault.endswith(f"; these look like {cure}")


@pytest.mark.parametrize(
    ("scale", "cure"),
    [(0.1, "centimetres: multiply by 10"), (10, "millimetre: divide by 10")],
)
def test_read_capture__face_of_another_unit_though_the_scan_could_be_a_patch(
    capture_folder, scale, cure
):
    """A head in centimetres is as large as a patch of skin: only its landmarks tell."""
    vertices, faces = half_sphere()
    put_scan(capture_folder, vertices * scale, faces)
    put_landmarks(capture_folder, {name: p * scale for name, p in FACE.items()})
    fault = only_fault(capture_folder)
    assert "landmarks.json: lengths must be in mm, and a face must be" in fault
    assert fault.endswith(f"{cure}, also for the scan")


@pytest.mark.parametrize(
    ("factor", "unit"), [(1e-3, "metres"), (0.1, "centimetres"), (1000, "micrometres")]
)
def test_read_capture__landmarks_of_another_unit_are_one_fault(
    capture_folder, factor, unit
):
    put_landmarks(capture_folder, {name: p * factor for name, p in FACE.items()})
    fault = only_fault(capture_folder)
    assert "landmarks.json: lengths must be in mm, and a face must be" in fault
    assert f"these look like {unit}: " in fault
    assert "also for the scan" not in fault


def test_landmark_faults__all_in_one_point_are_no_unit(capture_folder):
    """The origin of this frame lies on the nose: divided by 1000 all landmarks would be there."""
    surface = read_capture(capture_folder).surface
    moved = replace(surface, vertices=surface.vertices - [0, 0, RADIUS])
    found = landmark_faults(
        "f", {name: p + np.array([0, 300, -RADIUS]) for name, p in FACE.items()}, moved
    )
    assert len(found) == len(FACE)


def test_read_capture__landmarks_elsewhere_in_mm_are_named_one_by_one(capture_folder):
    put_landmarks(
        capture_folder, {name: p + np.array([0, 300, 0]) for name, p in FACE.items()}
    )
    with pytest.raises(InputError, match="mark it again") as caught:
        read_capture(capture_folder)
    assert len(caught.value.faults) == len(FACE)


def test_read_capture__landmarks_in_order_pass(capture_folder):
    put_landmarks(capture_folder, FACE)
    assert set(read_capture(capture_folder).landmarks) == set(FACE)


def test_read_capture__left_and_right_exchanged(capture_folder):
    put_landmarks(capture_folder, MIRRORED)
    fault = only_fault(capture_folder)
    assert "landmarks.json: left must be the subject's left" in fault
    assert "all 3 pairs the other way round; exchange left and right" in fault


def sphere_surface(turn: np.ndarray) -> CleanMesh:
    vertices, faces = half_sphere()
    return clean_mesh(vertices @ turn.T, faces)


def rotations():
    rng = np.random.default_rng(4)
    for _ in range(12):
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        yield q * np.sign(np.linalg.det(q))


def test_swapped_faults__hold_for_a_turned_head():
    one = FACE | {"brow_left": FACE["brow_right"], "brow_right": FACE["brow_left"]}
    for turn in rotations():
        surface = sphere_surface(turn)
        found = [
            [
                fault.where
                for fault in swapped_faults(
                    "f", {n: turn @ p for n, p in points.items()}, surface
                )
            ]
            for points in (FACE, MIRRORED, one)
        ]
        assert found == [[], ["f"], ["f[brow_left]"]]


def test_swapped_faults__a_mirrored_scan_is_told():
    vertices, faces = half_sphere()
    mirror = np.array([-1.0, 1, 1])
    (fault,) = swapped_faults(
        "f",
        {n: p * mirror for n, p in FACE.items()},
        clean_mesh(vertices * mirror, faces),
    )
    assert "if the scan is a mirror image" in fault.cure


def test_swapped_faults__names_as_prefix_count_and_without_pairs_or_heights_nothing_is_judged():
    surface = sphere_surface(np.eye(3))
    prefixed = {
        " ".join(reversed(name.rsplit("_", 1))): p for name, p in MIRRORED.items()
    }
    assert len(swapped_faults("f", prefixed, surface)) == 1
    for kept in (["brow_left", "chin"], ["brow_left", "brow_right"], ["nose_tip"]):
        assert (
            swapped_faults("f", {name: MIRRORED[name] for name in kept}, surface) == []
        )


def test_swapped_faults__a_slanting_pair_is_not_judged():
    """Asymmetry, or one point clicked badly: 60 degrees to either side are left alone."""
    points = FACE | {"brow_left": FACE["eye_outer_right"] + [-15, 60, 20]}
    assert swapped_faults("f", points, sphere_surface(np.eye(3))) == []


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("forehead_centre", "chin"),
        ("nose_tip", "chin"),
        ("forehead_centre", "nose_tip"),
        ("brow_left", "nose_tip"),
    ],
)
def test_order_faults__names_exchanged_along_the_middle(one, other):
    for turn in rotations():
        points = {name: turn @ p for name, p in FACE.items()}
        assert order_faults("f", points) == []
        (fault,) = order_faults("f", points | {one: points[other], other: points[one]})
        assert fault.rule == f"{one} must lie above {other} on a face"


def test_read_capture__names_exchanged_along_the_middle_are_one_fault(capture_folder):
    put_landmarks(
        capture_folder, FACE | {"nose_tip": FACE["chin"], "chin": FACE["nose_tip"]}
    )
    fault = only_fault(capture_folder)
    assert (
        "landmarks.json[nose_tip]: nose_tip must lie above chin on a face; found "
        "it 58 mm below; exchange"
    ) in fault


def test_order_faults__a_hanging_nose_passes_and_without_heights_nothing_is_judged():
    # above the tip of the nose
    hanging = FACE | {"subnasale": FACE["nose_tip"] + [0, 5, 0]}
    assert order_faults("f", hanging) == []
    assert order_faults("f", FACE | {"subnasale": FACE["nose_tip"] + [0, 12, 0]})
    few = {name: FACE[name] for name in ("brow_left", "nose_tip")}
    assert order_faults("f", few) == []
    assert order_faults("f", {}) == []


def test_coincidence_faults__two_names_at_one_point(capture_folder):
    points = FACE | {"subnasale": FACE["nose_tip"] + [0.1, 0, 0]}
    (fault,) = coincidence_faults("f", points)
    assert str(fault).startswith(
        "f[subnasale]: landmarks must be at least 0.5 mm apart; found nose_tip at the same point;"
    )
    assert (
        coincidence_faults("f", FACE | {"subnasale": FACE["nose_tip"] + [0, -1, 0]})
        == []
    )
    put_landmarks(capture_folder, points)
    assert "[subnasale]: landmarks must be at least" in only_fault(capture_folder)


@pytest.mark.parametrize("size", [15.0, 400.0, 1100.0])
def test_scan_faults__a_patch_a_head_and_a_person_pass(size):
    """Boxes of 22, 590 and 1620 mm across: only what is a unit away from any scan is refused."""
    ball = trimesh.creation.icosphere(1, radius=size / 2)
    surface = clean_mesh(np.asarray(ball.vertices), np.asarray(ball.faces))
    assert scan_faults("m", surface) == []


def move_camera(folder, index, eye):
    record = dome(folder)
    rotation = look_at((0, 30, 400))[0]
    record["cameras"][index] |= {
        "R": rotation.tolist(),
        "t": (-rotation @ np.asarray(eye, float)).tolist(),
    }
    write(folder, "dome/dome.json", record)


def test_read_capture__camera_inside_the_head(capture_folder):
    move_camera(capture_folder, 1, [10, 5, 40])
    fault = only_fault(capture_folder)
    assert (
        "dome.json[cameras]: cameras must be outside the head; found 1 of 2 inside "
        "it: c1; calibrate in mm"
    ) in fault


def test_read_capture__lights_in_metres_behind_an_open_scan(capture_folder):
    ball = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    cap = ball.vertices[ball.faces][..., 2].min(axis=1) > RADIUS / 4
    put_scan(capture_folder, ball.vertices, ball.faces[cap])
    record = dome(capture_folder)
    for light in record["lights"]:
        light["position"] = [x / 1000 for x in light["position"]]
    write(capture_folder, "dome/dome.json", record)
    fault = only_fault(capture_folder)
    assert "dome.json[lights]: positions must be in mm" in fault
    assert "all 4 within 0.5 mm of the origin; these look like metres" in fault


def test_read_capture__some_lights_inside_the_head_are_no_unit(capture_folder):
    record = dome(capture_folder)
    for i, light in enumerate(record["lights"][:2]):
        light["position"] = [10 - 5 * i, 20, 30]
    write(capture_folder, "dome/dome.json", record)
    fault = only_fault(capture_folder)
    assert (
        "dome.json[lights]: lights must be outside the head; found 2 of 4 inside "
        "it: l0, l1; calibrate in mm"
    ) in fault


def test_read_capture__camera_close_to_the_skin_or_behind_an_open_scan_is_fine(
    capture_folder,
):
    move_camera(capture_folder, 0, [0, 0, RADIUS + 1])
    move_camera(capture_folder, 1, [0, 0, -20])
    assert len(read_capture(capture_folder).dome.cameras) == 2


def test_read_capture__camera_below_a_slanting_rim_is_fine(capture_folder):
    """Within the box of the scan, where a fifth of all directions meet its inner side."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    put_scan(
        capture_folder,
        ball.vertices,
        ball.faces[ball.vertices[ball.faces][..., 1:].sum(axis=2).min(axis=1) > 0],
    )
    move_camera(capture_folder, 1, [0, -40, -40])
    assert len(read_capture(capture_folder).dome.cameras) == 2


def test_read_capture__a_faulty_camera_is_not_called_inside(capture_folder):
    record = dome(capture_folder)
    record["cameras"][0]["t"] = "here"
    write(capture_folder, "dome/dome.json", record)
    assert "must be 3 numbers" in only_fault(capture_folder)


def reduced(folder, cameras, lights):
    record = dome(folder)
    record["cameras"], record["lights"] = (
        record["cameras"][:cameras],
        record["lights"][:lights],
    )
    write(folder, "dome/dome.json", record)


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    ["one camera", "one light", "open mesh", "two components", "three triangles"],
)
def test_ingest_capture__extreme_captures_go_through(capture_folder, tmp_path, kind):
    vertices, faces = half_sphere()
    if kind == "one camera":
        reduced(capture_folder, 1, 4)
    elif kind == "one light":
        reduced(capture_folder, 2, 1)
    elif kind == "open mesh":
        faces = faces[np.hypot(*vertices[faces].mean(axis=1)[:, :2].T) > 25]
    elif kind == "two components":
        faces = np.concatenate([faces, faces + len(vertices)])
        vertices = np.concatenate([vertices, 0.3 * vertices + [200, 0, 0]])
    else:
        vertices = np.array(
            [[0, 0, RADIUS], [30, 0, 70], [-15, 30, 70], [-15, -30, 70]]
        )
        faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1]])
        record = json.loads((capture_folder / "capture.json").read_text())
        for key in ("landmarks", "regions", "contact"):
            record.pop(key)
        write(capture_folder, "capture.json", record)
    if kind not in ("one camera", "one light"):
        put_scan(capture_folder, vertices, faces)
    if kind == "open mesh":
        put_landmarks(capture_folder, {"chin": FACE["chin"]})
    db = Database(tmp_path / "db")
    record = ingest_take(db, capture_folder, spacing_mm=6.0, photographs=0)
    take = db.read("capture", "T001")
    known = np.isfinite(take["samples"]["reflectance_sample"].values).all(-1)
    assert known.any(axis=(1, 2)).mean() > 0.3
    report = record.provenance["cleaning"]
    assert report["open_loops"] == (2 if kind == "open mesh" else 1)
    if kind == "two components":
        assert report["island_faces"] == len(faces) // 2


def test_read_capture__crops_after_the_whole_was_judged(capture_folder):
    put_landmarks(capture_folder, FACE)
    whole = read_capture(capture_folder)
    # smaller than any scan may be
    patch = read_capture(capture_folder, crop=Crop((-8, -8, 0), (8, 8, 99)))
    assert 0 < len(patch.surface.faces) < 40
    assert np.abs(patch.surface.vertices[:, :2]).max() <= 8
    assert patch.surface.report["cropped_faces"] == len(whole.scan.faces) - len(
        patch.surface.faces
    )
    near = read_capture(capture_folder, crop=Crop(reach_mm=30.0)).surface.vertices
    gap = np.linalg.norm(near[:, None] - np.array([*FACE.values()]), axis=2).min(axis=1)
    assert 28 < gap.max() <= 30


def test_read_capture__crop_that_leaves_nothing_or_lacks_landmarks(capture_folder):
    with pytest.raises(
        InputError,
        match=r"the crop must leave a part.*0 of .*the scan reaches from -80 -80 -",
    ):
        read_capture(capture_folder, crop=Crop(low=(200, 0, 0)))
    record = json.loads((capture_folder / "capture.json").read_text())
    record.pop("landmarks")
    write(capture_folder, "capture.json", record)
    with pytest.raises(
        InputError, match=r"\[landmarks\]: a crop around the landmarks needs landmarks"
    ):
        read_capture(capture_folder, crop=Crop(reach_mm=30.0))


def test_ingest_capture__crop_is_in_the_provenance(capture_folder, tmp_path):
    db = Database(tmp_path / "db")
    record = ingest_take(
        db, capture_folder, spacing_mm=6.0, photographs=0, crop=Crop(low=(-99, 0, -99))
    )
    assert record.provenance["parameters"]["crop"]["low"] == [-99, 0, -99]
    assert record.provenance["cleaning"]["cropped_faces"] > 100
    assert (
        db.read("capture", "T001")["surfels"]["surfel_position"].values[:, 1].min() > -2
    )


@pytest.mark.parametrize("spacing", [6.0, 2.5])
def test_transferred_landmarks__lie_on_the_surface_of_the_surfels(
    capture_folder, spacing
):
    """Clicked 0, 1, 2 .. mm beside the sphere: that is the distance, and what is stored
    lies on the surface.
    """
    lifts = dict(zip(FACE, np.arange(len(FACE)) * 0.7, strict=True))
    put_landmarks(
        capture_folder,
        {name: p * (1 + lifts[name] / RADIUS) for name, p in FACE.items()},
    )
    capture = read_capture(capture_folder)
    surfels = build_surfels(capture, spacing_mm=spacing)
    position, distance = transferred_landmarks(capture, surfels)
    # mm, of the scan's chords: 5 mm on a sphere of 80 mm are 0.04 to 0.1 mm below it at
    # their middle
    sag = 0.13
    np.testing.assert_allclose(distance, list(lifts.values()), atol=sag)
    _, _, gap = closest_on_mesh(surfels.position, surfels.faces, position)
    np.testing.assert_allclose(gap, 0, atol=1e-9)
    # subdivision moves points along the surface by less than a tenth of a side of the scan
    expected = np.array([*FACE.values()])
    expected *= np.linalg.norm(position, axis=1, keepdims=True) / RADIUS
    assert np.linalg.norm(position - expected, axis=1).max() < 0.4


@pytest.mark.parametrize("below", [1.0, 4.0, 8.0, 30.0])
def test_transferred_landmarks__cropped_away_are_nan(capture_folder, below):
    """Cut that far above the nose: never carried to the cut edge, though that is within
    the reach of landmarks.
    """
    put_landmarks(capture_folder, FACE)
    capture = read_capture(
        capture_folder, crop=Crop(low=(-99, FACE["nose_tip"][1] + below, -99))
    )
    position, distance = transferred_landmarks(
        capture, build_surfels(capture, spacing_mm=6.0)
    )
    # mm, of the scan's chords; what is farther from the cut scan was on a triangle that
    # is gone
    sag = 0.13
    given = np.array([*FACE.values()])
    away = np.linalg.norm(position - given, axis=1)
    # 0.5 mm, and what subdivision moves points along the surface
    assert away[np.isfinite(away)].max() < 0.7
    np.testing.assert_array_equal(np.isnan(away), distance > 0.5 + sag)
    assert np.isnan(away)[list(FACE).index("nose_tip")]
    assert np.isfinite(away).any()


def test_transferred_landmarks__clicked_beside_the_scan_stay_where_they_are_not_cropped(
    capture_folder,
):
    put_landmarks(
        capture_folder, {name: p * (1 + 6 / RADIUS) for name, p in FACE.items()}
    )
    capture = read_capture(capture_folder, crop=Crop(low=(-99, -99, -99)))
    position, distance = transferred_landmarks(
        capture, build_surfels(capture, spacing_mm=6.0)
    )
    assert np.isfinite(position).all()
    np.testing.assert_allclose(distance, 6, atol=0.13)


def test_site_positions__lie_on_the_surface_though_the_landmark_was_clicked_beside_it(
    capture_folder,
):
    lifted = FACE | {"forehead_centre": FACE["forehead_centre"] * (1 + 6 / RADIUS)}
    put_landmarks(capture_folder, lifted)
    capture = read_capture(capture_folder)
    surfels = build_surfels(capture, spacing_mm=6.0)
    (place,) = site_positions(capture, surfels, ("forehead",))
    np.testing.assert_allclose(
        closest_on_mesh(surfels.position, surfels.faces, place[None])[2], 0, atol=1e-9
    )
    assert np.linalg.norm(place - lifted["forehead_centre"]) == pytest.approx(
        6, abs=0.4
    )


def test_site_positions__where_the_scan_was_cropped_away_the_landmark_counts_as_given(
    capture_folder,
):
    put_landmarks(capture_folder, FACE)
    capture = read_capture(capture_folder, crop=Crop(high=(99, 20, 99)))
    (place,) = site_positions(
        capture, build_surfels(capture, spacing_mm=6.0), ("forehead",)
    )
    np.testing.assert_array_equal(place, FACE["forehead_centre"])


def test_read_capture__landmarks_on_a_smaller_piece_of_the_scan(capture_folder):
    """A second, larger object in the scan: it would be kept, and the face with its
    landmarks removed.
    """
    vertices, faces = half_sphere()
    other = 1.2 * vertices + [400, 0, 0]
    put_scan(
        capture_folder,
        np.concatenate([vertices, other]),
        np.concatenate([faces, faces + len(vertices)]),
    )
    (capture_folder / "regions.json").write_text("{}")
    put_landmarks(capture_folder, FACE)
    rule = r"largest component of the scan, which is kept; found \d+\.\d mm away"
    with pytest.raises(InputError, match=f"{rule}; .* remove from the scan") as caught:
        read_capture(capture_folder)
    assert len(caught.value.faults) == len(FACE)


def test_read_capture__a_file_without_landmarks_is_told(capture_folder):
    put_landmarks(capture_folder, {})
    assert any(
        line.startswith("landmarks: none in the file")
        for line in read_capture(capture_folder).skipped
    )


def test_ingest_capture__what_no_light_and_camera_reach_is_not_committed(
    capture_folder, tmp_path
):
    """A crop beside the face in the pictures: the rim of the half sphere, which no
    camera sees steeply.
    """
    db = Database(tmp_path / "db")
    with pytest.raises(
        InputError,
        match=r"samples: a surfel must be lit .*; found none is; check the crop",
    ):
        ingest_take(
            db,
            capture_folder,
            crop=Crop(low=(-99, -99, -99), high=(99, -74, 99)),
            spacing_mm=4.0,
        )
    assert db.takes("capture") == []


@pytest.mark.parametrize(("part", "noted"), [(0.5, True), (0.8, False)])
def test_ingest_capture__pixels_wider_than_the_spacing_are_noted(
    capture_folder, tmp_path, part, noted
):
    camera = read_capture(capture_folder).dome.cameras[0]
    spacing = part * camera.pixel_width(np.zeros(3))
    record = ingest_take(Database(tmp_path / "db"), capture_folder, spacing_mm=spacing)
    notes = record.provenance["summary"]["notes"]
    assert noted == any("values of surfels are means over" in note for note in notes)


def test_ingest_capture__a_database_is_not_kept_in_the_capture(capture_folder):
    for root in (capture_folder, capture_folder / "dome" / "db"):
        with pytest.raises(
            InputError, match="a database lies outside the captures it holds"
        ):
            ingest_take(Database(root), capture_folder)


def test_ingest_capture__a_spacing_wider_than_the_scan_is_told(
    capture_folder, tmp_path
):
    record = ingest_take(Database(tmp_path / "db"), capture_folder, spacing_mm=1000.0)
    summary = record.provenance["summary"]
    (note,) = summary["notes"]
    assert "a wider spacing leaves the scan unchanged" in note
    vertices, faces = half_sphere()
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert summary["surfels"]["count"] == len(vertices)
    assert summary["surfels"]["spacing_mm"] == pytest.approx(
        np.sqrt(area / len(vertices) * 2 / np.sqrt(3)), rel=1e-6
    )


BOX = {"low": [-8, -8, 0], "high": [8, 8, 99]}


def test_read_capture__crops_by_the_box_beside_the_landmarks(capture_folder):
    by_option = read_capture(capture_folder, crop=Crop((-8, -8, 0), (8, 8, 99)))
    (capture_folder / "landmarks.crop.json").write_text(json.dumps(BOX))
    by_file = read_capture(capture_folder)
    assert by_file.crop == by_option.crop
    np.testing.assert_array_equal(by_file.surface.vertices, by_option.surface.vertices)
    # part of the digest of the inputs
    assert capture_folder / "landmarks.crop.json" in by_file.json_files
    assert any("landmarks.crop.json" in line for line in by_file.skipped)
    near = read_capture(capture_folder, crop=Crop(reach_mm=30.0))
    assert near.crop == Crop(reach_mm=30.0)  # an option has priority over the file


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "must be"),
        ("[]", "a crop box must be"),
        ('{"low": [1, 2], "high": [3, 4, 5]}', "a crop box must be"),
        ('{"low": [1, 1, 1], "high": [0, 0, 0]}', "lower corner must lie below"),
        (
            '{"low": [900, 900, 900], "high": [901, 901, 901]}',
            "must leave a part of the scan",
        ),
    ],
)
def test_read_capture__refuses_a_wrong_crop_file(capture_folder, content, message):
    (capture_folder / "landmarks.crop.json").write_text(content)
    with pytest.raises(InputError, match=message):
        read_capture(capture_folder)


def test_read_capture__refuses_a_crop_file_outside_the_folder(capture_folder, tmp_path):
    (tmp_path / "elsewhere.json").write_text(json.dumps(BOX))
    (capture_folder / "landmarks.crop.json").symlink_to(tmp_path / "elsewhere.json")
    with pytest.raises(
        InputError, match="every path must stay inside the capture folder"
    ):
        read_capture(capture_folder)
