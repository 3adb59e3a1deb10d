"""Geometry of a laboratory: cameras from pictures of a board, and scans in the frame of the
dome.
"""

import json
import os
import tempfile
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from scipy.spatial.transform import Rotation

from skindb.calibration.boards import calibrate_cameras as boards_to_cameras
from skindb.calibration.boards import read_boards, with_cameras
from skindb.calibration.setup import read_setup_dome
from skindb.errors import Fault, choices, require, require_none
from skindb.files import Json, make_private, private_file
from skindb.format.fields import Fields, read_json
from skindb.format.folder import read_capture
from skindb.geometry.scan import Scan, read_scan
from skindb.geometry.scan_pose import moved, rigid, scan_pose
from skindb.ingest.capture import ingest_capture
from skindb.parameters import IngestParameters
from skindb.schema import variables
from skindb.types import Array, Float64, Progress, float64, silent

ROUNDS = (
    3  # of the comparison with the photographs, each of which starts at the last pose
)
CHECK = IngestParameters(
    spacing_mm=4.0, photographs=0, calibration="note", refine=False
)
# folder inside the capture, so that what a killed run leaves is deleted with it
LINKS = ".scan-"
KEYS = ("mesh", "landmarks")  # of capture.json
FILES = ("scan.ply", "landmarks.json")


def calibrate_cameras(folder: Path, out: Path) -> Json:
    """Write a dome.json with cameras that pictures of a board calibrate, see
    `skindb.calibration.boards`.

    Parameters
    ----------
    folder
        Set-up folder with dome/boards.json and its pictures. Of a dome.json beside it,
        everything but size, matrices and distortion of these cameras is kept.
    out
        New file.

    Returns
    -------
    dict
        By camera: rms_px of its corners, number of poses, and standard errors
        focal_error_px, turn_error_degrees, position_error_mm.

    Raises
    ------
    InputError
        If the file exists or a picture or camera is faulty.
    """
    require(not out.exists(), str(out), "must be a new file", "one", "choose another")
    record, report = measured_cameras(folder)
    _dump(out, record)
    return report


def measured_cameras(folder: Path) -> tuple[Json, Json]:
    """The content of a dome.json, and the errors by camera, of `calibrate_cameras`."""
    faults = list[Fault]()
    before = folder / "dome/dome.json"
    record = read_json(before, faults) if before.is_file() else {}
    require_none(faults)
    boards = read_boards(folder)
    cameras = boards_to_cameras(boards)
    report = {
        name: {
            "rms_px": one.rms,
            "poses": one.poses,
            "focal_error_px": float(one.errors[:2].max()),
            "turn_error_degrees": float(np.degrees(one.errors[9:12].max())),
            "position_error_mm": float(np.linalg.norm(one.errors[12:])),
        }
        for name, one in cameras.items()
    }
    return with_cameras(record, boards, cameras), report


def write_geometry(folder: Path, record: Json, positions: xr.Dataset) -> None:
    """Replace the dome.json of a set-up by one with calibrated cameras and lights, which face
    the origin. One that had cameras is kept as dome.1.json, dome.2.json, ...
    """
    places = positions[variables.CALIBRATED_POSITION]
    lights = [
        {key: light[key] for key in light if key not in ("axis", "direction")}
        | {"position": places.sel(light=light["id"]).values.tolist()}
        for light in record["lights"]
    ]
    file = folder / "dome/dome.json"
    before = file.read_bytes()
    if any("K" in camera for camera in json.loads(before)["cameras"]):
        names = (file.with_suffix(f".{number}.json") for number in count(1))
        kept = next(name for name in names if not name.exists())
        private_file(kept).write_bytes(before)
    temporary = file.with_suffix(".new")
    _dump(temporary, record | {"lights": lights})
    temporary.replace(file)


