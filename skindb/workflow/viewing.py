"""Pages of the viewer from the models of a database."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import xarray as xr

from skindb.errors import Fault, InputError
from skindb.render.scene import Environment
from skindb.schema.consent import require_consent
from skindb.store import Database, UnavailableError, require_fresh
from skindb.types import Progress, silent
from skindb.view.face import Trait, face_record, page_omissions, still_picture
from skindb.view.landmarks import landmark_server, landmark_task
from skindb.view.page import (
    HTML,
    JSON,
    OVERCAST,
    Content,
    PagedFace,
    PageServer,
    index_text,
    write_folder,
    write_page,
)
from skindb.workflow.audit import logged
from skindb.workflow.edits import editable_model, stored_or_moved

NO_TRAITS: Mapping[str, float] = MappingProxyType({})
# attributes of a model that a page shows, besides those of the capture
SHOWN = ("subject", "condition", "session")


@logged("view")
def view_takes(
    db: Database,
    takes: Sequence[str],
    out: Path,
    *,
    traits: Mapping[str, float] = NO_TRAITS,
    study: str | None = None,
    dictionary: Path | None = None,
    environment: Path | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write the page of a take to the file `out`, or of several into the folder `out`.

    Parameters
    ----------
    db, takes
        Database with models of the takes.
    out
        A file that ends in .html, or a folder.
    traits, study, dictionary
        Trait -> amount at the end of its slider (as in `skindb.workflow.edit`), the
        study of the traits, and the dictionary of the fits.
    environment
        Light from all directions, an OpenEXR file; default an overcast sky.
    progress
        Called with the stage, the number of finished takes and the total number of takes.

    Returns
    -------
    dict
        path, takes, and of a file its bytes.
    """
    named = OVERCAST if environment is None else environment.name
    options: dict[str, Any] = {
        "traits": traits,
        "study": study,
        "dictionary": dictionary,
    }
    faces = _faces(db, takes, environment=environment, progress=progress, **options)
    about: dict[str, Any] = {"path": str(out), "takes": list(takes)}
    if out.suffix == ".html":
        [(record, still)] = faces
        return about | {"bytes": write_page(out, record, still, surroundings=named)}
    write_folder(
        out,
        [PagedFace.of(record, still) for record, still in faces],
        surroundings=named,
    )
    return about


@logged("view")
def view_server(
    db: Database,
    takes: Sequence[str],
    *,
    port: int = 0,
    environment: Path | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> PageServer:
    """A server of the page of several takes, which does not run yet; see `view_takes`.

    Faces are kept in memory only. Each request checks the consent of the subject: the
    face of one that does not consent to exports any more, or was withdrawn, is removed
    from the memory and not served.

    Parameters
    ----------
    db, takes, environment, progress
        See `view_takes`.
    port
        Port; 0 chooses a free one.
    **options
        traits, study and dictionary of `view_takes`.

    Raises
    ------
    InputError
        If the port is taken.
    """
    named = OVERCAST if environment is None else environment.name
    made = _faces(db, takes, environment=environment, progress=progress, **options)
    faces = {
        take: PagedFace.of(record, still)
        for take, (record, still) in zip(takes, made, strict=True)
    }

    def index() -> bytes:
        permitted = [_permitted(db, faces, take) for take in takes]
        return index_text(
            [face for face in permitted if face is not None], surroundings=named
        ).encode()

    def data(take: str) -> bytes:
        face = _permitted(db, faces, take)
        if face is None:
            raise InputError(
                Fault(
                    take,
                    "its subject must consent to exports",
                    "no such consent",
                    "show another take",
                )
            )
        return face.data

    contents = {
        f"faces/{take}.json": Content(JSON, partial(data, take)) for take in takes
    }
    return PageServer(contents | {"": Content(HTML, index)}, {}, port=port)


def _permitted(
    db: Database, faces: dict[str, PagedFace], take: str
) -> PagedFace | None:
    """The face of a take; None, and the face is removed, if its subject does not
    consent to exports any more.
    """
    try:
        scope = db.consent(take)
    except UnavailableError:
        raise
    except InputError:  # the subject was withdrawn
        scope = []
    if "export" not in scope:
        faces.pop(take, None)
    return faces.get(take)


def _faces(
    db: Database,
    takes: Sequence[str],
    *,
    traits: Mapping[str, float] = NO_TRAITS,
    study: str | None = None,
    dictionary: Path | None = None,
    environment: Path | None = None,
    progress: Progress | None = None,
) -> Iterator[tuple[dict[str, Any], str]]:
    """Record and still picture of each face, see `view_takes`."""
    report = progress or silent
    around = None if environment is None else Environment.read(environment)
    for done, take in enumerate(takes):
        report("view", done, len(takes))
        model = db.read("model", take)
        require_consent({**model.attrs, "take": take}, "export")
        require_fresh(db, "model", take)
        shown, moved = _moved(db, take, model, traits, study, dictionary)
        about = _attributes(db, take, model)
        yield (
            face_record(
                shown, take=take, attributes=about, traits=moved, environment=around
            ),
            still_picture(model),
        )
    report("view", len(takes), len(takes))


def landmark_page(scan: Path, out: Path, *, port: int = 0) -> PageServer:
    """A server of the page in which the landmarks of a scan are set and saved in `out`;
    it does not run yet.

    Raises
    ------
    InputError
        If the scan or a file that exists cannot be read, or the port is taken.
    """
    return landmark_server(landmark_task(scan, out), port=port)


@logged("view", explain=True)
def explain_view(
    db: Database, take: str, *, traits: Mapping[str, float] = NO_TRAITS
) -> list[str]:
    """What the page of a take would skip and approximate, with bounds, one line each;
    see `view_takes`.
    """
    model = db.read("model", take)
    require_consent({**model.attrs, "take": take}, "export")
    return page_omissions(model, edited=bool(traits))


def _moved(
    db: Database,
    take: str,
    model: xr.DataTree,
    traits: Mapping[str, float],
    study: str | None,
    dictionary: Path | None,
) -> tuple[xr.DataTree, tuple[Trait, ...]]:
    """The model on the basis of its edits, and the edits."""
    if not traits:
        return model, ()
    source = editable_model(db, take, study, dictionary)
    plain = stored_or_moved(db, take, source, dict.fromkeys(traits, 0.0))
    moved = []
    for name, amount in traits.items():
        whole, half = (
            stored_or_moved(db, take, source, {name: part * amount})
            for part in (1.0, 0.5)
        )
        moved.append(Trait(name, whole, half, amount))
    return plain, tuple(moved)


def _attributes(db: Database, take: str, model: xr.DataTree) -> dict[str, Any]:
    found = {name: model.attrs[name] for name in SHOWN if name in model.attrs}
    traits = (
        db.record("capture", take).provenance.get("traits", {})
        if db.has("capture", take)
        else {}
    )
    return found | (dict(traits) if isinstance(traits, dict) else {})
