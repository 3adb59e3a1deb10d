"""Run all stages of the library on virtual subjects, and write a report."""

import shutil
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from skindb import workflow
from skindb.demo.report import PLOTS, VIEWER, Results, write_report
from skindb.elementwise import thread_count
from skindb.errors import require
from skindb.export.bundle import export_bundle
from skindb.files import Json, make_private, private_file
from skindb.fit import compile_kernels
from skindb.parameters import DemoParameters, FitParameters, SimulationParameters
from skindb.render.photographs import compare_photographs
from skindb.store import Database
from skindb.types import Progress, silent
from skindb.virtual.capture import recovered_against_true, simulate_takes
from skindb.virtual.person import default_people

HELD_OUT = 0.1  # fraction of the lights
SPACING = 1.5  # mm
MAP_TEXELS = 512  # along each side of an exported map: 1 mm, of surfels 1.5 mm apart
MAX_WORKERS = 4  # each take of the demo needs 1.5 GB
# 0 and 1 correspond to measured takes of one subject
EDIT_CONDITION = "lotion"
EDIT_AMOUNTS = (0.0, 0.25, 1.0)


def run_demo(out: Path, *, progress: Progress = silent, **options: Any) -> Json:
    """Capture virtual subjects, ingest, fit, analyse, edit, render and export them, and
    write report.html.

    Parameters
    ----------
    out
        Folder for captures/, db/, export/, plots/, the viewer and report.html. It must be
        absent, empty or from an earlier demo, which is replaced.
    progress
        Called with the stage, the number of finished steps and the total number of steps.
    **options
        Of `skindb.parameters.DemoParameters`: takes, cameras, lights, seed, workers.

    Returns
    -------
    dict
        Paths of report, viewer and db, and the errors of the recovered values of each
        take.

    Raises
    ------
    InputError
        If the folder contains other files, its database other subjects, or an option is
        out of its limits.
    """
    parameters = DemoParameters(**options)
    _remove_earlier_demo(out)
    db = Database(out / "db")
    workers = parameters.workers or min(thread_count(), MAX_WORKERS)
    results = _make_takes(out, parameters, workers, progress)
    # once, for every study
    workflow.register_takes(db, workers=workers, progress=progress)
    for name, study_options in _studies(parameters).items():
        results.studies[name] = workflow.study(db, name, **study_options)
    _edit(results, db)
    exported = next(iter(results.models))
    model = results.models[exported]
    export_bundle(
        model,
        out / "export" / exported,
        size=MAP_TEXELS,
        merl=False,
        progress=progress,
    )
    traits = {EDIT_CONDITION: 1.0} if results.edited_take == exported else {}
    workflow.view_takes(db, [exported], out / VIEWER, traits=traits, progress=progress)
    report = write_report(out / "report.html", results, progress=progress)
    recovered = {
        take: recovery.summary() for take, recovery in results.recovered.items()
    }
    return {
        "report": str(report),
        "viewer": str(out / VIEWER),
        "db": db.url,
        "recovered": recovered,
    }


def _make_takes(
    out: Path, parameters: DemoParameters, workers: int, progress: Progress
) -> Results:
    """The results of all takes. The first one is made alone, as it compiles kernels that
    the others use.
    """
    compile_kernels(progress)
    results = Results()
    make = partial(_make_take, out=out, parameters=parameters)
    results.add(make(0, progress=progress))
    later = range(1, parameters.takes)
    outcomes = workflow.map_takes(make, later, workers=workers)
    if later:
        progress("the other takes", 0, len(later))
    for i, take_results in enumerate(workflow.results_of(outcomes), 1):
        results.add(take_results)
        progress("the other takes", i, len(later))
    results.sort_takes([person.take for person in default_people()])
    return results


def _studies(parameters: DemoParameters) -> dict[str, Json]:
    """Names and parameters of the studies; traits need two takes."""
    studies = {
        "brdf": {"seed": parameters.seed},
        "albedo": {},
        "translucency": {},
    }
    if parameters.takes > 1:
        studies["traits"] = {"seed": parameters.seed}
    return studies


def _remove_earlier_demo(out: Path) -> None:
    """Remove the files of an earlier demo; a folder with other content is refused."""
    mark = out / ".skindb-demo"
    require(
        mark.exists() or not out.exists() or not any(out.iterdir()),
        str(out),
        "the folder of the demo must be absent, empty or from an earlier demo",
        "other files",
        "choose another --out",
    )
    people = {person.subject for person in default_people()}
    added = sorted(set(Database(out / "db").subjects()) - people)
    require(
        not added,
        str(out / "db"),
        "the database of the demo, which is deleted, must have no other subjects",
        ", ".join(added),
        "choose another --out, or move the database",
    )
    for name in ("captures", "db", "export", PLOTS):
        shutil.rmtree(out / name, ignore_errors=True)
    for name in ("report.html", VIEWER):
        (out / name).unlink(missing_ok=True)
    make_private(out)
    private_file(mark)


def _make_take(
    i: int,
    *,
    out: Path,
    parameters: DemoParameters,
    progress: Progress = silent,
) -> Results:
    """Simulate, ingest and fit a virtual take, and compare the model with its
    photographs and its true values.
    """
    results = Results()
    db = Database(out / "db")
    seed = parameters.seed
    virtual = SimulationParameters(parameters.cameras, parameters.lights, seed=seed)
    (folder,) = simulate_takes(out / "captures", virtual, takes=[i], progress=progress)
    take = workflow.ingest_take(db, folder, spacing_mm=SPACING, progress=progress).take
    fitted = FitParameters(hold_out_lights=HELD_OUT, seed=seed)
    record = workflow.fit_take(db, take, fitted, progress=progress)
    results.fits[take] = record.provenance
    model = db.read("model", take)
    results.models[take] = model.map_over_datasets(lambda ds: ds.load())
    results.models[take].attrs = model.attrs
    results.compared[take] = compare_photographs(
        results.models[take], db.read("capture", take)
    )
    with np.load(folder.with_name(folder.name + ".truth.npz")) as truth:
        results.recovered[take] = recovered_against_true(
            results.models[take], dict(truth)
        )
    return results


def _edit(results: Results, db: Database) -> None:
    """Edit a subject who was measured with and without a condition, from one take
    towards the other.
    """
    pairs = [
        take for take in results.models if f"{take}.{EDIT_CONDITION}" in results.models
    ]
    if "traits" not in results.studies or not pairs:
        return
    results.edited_take = pairs[0]
    results.target_take = f"{pairs[0]}.{EDIT_CONDITION}"
    for amount in EDIT_AMOUNTS:
        results.edits[amount] = workflow.edit(
            db, results.edited_take, {EDIT_CONDITION: amount}
        )