def register_scan(
    scan: Path,
    landmarks: Path,
    seen: Path,
    capture: Path,
    out: Path,
    *,
    progress: Progress = silent,
) -> Json:
    """Write a scan and its landmarks in mm in the frame of a dome.

    The pose is that for which the landmarks appear where they are seen in the photographs;
    then the photographs are compared with the scan at this pose, as ingest does.

    Parameters
    ----------
    scan, landmarks
        Mesh (.ply, .obj) and JSON file {name: [x, y, z]}, in the same unit and frame.
    seen
        JSON file {camera: {name: [column, row]}} with pixels of photographs.
    capture
        Capture folder with the dome and the photographs; its own scan is not used.
    out
        New folder for scan.ply, landmarks.json and pose.json.
    progress
        Called with the stage, the number of finished steps and the total number of steps.

    Returns
    -------
    dict
        unit, matrix (4, 4), landmarks_px (distance by camera and landmark), rms_px, and
        by the photographs the last shift_mm and turn_degrees, None if they show too little
        of the face.

    Raises
    ------
    InputError
        If a file is faulty, or the landmarks do not determine the pose.
    """
    faults = []
    if taken := [name for name in (*FILES, "pose.json") if (out / name).exists()]:
        cure = "choose another folder"
        faults.append(Fault(str(out), "must not hold them", ", ".join(taken), cure))
    dome = read_setup_dome(capture, white=False, dark=False)
    points = _points(landmarks, faults)
    fields = Fields(read_json(seen, faults), str(seen), faults)
    pixels: dict[tuple[str, str], Array] = {}
    for camera in fields.data:
        item = fields.object(camera)
        if camera not in dome.camera_ids:
            fields.fault(camera, "must be a camera of the dome", camera)
        for name in set(item.data) - set(points):
            item.fault(
                name, "must be a landmark of the scan", name, choices(name, points)
            )
        pixels |= {(camera, name): item.array(name, (2,)) for name in item.data}
    require_none(faults)
    mesh = read_scan(scan)
    pose = scan_pose(points, pixels, {camera.id: camera for camera in dome.cameras})
    matrix = pose.matrix
    shift = turn = None
    with tempfile.TemporaryDirectory(dir=capture, prefix=LINKS) as folder:
        copy = Path(folder) / "capture"
        for file in _without_scan(capture):
            target = copy / file.relative_to(capture)
            make_private(target.parent)
            os.link(file, target)
        for i in range(ROUNDS):
            progress("comparison with the photographs", i, ROUNDS)
            _write(copy, mesh, points, matrix)
            _dump(
                copy / "capture.json",
                _record(capture) | dict(zip(KEYS, FILES, strict=True)),
            )
            with ingest_capture(read_capture(copy), CHECK, scratch=folder) as tree:
                found = _correction(tree)
            if found is None:
                break
            correction, shift, turn = found
            matrix = correction @ matrix
    make_private(out)
    _write(out, mesh, points, matrix)
    distances = {f"{c} {name}": px for (c, name), px in pose.residuals.items()}
    report = {
        "unit": pose.unit,
        "matrix": matrix.tolist(),
        "landmarks_px": distances,
        "rms_px": float(np.sqrt(np.mean(np.square(list(distances.values()))))),
        "shift_mm": shift,
        "turn_degrees": turn,
    }
    _dump(out / "pose.json", report)
    return report


def _points(path: Path, faults: list[Fault]) -> dict[str, Float64]:
    fields = Fields(read_json(path, faults), str(path), faults)
    return {name: fields.array(name, (3,)) for name in fields.data}


def _record(capture: Path) -> Json:
    """The content of capture.json."""
    faults = list[Fault]()
    record = read_json(capture / "capture.json", faults)
    require_none(faults)
    return dict(record)


def _without_scan(capture: Path) -> list[Path]:
    """Files of a capture except those that are written again."""
    record = _record(capture)
    names = {"capture.json", *FILES, *(str(record.get(key)) for key in KEYS)}
    return [
        file
        for file in capture.rglob("*")
        if file.is_file()
        and not (relative := str(file.relative_to(capture))).startswith(LINKS)
        and relative not in names
    ]


def _write(folder: Path, scan: Scan, points: dict[str, Float64], matrix: Array) -> None:
    """Write the moved scan and landmarks."""
    from trimesh import Trimesh  # takes longer to import than most commands run

    mesh = Trimesh(
        moved(matrix, scan.vertices),
        scan.faces,
        vertex_colors=scan.colours,
        process=False,
    )
    mesh.export(private_file(folder / FILES[0]))
    marks = {name: moved(matrix, point).tolist() for name, point in points.items()}
    _dump(folder / FILES[1], marks)


def _dump(path: Path, content: Any) -> None:
    private_file(path).write_text(json.dumps(content, indent=1), encoding="utf-8")


def _correction(tree: xr.DataTree) -> tuple[Float64, float, float] | None:
    """Matrix (4, 4) that moves the scan to where the photographs show it, and its shift in
    mm and turn in degrees; None if they show too little of the face.
    """
    calibration = tree["calibration"].dataset
    shift = calibration[variables.SCAN_TRANSLATION_ERROR].values
    angles = calibration[variables.SCAN_ROTATION_ERROR].values
    if not np.isfinite([*shift, *angles]).all():
        return None
    surfels = tree["surfels"].dataset
    middle = float64(surfels[variables.SURFEL_POSITION].values).mean(axis=0)
    turn = Rotation.from_rotvec(angles, degrees=True)
    matrix = rigid(turn, middle + shift - turn.apply(middle))
    return matrix, float(np.linalg.norm(shift)), float(np.linalg.norm(angles))
