"""Commands that draw or export models: render, compare, show, export."""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import click

import skindb
from skindb.cli.engine import SCHEDULER, shared_path
from skindb.cli.options import (
    DB,
    GENERATION,
    PATH,
    TAKE,
    WORKERS,
    Finite,
    Seed,
    asked,
    common,
)
from skindb.cli.shared import aligned, bar, each_take, emit, existing, writable
from skindb.errors import Fault, InputError


def exposure_option(_: click.Context, __: click.Parameter, value: str) -> float | str:
    """Parse an exposure: fixed, auto, or a positive number."""
    if value in ("fixed", "auto"):
        return value
    try:
        factor = float(value)
    except ValueError:
        factor = 0.0
    if not 1e-9 <= factor <= 1e9:
        raise click.BadParameter(
            f"must be fixed, auto, or a number from 1e-9 to 1e9; found {value!r}"
        )
    return factor


TAKES = click.argument("takes", metavar="[TAKE...]", nargs=-1)


@click.command()
@DB
@TAKES
@click.option(
    "--out",
    type=PATH,
    required=True,
    help=(
        "Picture of one take (.exr linear, .png tone-mapped), or folder for <take>.png "
        "of every take."
    ),
)
@click.option(
    "--light",
    "lights",
    multiple=True,
    help=(
        "Name of a light of the dome; several are added.  [default: all, or none with "
        "an environment]"
    ),
)
@click.option(
    "--environment",
    type=PATH,
    help="Latitude-longitude image of light from all directions (.exr).",
)
@click.option(
    "--camera", help="Name of a camera of the dome.  [default: the most frontal one]"
)
@click.option(
    "--spp",
    "samples",
    type=click.IntRange(8, 4096),
    default=32,
    help="Number of rays per pixel.",
)
@click.option(
    "--error",
    type=Finite(1e-4, 1),
    help="Relative standard error of the picture at which sampling stops.",
)
@click.option("--seed", type=Seed(), default=0, help="Random seed.")
@click.option(
    "--scale",
    type=Finite(0.1, 20),
    default=1.0,
    help="Size of the picture relative to that of the camera.",
)
@click.option(
    "--exposure",
    default="fixed",
    callback=exposure_option,
    help=(
        "Exposure of a PNG: fixed (a white matt surface appears white), auto (for each "
        "picture), or a factor."
    ),
)
@click.option(
    "--subsurface", is_flag=True, help="Simulate subsurface transport by the dipole."
)
@click.option("--edited", is_flag=True, help="Render the edited models.")
@GENERATION
@click.option(
    "--explain", is_flag=True, help="Only report what the pictures would skip."
)
@WORKERS
@SCHEDULER
@common
def render(
    db: str,
    takes: tuple[str, ...],
    out: Path,
    edited: bool,
    workers: int,
    scheduler: str | None,
    **options: Any,
) -> None:
    """Render models with lights of their dome or an environment.

    By default all models are rendered with all lights of the dome and its most frontal camera.
    """
    database = existing(db)
    chosen = _wanted(db, takes, edited=edited)
    if out.suffix:
        writable(out, ".exr", ".png")
        _require_one(out, chosen)
    call = partial(
        skindb.workflow.render_take,
        database,
        shared_path(out, scheduler),
        edited=edited,
        **options,
    )
    finish = partial(_rendered, explain=options["explain"], error=options["error"])
    work: dict[str, Any] = {"workers": workers, "scheduler": scheduler}
    with skindb.workflow.logged_action(
        database, "render", chosen, arguments={"edited": edited, **options}
    ):
        results, faults = each_take(call, chosen, **work, progress=bar(), finish=finish)
    emit(results, [], faults)


def _rendered(
    report: dict[str, Any], *, explain: bool, error: float | None
) -> tuple[str, Any, list[str]]:
    skipped = report["skipped"] or [skindb.render.NOTHING]
    if explain:
        return report["take"], report, [*skipped, *report["kept"]]
    relative_error = report["relative_error"]
    path = (
        f"{report['path']}: {report['samples']} rays per pixel, relative standard error "
        f"{relative_error:.2%}"
    )
    missed = (
        f", above the wanted {error:.2%}"
        if error is not None and relative_error > error
        else ""
    )
    plan = [f"plan: {line}" for line in skipped]
    return report["take"], report, [*(plan if asked("verbose") else []), path + missed]


