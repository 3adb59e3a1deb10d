"""Pictures and exports of the models of a database."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import xarray as xr

from skindb.errors import Fault, InputError
from skindb.export.bundle import export_bundle
from skindb.export.gltf import export_gltf
from skindb.files import make_private
from skindb.render.figures import write_field
from skindb.render.photographs import Comparison, compare_photographs
from skindb.render.rendering import render_picture
from skindb.schema.consent import require_consent
from skindb.store import Database, require_fresh
from skindb.types import Progress
from skindb.workflow.audit import logged


@logged("render")
def render_take(
    db: Database,
    out: Path,
    take: str,
    *,
    edited: bool = False,
    generation: int | None = None,
    **options: Any,
) -> dict[str, Any]:
    """Render the model of a take to a picture.

    Parameters
    ----------
    db
        Database with a model of the take.
    out
        Picture to write, or a folder for `<take>.png`.
    take
        Name of the take.
    edited
        Render the edited model.
    generation
        Version of the model; default the newest.
    **options
        Of `skindb.render.render_picture`.
    """
    _require_outside(db, out)
    model = _model(db, take, generation, edited=edited)
    path = out if out.suffix else out / f"{take}.png"
    if not options.get("explain"):
        make_private(path.parent)
    return {"take": take} | render_picture(model, path, **options)


@logged("compare")
def compare_take(
    db: Database, take: str, *, generation: int | None = None, **options: Any
) -> list[Comparison]:
    """Compare the photographs of a take with the model's prediction; see
    `skindb.render.compare_photographs`.
    """
    model = _model(db, take, generation)
    return compare_photographs(model, db.source(model), **options)


@logged("show")
def show_take(
    db: Database,
    take: str,
    variable: str,
    out: Path,
    *,
    at: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """Draw a variable of the newest model of a take, or of its newest capture, to a
    picture; see `write_field`.
    """
    trees = {
        kind: db.read(kind, take)
        for kind in ("model", "capture")
        if take in db.takes(kind)
    }
    if not trees:
        known = ", ".join(db.takes("capture")) or "there is none"
        raise InputError(
            Fault("take", "a take of the database is drawn", take, f"choose {known}")
        )
    require_consent({"consent_scope": db.consent(take), "take": take}, "export")
    return write_field(trees, variable, out, at=at)


@logged("export")
def export_take(
    db: Database,
    out: Path,
    take: str,
    *,
    size: int | None = None,
    gltf: bool = False,
    merl: bool = True,
    edited: bool = False,
    generation: int | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write the bundle of a model to `<out>/<take>`, or its glTF alone to `<out>/<take>.glb`.

    Parameters
    ----------
    db, take
        Database with a model of the take, and its name.
    out
        Folder; with `gltf` also a file that ends in .glb.
    size
        Texels along a map's side; default 1.5 in the spacing of the surfels, as a power of two.
    gltf, merl
        Write only the glTF; write MERL binaries, 35 MB each.
    edited, generation
        The edited model; the version of the model.
    progress
        Called with the stage, the number of finished steps and the total number of steps.
    """
    _require_outside(db, out)
    model = _model(db, take, generation, edited=edited)
    if not gltf:
        export_bundle(model, out / take, size=size, merl=merl, progress=progress)
        return out / take
    path = out if out.suffix == ".glb" else out / f"{take}.glb"
    make_private(path.parent)
    export_gltf(model, path, size=size)
    return path


def _model(
    db: Database, take: str, generation: int | None, *, edited: bool = False
) -> xr.DataTree:
    """A model or an edit whose subject agrees to exports; a stale edit is refused, or warned of."""
    kind = "edit" if edited else "model"
    model = db.read(kind, take, generation=generation)
    require_consent({**model.attrs, "take": take}, "export")
    if generation is None:  # who names one knows which it is
        require_fresh(db, kind, take)
    return model


def _require_outside(db: Database, out: Path) -> None:
    if db.folder is not None and db.folder.resolve() in (
        out.resolve(),
        *out.resolve().parents,
    ):
        rule = "pictures and exports are written outside of the database"
        cure = "choose another folder"
        raise InputError(Fault(str(out), rule, f"a place inside {db.url}", cure))
