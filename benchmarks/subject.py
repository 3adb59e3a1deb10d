"""A subject from capture to model: time and memory of every stage of ingest and fit.

    python -m benchmarks subject CAPTURE --make [--merge PNG]
    python -m benchmarks subject CAPTURE [--spacing 0.375]

The first command simulates the capture, 22 GB: a virtual person under 150 lights in 16
cameras of 1300 x 1030, two exposures of 16-bit PNG, or with `--merge` the merged OpenEXR
frames of such a capture. The second one measures. Its database is temporary, beside the
capture. Compile before, by a small take.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np

import skindb
from benchmarks.ratios import merged
from benchmarks.stages import Stages, peak, stage_lines
from skindb.parameters import VIRTUAL_SEED
from skindb.virtual.capture import DEVICE_SEED, _write_scan, simulate_take
from skindb.virtual.dome import build_dome
from skindb.virtual.head import parametric_head
from skindb.virtual.person import default_people, face_shape
from skindb.workflow import fit_take, ingest_take

# mm; three subdivisions of it have 603,153 surfels
SCAN_SPACING = 2.83


def make_capture(folder: Path) -> None:
    """Simulate the person; the scan is finer than that of `skindb simulate`."""
    person = default_people()[0]
    device = np.random.default_rng(DEVICE_SEED)
    dome = build_dome(150, 16, width=1300, height=1030, rng=device)
    simulate_take(folder, person, dome, rng=np.random.default_rng(VIRTUAL_SEED))
    scan = parametric_head(face_shape(person), spacing_mm=SCAN_SPACING, jitter=0.25)
    _write_scan(folder, scan, rng=np.random.default_rng(VIRTUAL_SEED))


def main(
    capture: Path,
    *,
    spacing: float = 0.375,
    make: Annotated[bool, "Make the capture instead."] = False,
    merge: Annotated[Path | None, "Capture whose exposures are merged."] = None,
) -> None:
    """Make the capture, or measure and print."""
    if merge is not None:
        merged(merge, capture)
        return
    if make:
        make_capture(capture)
        return
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
