"""The page in which landmarks are set on a scan, and its files."""

import hashlib
import html
import json
import os
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from skindb.errors import Fault, require, require_none
from skindb.format.fields import read_json
from skindb.format.scan_checks import (
    coincidence_faults,
    crop_path,
    face_faults,
    is_point,
    order_faults,
    parsed_crop,
    swapped_faults,
)
from skindb.geometry.clean import CleanMesh, clean_mesh
from skindb.geometry.landmarks import MEAN_FACE, suggest_landmarks
from skindb.geometry.mesh import closest_on_mesh, vertex_normals
from skindb.geometry.scan import Crop, Scan, read_scan
from skindb.limits import MAX_JSON_BYTES
from skindb.types import Float64
from skindb.view.page import HTML, Content, PageServer, embedded_json, page_text

Points = Mapping[str, Float64]
# clicks are on the surface; single precision and rounding cause errors of 0.001
MAX_OFF_SURFACE_MM = 1.0
DECIMALS = 3  # of coordinates [mm] in the file
SCRIPTS = (  # the first of them are those of the viewer
    "session",
    "page/matrix",
    "page/gpu",
    "page_landmarks/shaders",
    "page_landmarks/scan",
    "page_landmarks/controls",
    "page_landmarks/main",
)
PLACES = {
    "forehead_centre": "In the middle of the forehead, halfway between the brows and the hairline.",
    "nasion": "The deepest point of the bridge of the nose, between the eyes.",
    "nose_tip": "The foremost point of the nose.",
    "subnasale": "Where the partition between the nostrils meets the upper lip, in the middle.",
    "lip_upper": "The middle of the red of the upper lip.",
    "chin": "The foremost point of the chin, in the middle.",
    "forehead": "Above the outer third of the brow, slightly below the middle of the forehead.",
    "brow": "The highest point of the brow.",
    "ala": "The outermost point of the wing of the nose.",
    "eye_outer": "The outer corner of the eye, where the lids meet.",
    "eye_inner": "The inner corner of the eye, where the lids meet.",
    "mouth_corner": "The corner of the mouth, where the lips meet.",
    "jaw": "The corner of the lower jaw, below the ear.",
}


@dataclass(frozen=True)
class LandmarkTask:
    """A scan whose landmarks are to be set, with the contents of existing files."""

    scan_path: Path
    out: Path  # landmarks.json
    scan: Scan
    surface: CleanMesh  # the part of the scan that ingest keeps
    points: Points  # landmarks in the file [mm]
    crop: Crop | None

    @property
    def names(self) -> list[str]:
        """The 20 standard names, then other names in the file."""
        return [*MEAN_FACE, *(name for name in self.points if name not in MEAN_FACE)]


def landmark_task(scan_path: Path, out: Path) -> LandmarkTask:
    """Read a scan, and the files of its landmarks and its crop box if they exist.

    Raises
    ------
    InputError
        If the scan or one of the files cannot be read, or the folder of `out` does not exist.
    """
    require(
        out.parent.is_dir(),
        str(out),
        "its folder must exist",
        "none",
        f"create {out.parent}",
    )
    scan = read_scan(scan_path)
    surface = clean_mesh(scan.vertices, scan.faces)
    return reread_task(LandmarkTask(scan_path, out, scan, surface, {}, None))


def reread_task(task: LandmarkTask) -> LandmarkTask:
    """The task with the present contents of its files, which the page may have saved since.

    Raises
    ------
    InputError
        If one of the files cannot be read.
    """
    stored = _existing(task.out)
    box = _existing(crop_path(task.out))
    crop = None if not box else parsed_crop(box, str(crop_path(task.out)))
    return replace(task, points=parsed_points(stored, str(task.out)), crop=crop)


def _existing(path: Path) -> Any:
    if not path.exists():
        return {}
    faults = list[Fault]()
    stored = read_json(path, faults)
    require_none(faults)
    return stored


