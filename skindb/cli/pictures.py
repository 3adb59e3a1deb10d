"""Commands that show a model or hand it on: render, compare, show, export."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import skindb
from skindb.cli.options import DB, GENERATION, PATH, TAKE, Finite, asked, common
from skindb.cli.shared import aligned, bar, emit, existing, writable


@click.command()
@DB
@TAKE
@click.argument("out", type=PATH)
@click.option("--light", "lights", multiple=True, help="Name of a light of the dome (several: their sum); default all.")
@click.option("--camera", help="Name of a camera of the dome; default the most frontal.")
@click.option("--samples", type=click.IntRange(1, 8), default=2, help="Rays per pixel and axis.")
@click.option("--scale", type=Finite(0.1, 20), default=1.0, help="Of the camera's pixels.")
@click.option("--subsurface", is_flag=True, help="Diffuse light through the skin by the dipole.")
@click.option("--edited", is_flag=True, help="The edited model.")
@GENERATION
@click.option("--explain", is_flag=True, help="Only say what the picture leaves out.")
@common
def render(db: str, take: str, out: Path, edited: bool, generation: int | None, **options: Any) -> None:
    """Render a model by lights and a camera of its dome to OUT (.exr linear, .png tone-mapped)."""
    from skindb.plan import NOTHING
    from skindb.render.picture import render_picture

    writable(out, ".exr", ".png")
    model = skindb.open(db).read(_kind(edited), take, generation=generation)
    if asked("verbose") and not options["explain"]:
        planned = render_picture(model, out, **{**options, "explain": True})["left_out"]
        click.echo("\n".join(f"plan: {line}" for line in planned or [NOTHING]), err=True)
    told = render_picture(model, out, **options)
    emit(told, told["left_out"] or [NOTHING] if options["explain"] else [told["path"]])


@click.command()
@DB
@TAKE
@click.option("--out", type=PATH, help="Folder for pictures: photograph, rendering, difference.")
@click.option("--samples", type=click.IntRange(1, 8), default=2, help="Rays per pixel and axis.")
@click.option("--subsurface", is_flag=True, help="Diffuse light through the skin by the dipole.")
@GENERATION
@common
def compare(db: str, take: str, out: Path | None, generation: int | None, **options: Any) -> None:
    """Predict the photographs kept by ingest and say how far off: RMSE, PSNR, SSIM, CIEDE2000."""
    from skindb.render.photographs import compare_photographs, write_comparisons

    database = skindb.open(db)
    model = database.read("model", take, generation=generation)
    found = compare_photographs(model, database.source(model), **options)
    if out:
        write_comparisons(found, out)
    result = [{"light": c.light, "camera": c.camera, "held_out": c.held_out, **c.error} for c in found]
    header = ["light", "camera", "held_out", "relative_rmse", "psnr", "ssim", "delta_e_median"]
    emit(result, aligned([header, *([row[name] for name in header] for row in result)]))


@click.command()
@DB
@TAKE
@click.argument("variable")
@click.argument("out", type=PATH)
@click.option("--at", multiple=True, metavar="DIMENSION=LABEL", help="For example channel=G (several times).")
@common
def show(db: str, take: str, variable: str, out: Path, at: tuple[str, ...]) -> None:
    """Draw a variable of the surfels on the face to OUT (.png, .pdf, .svg): sample_count, fit_status..."""
    from skindb.render.field import write_field

    writable(out, ".png", ".pdf", ".svg")
    told = write_field(existing(db), take, variable, out, at=dict(map(_label, at)))
    emit(told, [told["path"]])


@click.command()
@DB
@TAKE
@click.argument("out", type=PATH)
@click.option("--size", type=click.IntRange(16, 8192), default=2048, help="Texels along a map's side.")
@click.option("--gltf", is_flag=True, help="Only model.glb, written to OUT.")
@click.option("--no-merl", is_flag=True, help="Leave out the MERL binaries (35 MB each).")
@click.option("--edited", is_flag=True, help="The edited model.")
@GENERATION
@common
def export(
    db: str,
    take: str,
    out: Path,
    size: int,
    gltf: bool,
    no_merl: bool,
    edited: bool,
    generation: int | None,
) -> None:
    """Write the bundle of a model: maps as EXR, bases as MERL binary and npz, glTF, manifest.json."""
    from skindb.export.bundle import export_bundle
    from skindb.export.gltf import export_gltf

    model = skindb.open(db).read(_kind(edited), take, generation=generation)
    if gltf:
        export_gltf(model, out, size=size)
    else:
        export_bundle(model, out, size=size, merl=not no_merl, progress=bar())
    emit({"path": str(out)}, [str(out)])


def _kind(edited: bool) -> str:
    return "edit" if edited else "model"


def _label(text: str) -> tuple[str, str]:
    name, _, label = text.partition("=")
    if not label:
        raise click.UsageError(f"--at needs DIMENSION=LABEL, such as channel=G; found {text!r}")
    return name, label
