"""Commands that show a model or hand it on: render, compare, show, export."""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import click

import skindb
from skindb.cli.engine import SCHEDULER, shared_path
from skindb.cli.options import DB, GENERATION, PATH, TAKE, WORKERS, Finite, asked, common
from skindb.cli.shared import aligned, bar, each_take, emit, existing, writable
from skindb.errors import Fault, InputError


def exposure_option(_: click.Context, __: click.Parameter, value: str) -> float | str:
    """fixed, auto, or a positive number."""
    if value in ("fixed", "auto"):
        return value
    try:
        factor = float(value)
    except ValueError:
        factor = 0.0
    if not 1e-9 <= factor <= 1e9:
        raise click.BadParameter(f"must be fixed, auto, or a number from 1e-9 to 1e9; found {value!r}")
    return factor


TAKES = click.argument("takes", metavar="[TAKE...]", nargs=-1)


@click.command()
@DB
@TAKES
@click.option(
    "--out",
    type=PATH,
    required=True,
    help="Picture of one take (.exr linear, .png tone-mapped), or folder for <take>.png of every take.",
)
@click.option(
    "--light",
    "lights",
    multiple=True,
    help="Name of a light of the dome (several: their sum).  [default: all, with an environment none]",
)
@click.option("--environment", type=PATH, help="Light from all directions: a latitude-longitude image (.exr).")
@click.option("--camera", help="Name of a camera of the dome; default the most frontal.")
@click.option("--spp", "samples", type=click.IntRange(8, 4096), default=32, help="Number of rays per pixel.")
@click.option("--error", type=Finite(1e-4, 1), help="Relative standard error at which a picture is finished.")
@click.option("--seed", type=click.IntRange(0), default=0, help="Random seed.")
@click.option("--scale", type=Finite(0.1, 20), default=1.0, help="Size of the picture over that of the camera.")
@click.option(
    "--exposure",
    default="fixed",
    callback=exposure_option,
    help="Factor on the radiance of a PNG: fixed (a white matt surface is white), auto (by each picture), or a number.",
)
@click.option("--subsurface", is_flag=True, help="Let diffuse light travel through the skin by the dipole.")
@click.option("--edited", is_flag=True, help="Render the edited models.")
@GENERATION
@click.option("--explain", is_flag=True, help="Only say what the pictures skip.")
@WORKERS
@SCHEDULER
@common
def render(
    db: str, takes: tuple[str, ...], out: Path, edited: bool, workers: int, scheduler: str | None, **options: Any
) -> None:
    """Render models, default all, by lights and a camera of their dome."""
    database = existing(db)
    wanted = _wanted(db, takes, edited=edited)
    if out.suffix:
        writable(out, ".exr", ".png")
        _require_one(out, wanted)
    call = partial(skindb.workflow.render_take, database, shared_path(out, scheduler), edited=edited, **options)
    finish = partial(_rendered, explain=options["explain"])
    done, faults = each_take(call, wanted, workers=workers, scheduler=scheduler, progress=bar(), finish=finish)
    emit(done, [], faults)


def _rendered(told: dict[str, Any], *, explain: bool) -> tuple[str, Any, list[str]]:
    plan = [f"plan: {line}" for line in told["skipped"] or [skindb.render.NOTHING]]
    lines = [*(plan if asked("verbose") else []), told["path"]]
    if explain:
        lines = told["skipped"] or [skindb.render.NOTHING]
    return told["take"], told, lines


