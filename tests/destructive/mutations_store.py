"""Damage to a database, chosen by a random generator; each function returns the kind of
file and a description.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
from mutations import (
    SUBSTITUTES,
    extend,
    flip,
    json_value,
    put,
    replace_by,
    truncate,
    zero,
)

from skindb.store.record import seal_of

TIME_HEX = "20260101T000000-01234567"
FOREIGN = (
    "x",
    "note.txt",
    ".DS_Store",
    "00000009.json",
    "0000009.json",
    "\u0661" * 8 + ".json",
    "zarr.json",
    "a b",
    "A9",
    "modell",
    f"{TIME_HEX}.zarr",
    f"{TIME_HEX}.manifest.json",
    "\udcff",
    "x" * 200,
)


def damage(root: Path, rng: np.random.Generator) -> tuple[str, str]:
    """Damage one thing of the database; returns the kind of file, and what was done to which."""
    choices = [_file] * 10 + [_folder, _foreign]
    kind, path, done = choices[rng.integers(len(choices))](root, rng)
    return kind, f"{path.relative_to(root)}: {done}".encode(
        errors="backslashreplace"
    ).decode()


def kind_of(root: Path, path: Path) -> str:
    """Kind of a file of a database."""
    top = path.relative_to(root).parts[0]
    if top != "data":
        return {"log": "record", "heads": "head", "tombstones": "tombstone"}.get(
            top, top
        )
    if path.name.endswith((".manifest.json", ".tables.json")):
        return path.name.split(".")[-2]
    return "metadata" if path.name == "zarr.json" else "chunk"


def _files(root: Path) -> dict[str, list[Path]]:
    found: dict[str, list[Path]] = {}
    for path in sorted(root.rglob("*")):
        if path.is_file():
            found.setdefault(kind_of(root, path), []).append(path)
    return found


def _file(root: Path, rng: np.random.Generator) -> tuple[str, Path, str]:
    files = _files(root)
    kinds = [*files, "record", "record", "record"]  # otherwise a fifth of all
    kind = kinds[rng.integers(len(kinds))]
    path = files[kind][rng.integers(len(files[kind]))]
    choices = [flip, flip, truncate, zero, extend, replace_by, replace_by]
    if path.suffix == ".json":
        choices += [json_value] * 3
    if kind in ("record", "head"):
        choices += [_sealed] * 6
    at = int(rng.integers(len(choices) + 3))
    if at < len(choices):
        return kind, path, choices[at](path, rng)
    near = [other for other in files[kind] if other != path] or [path]
    other = near[rng.integers(len(near))]
    mine = path.read_bytes()
    theirs = other.read_bytes()
    path.write_bytes(theirs)
    if at == len(choices):
        other.write_bytes(mine)
    return (
        kind,
        path,
        f"{'exchanged with' if at == len(choices) else 'overwritten by'} {other.relative_to(root)}",
    )


def _sealed(path: Path, rng: np.random.Generator) -> str:
    """A value of a record changed and its seal made to fit; for some the head, too, or
    the head removed.
    """
    said = json_value(path, rng) if rng.random() < 0.8 else _telling(path, rng)
    try:
        body = json.loads(path.read_text())
        body.pop("seal")
        seal = seal_of(body)
    except (ValueError, AttributeError, TypeError, KeyError, RecursionError):
        return said
    path.write_text(json.dumps(body | {"seal": seal}))
    what = int(rng.integers(3))
    if what == 0 or path.parts[-4] != "log":
        return f"{said}, sealed again"
    head = path.parents[2].parent / f"heads/{path.parts[-3]}/{path.parts[-2]}.json"
    if what == 1:
        head.unlink()
        return f"{said}, sealed again, head removed"
    ours = {"generation": json.loads(head.read_text())["generation"], "seal": seal}
    digest = seal_of(ours | {"kind": path.parts[-3], "take": path.parts[-2]})
    head.write_text(json.dumps(ours | {"digest": digest}))
    return f"{said}, sealed again, head too"


def _telling(path: Path, rng: np.random.Generator) -> str:
    """Changes of a record that change its meaning."""
    body = json.loads(path.read_text())
    about = body.get("provenance", {})
    what = int(rng.integers(8))
    changes = (
        lambda: about.update(schema_version=3),
        lambda: about.clear(),
        lambda: body.update(format=3),
        lambda: about.update(consent_scope=["fit", "statistics", "export", "publish"]),
        lambda: about.update(inputs=[]),
        lambda: body.update(contents={}),
        lambda: body.update(tables=""),
        lambda: body.update(generation=99_999_999),
    )
    changes[what]()
    path.write_text(json.dumps(body))
    return f"meaning changed ({what})"


def _folder(root: Path, rng: np.random.Generator) -> tuple[str, Path, str]:
    folders = [path for path in sorted(root.rglob("*")) if path.is_dir()]
    depth = int(rng.integers(1, 7))
    near = [
        path for path in folders if len(path.relative_to(root).parts) == depth
    ] or folders
    path = near[rng.integers(len(near))]
    if rng.random() < 0.3 and len(near) > 1:
        other = near[rng.integers(len(near))]
        if other != path:
            aside = root.parent / "aside"
            path.rename(aside)
            other.rename(path)
            aside.rename(other)
        return "folder", path, f"exchanged with {other.relative_to(root)}"
    shutil.rmtree(path)
    what = str(rng.choice(SUBSTITUTES))
    put(what, path)
    return "folder", path, f"replaced by {what}"


def _foreign(root: Path, rng: np.random.Generator) -> tuple[str, Path, str]:
    folders = [path for path in sorted(root.rglob("*")) if path.is_dir()]
    path = folders[rng.integers(len(folders))] / FOREIGN[rng.integers(len(FOREIGN))]
    if path.exists():
        return "nothing", path, "it exists"
    what = str(rng.choice([*SUBSTITUTES[1:], "text"]))
    path.write_text("{}") if what == "text" else put(what, path)
    return "foreign", path, f"added as {what}"