def parsed_points(value: Any, file: str) -> dict[str, Float64]:
    """Positions (3,) [mm] by name from JSON.

    Raises
    ------
    InputError
        If the value is not an object, or a position is not three finite numbers.
    """
    require(
        isinstance(value, dict),
        file,
        "must be a JSON object {name: [x, y, z]}",
        type(value).__name__,
        "correct it",
    )
    rule = "a landmark must be [x, y, z] in mm"
    cure = "correct it, or remove it"
    wrong = [
        Fault(f"{file}[{name}]", rule, str(p), cure)
        for name, p in value.items()
        if not is_point(p)
    ]
    require_none(wrong)
    return {name: np.array(p, float) for name, p in value.items()}


def landmark_mistakes(
    task: LandmarkTask, points: Points, crop: Crop | None
) -> list[Fault]:
    """Faults of landmarks: unknown names, positions off the surface, and everything
    that ingest would refuse.
    """
    file = str(task.out)
    if not points:
        return [
            Fault(
                file,
                "at least one landmark must be set",
                "none",
                "click a point on the scan",
            )
        ]
    unknown = [name for name in points if name not in task.names]
    if unknown:
        rule = "the name of a landmark must be in the list"
        return [
            Fault(f"{file}[{name}]", rule, "another name", "choose a name of the list")
            for name in unknown
        ]
    place = np.array([*points.values()])
    distance = closest_on_mesh(task.surface.vertices, task.surface.faces, place)[2]
    rule = (
        f"a landmark must be within {MAX_OFF_SURFACE_MM:g} mm of the scan, of which the "
        "largest component is kept"
    )
    faults = [
        Fault(f"{file}[{name}]", rule, f"a distance of {d:.1f} mm", "set it again")
        for name, d in zip(points, distance, strict=True)
        if d > MAX_OFF_SURFACE_MM
    ] + _outside(file, points, crop)
    return (
        faults
        or coincidence_faults(file, points)
        or [*face_faults(file, points), *order_faults(file, points)]
        or swapped_faults(file, points, task.surface)
    )


def _outside(file: str, points: Points, crop: Crop | None) -> list[Fault]:
    if crop is None or crop.low is None or crop.high is None:
        return []
    out = [
        name
        for name, p in points.items()
        if (p < crop.low).any() or (p > crop.high).any()
    ]
    rule = "a landmark must be inside the crop box"
    cure = "enlarge the box, or move the point"
    return [Fault(f"{file}[{name}]", rule, "a point outside", cure) for name in out]


def open_questions(task: LandmarkTask, points: Points, *, seen: str) -> list[str]:
    """Questions that a person has to confirm before the landmarks are saved.

    Parameters
    ----------
    task, points
        The task and the landmarks to be saved.
    seen
        Digest of the file that `save_landmarks` returned when this page last wrote it;
        "" if it has not.
    """
    missing = [name for name in MEAN_FACE if name not in points]
    questions = []
    if missing:
        number = (
            f"{len(missing)} of the {len(MEAN_FACE)} points "
            f"{'is' if len(missing) == 1 else 'are'} missing"
        )
        questions.append(f"{number}: {', '.join(missing)}.")
    if task.out.exists() and _digest(task.out.read_bytes()) != seen:
        questions.append(f"{task.out} exists and will be replaced.")
    return questions


def save_landmarks(task: LandmarkTask, points: Points, crop: Crop | None) -> str:
    """Write the landmarks and the crop box, and return a digest of the file of landmarks.

    Without a crop box, its file is removed. Files are replaced atomically.
    """
    content = {
        name: np.round(points[name], DECIMALS).tolist()
        for name in task.names
        if name in points
    }
    box = crop_path(task.out)
    if crop is None:
        box.unlink(missing_ok=True)
    else:
        _replace(box, json.dumps({"low": crop.low, "high": crop.high}, indent=1) + "\n")
    text = json.dumps(content, indent=1, allow_nan=False) + "\n"
    _replace(task.out, text)
    return _digest(text.encode())


