"""Scans and domes of different units are refused with one line; patches, people and odd
cameras are not.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from sphere import RADIUS, half_sphere

from skindb.errors import InputError
from skindb.format.scan_checks import dome_unit_faults
from skindb.geometry.clean import CleanMesh, clean_mesh
from skindb.ingest import read_capture

OTHERS = {  # mm to this unit, and what is said of it
    0.1: "centimetres: multiply by 10",
    1 / 25.4: "inches: multiply by 25.4",
    1e-3: "metres: multiply by 1000",
    10: "tenths of a millimetre: divide by 10",
    1000: "micrometres: divide by 1000",
}


def edit(folder, name, change):
    record = json.loads((folder / name).read_text())
    change(record)
    (folder / name).write_text(json.dumps(record))


def without(folder, *keys):
    edit(folder, "capture.json", lambda record: [record.pop(key, None) for key in keys])


def scale_dome(folder, factor):
    def change(record):
        for camera in record["cameras"]:
            camera["t"] = [factor * x for x in camera["t"]]
        for light in record["lights"]:
            light["position"] = [factor * x for x in light["position"]]

    edit(folder, "dome/dome.json", change)


def put_scan(folder, vertices, faces):
    trimesh.Trimesh(vertices, faces, process=False).export(folder / "scan.ply")


def patch(reach: float, *, towards=(0.5, 0.3, 0.8)) -> CleanMesh:
    """What of the sphere lies as near to the point in that direction, mm."""
    vertices, faces = half_sphere()
    middle = RADIUS * np.array(towards) / np.linalg.norm(towards)
    near = np.linalg.norm(vertices - middle, axis=1) < reach
    return clean_mesh(vertices, faces, keep=near[faces].all(axis=1))


def only_fault(folder):
    with pytest.raises(InputError) as caught:
        read_capture(folder)
    (fault,) = caught.value.faults
    return str(fault)


@pytest.mark.parametrize("factor", OTHERS)
def test_read_capture__dome_of_another_unit_is_one_fault(capture_folder, factor):
    """Cameras and lights alike, as a calibration in that unit has them; they stand 400 mm away."""
    scale_dome(capture_folder, factor)
    fault = only_fault(capture_folder)
    assert "dome.json: lengths must be in mm, and " in fault
    assert f"these look like {OTHERS[factor]}" in fault


def test_read_capture__scan_in_centimetres_without_names_is_a_fault(capture_folder):
    vertices, faces = half_sphere()
    put_scan(capture_folder, vertices / 10, faces)
    without(capture_folder, "landmarks", "regions", "contact")
    fault = only_fault(capture_folder)
    assert "scan.ply (mesh): lengths must be in mm, and a head must span" in fault
    assert fault.endswith("these look like centimetres: multiply by 10")


def test_read_capture__scan_and_dome_in_centimetres_are_told_by_the_regions(
    capture_folder,
):
    """Both alike are a smaller dome: only the names on the face have a size."""
    vertices, faces = half_sphere()
    put_scan(capture_folder, vertices / 10, faces)
    scale_dome(capture_folder, 0.1)
    without(capture_folder, "landmarks", "contact")
    # a dome of 50 mm around a fingertip, for all that is known
    assert read_capture(capture_folder).dome is not None
    chin = np.flatnonzero(vertices[:, 1] < -50).tolist()
    edit(capture_folder, "regions.json", lambda record: record.update(chin=[chin]))
    fault = only_fault(capture_folder)
    assert "regions.json: lengths must be in mm, and a face must be" in fault
    assert fault.endswith("centimetres: multiply by 10, also for the scan")


@pytest.mark.parametrize("factor", [0.1, 1 / 25.4, 1e-3, 1000])
@pytest.mark.parametrize("part", ["cameras", "lights"])
def test_read_capture__cameras_or_lights_of_another_unit_are_one_fault(
    capture_folder, factor, part
):
    kept = json.loads((capture_folder / "dome/dome.json").read_text())
    scale_dome(capture_folder, factor)
    other = "lights" if part == "cameras" else "cameras"
    edit(
        capture_folder,
        "dome/dome.json",
        lambda record: record.update({other: kept[other]}),
    )
    fault = only_fault(capture_folder)
    assert "dome.json" in fault
    assert "in mm" in fault


@pytest.fixture
def dome(pristine):
    return read_capture(pristine).dome


def judged(dome, surface, *, sized=False):
    """The fault, or None."""
    faults = dome_unit_faults("dome.json", dome, "scan", surface, sized=sized)
    return next(iter(faults), None)


@pytest.mark.parametrize("reach", [12.0, 20.0, 40.0])
@pytest.mark.parametrize("centred", [False, True])
def test_dome_unit_faults__a_patch_of_skin_passes(dome, reach, centred):
    """Cut from the face where it lies, or a sample held into the middle of the dome."""
    surface = patch(reach)
    if centred:
        surface = replace(
            surface, vertices=surface.vertices - surface.vertices.mean(axis=0)
        )
    assert judged(dome, surface) is None
    # less than a tenth of every picture
    assert judged(further(dome, 4), surface) is None


def further(dome, factor):
    cameras = tuple(replace(camera, t=factor * camera.t) for camera in dome.cameras)
    return replace(
        dome,
        cameras=cameras,
        lights=tuple(replace(x, position=factor * x.position) for x in dome.lights),
    )


def test_dome_unit_faults__a_face_that_spans_a_ninth_of_the_pictures_passes_a_patch_far_less(
    dome,
):
    vertices, faces = half_sphere()
    assert judged(further(dome, 8.5), clean_mesh(vertices, faces)) is None
    assert judged(further(dome, 11), clean_mesh(vertices, faces)) is not None
    assert judged(further(dome, 10), patch(20)) is None
    fault = judged(further(dome, 1000), patch(20))
    assert (fault.where, fault.cure) == (
        "dome.json",
        "these look like micrometres: divide by 1000",
    )


def test_dome_unit_faults__a_person_in_a_large_dome_passes(dome):
    vertices, faces = half_sphere()
    assert judged(further(dome, 5), clean_mesh(vertices * [3, 10, 2], faces)) is None


def test_dome_unit_faults__a_nose_whose_landmarks_tell_its_size_passes(dome):
    """Round, in the middle of its frame and small in the pictures as it is: a head in
    centimetres else.
    """
    vertices, faces = half_sphere()
    nose = clean_mesh(vertices / 10, faces)
    afar = further(dome, 2)
    assert judged(afar, nose) is not None
    assert judged(afar, nose, sized=True) is None
    ahead = np.array([0.0, 0, 70])  # where a nose lies in the frame of its head
    assert judged(afar, replace(nose, vertices=nose.vertices + ahead)) is None


def test_dome_unit_faults__a_scan_round_a_camera_is_large_not_unseen(dome):
    """A camera between the ears of an open scan: some of it lies behind, and no
    picture's side measures that.
    """
    vertices, faces = half_sphere()
    rotation = dome.cameras[0].R
    inside = replace(dome.cameras[0], t=-rotation @ np.array([0.0, 0, -1]))
    assert judged(replace(dome, cameras=(inside,)), clean_mesh(vertices, faces)) is None


@pytest.mark.parametrize("how", ["turned away", "aside", "other side"])
def test_dome_unit_faults__no_camera_shows_the_scan(dome, how):
    vertices, faces = half_sphere()
    turn = np.diag([-1.0, 1, -1])
    aside = np.array([500.0 if how == "aside" else -500.0, 0, 0])
    cameras = tuple(
        replace(c, R=turn @ c.R, t=turn @ c.t)
        if how == "turned away"
        else replace(c, t=c.t + aside)
        for c in dome.cameras
    )
    fault = judged(replace(dome, cameras=cameras), clean_mesh(vertices, faces))
    assert str(fault).startswith(
        "dome.json: the picture of a camera must show the scan; found none of 2 "
        "does; calibrate in mm"
    )
    one = (cameras[0], dome.cameras[1])
    assert judged(replace(dome, cameras=one), clean_mesh(vertices, faces)) is None
