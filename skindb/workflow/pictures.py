"""Pictures, exports and pages of the models of a database."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from xarray import DataTree

from skindb.analysis.components import privacy_notes
from skindb.analysis.edit import move_along_modes
from skindb.errors import SkindbWarning, input_error, require
from skindb.export.bundle import export_bundle
from skindb.export.gltf import export_gltf
from skindb.files import Json, make_private
from skindb.parameters import ComparisonParameters, ExportParameters
from skindb.render.figures import write_field, write_grid
from skindb.render.photographs import Comparison, compare_photographs
from skindb.render.rendering import (
    chosen_camera,
    fixed_exposure,
    render,
    render_picture,
)
from skindb.render.scene import Camera, Environment, Lighting, from_model
from skindb.render.views import light_from
from skindb.schema import variables
from skindb.store import STUDY, Database, intact_or_none, require_fresh
from skindb.types import Progress, float64, silent
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
    write_page,
)
from skindb.workflow.audit import logged
from skindb.workflow.cohorts import current_registrations, registered_datasets
from skindb.workflow.edits import editable_model, stored_study

SIDE_PX = 320  # of a picture
CLOSE_MM = 40.0  # side of a close-up
# the shadow of the nose is on the cheek, which is lit around it
LIGHT = "42,22"
LANDMARK = "nose_tip"
COMPONENTS = "components"  # study of modes
MODE_END = 2.0  # standard deviations at the ends of its slider
NO_TRAITS: Mapping[str, float] = MappingProxyType({})
# attributes of a model that a page shows, besides those of the capture
SHOWN = ("subject", "condition", "session")


@logged("render")
def render_take(
    db: Database,
    out: Path,
    take: str,
    *,
    edited: bool = False,
    generation: int | None = None,
    explain: bool = False,
    progress: Progress = silent,
    **options: Any,
) -> Json:
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
    explain
        Only plan the picture.
    progress
        As in `skindb.render.render`.
    **options
        Of `skindb.parameters.RenderParameters`, see `skindb.render.render_picture`.
    """
    _require_outside(db, out)
    model = _model(db, take, generation, edited=edited)
    path = out if out.suffix else out / f"{take}.png"
    if not explain:
        make_private(path.parent)
    picture = render_picture(model, path, explain=explain, progress=progress, **options)
    return {"take": take} | picture


@logged("compare")
def compare_take(
    db: Database, take: str, *, generation: int | None = None, **options: Any
) -> list[Comparison]:
    """Compare the photographs of a take with the model's prediction; see
    `skindb.render.compare_photographs`.

    The `options` are those of `skindb.parameters.ComparisonParameters`.
    """
    parameters = ComparisonParameters(**options)
    model = _model(db, take, generation)
    return compare_photographs(model, db.source(model), **vars(parameters))


@logged("show")
def show_take(
    db: Database,
    take: str,
    variable: str,
    out: Path,
    *,
    at: Mapping[str, str] | None = None,
) -> Json:
    """Draw a variable of the newest model of a take, or of its newest capture, to a
    picture; see `write_field`.
    """
    trees = {
        kind: db.read(kind, take)
        for kind in ("model", "capture")
        if take in db.takes(kind)
    }
    cure = f"choose {', '.join(db.takes('capture')) or 'there is none'}"
    require(trees, "take", "a take of the database is drawn", take, cure)
    db.require_consent(take, "export")
    return write_field(trees, variable, out, at=at)


@logged("export")
def export_take(
    db: Database,
    out: Path,
    take: str,
    *,
    edited: bool = False,
    generation: int | None = None,
    progress: Progress = silent,
    **options: Any,
) -> Path:
    """Write the bundle of a model to `<out>/<take>`, or its glTF alone to `<out>/<take>.glb`.

    Parameters
    ----------
    db, take
        Database with a model of the take, and its name.
    out
        Folder; with `gltf` also a file that ends in .glb.
    edited, generation
        The edited model; the version of the model.
    progress
        Called with the stage, the number of finished steps and the total number of steps.
    **options
        Of `skindb.parameters.ExportParameters`: the number of texels along the side of a
        map, whether only glTF is written, and whether MERL binaries are.
    """
    parameters = ExportParameters(**options)
    size = parameters.size
    _require_outside(db, out)
    model = _model(db, take, generation, edited=edited)
    if not parameters.gltf:
        export_bundle(
            model, out / take, size=size, merl=parameters.merl, progress=progress
        )
        return out / take
    path = out if out.suffix == ".glb" else out / f"{take}.glb"
    make_private(path.parent)
    export_gltf(model, path, size=size)
    return path


def _model(
    db: Database, take: str, generation: int | None, *, edited: bool = False
) -> DataTree:
    """A model or an edit whose subject agrees to exports; a stale edit is refused, or warned of."""
    kind = "edit" if edited else "model"
    model = db.read(kind, take, generation=generation)
    db.require_consent(take, "export")
    if generation is None:  # who names one knows which it is
        require_fresh(db, kind, take)
    return model


def _require_outside(db: Database, out: Path) -> None:
    require(
        db.folder is None
        or db.folder.resolve() not in (out.resolve(), *out.resolve().parents),
        str(out),
        "pictures and exports are written outside of the database",
        f"a place inside {db.url}",
        "choose another folder",
    )


@logged("render")
def translucency_grid(
    db: Database,
    out: Path,
    *,
    site: str = "cheek",
    samples: int = 8,
    progress: Progress = silent,
) -> dict[str, float]:
    """Draw the takes with the shortest and the longest diffusion length at a site, with
    one light and the exposure "fixed" of `render_picture`.

    The columns are close-ups of the edge of the nose's shadow with light under the skin,
    and with light that is reflected where it enters.

    Parameters
    ----------
    db
        Database with models whose subjects consent to exports.
    out
        Picture to write (.png, .pdf, .svg).
    site
        Of the probe.
    samples
        Rays per pixel.
    progress
        Called with the stage, the number of finished takes and the total number of takes.

    Returns
    -------
    dict
        Take -> mean of 1 / sigma_tr over red, green and blue [mm].

    Raises
    ------
    InputError
        If fewer than two takes have translucency at that site.
    """
    lengths = _diffusion_lengths(db, site)
    require(
        len(lengths) >= 2,
        db.url,
        f"two takes must have translucency at {site}",
        f"{len(lengths)}",
        "name another site, or fit more takes",
    )
    rows = {}
    chosen = {}
    for i, extreme in enumerate((min, max)):
        progress("render", i, 2)
        take = extreme(lengths, key=lengths.__getitem__)
        model = db.read("model", take)
        light = light_from(from_model(model), LIGHT)
        camera = _close_up(model)
        rows[f"{take}\n{lengths[take]:.2f} mm"] = [
            render(
                model, lights=light, camera=camera, samples=samples, subsurface=under
            )["radiance"].values
            for under in (True, False)
        ]
        chosen[take] = lengths[take]
    progress("render", 2, 2)
    gain = fixed_exposure(Lighting(light), camera)
    write_grid(out, rows, ["light under the skin", "without"], exposure=gain)
    return chosen


def _diffusion_lengths(db: Database, site: str) -> dict[str, float]:
    """Mean diffusion length [mm] at a site of every take whose subject consents to exports."""
    lengths = {}
    for take in db.takes("model"):
        record = db.record("model", take)
        if "export" not in db.consent(take) or "translucency" not in record.contents:
            continue
        sites = db.version(record, ["translucency"])["translucency"].to_dataset()
        if site in sites["site"].values.tolist():
            sigma = sites[variables.SITE_SIGMA_TR].sel(site=site).values.astype(float)
            if (np.isfinite(sigma) & (sigma > 0)).all():
                lengths[take] = float((1 / sigma).mean())
    return lengths


def _nose(model: DataTree) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Tip of the nose (3,), or the middle of the surfels."""
    mesh = model["mesh"].dataset
    landmarks = mesh["landmark"].values.tolist() if "landmark" in mesh.coords else []
    if variables.LANDMARK_POSITION in mesh and LANDMARK in landmarks:
        return float64(mesh[variables.LANDMARK_POSITION].sel(landmark=LANDMARK).values)
    return float64(
        model["fitted"].dataset[variables.SURFEL_POSITION].values.mean(axis=0)
    )


def _close_up(model: DataTree) -> Camera:
    """A camera that looks at the edge of the nose's shadow from the front."""
    frontal, _ = chosen_camera(model["dome"].dataset.load(), None)
    # beside the nose, on the side away from the light
    place = _nose(model) + np.array([-17.0, -2.0, -14.0])
    seen = frontal.R @ place + frontal.t
    pixel = (frontal.K @ seen)[:2] / seen[2]
    zoom = SIDE_PX / (CLOSE_MM * frontal.K[0, 0] / seen[2])
    K = np.diag([zoom, zoom, 1.0]) @ frontal.K
    K[:2, 2] += SIDE_PX / 2 - zoom * pixel
    return replace(frontal, K=K, distortion=np.zeros(5), width=SIDE_PX, height=SIDE_PX)


@logged("view")
def view_takes(
    db: Database,
    takes: Sequence[str],
    out: Path,
    *,
    environment: Path | None = None,
    progress: Progress = silent,
    **options: Any,
) -> Json:
    """Write a self-contained page of takes to the file `out` (.html).

    Parameters
    ----------
    db, takes
        Database with models of the takes.
    out
        A file that ends in .html.
    environment
        Light from all directions, an OpenEXR file; default an overcast sky.
    progress
        Called with the stage, the number of finished takes and the total number of takes.
    **options
        traits, study, dictionary: trait -> amount at the end of its slider (as in
        `skindb.workflow.edit`), the study of the traits, and the dictionary of the fits;
        modes, the number of modes of the study of components that have sliders.

    Returns
    -------
    dict
        path, takes and bytes.
    """
    named = OVERCAST if environment is None else environment.name
    faces = _faces(db, takes, environment=environment, progress=progress, **options)
    size = write_page(out, (PagedFace.of(*face) for face in faces), environment=named)
    return {"path": str(out), "takes": list(takes), "bytes": size}


@logged("view")
def view_server(
    db: Database,
    takes: Sequence[str],
    *,
    port: int = 0,
    environment: Path | None = None,
    progress: Progress = silent,
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
        traits, study, dictionary and modes of `view_takes`.

    Raises
    ------
    InputError
        If the port is taken.
    """
    named = OVERCAST if environment is None else environment.name
    records = _faces(db, takes, environment=environment, progress=progress, **options)
    faces = {
        take: PagedFace.of(*face) for take, face in zip(takes, records, strict=True)
    }

    def index() -> bytes:
        permitted = filter(None, (_permitted(db, faces, take) for take in takes))
        return index_text(list(permitted), environment=named).encode()

    def data(take: str) -> bytes:
        face = _permitted(db, faces, take)
        if face is None:
            rule = "its subject must consent to exports"
            raise input_error(take, rule, "no such consent", "show another take")
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
    scope = intact_or_none(partial(db.consent, take))  # None: the subject was withdrawn
    if scope is None or "export" not in scope:
        faces.pop(take, None)
    return faces.get(take)


def _faces(
    db: Database,
    takes: Sequence[str],
    *,
    traits: Mapping[str, float] = NO_TRAITS,
    study: str | None = None,
    dictionary: Path | None = None,
    modes: int = 0,
    environment: Path | None = None,
    progress: Progress = silent,
) -> Iterator[tuple[Json, str]]:
    """Record and still picture of each face, see `view_takes`."""
    around = None if environment is None else Environment.read(environment)
    for number, take in enumerate(takes):
        progress("view", number, len(takes))
        model = db.read("model", take)
        db.require_consent(take, "export")
        require_fresh(db, "model", take)
        unedited, moved = _moved(db, take, model, traits, study, dictionary)
        moved += _along_modes(db, take, unedited, modes)
        attributes = {name: model.attrs[name] for name in SHOWN if name in model.attrs}
        capture = db.read("capture", take) if db.has("capture", take) else None
        if capture is not None:
            attributes |= db.record("capture", take).provenance.get("traits", {})
        record = face_record(
            unedited,
            take=take,
            attributes=attributes,
            traits=moved,
            environment=around,
            capture=capture,
        )
        yield record, still_picture(model)
    progress("view", len(takes), len(takes))


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
    db: Database,
    take: str,
    *,
    traits: Mapping[str, float] = NO_TRAITS,
    modes: int = 0,
) -> list[str]:
    """What the page of a take would skip and approximate, with bounds, one line each;
    see `view_takes`.
    """
    model = db.read("model", take)
    db.require_consent(take, "export")
    lines = page_omissions(model, edited=bool(traits))
    if modes:
        lines.append(
            f"sliders of modes: shape, albedo, gloss and translucency are interpolated "
            f"between 0 and {MODE_END:g} standard deviations (errors stand beside the "
            "sliders), and the environment's diffuse light is that of the measured shape"
        )
        lines += privacy_notes(db.read(STUDY, COMPONENTS)["face_model"].to_dataset())
    return lines


def _moved(
    db: Database,
    take: str,
    model: DataTree,
    traits: Mapping[str, float],
    study: str | None,
    dictionary: Path | None,
) -> tuple[DataTree, tuple[Trait, ...]]:
    """The model on the basis of its edits, and the edits."""
    if not traits:
        return model, ()
    source = editable_model(db, take, study, dictionary)
    plain = source.move(dict.fromkeys(traits, 0.0))
    moved = []
    for name, amount in traits.items():
        full, half = (source.move({name: part * amount}) for part in (1.0, 0.5))
        moved.append(Trait(name, full, half, amount))
    return plain, tuple(moved)


def _along_modes(
    db: Database, take: str, model: DataTree, count: int
) -> tuple[Trait, ...]:
    """A model of a registered take along modes of the population."""
    if not count:
        return ()
    db.require_consent(take, "statistics")
    study = stored_study(db, COMPONENTS)
    faces = db.read(STUDY, study)["face_model"].to_dataset().load()
    for note in privacy_notes(faces):
        warnings.warn(f"study of components: {note}", SkindbWarning, stacklevel=2)
    require_fresh(db, STUDY, study)
    records = current_registrations(db, [take])
    require(records, take, "must be registered", "none", "run: skindb register DB")
    registered = registered_datasets(db, records)[take]
    uv = registered[variables.COMMON_UV].values
    move = partial(move_along_modes, model, faces=faces, uv=uv)
    moved = []
    for i in range(min(count, faces.sizes["mode"])):
        full = np.eye(i + 1)[i] * MODE_END
        ends = (move(full), move(full / 2))
        moved.append(Trait(f"mode {i + 1}", *ends, MODE_END, symmetric=True))
    return tuple(moved)
