"""The page in which landmarks are set on a scan."""

from __future__ import annotations

import html
from functools import partial
from typing import Any

import numpy as np

from skindb.errors import InputError
from skindb.format.crop_file import crop_path, parsed_crop
from skindb.geometry.landmarks import suggest_landmarks
from skindb.geometry.mesh import vertex_normals
from skindb.geometry.scan import Crop
from skindb.view.landmarks import (
    LandmarkTask,
    landmark_mistakes,
    open_questions,
    parsed_points,
    reread_task,
    save_landmarks,
)
from skindb.view.server import HTML, Content, PageServer
from skindb.view.template import embedded_json, page_text

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


def _suggest(task: LandmarkTask, asked: dict[str, Any]) -> dict[str, Any]:
    found = suggest_landmarks(
        task.scan.vertices,
        task.scan.faces,
        parsed_points(asked.get("points"), "points"),
    )
    return {"points": {name: p.tolist() for name, p in found.items()}}


def _save(task: LandmarkTask, asked: dict[str, Any]) -> dict[str, Any]:
    """Save the landmarks, unless there are faults or questions that are not yet
    confirmed, and describe the result.
    """
    points = parsed_points(asked.get("points"), "points")
    crop: Crop | None = (
        None if asked.get("crop") is None else parsed_crop(asked["crop"], "crop box")
    )
    if faults := landmark_mistakes(task, points, crop):
        raise InputError(faults)
    confirmed = asked.get("confirmed")
    questions = open_questions(task, points, seen=str(asked.get("seen", "")))
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
        b"" if task.colours is None else task.colours.tobytes()
    )


def _page(task: LandmarkTask) -> str:
    box = task.crop
    about = {
        "vertices": len(task.scan.vertices),
        "faces": len(task.scan.faces),
        "colours": task.colours is not None,
        "names": {name: place_sentence(name) for name in task.names},
        "points": {name: p.tolist() for name, p in task.points.items()},
        "crop": None if box is None else {"low": box.low, "high": box.high},
    }
    parts = {
        "scan": html.escape(task.scan_path.name),
        "out": html.escape(str(task.out)),
        "about": embedded_json(about),
    }
    return page_text("page_landmarks", [f"{name}.js" for name in SCRIPTS], parts)
