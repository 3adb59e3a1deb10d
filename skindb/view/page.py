"""Pages from templates, whose markers are replaced in one pass: nothing is replaced inside
of data; and the page of the viewer.
"""

from __future__ import annotations

import html
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

from skindb.errors import Fault, InputError
from skindb.files import make_private, private_file

SCRIPTS = (
    "session",
    "page/matrix",
    "page/data",
    "page/shaders",
    "page/gpu",
    "page/visible",
    "page/painter",
    "page/main",
)
MAX_PAGE_BYTES = 30_000_000
OVERCAST = "overcast sky"
APPROXIMATIONS = (
    "Shadows come from maps of 1,024 texels with filtered edges. Light under the "
    "skin is the irradiance, blurred in "
    "the texture by one Gaussian, which has the mean square distance of the dipole "
    "and the local diffusion length. "
    "Light from all directions is that of 256 distant lights, four of which are "
    "added in each step. Light that is "
    "reflected more than once is not included. skindb render omits it too, but has "
    "none of the other approximations."
)


def page_text(folder: str, scripts: Iterable[str], parts: Mapping[str, str]) -> str:
    """A page of `skindb.view`.

    Parameters
    ----------
    folder
        Folder with page.html and page.css.
    scripts
        Paths of the scripts, in order, from `skindb/view`.
    parts
        Marker in page.html, such as ``title`` for ``$title`` -> HTML, or JSON from `embedded_json`.
    """
    root = resources.files("skindb.view")
    code = "\n".join((root / name).read_text(encoding="utf-8") for name in scripts)
    style = (root / folder / "page.css").read_text(encoding="utf-8")
    template = Template((root / folder / "page.html").read_text(encoding="utf-8"))
    return template.substitute(parts, style=style, script=f"(() => {{\n{code}\n}})();")


def embedded_json(value: Any) -> str:
    """JSON that is safe inside a script element: ASCII without "<", so that no data end
    the element.
    """
    return json.dumps(value, allow_nan=False).replace("<", "\\u003c")


def write_page(
    out: Path, record: Mapping[str, Any], still: str, *, surroundings: str = OVERCAST
) -> int:
    """Write a self-contained page of one face and return its size in bytes;
    `surroundings` names the environment.

    Raises
    ------
    InputError
        If the page would be larger than 30 MB.
    """
    take = str(record["about"]["attributes"]["take"])
    faces = (
        '<script type="application/json" '
        f'id="face-{html.escape(take)}">{embedded_json(record)}</script>'
    )
    text = _page(
        f"skindb: {take}",
        [{"take": take, "title": take, "still": still}],
        faces,
        surroundings,
    )
    if (size := len(text.encode())) > MAX_PAGE_BYTES:
        rule = f"a page must have at most {MAX_PAGE_BYTES // 1_000_000} MB"
        cure = "fit with a larger --spacing"
        raise InputError(Fault(str(out), rule, f"{size / 1e6:.0f} MB", cure))
    private_file(out).write_text(text, encoding="utf-8")
    return size


@dataclass(frozen=True)
class PagedFace:
    """One of several faces of a page: its entry in the list of takes, and the data that
    the page requests.
    """

    take: str
    title: str
    still: str
    data: bytes

    @classmethod
    def of(cls, record: Mapping[str, Any], still: str) -> PagedFace:
        """The face of a record of `face_record`."""
        attributes = record["about"]["attributes"]
        texts = [
            f"{name} {attributes[name]}"
            for name in ("age", "gender", "condition")
            if name in attributes
        ]
        return cls(
            attributes["take"],
            ", ".join([attributes["take"], *texts]),
            still,
            embedded_json(record).encode(),
        )


def index_text(faces: Iterable[PagedFace], *, surroundings: str = OVERCAST) -> str:
    """The page of several faces, which requests faces/<take>.json."""
    takes = [
        {"take": face.take, "title": face.title, "still": face.still} for face in faces
    ]
    return _page("skindb viewer", takes, "", surroundings)


def write_folder(
    out: Path, faces: Iterable[PagedFace], *, surroundings: str = OVERCAST
) -> None:
    """Write index.html and faces/<take>.json for several faces, which browsers can only
    read over HTTP.
    """
    make_private(out / "faces")
    listed = list(faces)
    for face in listed:
        private_file(out / "faces" / f"{face.take}.json").write_bytes(face.data)
    private_file(out / "index.html").write_text(
        index_text(listed, surroundings=surroundings), encoding="utf-8"
    )


def _page(
    title: str, takes: list[dict[str, str]], faces: str, surroundings: str
) -> str:
    parts = {
        "title": html.escape(title),
        "approximations": APPROXIMATIONS,
        "surroundings": html.escape(surroundings),
        "takes": embedded_json(takes),
        "faces": faces,
    }
    return page_text("page", [f"{name}.js" for name in SCRIPTS], parts)
