"""A subject from capture to model: time and memory of every stage of ingest and fit.

    python -m benchmarks subject CAPTURE [--spacing 0.375]

The database is temporary, beside the capture. Compile before, by a small take.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import skindb
from benchmarks.stages import Stages, peak, stage_lines
from skindb.workflow import fit_take, ingest_take


def main(capture: Path, *, spacing: float = 0.375) -> None:
    """Measure and print."""
    with tempfile.TemporaryDirectory(dir=capture.parent) as folder:
        db = skindb.open(folder)
        with Stages() as stages:
            record = ingest_take(db, capture, spacing_mm=spacing, progress=stages)
            stages.end("commit")
        print("\n".join(stage_lines(stages.table())))
        summary = record.provenance["summary"]
        print(f"{summary['surfels']['count']:,} surfels, {record.bytes / 1e6:,.0f} MB")
        with Stages() as stages:
            fit_take(db, db.takes("capture")[0], progress=stages)
            stages.end("commit")
        print("\n".join(stage_lines(stages.table())))
    print(f"peak resident memory: {peak():.2f} GiB")
