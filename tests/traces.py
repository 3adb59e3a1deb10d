"""Search for data of a subject in everything that a database consists of."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import zarr

MARK = np.float32(0.12345679)  # planted in the data of a subject


def traces(root: Path, subject: str) -> list[str]:
    """Files and folders whose names or contents, with every chunk decompressed, contain
    the subject or `MARK`.

    Parameters
    ----------
    root
        Folder of a database, a cache or scratch files.
    subject
        Pseudonym, which must not be a part of any other word.
    """
    name = subject.encode()
    found = []
    for path in sorted(root.rglob("*")):
        if name in path.name.encode():
            found.append(f"name of {path}")
        if path.is_file() and not path.is_symlink():
            content = path.read_bytes()
            if name in content or MARK.tobytes() in content:
                found.append(f"content of {path}")
    for path in sorted(root.rglob("*.zarr")):
        found += [f"values of {path}/{key}" for key in _marked_arrays(path, subject)]
    return found


def _marked_arrays(version: Path, subject: str) -> list[str]:
    """Names of the arrays of a version that contain the mark or the subject; unfinished
    arrays are read as far as possible.
    """
    found = []
    for file in sorted(version.rglob("zarr.json")):
        if json.loads(file.read_bytes()).get("node_type") != "array":
            continue
        values = np.asarray(zarr.open_array(file.parent, mode="r")[...])
        is_marked = values.dtype.kind == "f" and bool((values == MARK).any())
        is_named = values.dtype.kind == "T" and any(
            subject in str(text) for text in values.ravel()
        )
        if is_marked or is_named:
            found.append(file.parent.relative_to(version).as_posix())
    return found


def contents(root: Path) -> dict[str, bytes]:
    """Content of every file below a folder, by its path."""
    return {
        str(path.relative_to(root)): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }
