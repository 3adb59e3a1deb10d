"""Models moved along traits: committed, or drawn as a grid of pictures."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from xarray import DataTree

from skindb.analysis.brdf import population_basis
from skindb.analysis.edit import apply_traits, with_basis
from skindb.analysis.summary import SAMPLED, common_maps
from skindb.errors import require
from skindb.files import Json, plain
from skindb.reflectance.dictionary import embedded_dictionary
from skindb.reflectance.kinds import require_mixture
from skindb.render.figures import write_grid
from skindb.render.rendering import frontal_camera, render
from skindb.schema import variables
from skindb.store import STUDY, Database, Record, require_fresh
from skindb.types import Float32, Progress, lengths, silent
from skindb.workflow import studies
from skindb.workflow.audit import logged
from skindb.workflow.cohorts import current_registrations, registered_datasets
from skindb.workflow.derive import Derivation, derive
from skindb.workflow.fit import dictionary_at

GRID_SIDE = 320.0  # pixels, the longer side of a picture in a grid
SAMPLES = 4  # rays per pixel of such a picture, of few lights
LABEL_WIDTH = 26  # characters
METHOD = (apply_traits, common_maps)  # functions that compute an edit
TRAITS = "traits"  # method of the study of an edit
STRENGTHS = (0.5, 1.0)  # of the edits in a grid, as in figure 19 of the paper


@dataclass(frozen=True)
class Editable:
    """A model, what moves it, and the versions both are from."""

    model: DataTree
    study: str
    move: Callable[[Mapping[str, float]], DataTree]
    derivation: Derivation  # without the amounts

    def derivation_by(self, amounts: Mapping[str, float]) -> Derivation:
        """What decides an edit by these amounts."""
        parameters = {"study": self.study, "amounts": plain(dict(amounts))}
        provenance = {**self.derivation.provenance, "parameters": parameters}
        return replace(self.derivation, provenance=provenance)


@logged("edit")
def edit(
    db: Database,
    take: str,
    amounts: Mapping[str, float],
    *,
    study: str | None = None,
    dictionary: Path | None = None,
) -> DataTree:
    """Move the model of a take along traits and commit it as the kind "edit".

    If the newest edit is this one already, nothing is computed.

    Parameters
    ----------
    db
        Database with a study of traits.
    take
        Its model is moved.
    amounts, dictionary
        Trait -> amount, see `skindb.analysis.apply_traits`; path of the dictionary of the fits.
    study
        What the study of traits is stored as; default "traits", or the only one there is.

    Warns
    -----
    StaleWarning
        If a model that the study was made from was fitted again since.

    Raises
    ------
    InputError
        Without such a study, without the consent to statistics, or if a subject whose
        data the study used withdrew it.
    """
    source = editable_model(db, take, study, dictionary)
    record = derive(source.derivation_by(amounts), partial(source.move, amounts))
    return db.version(record)


@logged("render")
def edit_grid(
    db: Database,
    take: str,
    rows: Mapping[str, Mapping[str, float]],
    out: Path,
    *,
    strengths: Sequence[float] = STRENGTHS,
    study: str | None = None,
    dictionary: Path | None = None,
    progress: Progress = silent,
    **options: Any,
) -> dict[str, DataTree]:
    """Draw a model and edits of it, one row each, with one exposure for all; nothing is
    committed (figure 19).

    Parameters
    ----------
    db, take, study, dictionary
        As in `edit`.
    rows
        Label -> amounts at full strength.
    out
        Picture to write (.png, .pdf, .svg).
    strengths
        Of the columns beside the unedited model.
    progress
        Called with the stage, the number of finished steps and the total number of steps.
    **options
        Of `skindb.render.render`: lights, by default the one nearest to
        the frontal camera, in which gloss shows most; camera, samples, subsurface, and
        scale, by default such that a picture's longer side has 320 pixels.

    Returns
    -------
    dict
        Label -> edited model at the last strength, which is described in `edit_report`
        and `trait_notes`.
    """
    source = editable_model(db, take, study, dictionary)
    db.require_consent(take, "export")
    options.setdefault("scale", _grid_scale(source.model))
    options.setdefault("lights", [_frontal_light(source.model)])
    plain = _radiance(source.model, **options)
    pictures = {}
    strongest = {}
    number = 0
    steps = len(rows) * len(strengths)
    progress("edits", 0, steps)
    for label, amounts in rows.items():
        pictures[label] = [plain]
        for strength in strengths:
            strongest[label] = source.move(
                {name: strength * amount for name, amount in amounts.items()}
            )
            pictures[label].append(_radiance(strongest[label], **options))
            number += 1
            progress("edits", number, steps)
    titles = [take, *(f"{strength:g} times the trait" for strength in strengths)]
    labels = {label: f"{label}\n{_sides(strongest[label])}" for label in rows}
    write_grid(out, {labels[label]: row for label, row in pictures.items()}, titles)
    return strongest


@logged("render")
def basis_grid(
    db: Database,
    take: str,
    out: Path,
    *,
    ks: Sequence[int] = (1, 2, 4),
    lights: Sequence[str] = (),
    seed: int = 0,
    dictionary: Path | None = None,
    **options: Any,
) -> dict[str, float]:
    """Draw a face, and what its surface reflects alone, with k basis BRDFs and with all of
    the dictionary, with one exposure (figure 7).

    Parameters
    ----------
    db, take, dictionary
        As in `edit`.
    out
        Picture to write (.png, .pdf, .svg).
    ks
        Numbers of basis BRDFs; each basis is the best one for this take.
    lights
        Names of lights, summed; default the one nearest to the frontal camera, in which
        highlights show most.
    seed
        Random seed of the factorisations.
    **options
        Of `skindb.render.render`.

    Returns
    -------
    dict
        Column -> relative RMS difference of its picture from that with the whole dictionary.
    """
    model = db.read("model", take)
    db.require_consent(take, "export")
    require_mixture(model["fitted"].dataset, f"model of {take}")
    names = model["fitted"].dataset["dictionary"].values.tolist()
    tables = studies.dictionary_tables(
        names, float(model[f"basis/{variables.DISC_ANGULAR_RADIUS}"]), dictionary
    )
    cohort = db.cohort("surfels", takes=[take], surfels=SAMPLED)
    mixtures = {}
    for k in ks:
        rng = np.random.default_rng(seed)
        reduced = population_basis(cohort, tables=tables, k=k, in_metric=True, rng=rng)
        mixtures[f"k = {k}"] = reduced[variables.POPULATION_MIXTURE].values
    mixtures[f"all {len(names)}"] = np.eye(len(names))
    options.setdefault("scale", _grid_scale(model))
    options["lights"] = lights or [_frontal_light(model)]
    pictures = {}
    surfaces = []
    for name, mixture in mixtures.items():
        reduced_model = with_basis(model, mixture=mixture, names=names, tables=tables)
        pictures[name] = _radiance(reduced_model, **options)
        surfaces.append(_radiance(reduced_model, **options, terms=("surface",)))
    rows = {take: [*pictures.values()], "surface alone": surfaces}
    write_grid(out, rows, list(pictures))
    *_, full = pictures.values()
    return {
        name: _root_mean_square(picture - full) / _root_mean_square(full)
        for name, picture in pictures.items()
    }


def _radiance(model: DataTree, **options: Any) -> Float32:
    """Picture (h, w, 3) of a grid."""
    seen = render(model, **{"samples": SAMPLES, **options})
    return seen["radiance"].values


def _root_mean_square(values: Float32) -> float:
    return float(np.sqrt((values**2).mean()))


def _frontal_light(model: DataTree) -> str:
    """The light whose direction is nearest to that of the frontal camera."""
    dome = model["dome"].dataset.load()
    seen_from = dome[variables.CAMERA_POSITION].values[frontal_camera(dome)]
    place = dome[variables.LIGHT_POSITION].values
    cosine = place @ seen_from / lengths(place)
    return str(dome["light"].values[int(np.argmax(cosine))])


def _grid_scale(model: DataTree) -> float:
    """Size of the pictures of a grid over that of the camera's: few pixels, of which
    each costs every light.
    """
    dome = model["dome"].dataset
    return GRID_SIDE / float(dome[variables.CAMERA_SIZE].max())


def _sides(edited: DataTree) -> str:
    """How many takes the traits of a row follow from."""
    return "\n".join(
        fill(note.partition(": ")[2].partition(";")[0], LABEL_WIDTH)
        for note in edited.attrs["trait_notes"]
    )


def editable_model(
    db: Database, take: str, study: str | None, dictionary: Path | None
) -> Editable:
    """A model of a database with what moves it along the traits of a study."""
    study = stored_study(db, TRAITS, study)
    inputs = [db.record("model", take), db.record(STUDY, study)]
    model, vectors = map(db.version, inputs)
    db.require_consent(take, "statistics")
    require_fresh(db, STUDY, study)
    require_mixture(model["fitted"].dataset, f"model of {take}")
    brdfs = model["fitted"].dataset["dictionary"].values.tolist()
    textures, registrations = _registered_textures(db, take, model, vectors)
    inputs += registrations
    traits, basis, albedo = (
        vectors[name].dataset.compute()
        for name in ("traits", "population_basis", "albedo")
    )
    tables = studies.dictionary_tables(
        brdfs, float(model[f"basis/{variables.DISC_ANGULAR_RADIUS}"]), dictionary
    )

    def move(amounts: Mapping[str, float]) -> DataTree:
        return apply_traits(
            model,
            amounts=amounts,
            traits=traits,
            basis=basis,
            albedo=albedo,
            tables=tables,
            **textures,
        )

    derivation = Derivation.of(
        db,
        "edit",
        take,
        inputs=inputs,
        code=METHOD,
        names={name for record in inputs for name in record.names},
        study_takes=traits["take"].values.tolist(),
        dictionary_digest=(dictionary_at(dictionary) or embedded_dictionary()).digest,
    )
    return Editable(model, study, move, derivation)


def _registered_textures(
    db: Database, take: str, model: DataTree, vectors: DataTree
) -> tuple[Json, list[Record]]:
    """What moves the texture of a registered take: arguments of `apply_traits`, and the
    record of its registration; nothing for other takes.
    """
    is_textured = "texture" in vectors.children
    records = current_registrations(db, [take]) if is_textured else {}
    if not records:
        return {}, []
    registered = registered_datasets(db, records)[take]
    texture = vectors["texture"].dataset.compute()
    maps = common_maps(model, registered, size=texture.sizes["v"])
    arguments = {"texture": texture, "maps": maps, "registered": registered}
    return arguments, [records[take]]


def stored_study(db: Database, method: str, name: str | None = None) -> str:
    """What a study of traits or components is stored as; by default `method`, or the only one."""
    stored = [study for study in db.takes(STUDY) if study.partition(".")[0] == method]
    study = name or (stored[0] if len(stored) == 1 else method)
    cure = f"run: skindb analyze DB {method}"
    require(
        study in stored,
        f"study {study}",
        f"must be a study of {method} in the database",
        f"studies of {method}: {', '.join(stored) or 'none'}",
        "name one of them with --study" if stored and method == TRAITS else cure,
    )
    return study
