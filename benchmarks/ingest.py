"""Ingest against decoding alone: CPU and wall seconds of every stage, and its peak of anonymous memory.

    python benchmarks/ingest.py CAPTURE [--spacing MM] [--every N] [--json FILE]

Processor seconds are what is compared. Every N-th frame of each kind (of the face, of the white target, dark ones) is
decoded by as many threads, before and after the ingest: a processor that others use as well is slower at times,
and the mean of both counts. The first run after a change of the code compiles: run it twice.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from stages import Stages, stage_lines

import skindb
from skindb.ingest.devices import promised_frames
from skindb.ingest.folder import read_capture
from skindb.ingest.frames import FrameKind, read_frame
from skindb.ingest.report import sample_lines
from skindb.ingest.run import threads
from skindb.workflow import ingest_take


def decoding(folder: Path, every: int) -> dict[str, dict[str, float]]:
    """Seconds to decode the frames of each kind, "frames" of the face, "white" and "dark", and their number."""
    dome = read_capture(folder).dome
    if dome is None:
        raise SystemExit(f"{folder}: no dome")
    kinds: dict[str, list[tuple[Path, FrameKind]]] = {}
    for kind, name, camera in promised_frames(dome):
        kinds.setdefault(kind, []).append((dome.folder / name, camera.sensor.kind))
    found = {}
    for kind, frames in kinds.items():
        some = frames[::every] if len(frames) > 10 * every else frames
        start = time.monotonic(), time.process_time()
        with ThreadPoolExecutor(threads(dome)) as pool:
            for _ in pool.map(lambda frame: len(read_frame(*frame)), some):
                pass
        scale = len(frames) / len(some)
        spent = {"wall": scale * (time.monotonic() - start[0]), "cpu": scale * (time.process_time() - start[1])}
        found[kind] = spent | {"frames": len(frames)}
    return found


def main() -> None:
    """Print a table, and write what was measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--spacing", type=float, default=1.5)
    parser.add_argument("--every", type=int, default=10)
    parser.add_argument("--footprint", action="store_true")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    before = decoding(options.capture, options.every)
    with tempfile.TemporaryDirectory(dir=options.capture.parent) as folder, Stages() as stages:
        record = ingest_take(
            skindb.open(folder),
            options.capture,
            spacing_mm=options.spacing,
            footprint=options.footprint,
            progress=stages,
        )
        stages.end("commit")
    after = decoding(options.capture, options.every)
    alone = {kind: {key: (before[kind][key] + after[kind][key]) / 2 for key in before[kind]} for kind in before}
    decoded = {key: sum(kind[key] for kind in alone.values()) for key in ("wall", "cpu")}
    table = stages.table()
    ratio = table["all"]["cpu"] / decoded["cpu"]
    result: dict[str, Any] = {"capture": options.capture.name, "spacing_mm": options.spacing, "decoding": alone}
    result |= {"stages": table, "ratio_cpu": ratio, "bytes": record.bytes}
    result |= {"samples": record.provenance["summary"]["samples"]}
    rows = {f"decode {kind} ({spent['frames']:.0f})": spent for kind, spent in alone.items()}
    print("\n".join(stage_lines({**rows, "decode all": decoded, **table})))
    print(f"ratio {ratio:.2f}, {record.bytes / 1e6:.0f} MB")
    print("\n".join(sample_lines(result["samples"])))
    if options.json:
        options.json.write_text(json.dumps(result, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