def _digest(content: bytes) -> str:
    return hashlib.sha256(content[: MAX_JSON_BYTES + 1]).hexdigest()


def _replace(path: Path, text: str) -> None:
    number, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(number, "w", encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
        Path(name).replace(path)
    except BaseException:
        with suppress(OSError):
            Path(name).unlink()
        raise


def place_sentence(name: str) -> str:
    """Description of the place of a landmark; for unknown names, that the point is from
    the file.
    """
    side = next((side for side in ("right", "left") if name.endswith(f"_{side}")), "")
    sentence = PLACES.get(name.removesuffix(f"_{side}") if side else name)
    if sentence is None:
        return "A point from the file that is not one of the 20 landmarks."
    return f"{sentence} On the subject's {side}." if side else sentence


def landmark_server(task: LandmarkTask, *, port: int = 0) -> PageServer:
    """Server of the page, which is not yet running; port 0 chooses a free port.

    Raises
    ------
    InputError
        If the port is taken.
    """
    mesh = _mesh(task)
    contents = {
        "": Content(HTML, lambda: _page(reread_task(task)).encode()),
        "mesh": Content("application/octet-stream", lambda: mesh),
    }
    return PageServer(
        contents,
        {"suggest": partial(_suggest, task), "save": partial(_save, task)},
        port=port,
    )


def _suggest(task: LandmarkTask, request: dict[str, Any]) -> dict[str, Any]:
    suggestions = suggest_landmarks(
        task.scan.vertices,
        task.scan.faces,
        parsed_points(request.get("points"), "points"),
    )
    return {"points": {name: p.tolist() for name, p in suggestions.items()}}


def _save(task: LandmarkTask, request: dict[str, Any]) -> dict[str, Any]:
    """Save the landmarks, unless there are faults or questions that are not yet
    confirmed, and describe the result.
    """
    points = parsed_points(request.get("points"), "points")
    crop = (
        None
        if request.get("crop") is None
        else parsed_crop(request["crop"], "crop box")
    )
    require_none(landmark_mistakes(task, points, crop))
    confirmed = request.get("confirmed")
    questions = open_questions(task, points, seen=str(request.get("seen", "")))
    if any(
        not isinstance(confirmed, list) or question not in confirmed
        for question in questions
    ):
        return {"questions": questions}
    seen = save_landmarks(task, points, crop)
    text = (
        f"{len(points)} {'point was' if len(points) == 1 else 'points were'} saved in "
        f"{task.out}."
    )
    return {
        "saved": text + (f" The crop box is in {crop_path(task.out)}." if crop else ""),
        "seen": seen,
    }


def _mesh(task: LandmarkTask) -> bytes:
    """Bytes of positions and normals (float32), triangles (uint32) and colours (uint8),
    in this order.
    """
    vertices = task.scan.vertices
    faces = task.scan.faces
    normal = np.nan_to_num(vertex_normals(vertices, faces))
    parts = [vertices.astype("<f4"), normal.astype("<f4"), faces.astype("<u4")]
    return b"".join(part.tobytes() for part in parts) + (
        b"" if task.scan.colours is None else task.scan.colours.tobytes()
    )


def _page(task: LandmarkTask) -> str:
    box = task.crop
    task_record = {
        "vertices": len(task.scan.vertices),
        "faces": len(task.scan.faces),
        "colours": task.scan.colours is not None,
        "names": {name: place_sentence(name) for name in task.names},
        "points": {name: p.tolist() for name, p in task.points.items()},
        "crop": None if box is None else {"low": box.low, "high": box.high},
    }
    parts = {
        "scan": html.escape(task.scan_path.name),
        "out": html.escape(str(task.out)),
        "about": embedded_json(task_record),
    }
    return page_text("page_landmarks", [f"{name}.js" for name in SCRIPTS], parts)
