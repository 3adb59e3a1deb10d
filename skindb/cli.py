"""The command line: parse, one public call, print."""

from __future__ import annotations

import json
import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import click

import skindb
from skindb.bench import KERNELS
from skindb.errors import Fault, InputError
from skindb.schema.plain import plain

if TYPE_CHECKING:
    from skindb.ingest.lumitexels import Soft
    from skindb.plan import Plan
    from skindb.store import Database, Record

T = TypeVar("T")
INTERRUPTED = 130
ATLAS_WEIGHTS = {
    "intrinsic": "intrinsic weights (Desbrun et al. 2002)",
    "mean_value": "mean-value weights (Floater 2003): intrinsic ones would turn triangles over",
}
MOSTLY = 0.7  # share of fitted surfels below which the errors of those say little about the face


class _Finite(click.FloatRange):
    """A range without NaN, which compares with nothing."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number, if it is one."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number


class Progress:
    """Stage, count and time left on standard error; with `plain` a line a stage, where no bar can move."""

    def __init__(self, *, show: bool, plain: bool = False) -> None:
        self.show, self.plain, self.stage, self.since, self.last = show, plain, "", 0.0, 0.0

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report that `done` of `total` steps of `stage` are finished."""
        now = time.monotonic()
        if stage != self.stage:
            self.stage, self.since = stage, now
            if self.plain:
                click.echo(stage, err=True)
        if not self.show or (now - self.last < 0.2 and done < total):
            return
        self.last = now
        left = (now - self.since) / done * (total - done) if done else 0.0
        bar = "#" * round(24 * done / max(total, 1))
        end = "\n" if done >= total else ""
        click.echo(f"\r{stage:<44.44} [{bar:<24}] {done}/{total} {left:4.0f} s left{end}", nl=False, err=True)


def _remember(ctx: click.Context, option: click.Parameter, value: bool) -> None:
    ctx.meta[str(option.name)] = value
    ctx.meta.setdefault("since", time.monotonic())


