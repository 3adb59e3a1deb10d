"""Commands that draw, show or export models: render, compare, show, export, view."""

from functools import partial
from pathlib import Path
from typing import Any

import click

import skindb
from skindb import workflow
from skindb.cli.options import (
    DB,
    GENERATION,
    PATH,
    PORT,
    SCHEDULER,
    TAKE,
    WORKERS,
    asked,
    command,
    options_of,
)
from skindb.cli.shared import (
    aligned,
    chosen_takes,
    each_take,
    emit,
    require_one_take,
    serve,
    shared_path,
    trait_amounts,
    writable,
)
from skindb.cli.terminal import bar
from skindb.errors import input_error, require
from skindb.parameters import (
    ComparisonParameters,
    ExportParameters,
    RenderParameters,
    ViewParameters,
)

TAKES = click.argument("takes", metavar="[TAKE...]", nargs=-1)


@command
@DB
@TAKES
@click.option(
    "--out",
    type=PATH,
    help=(
        "Picture of one take (.exr linear, .png tone-mapped), or folder for <take>.png "
        "of every take."
    ),
)
@click.option(
    "--turntable",
    type=PATH,
    help="Animated picture of one take (.webp) from left to right and back, instead of --out.",
)
@options_of(RenderParameters)
@click.option("--edited", is_flag=True, help="Render the edited models.")
@GENERATION
@click.option(
    "--explain", is_flag=True, help="Only report what the pictures would skip."
)
@WORKERS
@SCHEDULER
def render(
    db: str,
    takes: tuple[str, ...],
    out: Path | None,
    turntable: Path | None,
    edited: bool,
    parameters: RenderParameters,
    **request: Any,
) -> None:
    """Render models with lights of their dome or an environment.

    By default all models are rendered with all lights of the dome and its most frontal camera.
    """
    database = skindb.open(db, create=False)
    chosen = chosen_takes(database, takes, "edit" if edited else "model")
    written = turntable or out
    if written is None or (turntable and out):
        raise click.UsageError("give either --out or --turntable")
    if turntable:
        writable(turntable, ".webp")
    elif written.suffix:
        writable(written, ".exr", ".png")
    if written.suffix:
        require_one_take(written, chosen)
    request["edited"] = edited
    progress = bar()
    call = partial(
        workflow.render_take,
        database,
        shared_path(written),
        progress=progress,
        **request,
        **vars(parameters),
    )
    finish = partial(_rendered, explain=request["explain"], error=parameters.error)
    with workflow.logged_action(database, "render", chosen, arguments=request):
        results, faults = each_take(call, chosen, progress=progress, finish=finish)
    emit(results, [], faults)


def _rendered(
    report: dict[str, Any], *, explain: bool, error: float | None
) -> tuple[str, Any, list[str]]:
    skipped = report["skipped"] or ["nothing is skipped"]
    if explain:
        return report["take"], report, [*skipped, *report["kept"]]
    line = (
        f"{report['path']}: {report['samples']} rays per pixel, relative standard error "
        f"{report['relative_error']:.2%}"
    )
    if error is not None and report["relative_error"] > error:
        line += f", above the wanted {error:.2%}"
    plan = [f"plan: {step}" for step in skipped] if asked("verbose") else []
    return report["take"], report, [*plan, line]


@command
@DB
@TAKE
@click.option(
    "--out",
    type=PATH,
    help="Folder for pictures: photograph, rendering, diffuse and surface components, difference.",
)
@options_of(ComparisonParameters)
@GENERATION
def compare(
    db: str,
    take: str,
    out: Path | None,
    generation: int | None,
    parameters: ComparisonParameters,
) -> None:
    """Compare the kept photographs with renderings of the model.

    The measures are RMSE, PSNR, SSIM, CIEDE2000 and the fine contrast (below about 2 mm)
    over that of the photograph without its noise, for each photograph that ingest kept.
    """
    comparisons = workflow.compare_take(
        skindb.open(db, create=False), take, generation=generation, **vars(parameters)
    )
    if out:
        skindb.render.write_comparisons(comparisons, out)
    stated = ["light", "camera", "held_out"]
    result = [
        {name: getattr(c, name) for name in stated} | c.error | {"filled": c.filled}
        for c in comparisons
    ]
    measures = ("relative_rmse", "psnr", "ssim", "delta_e_median", "fine_contrast")
    header = [*stated, *measures]
    rows = [[row[name] for name in header] for row in result]
    emit(result, aligned([header, *rows]))


