"""Commands that fit: fit, basis."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from skindb.cli.options import DB, PATH, Finite, asked, common
from skindb.cli.shared import aligned, bar, each, emit, existing, summary_of

if TYPE_CHECKING:
    from skindb.plan import Plan
    from skindb.store import Database

POOR = 0.2  # median residual: good captures have 2 to 6 %, exchanged exposures or poses 50 to 80 %
MOSTLY = 0.5  # share of fitted surfels below which the errors of those say little about the face


@click.command()
@DB
@click.argument("takes", metavar="[TAKE...]", nargs=-1)
@click.option("--k", type=click.IntRange(1), default=4, help="Basis BRDFs after reduction.")
@click.option(
    "--profile",
    type=click.Choice(["transport", "dipole"]),
    default="transport",
    help="What the probe's profiles are fitted by; dipole is the paper's.",
)
@click.option(
    "--mode",
    type=click.Choice(["perceptual", "linear", "paper"]),
    default="perceptual",
    help="Least squares between cube roots of reflectance, between reflectances, or the paper's roots of elements.",
)
@click.option(
    "--rank", type=click.IntRange(1), default=16, help="Dimensions of the fit with every BRDF; their number is exact."
)
@click.option("--eta", type=Finite(1.0, 2.0), default=1.3, help="Refractive index.")
@click.option("--hold-out-lights", type=Finite(0, 0.9), default=0.0, help="Share of lights.")
@click.option("--hold-out-cameras", type=Finite(0, 0.9), default=0.0, help="Share of cameras.")
@click.option("--seed", type=click.IntRange(0), default=0, help="Of what is held out and sampled.")
@click.option("--basis", type=PATH, help="MERL files (folder) or .npz of tables, not the embedded BRDFs.")
@click.option("--refit", is_flag=True, help="Fit takes that have a model already.")
@click.option("--explain", is_flag=True, help="Only say what the fits would leave out.")
@common
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

    database = existing(db)
    wanted = takes or [t for t in database.takes("capture") if refit or not _fresh(database, t)]
    dictionary, progress = read_dictionary(basis) if basis else None, bar()

    def plan(take: str) -> Plan:
        known = {name: options[name] for name in ("mode", "rank")}
        return plan_take(database.read("capture", take), dictionary=dictionary, **known)

    if explain:
        plans, faults = each(wanted, lambda take: (take, plan(take).explain()))
        emit(plans, [f"{take}: {line}" for take, lines in plans.items() for line in lines], faults)
        return

    def one(take: str) -> tuple[str, dict[str, Any]]:
        planned = plan(take) if asked("verbose") else None
        if planned:
            click.echo("\n".join(f"{take}: plan: {line}" for line in planned.explain()), err=True)
        record, report = fit_take(database, take, dictionary=dictionary, plan=planned, progress=progress, **options)
        return take, {**summary_of(record), **report}

    done, faults = each(wanted, one)
    if not wanted:
        said = "every take has a model of its newest capture; --refit fits them again"
        click.echo(said if database.takes("capture") else "no captures: ingest some first", err=True)
    emit(done, [line for take, report in done.items() for line in _fit_lines(take, report)], faults)


def _fresh(database: Database, take: str) -> bool:
    """Whether the take has a model, and of its newest capture."""
    if take not in database.takes("model"):
        return False
    made_from = database.record("model", take).provenance.get("inputs", [])
    newest = database.record("capture", take).generation
    return any(one["kind"] == "capture" and one["generation"] == newest for one in made_from)


def _fit_lines(take: str, report: dict[str, Any]) -> list[str]:
    from skindb.fit.prediction import tabulate_prediction

    total = sum(report["seconds"].values())
    status = ", ".join(f"{share:.1%} {name}" for name, share in report["status"].items())
    lines = [f"{take}: model {report['generation']}, {report['surfels']} surfels in {total:.1f} s: {status}"]
    if report["status"].get("fitted", 0) < MOSTLY:
        lines.append("  few surfels are fitted, and the errors below are theirs alone: `show` fit_status, to see where")
    shown = {
        name: report[name] for name in ("fit_residual", "held_out_error", "held_out_camera_error") if name in report
    }
    lines += [f"  {n.replace('_', ' ')}: median {v['median']:.1%}, 95 % {v['p95']:.1%}" for n, v in shown.items()]
    if report.get("fit_residual", {}).get("median", 0) > POOR:
        said = (
            "the model does not explain the photographs: check camera poses, exposure seconds, response and positions"
        )
        lines.append(f"  {said} of the lights before anything else")
    lines += [f"  dictionary, {line}" for line in report.get("dictionary_notes", [])]
    lines += [_suspect_line(one) for one in report["suspects"]]
    lines += [f"  left out: {line}" for line in report["left_out"]]
    if asked("verbose"):
        lines += [f"  {line}" for line in aligned(tabulate_prediction(report["prediction"]))]
        lines += [f"  {stage}: {seconds:.1f} s" for stage, seconds in report["seconds"].items()]
    return lines


def _suspect_line(one: dict[str, Any]) -> str:
    what, why = ("light", "did the face move?") if "light" in one else ("camera", "was it moved?")
    share, misfit = one["outlier_share"], one["misfit"]
    return f"  {what} {one[what]}: {share:.0%} of its samples are outliers, residuals {misfit:.1f} times noise ({why})"


@click.command("basis")
@click.argument("path", type=PATH, required=False)
@click.option("--disc", type=Finite(0, 20), default=0.8, help="Radius of lights, degrees.")
@common
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
    emit(report.attrs | {"header": header, "rows": rows}, [*aligned([header, *rows]), *worst, *report.attrs["notes"]])
