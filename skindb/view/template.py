"""Pages from templates, whose markers are replaced in one pass: nothing is replaced
inside of data.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from importlib import resources
from string import Template
from typing import Any


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