@command
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
def show(db: str, take: str, variable: str, out: Path, at: tuple[str, ...]) -> None:
    """Draw a variable of the surfels on the face.

    A variable is, for example, sample_count or fit_status. OUT is a picture (.png, .pdf, .svg).
    """
    writable(out, ".png", ".pdf", ".svg")
    report = workflow.show_take(
        skindb.open(db, create=False), take, variable, out, at=dict(map(_label, at))
    )
    emit(report, [report["path"]])


@command
@DB
@TAKES
@click.option(
    "--out",
    type=PATH,
    required=True,
    help="Folder that gets a folder for each take, or with --gltf a .glb file for each.",
)
@options_of(ExportParameters)
@click.option("--edited", is_flag=True, help="Export the edited models.")
@GENERATION
@WORKERS
@SCHEDULER
def export(
    db: str,
    takes: tuple[str, ...],
    out: Path,
    edited: bool,
    generation: int | None,
    parameters: ExportParameters,
) -> None:
    """Export models, by default all, for other programs.

    The bundle of a take holds maps (EXR), basis BRDFs (MERL binary and npz), glTF, USD
    with OpenPBR, a program for Mitsuba 3, manifest.json and a README.txt that describes
    each file and its measured error.
    """
    database = skindb.open(db, create=False)
    progress = bar()
    chosen = chosen_takes(database, takes, "edit" if edited else "model")
    if parameters.gltf and out.suffix:
        writable(out, ".glb")
        require_one_take(out, chosen)
    elif out.suffix in (".glb", ".gltf"):
        raise input_error(
            str(out),
            "without --gltf it must be a folder, which gets a bundle for each take",
            f"a name that ends in {out.suffix}",
            "add --gltf, or rename it",
        )
    options = {"edited": edited, "generation": generation, **vars(parameters)}
    call = partial(
        workflow.export_take,
        database,
        shared_path(out),
        progress=progress,
        **options,
    )
    with workflow.logged_action(database, "export", chosen, arguments=options):
        results, faults = each_take(
            call,
            chosen,
            progress=progress,
            finish=lambda path: (path.name, str(path), [str(path)]),
        )
    emit(results, [], faults)


def _label(text: str) -> tuple[str, str]:
    name, _, label = text.partition("=")
    if not label:
        raise click.UsageError(
            f"--at needs DIMENSION=LABEL, such as channel=G; found {text!r}"
        )
    return name, label


@command
@DB
@TAKES
@click.option(
    "--out",
    type=PATH,
    help="Self-contained page of the takes (.html).",
)
@options_of(ViewParameters)
@PORT
@click.option(
    "--explain",
    is_flag=True,
    help="Only report what the pages skip and approximate, with error bounds.",
)
def view(
    db: str,
    takes: tuple[str, ...],
    out: Path | None,
    port: int,
    explain: bool,
    parameters: ViewParameters,
) -> None:
    """Show models in a browser, to turn, light and edit them.

    By default all models are shown. With --out, the page is written. Otherwise the
    printed address opens it, once, in one browser of this machine, until Ctrl-C ends
    the server.
    """
    if out is not None:
        writable(out, ".html")
    amounts = trait_amounts(parameters.traits, default=1.0)
    require(
        0.0 not in amounts.values(),
        "--trait",
        "the amount at the end of a slider must not be 0",
        "0",
        "give, for example, age=20",
    )
    database = skindb.open(db, create=False)
    chosen = chosen_takes(database, takes, "model")
    if explain:
        with workflow.logged_action(database, "view", chosen, explain=True):
            skipped = {
                take: workflow.explain_view(
                    database, take, traits=amounts, modes=parameters.modes
                )
                for take in chosen
            }
        lines = [f"{take}: {line}" for take, lines in skipped.items() for line in lines]
        emit(skipped, lines)
        return
    options = {**vars(parameters), "traits": amounts, "progress": bar()}
    if out is None:
        server = workflow.view_server(database, chosen, port=port, **options)
        serve(server, takes=chosen)
        return
    report = workflow.view_takes(database, chosen, out, **options)
    emit(report, [report["path"]])