def _common(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options every command has; they are kept in the context, see `_said`."""
    for names, text in (
        (("--json",), "Print the result as JSON."),
        (("--no-progress",), "No progress bars."),
        (("-v", "--verbose"), "Say more, and how long it took."),
    ):
        command = click.option(*names, is_flag=True, expose_value=False, callback=_remember, help=text)(command)
    return command


def _said(name: str) -> bool:
    return bool(click.get_current_context().meta[name])


class _UnfinishedError(InputError):
    """Mistakes after which something was done all the same."""

    def __init__(self, faults: Iterable[Fault], done: Any) -> None:
        super().__init__(faults)
        self.done = done


def _emit(result: Any, lines: list[str], faults: Sequence[Fault] = ()) -> None:
    """Print a result; with faults they are raised, and the result is in the one JSON object that names them."""
    if faults and _said("json"):
        raise _UnfinishedError(faults, result)
    if _said("json"):
        click.echo(json.dumps(plain(result), indent=1, allow_nan=False))
    elif lines:
        click.echo("\n".join(lines))
    if _said("verbose"):
        click.echo(f"{time.monotonic() - click.get_current_context().meta['since']:.1f} s", err=True)
    if faults:
        raise InputError(faults)


def _bar(*, plain: bool = False) -> Progress:
    """Bars for who looks; `plain` for long commands whose output goes to a file."""
    wanted, moving = not _said("no_progress"), sys.stderr.isatty()
    return Progress(show=wanted and moving, plain=plain and wanted and not moving)


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(skindb.__version__, prog_name="skindb")
def cli() -> None:
    """A database of measured faces: capture folders in, reflectance models, populations and edits out."""


_DB = click.argument("db", metavar="DB")
_PATH = click.Path(path_type=Path)
_TAKE = click.argument("take")
_GENERATION = click.option("--generation", type=click.IntRange(1), help="An earlier version; default the newest.")


@cli.command()
@click.option("--out", type=_PATH, default=Path("demo"), show_default=True, help="Folder to write.")
@click.option("--takes", type=click.IntRange(1, 8), default=8, show_default=True, help="How many of the virtual takes.")
@click.option("--cameras", type=click.IntRange(2), default=8, show_default=True, help="Of the virtual dome.")
@click.option("--lights", type=click.IntRange(12), default=48, show_default=True, help="Of the virtual dome.")
@click.option("--seed", type=click.IntRange(0), default=2005, show_default=True, help="Of the noise.")
@_common
def demo(out: Path, **options: int) -> None:
    """Virtual subjects -> capture -> ingest -> fit -> analysis -> edit -> render -> export -> report.html."""
    from skindb.demo import run_demo

    result = run_demo(out, progress=_bar(plain=True), **options)
    stages = [f"{stage:<10} {seconds:7.1f} s" for stage, seconds in result["seconds"].items()]
    _emit(result, [*(stages if _said("verbose") else []), str(result["report"])])


@cli.command()
@click.argument("out", type=_PATH)
@click.option("--takes", type=click.IntRange(1, 8), default=8, show_default=True, help="How many of the virtual takes.")
@click.option("--cameras", type=click.IntRange(1), default=8, show_default=True, help="Of the virtual dome.")
@click.option("--lights", type=click.IntRange(1), default=48, show_default=True, help="Of the virtual dome.")
@click.option("--width", type=click.IntRange(16), default=160, show_default=True, help="Pixels of a frame.")
@click.option("--height", type=click.IntRange(16), default=200, show_default=True, help="Pixels of a frame.")
@click.option("--head", type=_PATH, help="Head model file instead of the parametric face.")
@click.option("--subsurface", is_flag=True, help="Diffuse light through the skin by the dipole.")
@click.option("--seed", type=click.IntRange(0), default=2005, show_default=True, help="Of the noise.")
@_common
def simulate(out: Path, **options: Any) -> None:
    """Write virtual captures, one folder a take, with their truth beside them."""
    from skindb.virtual.takes import simulate_takes

    folders = [str(folder) for folder in simulate_takes(out, progress=_bar(), **options)]
    _emit(folders, folders)


@cli.command()
@_DB
@click.argument("captures", metavar="CAPTURE...", nargs=-1, required=True, type=_PATH)
@click.option(
    "--spacing",
    "spacing_mm",
    type=_Finite(0.05),
    default=1.5,
    show_default=True,
    help="Distance of neighbouring surfels, mm.",
)
@click.option(
    "--photographs", type=click.IntRange(0), default=4, show_default=True, help="Photographs kept to compare."
)
@click.option("--crop-box", type=_Finite(), nargs=6, help="Keep of the scan what lies from X Y Z to X Y Z, mm.")
@click.option("--crop-reach", type=_Finite(0, min_open=True), help="Keep what is as near to a landmark, mm.")
@click.option(
    "--soft",
    type=click.Choice(["leave-out", "keep"]),
    default="leave-out",
    show_default=True,
    help="Samples at the soft edges of shadows: leave them out, or divide them by the visible share of the light.",
)
@click.option(
    "--footprint", is_flag=True, help="Samples are means over a surfel's whole splat, not its centre's pixels."
)
@click.option(
    "--visibility",
    type=click.Choice(["rays", "splats"]),
    default="rays",
    show_default=True,
    help="What finds the lights and cameras a surfel sees; splats are the paper's, slower and a little less exact.",
)
@click.option("--explain", is_flag=True, help="Say what was cleaned (with -v where) and what was left out.")
@_common
def ingest(
    db: str,
    captures: tuple[Path, ...],
    crop_box: tuple[float, float, float, float, float, float] | None,
    crop_reach: float | None,
    soft: str,
    explain: bool,
    **options: Any,
) -> None:
    """Capture folders -> store. A folder with faults is reported whole and commits nothing; the others go on.

    Killed at any point it leaves nothing half visible, and the same command goes on where it was.
    """
    from skindb.geometry.crop import Crop
    from skindb.ingest import ingest_capture
    from skindb.ingest.report import cleaning_lines, sample_lines

    database, progress = skindb.open(db), _bar()
    low, high = (crop_box[:3], crop_box[3:]) if crop_box else (None, None)
    crop = Crop(low, high, crop_reach) if crop_box or crop_reach else None

    def one(folder: Path) -> tuple[str, dict[str, Any]]:
        kept: Soft = "keep" if soft == "keep" else "leave_out"
        record = ingest_capture(database, folder, crop=crop, soft=kept, progress=progress, **options)
        if keys := record.provenance["unknown_keys"]:
            said = f"{record.take}: warning: unknown keys of capture.json, kept but not read: {', '.join(keys)}"
            click.echo(said, err=True)
        return record.take, _summary(record)

    done, faults = _each(captures, one)
    lines = []
    for take, summary in done.items():
        lines.append(f"{take}: capture {summary['generation']}, {summary['path']}")
        if "samples" in summary.get("summary", {}):
            lines += [f"  {line}" for line in sample_lines(summary["summary"]["samples"])]
        lines += [f"  note: {line}" for line in summary.get("summary", {}).get("notes", [])]
        lines += [f"  left out: {line}" for line in summary.get("left_out", [])]
        lines += [f"  {line}" for line in cleaning_lines(summary, places=_said("verbose")) if explain]
    _emit(done, lines, faults)


@cli.command()
@_DB
@click.argument("takes", metavar="[TAKE...]", nargs=-1)
@click.option("--k", type=click.IntRange(1), default=4, show_default=True, help="Basis BRDFs after reduction.")
@click.option(
    "--profile",
    type=click.Choice(["transport", "dipole"]),
    default="transport",
    show_default=True,
    help="What the probe's profiles are fitted by; dipole is the paper's.",
)
@click.option(
    "--mode",
    type=click.Choice(["perceptual", "linear", "paper"]),
    default="perceptual",
    show_default=True,
    help="Least squares between cube roots of reflectance, between reflectances, or the paper's roots of elements.",
)
@click.option(
    "--rank",
    type=click.IntRange(1),
    default=16,
    show_default=True,
    help="Dimensions of the fit with every BRDF; their number is exact.",
)
@click.option("--eta", type=_Finite(1.0, 2.0), default=1.3, show_default=True, help="Refractive index.")
@click.option("--hold-out-lights", type=_Finite(0, 0.9), default=0.0, show_default=True, help="Share of lights.")
@click.option("--hold-out-cameras", type=_Finite(0, 0.9), default=0.0, show_default=True, help="Share of cameras.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Of what is held out and sampled.")
@click.option("--basis", type=_PATH, help="MERL files (folder) or .npz of tables, not the embedded BRDFs.")
@click.option("--refit", is_flag=True, help="Fit takes that have a model already.")
@click.option("--explain", is_flag=True, help="Only say what the fits would leave out.")
@_common
def fit(
    db: str,
    takes: tuple[str, ...],
    basis: Path | None,
    refit: bool,
    explain: bool,
    **options: Any,
) -> None:
    """Fit the named takes, or every take without a model of its newest capture; one that fails stops no other."""
    from skindb.fit import fit_take, plan_take
    from skindb.optics.measured import read_dictionary

    database = _existing(db)
    wanted = takes or [t for t in database.takes("capture") if refit or not _fresh(database, t)]
    dictionary, progress = read_dictionary(basis) if basis else None, _bar()

    def plan(take: str) -> Plan:
        known = {name: options[name] for name in ("mode", "rank")}
        return plan_take(database.read("capture", take), dictionary=dictionary, **known)

    if explain:
        plans, faults = _each(wanted, lambda take: (take, plan(take).explain()))
        _emit(plans, [f"{take}: {line}" for take, lines in plans.items() for line in lines], faults)
        return

    def one(take: str) -> tuple[str, dict[str, Any]]:
        planned = plan(take) if _said("verbose") else None
        if planned:
            click.echo("\n".join(f"{take}: plan: {line}" for line in planned.explain()), err=True)
        record, report = fit_take(database, take, dictionary=dictionary, plan=planned, progress=progress, **options)
        return take, {**_summary(record), **report}

    done, faults = _each(wanted, one)
    if not wanted:
        said = "every take has a model of its newest capture; --refit fits them again"
        click.echo(said if database.takes("capture") else "no captures: ingest some first", err=True)
    _emit(done, [line for take, report in done.items() for line in _fit_lines(take, report)], faults)


@cli.command("basis")
@click.argument("path", type=_PATH, required=False)
@click.option("--disc", type=_Finite(0, 20), default=0.8, show_default=True, help="Radius of lights, degrees.")
@_common
def basis_command(path: Path | None, disc: float) -> None:
    """Energy, reciprocity, errors and holes of measured BRDFs: PATH as for fit --basis, or the embedded ones."""
    from skindb.fit import dictionary_report
    from skindb.optics.dictionary import embedded_dictionary
    from skindb.optics.measured import read_dictionary

    dictionary = read_dictionary(path) if path else embedded_dictionary()
    report = dictionary_report(dictionary, disc_angular_radius=math.radians(disc))
    rows = [[name, *(float(v[i]) for v in report.values())] for i, name in enumerate(dictionary.names)]
    worst = [f"{name}: median {float(v.median()):.3g}, largest {float(v.max()):.3g}" for name, v in report.items()]
    header = ["basis", *map(str, report)]
    _emit(report.attrs | {"header": header, "rows": rows}, [*_aligned([header, *rows]), *worst, *report.attrs["notes"]])


@cli.command()
@_DB
@click.argument("what", type=click.Choice(["brdf", "albedo", "translucency", "traits"]))
@click.option("--take", "takes", multiple=True, help="Only these takes (may be given several times).")
@click.option("--group-by", help="Attribute or trait to group translucency or albedo by: condition, gender, ...")
@click.option("--k", type=click.IntRange(1), default=6, show_default=True, help="Components of the common basis.")
@click.option("--in-metric", is_flag=True, help="Find the common basis by distances between BRDFs, not coefficients.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Of the surfels drawn.")
@click.option("--basis", "merl", type=_PATH, help="MERL files or tables the takes were fitted with.")
@click.option("--plot", type=_PATH, help="Also write a plot (.png, .pdf, .svg).")
@_common
def analyze(db: str, what: str, plot: Path | None, **options: Any) -> None:
    """Population studies of the fitted takes: brdf, albedo, translucency or traits."""
    from skindb.analysis.study import analyze as study
    from skindb.analysis.study import plot_study, tabulate_study

    if plot:
        _writable(plot, ".png", ".pdf", ".svg")
    record, tree = study(skindb.open(db), what, progress=_bar(), **options)
    if plot:
        plot_study(tree, plot)
    header, rows = tabulate_study(tree)
    result = {**_summary(record), "header": header, "rows": rows}
    left = [f"left out: {line}" for line in record.provenance["left_out"]]
    _emit(result, [*_aligned([header, *rows]), *left, *record.provenance.get("registration", [])])


@cli.command()
@_DB
@click.option("--take", "takes", multiple=True, help="Only these takes (may be given several times).")
@click.option("--reference", metavar="TAKE", help="Whose (u, v) is the common one; default the mean of all takes.")
@_common
def register(db: str, takes: tuple[str, ...], reference: str | None) -> None:
    """Warp the fitted takes into one (u, v) by their landmarks, and say how well these agree."""
    from skindb.analysis.registration import tabulate_registration
    from skindb.analysis.study import register_takes

    records, registered = register_takes(_existing(db), takes=takes, reference=reference)
    header, rows = tabulate_registration(registered)
    done = {take: _summary(record) for take, record in records.items()}
    _emit({"takes": done, "header": header, "rows": rows}, _aligned([header, *rows]))


@cli.command()
@_DB
@_TAKE
@click.option("--trait", "amounts", multiple=True, required=True, metavar="NAME=AMOUNT", help="For example lotion=0.5.")
@click.option("--basis", "merl", type=_PATH, help="MERL files or tables the take was fitted with.")
@_common
def edit(db: str, take: str, amounts: tuple[str, ...], merl: Path | None) -> None:
    """Move a model along traits; `render` and `export` show it with --edited."""
    from skindb.analysis.study import edit_take

    record, tree = edit_take(skindb.open(db), take, dict(_amount(text) for text in amounts), merl=merl)
    distance = float(tree.attrs["edit_distance"])
    far = " (farther than takes differ from each other: do not trust it)" if distance > 1 else ""
    report: dict[str, Any] = dict(tree.attrs["edit_report"])
    lines = [f"{take}: edit {record.generation}, {distance:.2f} of the distance between takes{far}"]
    lines += [
        f"  {part}: cut to what is physical on {own['clipped']:.0%} of the area"
        for part, own in report.items()
        if own["clipped"]
    ]
    _emit({**_summary(record), "edit_distance": distance, "edit_report": report}, lines)


@cli.command()
@_DB
@_TAKE
@click.argument("out", type=_PATH)
@click.option("--light", "lights", multiple=True, help="Name of a light of the dome (several: their sum); default all.")
@click.option("--camera", help="Name of a camera of the dome; default the most frontal.")
@click.option("--samples", type=click.IntRange(1, 8), default=2, show_default=True, help="Rays per pixel and axis.")
@click.option("--scale", type=_Finite(0.1, 20), default=1.0, show_default=True, help="Of the camera's pixels.")
@click.option("--subsurface", is_flag=True, help="Diffuse light through the skin by the dipole.")
@click.option("--edited", is_flag=True, help="The edited model.")
@_GENERATION
@click.option("--explain", is_flag=True, help="Only say what the picture leaves out.")
@_common
def render(db: str, take: str, out: Path, edited: bool, generation: int | None, **options: Any) -> None:
    """Render a model by lights and a camera of its dome to OUT (.exr linear, .png tone-mapped)."""
    from skindb.plan import NOTHING
    from skindb.render.picture import render_picture

    _writable(out, ".exr", ".png")
    model = skindb.open(db).read(_kind(edited), take, generation=generation)
    if _said("verbose") and not options["explain"]:
        planned = render_picture(model, out, **{**options, "explain": True})["left_out"]
        click.echo("\n".join(f"plan: {line}" for line in planned or [NOTHING]), err=True)
    told = render_picture(model, out, **options)
    _emit(told, told["left_out"] or [NOTHING] if options["explain"] else [told["path"]])


@cli.command()
@_DB
@_TAKE
@click.argument("variable")
@click.argument("out", type=_PATH)
@click.option("--at", multiple=True, metavar="DIMENSION=LABEL", help="For example channel=G (several times).")
@_common
def show(db: str, take: str, variable: str, out: Path, at: tuple[str, ...]) -> None:
    """Draw a variable of the surfels on the face to OUT (.png, .pdf, .svg): sample_count, fit_status..."""
    from skindb.render.field import write_field

    _writable(out, ".png", ".pdf", ".svg")
    told = write_field(_existing(db), take, variable, out, at=dict(map(_label, at)))
    _emit(told, [told["path"]])


@cli.command()
@_DB
@_TAKE
@click.option("--out", type=_PATH, help="Folder for pictures: photograph, rendering, difference.")
@click.option("--samples", type=click.IntRange(1, 8), default=2, show_default=True, help="Rays per pixel and axis.")
@click.option("--subsurface", is_flag=True, help="Diffuse light through the skin by the dipole.")
@_GENERATION
@_common
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
    _emit(result, _aligned([header, *([row[name] for name in header] for row in result)]))


@cli.command()
@_DB
@_TAKE
@click.argument("out", type=_PATH)
@click.option(
    "--size", type=click.IntRange(16, 8192), default=2048, show_default=True, help="Texels along a map's side."
)
@click.option("--gltf", is_flag=True, help="Only model.glb, written to OUT.")
@click.option("--no-merl", is_flag=True, help="Leave out the MERL binaries (35 MB each).")
@click.option("--edited", is_flag=True, help="The edited model.")
@_GENERATION
@_common
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
        export_bundle(model, out, size=size, merl=not no_merl, progress=_bar())
    _emit({"path": str(out)}, [str(out)])


@cli.command()
@_DB
@_common
def info(db: str) -> None:
    """Takes, their versions with paths and sizes; with -v samples per surfel, the atlas, how well models predict."""
    database = _existing(db)
    result = database.info()
    lines = []
    for take, kinds in [*result["takes"].items(), *result.get("studies", {}).items()]:
        for kind, one in kinds.items():
            text = (
                one.get("fault")
                or f"{one['generation']:3d}  {one['bytes'] / 1e6:8.1f} MB  {one['created']}  {one['path']}"
            )
            lines.append(f"{take:<16} {kind:<10} {text}")
            if kind in DETAILS and "fault" not in one and _said("verbose"):
                lines += [f"  {line}" for line in DETAILS[kind](database, take)]
    _emit(result, lines or ["no takes"])


@cli.command()
@_DB
@_common
def verify(db: str) -> None:
    """Read every file of every version again and report all damage."""
    faults = _existing(db).verify()
    _emit([], [] if faults else ["every version is whole"], faults)


@cli.command()
@click.option("--out", type=_PATH, default=Path("bench"), show_default=True, help="Folder for bench.json and plots.")
@click.option(
    "--only", multiple=True, type=click.Choice(KERNELS), help="Only this kernel (may be given several times)."
)
@click.option("--quick", is_flag=True, help="Smaller problems: half a minute instead of some.")
@_common
def bench(out: Path, only: tuple[str, ...], quick: bool) -> None:
    """Error against run time of every kernel, and the stress set; exit 1 where a promise of it is broken."""
    from skindb.bench.run import run_bench, table_of

    result = run_bench(out, only=only, quick=quick, progress=_bar())
    failures = [f"fails: {line}" for line in result["failures"]]
    kept = f"{len(result['stress']) - result['broken']} of {len(result['stress'])} promises of the stress set hold"
    broken = [case for case in result["stress"] if case["failure"]]
    faults = [Fault(f"{case['kernel']}: {case['name']}", case["promise"], case["failure"]) for case in broken]
    _emit(result, [*_aligned(table_of(result)), "", *failures, kept, str(out / "bench.json")], faults)


def _existing(db: str) -> Database:
    database = skindb.open(db)
    if not database.root.is_dir():
        raise InputError(Fault(db, "the database must exist", "nothing", "ingest a capture into it first"))
    begun = {"data", "tmp"}  # a killed first ingest leaves these
    if {path.name for path in database.root.iterdir()} - begun and not (database.root / "log").is_dir():
        raise InputError(Fault(db, "a database has a log", "a folder without", "give the folder captures went into"))
    return database


def _writable(path: Path, *endings: str) -> None:
    """A file that is to be written at the end of the work: wrong names are told before it."""
    if path.suffix.lower() not in endings:
        raise InputError(
            Fault(str(path), f"must end in {' or '.join(endings)}", path.suffix or "no ending", "rename it")
        )
    if not path.parent.is_dir():
        raise InputError(Fault(str(path), "its folder must exist", "none", f"make {path.parent}"))


def _fresh(database: Database, take: str) -> bool:
    """Whether the take has a model, and of its newest capture."""
    if take not in database.takes("model"):
        return False
    made_from = database.record("model", take).provenance.get("inputs", [])
    newest = database.record("capture", take).generation
    return any(one["kind"] == "capture" and one["generation"] == newest for one in made_from)


def _kind(edited: bool) -> str:
    return "edit" if edited else "model"


def _summary(record: Record) -> dict[str, Any]:
    names = ("left_out", "cleaning", "cleaning_places", "summary", "registration")
    said = {name: record.provenance[name] for name in names if name in record.provenance}
    return {"generation": record.generation, "path": record.path, **said}


def _each(items: Iterable[T], call: Callable[[T], tuple[str, Any]]) -> tuple[dict[str, Any], list[Fault]]:
    """Call for every item; one user's mistake does not stop the others."""
    done: dict[str, Any] = {}
    faults: list[Fault] = []
    for item in items:
        try:
            name, result = call(item)
            done[name] = result
        except InputError as error:
            faults += [_placed(fault, str(item)) for fault in dict.fromkeys(error.faults)]
        except OSError as error:  # a full or failing disc: what is committed is still told
            where = str(error.filename or item)
            faults.append(Fault(where, "it must be possible to read and write", str(error), "check the disc"))
    return done, faults


def _placed(fault: Fault, item: str) -> Fault:
    """The fault with the capture or take it is of, where it does not say so itself."""
    return fault if item in fault.where else replace(fault, where=f"{item}: {fault.where}")


def _label(text: str) -> tuple[str, str]:
    name, _, label = text.partition("=")
    if not label:
        raise click.UsageError(f"--at needs DIMENSION=LABEL, such as channel=G; found {text!r}")
    return name, label


def _amount(text: str) -> tuple[str, float]:
    name, _, number = text.partition("=")
    try:
        return name, float(number)
    except ValueError:
        raise click.UsageError(f"--trait needs NAME=AMOUNT, such as lotion=0.5; found {text!r}") from None


def _fit_lines(take: str, report: dict[str, Any]) -> list[str]:
    from skindb.fit.prediction import tabulate_prediction

    total = sum(report["seconds"].values())
    status = ", ".join(f"{share:.1%} {name}" for name, share in report["status"].items())
    lines = [f"{take}: model {report['generation']}, {report['surfels']} surfels in {total:.1f} s: {status}"]
    if report["status"].get("fitted", 0) < MOSTLY:
        lines.append(
            "  few surfels are fitted, and the errors below are theirs alone: more lights and cameras are needed"
        )
    shown = {
        name: report[name] for name in ("fit_residual", "held_out_error", "held_out_camera_error") if name in report
    }
    lines += [f"  {n.replace('_', ' ')}: median {v['median']:.1%}, 95 % {v['p95']:.1%}" for n, v in shown.items()]
    lines += [f"  dictionary, {line}" for line in report.get("dictionary_notes", [])]
    lines += [_suspect_line(one) for one in report["suspects"]]
    lines += [f"  left out: {line}" for line in report["left_out"]]
    if _said("verbose"):
        lines += [f"  {line}" for line in _aligned(tabulate_prediction(report["prediction"]))]
        lines += [f"  {stage}: {seconds:.1f} s" for stage, seconds in report["seconds"].items()]
    return lines


def _sample_lines(database: Database, take: str) -> list[str]:
    """Table of samples by region; nothing for captures without a dome, or from before it was kept."""
    from skindb.ingest.report import sample_lines, sample_table

    samples = database.record("capture", take).provenance.get("summary", {}).get("samples")
    return [] if samples is None else [*sample_lines(samples), *_aligned(sample_table(samples))]


def _prediction_lines(database: Database, take: str) -> list[str]:
    from skindb.fit.prediction import describe_prediction, prediction_table, tabulate_prediction

    described = describe_prediction(prediction_table(database.read("model", take)["fitted"].to_dataset()))
    return _aligned(tabulate_prediction(described))


def _atlas_lines(database: Database, take: str) -> list[str]:
    capture = database.read("capture", take)
    if "atlas" not in capture.children:  # ingested before atlases were measured
        return []
    atlas = capture["atlas"].to_dataset()
    columns = {
        "atlas": "region",
        "area log2 sd": "atlas_area_log2_sd",
        "stretch median": "atlas_anisotropy_median",
        "stretch 99 %": "atlas_anisotropy_p99",
        "flips": "atlas_flips",
    }
    rows = zip(*(atlas[name].values.tolist() for name in columns.values()), strict=True)
    made = [f"atlas by {ATLAS_WEIGHTS[atlas.attrs['weights']]}"] if "weights" in atlas.attrs else []
    return [*made, *_aligned([[*columns], *map(list, rows)])]


def _capture_lines(database: Database, take: str) -> list[str]:
    return _sample_lines(database, take) + _atlas_lines(database, take)


DETAILS = {"capture": _capture_lines, "model": _prediction_lines}  # kind -> what info -v adds


def _suspect_line(one: dict[str, Any]) -> str:
    what, why = ("light", "did the face move?") if "light" in one else ("camera", "was it moved?")
    share, misfit = one["outlier_share"], one["misfit"]
    return f"  {what} {one[what]}: {share:.0%} of its samples are outliers, residuals {misfit:.1f} times noise ({why})"


def _aligned(rows: list[list[Any]]) -> list[str]:
    """Rows as text in columns; numbers to three significant digits."""
    text = [[f"{c:.3g}" if isinstance(c, float) else str(c) for c in row] for row in rows]
    widths = [max(len(row[i]) for row in text) for i in range(len(text[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in text]


def _fault_lines(faults: Iterable[Fault], *, every: bool, most: int = 10) -> list[str]:
    """A line a fault; of many that break the same rule the first ones only, as 4,800 frames may, unless `every`."""
    lines, count = [], Counter[str]()
    for fault in faults:
        count[fault.rule] += 1
        if every or count[fault.rule] <= most:
            lines.append(str(fault))
    folded = {rule: n - most for rule, n in count.items() if n > most and not every}
    return lines + [f"and {n} more: {rule} (-v lists them)" for rule, n in folded.items()]


def _give_up(code: int, faults: Sequence[Fault], done: Any = None) -> NoReturn:
    """Leave; with --json, which no command may have got to read, what is wrong and what was done all the same."""
    if "--json" in sys.argv:
        told = [{"what": f.where, "rule": f.rule, "found": f.found, "cure": f.cure} for f in faults]
        click.echo(json.dumps(plain({"error": told} | ({"done": done} if done else {})), indent=1, allow_nan=False))
    sys.exit(code)


def main() -> None:
    """Run the command line; a user's mistake is one line each and exit 1, bad usage exit 2, never a traceback."""
    try:
        cli.main(standalone_mode=False)
    except InputError as error:
        for line in _fault_lines(error.faults, every=bool({"-v", "--verbose"} & set(sys.argv))):
            click.echo(f"skindb: {line}", err=True)
        _give_up(1, error.faults, getattr(error, "done", None))
    except click.ClickException as error:
        error.show()
        context = getattr(error, "ctx", None)
        command = context.command_path if context else "skindb"
        rule = "must be called as its --help says"
        _give_up(error.exit_code, [Fault(command, rule, error.format_message(), f"see {command} --help")])
    except (click.Abort, KeyboardInterrupt):
        said = "interrupted; nothing half finished was committed"
        click.echo(f"skindb: {said}", err=True)
        _give_up(INTERRUPTED, [Fault("skindb", "must run to its end", said)])
    except OSError as error:
        place = error.filename or "file system"
        fault = Fault(str(place), "must be readable and writable", str(error.strerror or error))
        click.echo(f"skindb: {fault}", err=True)
        _give_up(1, [fault])
