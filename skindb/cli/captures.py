"""Commands that make captures and take them in: demo, simulate, ingest."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import skindb
from skindb.cli.options import DB, PATH, Finite, asked, common
from skindb.cli.shared import bar, each, emit, summary_of

if TYPE_CHECKING:
    from skindb.ingest.lumitexels import Soft


@click.command()
@click.option("--out", type=PATH, default=Path("demo"), help="Folder to write.")
@click.option("--takes", type=click.IntRange(1, 8), default=8, help="How many of the virtual takes.")
@click.option("--cameras", type=click.IntRange(2), default=8, help="Of the virtual dome.")
@click.option("--lights", type=click.IntRange(12), default=48, help="Of the virtual dome.")
@click.option("--seed", type=click.IntRange(0), default=2005, help="Of the noise.")
@common
def demo(out: Path, **options: int) -> None:
    """Virtual subjects -> capture -> ingest -> fit -> analysis -> edit -> render -> export -> report.html."""
    from skindb.demo import run_demo

    result = run_demo(out, progress=bar(plain=True), **options)
    stages = [f"{stage:<10} {seconds:7.1f} s" for stage, seconds in result["seconds"].items()]
    emit(result, [*(stages if asked("verbose") else []), str(result["report"])])


@click.command()
@click.argument("out", type=PATH)
@click.option("--takes", type=click.IntRange(1, 8), default=8, help="How many of the virtual takes.")
@click.option("--cameras", type=click.IntRange(1), default=8, help="Of the virtual dome.")
@click.option("--lights", type=click.IntRange(1), default=48, help="Of the virtual dome.")
@click.option("--width", type=click.IntRange(16), default=160, help="Pixels of a frame.")
@click.option("--height", type=click.IntRange(16), default=200, help="Pixels of a frame.")
@click.option("--head", type=PATH, help="Head model file instead of the parametric face.")
@click.option("--subsurface", is_flag=True, help="Diffuse light through the skin by the dipole.")
@click.option("--seed", type=click.IntRange(0), default=2005, help="Of the noise.")
@common
def simulate(out: Path, **options: Any) -> None:
    """Write virtual captures, one folder a take, with their truth beside them."""
    from skindb.virtual.takes import simulate_takes

    folders = [str(folder) for folder in simulate_takes(out, progress=bar(), **options)]
    emit(folders, folders)


@click.command()
@DB
@click.argument("captures", metavar="CAPTURE...", nargs=-1, required=True, type=PATH)
@click.option("--spacing", "spacing_mm", type=Finite(0.05), default=1.5, help="Distance of neighbouring surfels, mm.")
@click.option("--photographs", type=click.IntRange(0), default=4, help="Photographs kept to compare.")
@click.option("--crop-box", type=Finite(), nargs=6, help="Keep of the scan what lies from X Y Z to X Y Z, mm.")
@click.option("--crop-reach", type=Finite(0, min_open=True), help="Keep what is as near to a landmark, mm.")
@click.option(
    "--soft",
    type=click.Choice(["leave-out", "keep"]),
    default="leave-out",
    help="Samples at the soft edges of shadows: leave them out, or divide them by the visible share of the light.",
)
@click.option(
    "--footprint", is_flag=True, help="Samples are means over a surfel's whole splat, not its centre's pixels."
)
@click.option(
    "--visibility",
    type=click.Choice(["rays", "splats"]),
    default="rays",
    help="What finds the lights and cameras a surfel sees; splats are the paper's, slower and a little less exact.",
)
@click.option("--explain", is_flag=True, help="Say what was cleaned (with -v where) and what was left out.")
@common
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

    database, progress = skindb.open(db), bar()
    low, high = (crop_box[:3], crop_box[3:]) if crop_box else (None, None)
    crop = Crop(low, high, crop_reach) if crop_box or crop_reach else None

    taken: list[Path] = []

    def one(folder: Path) -> tuple[str, dict[str, Any]]:
        kept: Soft = "keep" if soft == "keep" else "leave_out"
        record = ingest_capture(database, folder, crop=crop, soft=kept, progress=progress, **options)
        if keys := record.provenance["unknown_keys"]:
            said = f"{record.take}: warning: unknown keys of capture.json, kept but not read: {', '.join(keys)}"
            click.echo(said, err=True)
        taken.append(folder)
        return record.take, summary_of(record)

    done, faults = each(captures, one)
    lines = []
    if faults and len(captures) > 1:
        refused = ", ".join(str(folder) for folder in captures if folder not in taken)
        click.echo(f"{len(taken)} of {len(captures)} captures ingested; refused: {refused}", err=True)
    for take, summary in done.items():
        lines.append(f"{take}: capture {summary['generation']}, {summary['path']}")
        made = summary.get("summary", {}).get("surfels", {})
        lines += [f"  {made['count']:,} surfels, {made['spacing_mm']:.2g} mm apart"] if made else []
        if "samples" in summary.get("summary", {}):
            lines += [f"  {line}" for line in sample_lines(summary["summary"]["samples"])]
        lines += [f"  note: {line}" for line in summary.get("summary", {}).get("notes", [])]
        lines += [f"  left out: {line}" for line in summary.get("left_out", [])]
        lines += [f"  {line}" for line in cleaning_lines(summary, places=asked("verbose")) if explain]
    emit(done, lines, faults)
