"""Recover the truth of captures made by an independent renderer: the rows of docs/validation.md.

    python benchmarks/validate.py DB CAPTURE [CAPTURE...]

Each capture folder has its truth beside it as <folder>.truth.npz (keys of skindb.virtual.truth). The captures are
ingested into DB and fitted; a Markdown row a capture is printed.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
from pathlib import Path
from typing import Any

import numpy as np
from stages import Stages, stage_lines

import skindb
from skindb.fit import fit_take
from skindb.ingest import ingest_capture
from skindb.virtual.truth import recovered_against_true

HEADER = (
    "| capture | surfels | fitted | normal median, 95 % [deg] | R_d error R G B [%] | held-out lights; cameras [%] "
    "| sigma_tr error per site, R G B [%] | ingest, fit [s] | peak [GiB] |\n|---|---|---|---|---|---|---|---|---|"
)


def measure(db: Any, folder: Path, *, spacing: float, lights: float, cameras: float) -> dict[str, Any]:
    """Ingest, fit and compare one capture."""
    with Stages() as ingest:
        take = ingest_capture(db, folder, spacing_mm=spacing, progress=ingest).take
        ingest.end("commit")
    with Stages() as fit:
        _, report = fit_take(db, take, hold_out_lights=lights, hold_out_cameras=cameras, progress=fit)
        fit.end("commit")
    with np.load(folder.with_name(folder.name + ".truth.npz")) as truth:
        recovered = recovered_against_true(db.read("model", take), dict(truth)).summary()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    stages = {"ingest": ingest.table(), "fit": fit.table()}
    return {"capture": folder.name, **report, **recovered, "stages": stages, "peak": peak}


def row(r: dict[str, Any]) -> str:
    """One row of the table."""
    status = "; ".join(f"{name} {share:.1%}" for name, share in r["status"].items())
    sites = "; ".join(
        f"{site} {' '.join(f'{v:+.0f}' for v in values)}" for site, values in r["sigma_tr_percent"].items()
    )
    held = "; ".join(
        f"{100 * r[name]['median']:.1f}" for name in ("held_out_error", "held_out_camera_error") if name in r
    )
    diffuse = " ".join(f"{v:.1f}" for v in r["diffuse_median_percent"])
    seconds = ", ".join(f"{r['stages'][name]['all']['wall']:.0f}" for name in ("ingest", "fit"))
    return (
        f"| {r['capture']} | {r['surfels']:,} | {status} | {r['normal_median_deg']:.1f}, {r['normal_95_deg']:.1f} "
        f"| {diffuse} | {held or 'none'} | {sites or 'no probe'} | {seconds} | {r['peak']:.1f} |"
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("db")
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--spacing", type=float, default=1.5)
    parser.add_argument("--hold-out-lights", type=float, default=0.1)
    parser.add_argument("--hold-out-cameras", type=float, default=0.0)
    parser.add_argument("--stages", action="store_true", help="time and memory of every stage, on standard error")
    parser.add_argument("--json", type=Path, help="also write everything measured")
    args = parser.parse_args()
    db, results = skindb.open(args.db), []
    print(HEADER)
    for folder in args.captures:
        shares = {"lights": args.hold_out_lights, "cameras": args.hold_out_cameras}
        results.append(measure(db, folder, spacing=args.spacing, **shares))
        print(row(results[-1]), flush=True)
        for name, table in results[-1]["stages"].items() if args.stages else ():
            print("\n".join([name, *stage_lines(table)]), file=sys.stderr)
    if args.json:
        args.json.write_text(json.dumps(results, indent=1, default=str), encoding="utf-8")


if __name__ == "__main__":
    main()
