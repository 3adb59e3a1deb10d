"""The whole way of the data once, on virtual subjects, ending in a report."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from skindb.analysis.study import STUDIES, analyze, edit_take, register_takes
from skindb.demo_report import Results, write_report
from skindb.errors import Fault, InputError
from skindb.export.bundle import export_bundle
from skindb.fit import fit_take
from skindb.ingest import ingest_capture
from skindb.processes import side_by_side
from skindb.render.photographs import compare_photographs
from skindb.store import Database
from skindb.virtual.person import default_people
from skindb.virtual.takes import simulate_takes
from skindb.virtual.truth import recovered_against_true

Progress = Callable[[str, int, int], None]
HELD_OUT, SPACING = 0.1, 1.5  # share of lights; mm
EDIT = ("lotion", (0.0, 0.5, 1.0))


def run_demo(
    out: Path,
    *,
    takes: int = 8,
    cameras: int = 8,
    lights: int = 48,
    seed: int = 2005,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Virtual subjects -> capture -> ingest -> fit -> analysis -> edit -> render -> export -> report.html.

    Parameters
    ----------
    out
        Folder to write; captures/, db/, export/ and report.html. It must be absent, empty or an earlier demo's.
    takes
        How many of the eight virtual takes.
    cameras, lights
        The virtual dome.
    seed
        Of all noise and sampling.
    progress
        Called with stage, steps done and steps in all.

    Returns
    -------
    dict
        report (path), db (path), seconds per stage, and the recovered errors of each take.
    """
    _start_afresh(out)
    tell = progress or (lambda *_: None)
    results, db = Results(), Database(out / "db")
    make = partial(_make_take, out=out, cameras=cameras, lights=lights, seed=seed)
    results.add(make(0, progress=tell))  # alone: it compiles what the others use
    if takes > 1:
        tell("the other takes", 0, takes - 1)
    for i, made in enumerate(side_by_side(make, range(1, takes)), 1):
        results.add(made)
        tell("the other takes", i, takes - 1)
    with results.stage("analyze"):
        register_takes(db)  # once, for every study
        for what in STUDIES if takes > 1 else ("albedo", "translucency", "brdf"):
            results.studies[what] = analyze(db, what, seed=seed, progress=tell)[1]
    with results.stage("edit"):
        _edit(results, db)
    with results.stage("export"):
        first = next(iter(results.models))
        export_bundle(results.models[first], out / "export" / first, size=1024, merl=False, progress=tell)
    with results.stage("report"):
        report = write_report(out / "report.html", results, progress=tell)
    recovered = {take: one.summary() for take, one in results.recovered.items()}
    return {"report": str(report), "db": str(db.root), "seconds": results.seconds, "recovered": recovered}


def _start_afresh(out: Path) -> None:
    """An earlier demo is replaced; anything else is left alone."""
    mark = out / ".skindb-demo"
    if out.exists() and any(out.iterdir()) and not mark.exists():
        raise InputError(
            Fault(str(out), "the demo needs an absent or empty folder", "other files", "choose another --out")
        )
    added = sorted(set(Database(out / "db").subjects()) - {person.subject for person in default_people()})
    if added:
        rule = "the demo makes its database anew and would take these subjects along"
        raise InputError(Fault(str(out / "db"), rule, ", ".join(added), "choose another --out, or move the database"))
    for name in ("captures", "db", "export"):
        shutil.rmtree(out / name, ignore_errors=True)
    (out / "report.html").unlink(missing_ok=True)
    out.mkdir(parents=True, exist_ok=True)
    mark.touch()


def _make_take(i: int, *, out: Path, cameras: int, lights: int, seed: int, progress: Progress | None = None) -> Results:
    """Photograph, ingest and fit one of the virtual takes; compare it with its photographs and its truth."""
    results, db = Results(), Database(out / "db")
    with results.stage("simulate"):
        (folder,) = simulate_takes(
            out / "captures", takes=[i], cameras=cameras, lights=lights, seed=seed, progress=progress
        )
    with results.stage("ingest"):
        take = ingest_capture(db, folder, spacing_mm=SPACING, progress=progress).take
    with results.stage("fit"):
        _, results.fits[take] = fit_take(db, take, hold_out_lights=HELD_OUT, seed=seed, progress=progress)
    with results.stage("compare"):
        model = db.read("model", take)
        results.models[take] = model.map_over_datasets(lambda ds: ds.load())
        results.models[take].attrs = model.attrs
        results.compared[take] = compare_photographs(results.models[take], db.read("capture", take))
        with np.load(folder.with_name(folder.name + ".truth.npz")) as truth:
            results.recovered[take] = recovered_against_true(results.models[take], dict(truth))
    return results


def _edit(results: Results, db: Database) -> None:
    """Move the last take, which is nobody's twin, along one trait in steps."""
    if "traits" not in results.studies:
        return
    names = [str(t) for t in results.studies["traits"]["traits"].to_dataset()["trait"].values]
    if not names:
        return
    trait = EDIT[0] if EDIT[0] in names else names[0]
    results.edited_take = list(results.models)[-1]
    for amount in EDIT[1]:
        tree = edit_take(db, results.edited_take, {trait: amount})[1]
        results.edits[amount] = tree