@click.command()
@DB
@TAKE
@click.option(
    "--out", type=PATH, help="Folder for pictures: photograph, rendering, diffuse and surface part, difference."
)
@click.option("--samples", type=click.IntRange(1, 8), default=2, help="Number of rays per pixel and axis.")
@click.option("--subsurface", is_flag=True, help="Let diffuse light travel through the skin by the dipole.")
@GENERATION
@common
def compare(db: str, take: str, out: Path | None, generation: int | None, **options: Any) -> None:
    """Compare the photographs kept by ingest with the model's prediction: RMSE, PSNR, SSIM, CIEDE2000.

    Below the table stands what large residuals look like: another light intensity, a shift, light in shadows,
    another gloss, hair. --json has the figures of each region too.
    """
    found = skindb.workflow.compare_take(existing(db), take, generation=generation, **options)
    if out:
        skindb.render.write_comparisons(found, out)
    result = [
        {
            "light": c.light,
            "camera": c.camera,
            "held_out": c.held_out,
            **c.error,
            "regions": c.regions,
            "causes": asdict(c.causes),
            "likely_causes": c.causes.notable,
        }
        for c in found
    ]
    header = ["light", "camera", "held_out", "relative_rmse", "psnr", "ssim", "delta_e_median"]
    lines = aligned([header, *([row[name] for name in header] for row in result)])
    lines += [f"{c.light} {c.camera}: {'; '.join(c.causes.notable)}" for c in found if c.causes.notable]
    emit(result, lines)


@click.command()
@DB
@TAKE
@click.argument("variable")
@click.argument("out", type=PATH)
@click.option("--at", multiple=True, metavar="DIMENSION=LABEL", help="For example channel=G (several times).")
@common
def show(db: str, take: str, variable: str, out: Path, at: tuple[str, ...]) -> None:
    """Draw a variable of the surfels on the face to OUT (.png, .pdf, .svg): sample_count, fit_status..."""
    writable(out, ".png", ".pdf", ".svg")
    told = skindb.workflow.show_take(existing(db), take, variable, out, at=dict(map(_label, at)))
    emit(told, [told["path"]])


@click.command()
@DB
@TAKES
@click.option("--out", type=PATH, required=True, help="Folder for <take>/ of every take; with --gltf for <take>.glb.")
@click.option(
    "--size",
    type=click.IntRange(16, 8192),
    help="Number of texels along a map's side.  [default: 1.5 in the spacing of the surfels, as a power of two]",
)
@click.option("--gltf", is_flag=True, help="Write only the glTF; --out may then be a .glb file.")
@click.option("--no-merl", is_flag=True, help="Write no MERL binaries (35 MB each).")
@click.option("--edited", is_flag=True, help="Export the edited models.")
@GENERATION
@WORKERS
@SCHEDULER
@common
def export(
    db: str,
    takes: tuple[str, ...],
    out: Path,
    no_merl: bool,
    edited: bool,
    workers: int,
    scheduler: str | None,
    **options: Any,
) -> None:
    """Write models, default all: maps as EXR, bases as MERL binary and npz, glTF, manifest.json."""
    database, progress = existing(db), bar()
    wanted = _wanted(db, takes, edited=edited)
    if options["gltf"] and out.suffix:
        writable(out, ".glb")
        _require_one(out, wanted)
    options |= {"merl": not no_merl, "edited": edited, "progress": progress}
    call = partial(skindb.workflow.export_take, database, shared_path(out, scheduler), **options)
    work: dict[str, Any] = {"workers": workers, "scheduler": scheduler}
    done, faults = each_take(call, wanted, **work, progress=progress, finish=_exported)
    emit(done, [], faults)


def _exported(path: Path) -> tuple[str, Any, list[str]]:
    return path.name, str(path), [str(path)]


def _wanted(db: str, takes: tuple[str, ...], *, edited: bool) -> list[str]:
    """The takes that are named, or all that have a model."""
    kind = "edit" if edited else "model"
    found = list(takes) or skindb.open(db).takes(kind)
    if not found:
        cure = "run skindb edit first" if edited else "run skindb fit first"
        raise InputError(Fault(db, f"there must be a take with a {kind}", "none", cure))
    return found


def _require_one(out: Path, takes: list[str]) -> None:
    if len(takes) > 1:
        raise InputError(Fault(str(out), "a file holds one take", f"{len(takes)} takes", "name a folder, or one take"))


def _label(text: str) -> tuple[str, str]:
    name, _, label = text.partition("=")
    if not label:
        raise click.UsageError(f"--at needs DIMENSION=LABEL, such as channel=G; found {text!r}")
    return name, label
