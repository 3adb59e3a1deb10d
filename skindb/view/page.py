"""Pages of the viewer: a self-contained file for one face, or a folder that is served on this machine."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from typing import Any

from skindb.errors import Fault, InputError

SCRIPTS = ("matrix", "data", "shaders", "gpu", "visible", "painter", "main")  # in this order
MAX_PAGE_BYTES = 30_000_000
LOCAL = "127.0.0.1"
OVERCAST = "overcast sky"
APPROXIMATIONS = (
    "Shadows come from maps of 1,024 texels with filtered edges. Light under the skin is the irradiance, blurred in "
    "the texture by one Gaussian, which has the mean square distance of the dipole and the local diffusion length. "
    "Light from all directions is that of 256 distant lights, four of which are added in each step. Light that is "
    "reflected more than once is not included. skindb render omits it too, but has none of the other approximations."
)


def write_page(out: Path, record: Mapping[str, Any], still: str, *, surroundings: str = OVERCAST) -> int:
    """Write a self-contained page of one face and return its size in bytes; `surroundings` names the environment.

    Raises
    ------
    InputError
        If the page would be larger than 30 MB.
    """
    take = str(record["about"]["attributes"]["take"])
    faces = f'<script type="application/json" id="face-{html.escape(take)}">{_json(record)}</script>'
    text = _page(f"skindb: {take}", [{"take": take, "title": take, "still": still}], faces, surroundings)
    if (size := len(text.encode())) > MAX_PAGE_BYTES:
        rule, cure = f"a page must have at most {MAX_PAGE_BYTES // 1_000_000} MB", "fit with a larger --spacing"
        raise InputError(Fault(str(out), rule, f"{size / 1e6:.0f} MB", cure))
    out.write_text(text, encoding="utf-8")
    return size


def write_folder(
    out: Path, records: Mapping[str, Mapping[str, Any]], stills: Mapping[str, str], *, surroundings: str = OVERCAST
) -> None:
    """Write index.html and faces/<take>.json for several faces, which browsers can only read over HTTP."""
    (out / "faces").mkdir(parents=True, exist_ok=True)
    titles = []
    for take, record in records.items():
        (out / "faces" / f"{take}.json").write_text(_json(record), encoding="utf-8")
        about = record["about"]["attributes"]
        title = ", ".join(
            [take, *(f"{name} {about[name]}" for name in ("age", "gender", "condition") if name in about)]
        )
        titles.append({"take": take, "title": title, "still": stills[take]})
    (out / "index.html").write_text(_page("skindb viewer", titles, "", surroundings), encoding="utf-8")


def is_local(host: str | None) -> bool:
    """Whether the header Host is this machine; other host names are refused, to prevent access by foreign pages."""
    return (host or "").rsplit(":", 1)[0] in (LOCAL, "localhost")


class _Handler(SimpleHTTPRequestHandler):
    """Serves files, to this machine only."""

    def do_GET(self) -> None:
        if not is_local(self.headers.get("Host")):
            self.send_error(403, "only requests from this machine are allowed")
            return
        super().do_GET()

    def end_headers(self) -> None:
        self.send_header("Cache-Control", "no-store")
        super().end_headers()

    def log_message(self, *_: Any) -> None:
        """Do not log requests."""


def server(folder: Path, *, port: int = 0) -> ThreadingHTTPServer:
    """Server of a folder at 127.0.0.1, which is not yet running; port 0 chooses a free port.

    Raises
    ------
    InputError
        If the port is taken.
    """

    class Handler(_Handler):
        def __init__(self, *args: Any, **options: Any) -> None:
            super().__init__(*args, directory=str(folder), **options)

    try:
        return ThreadingHTTPServer((LOCAL, port), Handler)
    except OSError as error:
        cure = "choose another port, or omit --port"
        raise InputError(Fault(f"port {port}", "must be free", error.strerror or str(error), cure)) from None


def _page(title: str, takes: list[dict[str, str]], faces: str, surroundings: str) -> str:
    folder = resources.files("skindb.view") / "page"
    script = "\n".join((folder / f"{name}.js").read_text(encoding="utf-8") for name in SCRIPTS)
    parts = {
        "title": html.escape(title),
        "style": (folder / "page.css").read_text(encoding="utf-8"),
        "approximations": APPROXIMATIONS,
        "surroundings": html.escape(surroundings),
        "takes": _json(takes),
        "faces": faces,
        "script": f"(() => {{\n{script}\n}})();",
    }
    text = (folder / "page.html").read_text(encoding="utf-8")
    for name, value in parts.items():
        text = text.replace(f"{{{name}}}", value)
    return text


def _json(value: Any) -> str:
    """JSON that is safe inside a script element."""
    return json.dumps(value, allow_nan=False).replace("<", "\\u003c")