@click.command()
@DB
@TAKE
@click.option(
    "--out",
    type=PATH,
    help="Folder for pictures: photograph, rendering, diffuse and surface components, difference.",
)
@click.option(
    "--samples",
    type=click.IntRange(1, 8),
    default=2,
    help="Number of rays per pixel and axis.",
)
@click.option(
    "--subsurface", is_flag=True, help="Simulate subsurface transport by the dipole."
)
@GENERATION
@common
def compare(
    db: str, take: str, out: Path | None, generation: int | None, **options: Any
) -> None:
    """Compare the kept photographs with renderings of the model.

    The measures are RMSE, PSNR, SSIM and CIEDE2000 for each photograph that ingest kept.

    Likely causes of large residuals are named below the table: a wrong light intensity,
    a shift, light in shadows, a different gloss, hair. With --json, the figures of each
    region are printed too.
    """
    comparisons = skindb.workflow.compare_take(
        existing(db), take, generation=generation, **options
    )
    if out:
        skindb.render.write_comparisons(comparisons, out)
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
        for c in comparisons
    ]
    header = [
        "light",
        "camera",
        "held_out",
        "relative_rmse",
        "psnr",
        "ssim",
        "delta_e_median",
    ]
    lines = aligned([header, *([row[name] for name in header] for row in result)])
    lines += [
        f"{c.light} {c.camera}: {'; '.join(c.causes.notable)}"
        for c in comparisons
        if c.causes.notable
    ]
    emit(result, lines)


@click.command()
@DB
@TAKE
@click.argument("variable")
@click.argument("out", type=PATH)
@click.option(
    "--at",
    multiple=True,
    metavar="DIMENSION=LABEL",
    help="Position along a dimension, for example channel=G (may be given several times).",
)
@common
def show(db: str, take: str, variable: str, out: Path, at: tuple[str, ...]) -> None:
    """Draw a variable of the surfels on the face.

    A variable is, for example, sample_count or fit_status. OUT is a picture (.png, .pdf, .svg).
    """
    writable(out, ".png", ".pdf", ".svg")
    report = skindb.workflow.show_take(
        existing(db), take, variable, out, at=dict(map(_label, at))
    )
    emit(report, [report["path"]])


@click.command()
@DB
@TAKES
@click.option(
    "--out",
    type=PATH,
    required=True,
    help="Folder that gets a folder for each take, or with --gltf a .glb file for each.",
)
@click.option(
    "--size",
    type=click.IntRange(16, 8192),
    help=(
        "Number of texels along each side of a map.  [default: 1.5 per surfel spacing, "
        "rounded up to a power of two]"
    ),
)
@click.option(
    "--gltf",
    is_flag=True,
    help="Write only glTF; for one take, --out may then be a .glb file.",
)
@click.option("--no-merl", is_flag=True, help="Skip the MERL binaries (35 MB each).")
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
    """Export models, by default all, for other programs.

    The bundle of a take holds maps (EXR), basis BRDFs (MERL binary and npz), glTF, USD
    with OpenPBR, a program for Mitsuba 3, manifest.json and a README.txt that describes
    each file and its measured error.
    """
    database = existing(db)
    progress = bar()
    chosen = _wanted(db, takes, edited=edited)
    if options["gltf"] and out.suffix:
        writable(out, ".glb")
        _require_one(out, chosen)
    elif out.suffix in (".glb", ".gltf"):
        rule = "without --gltf it must be a folder, which gets a bundle for each take"
        cure = "add --gltf, or rename it"
        raise InputError(
            Fault(str(out), rule, f"a name that ends in {out.suffix}", cure)
        )
    options |= {"merl": not no_merl, "edited": edited, "progress": progress}
    call = partial(
        skindb.workflow.export_take, database, shared_path(out, scheduler), **options
    )
    work: dict[str, Any] = {"workers": workers, "scheduler": scheduler}
    with skindb.workflow.logged_action(database, "export", chosen, arguments=options):
        results, faults = each_take(
            call, chosen, **work, progress=progress, finish=_exported
        )
    emit(results, [], faults)


def _exported(path: Path) -> tuple[str, Any, list[str]]:
    return path.name, str(path), [str(path)]


def _wanted(db: str, takes: tuple[str, ...], *, edited: bool) -> list[str]:
    """The named takes, or all that have a model."""
    kind = "edit" if edited else "model"
    chosen = list(takes) or skindb.open(db).takes(kind)
    if not chosen:
        cure = "run skindb edit first" if edited else "run skindb fit first"
        raise InputError(Fault(db, f"there must be a take with a {kind}", "none", cure))
    return chosen


def _require_one(out: Path, takes: list[str]) -> None:
    if len(takes) > 1:
        raise InputError(
            Fault(
                str(out),
                "a file must hold one take",
                f"{len(takes)} takes",
                "name a folder, or one take",
            )
        )


def _label(text: str) -> tuple[str, str]:
    name, _, label = text.partition("=")
    if not label:
        raise click.UsageError(
            f"--at needs DIMENSION=LABEL, such as channel=G; found {text!r}"
        )
    return name, label
