"""The page in which landmarks are set on a scan, and its server, which answers only requests of this machine."""

from __future__ import annotations

import html
import json
from collections.abc import Callable
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any

import numpy as np

from skindb.errors import Fault, InputError, system_fault
from skindb.geometry.crop import Crop
from skindb.geometry.landmark_suggestions import suggest_landmarks
from skindb.geometry.surfels import vertex_normals
from skindb.ingest.crop_file import crop_path, parsed_crop
from skindb.view.landmarks import (
    LandmarkTask,
    landmark_mistakes,
    open_questions,
    parsed_points,
    reread_task,
    save_landmarks,
)
from skindb.view.page import LOCAL, is_local

SHARED_SCRIPTS = ("matrix", "gpu")  # scripts of the viewer that this page also uses
SCRIPTS = ("shaders", "scan", "controls", "main")  # in this order
MAX_REQUEST_BYTES = 1_000_000  # a hundred points take about 20,000
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
    """Description of the place of a landmark; for unknown names, that the point is from the file."""
    side = next((side for side in ("right", "left") if name.endswith(f"_{side}")), "")
    sentence = PLACES.get(name.removesuffix(f"_{side}") if side else name)
    if sentence is None:
        return "A point from the file that is not one of the 20 landmarks."
    return f"{sentence} On the subject's {side}." if side else sentence


def landmark_server(task: LandmarkTask, *, port: int = 0) -> ThreadingHTTPServer:
    """Server of the page at 127.0.0.1, which is not yet running; port 0 chooses a free port.

    Raises
    ------
    InputError
        If the port is taken.
    """
    mesh = _mesh(task)

    class Handler(_Handler):
        pages = {  # noqa: RUF012
            "/": ("text/html; charset=utf-8", lambda: _page(reread_task(task)).encode()),
            "/mesh": ("application/octet-stream", lambda: mesh),
        }
        actions = {"/suggest": lambda asked: _suggest(task, asked), "/save": lambda asked: _save(task, asked)}  # noqa: RUF012

    try:
        return ThreadingHTTPServer((LOCAL, port), Handler)
    except OSError as error:
        cure = "choose another port, or omit --port"
        raise InputError(Fault(f"port {port}", "must be free", error.strerror or str(error), cure)) from None


def _suggest(task: LandmarkTask, asked: dict[str, Any]) -> dict[str, Any]:
    found = suggest_landmarks(task.scan.vertices, task.scan.faces, parsed_points(asked.get("points"), "points"))
    return {"points": {name: p.tolist() for name, p in found.items()}}


def _save(task: LandmarkTask, asked: dict[str, Any]) -> dict[str, Any]:
    """Save the landmarks, unless there are faults or questions that are not yet confirmed, and describe the result."""
    points = parsed_points(asked.get("points"), "points")
    crop: Crop | None = None if asked.get("crop") is None else parsed_crop(asked["crop"], "crop box")
    if faults := landmark_mistakes(task, points, crop):
        raise InputError(faults)
    confirmed = asked.get("confirmed")
    questions = open_questions(task, points, seen=str(asked.get("seen", "")))
    if any(not isinstance(confirmed, list) or question not in confirmed for question in questions):
        return {"questions": questions}
    seen = save_landmarks(task, points, crop)
    text = f"{len(points)} {'point was' if len(points) == 1 else 'points were'} saved in {task.out}."
    return {"saved": text + (f" The crop box is in {crop_path(task.out)}." if crop else ""), "seen": seen}


class _Handler(BaseHTTPRequestHandler):
    """Answers requests of its own page; refuses those of other pages and those under another host name."""

    pages: dict[str, tuple[str, Callable[[], bytes]]]
    actions: dict[str, Callable[[dict[str, Any]], dict[str, Any]]]

    def do_GET(self) -> None:
        if not is_local(self.headers.get("Host")):
            self.send_error(403, "only requests from this machine are allowed")
        elif self.path not in self.pages:
            self.send_error(404)
        else:
            kind, content = self.pages[self.path]
            try:
                body = content()
            except (InputError, OSError) as error:
                self._answer(500, "text/plain; charset=utf-8", str(error).encode())
                return
            self._answer(200, kind, body)

    def do_POST(self) -> None:
        action, length = self.actions.get(self.path), self.headers.get("Content-Length") or ""
        if not is_local(self.headers.get("Host")) or not self._from_here():
            self.send_error(403, "only requests of the landmark page are allowed")
        elif action is None:
            self.send_error(404)
        elif not length.isdecimal() or int(length) > MAX_REQUEST_BYTES:
            self.send_error(413)
        else:
            self._reply(action, self.rfile.read(int(length)))

    def _from_here(self) -> bool:
        """Whether a request is from the page itself, by its origin; browsers send no JSON to other origins unasked."""
        origin = self.headers.get("Origin")
        own = origin is None or origin == f"http://{self.headers.get('Host')}"
        return own and self.headers.get("Content-Type") == "application/json"

    def _reply(self, action: Callable[[dict[str, Any]], dict[str, Any]], body: bytes) -> None:
        try:
            asked = json.loads(body)
            reply = action(asked if isinstance(asked, dict) else {})
        except InputError as error:
            reply = {"faults": [str(fault) for fault in error.faults]}
        except OSError as error:
            reply = {"faults": [str(system_fault(error, "file system"))]}
        except (ValueError, RecursionError):
            self.send_error(400, "the request must be JSON")
            return
        self._answer(200, "application/json", json.dumps(reply).encode())

    def _answer(self, code: int, kind: str, body: bytes) -> None:
        with suppress(ConnectionError):  # the page was closed
            self.send_response(code)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(body)

    def log_message(self, *_: Any) -> None:
        """Do not log requests."""


def _mesh(task: LandmarkTask) -> bytes:
    """Bytes of positions and normals (float32), triangles (uint32) and colours (uint8), in this order."""
    vertices, faces = task.scan.vertices, task.scan.faces
    normal = np.nan_to_num(vertex_normals(vertices, faces))
    parts = [vertices.astype("<f4"), normal.astype("<f4"), faces.astype("<u4")]
    return b"".join(part.tobytes() for part in parts) + (b"" if task.colours is None else task.colours.tobytes())


def _page(task: LandmarkTask) -> str:
    shared, own = (resources.files("skindb.view") / folder for folder in ("page", "page_landmarks"))
    files = [shared / f"{name}.js" for name in SHARED_SCRIPTS] + [own / f"{name}.js" for name in SCRIPTS]
    script = "\n".join(file.read_text(encoding="utf-8") for file in files)
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
        "style": (own / "page.css").read_text(encoding="utf-8"),
        "about": json.dumps(about, allow_nan=False).replace("<", "\\u003c"),
        "script": f"(() => {{\n{script}\n}})();",
    }
    text = (own / "page.html").read_text(encoding="utf-8")
    for name, value in parts.items():
        text = text.replace(f"{{{name}}}", value)
    return text
