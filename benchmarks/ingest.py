"""Ingest compared with decoding its frames by the libraries: CPU time, wall time and peak
anonymous memory of every stage.

    python -m benchmarks ingest CAPTURE [--spacing MM] [--stride N] [--json FILE]

Each N-th frame of each kind (face, white target, dark) is decoded with the same number
of threads before and after the ingest, and the mean of both is used, because a shared
processor varies in speed. The first run after a change of the code also compiles.
"""

from __future__ import annotations

import json
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import imagecodecs
import OpenEXR

import skindb
from benchmarks.stages import Stages, stage_lines
from skindb.format.dome import promised_frames
from skindb.format.folder import read_capture
from skindb.format.frames import read_frame
from skindb.ingest.capture import threads
from skindb.ingest.report import sample_lines
from skindb.workflow import ingest_take


def decode(path: Path) -> None:
    """Decode a frame by the library for its format."""
    if path.suffix == ".exr":
        OpenEXR.File(str(path)).channels()
    elif path.suffix == ".png":
        imagecodecs.png_decode(path.read_bytes())
    else:
        read_frame(path)


def decoding(folder: Path, stride: int) -> dict[str, dict[str, float]]:
    """CPU and wall time of decoding the frames of each kind ("frames" of the face,
    "white", "dark"), and number.
    """
    dome = read_capture(folder).dome
    if dome is None:
        raise SystemExit(f"{folder}: no dome")
    kinds: dict[str, list[Path]] = {}
    for kind, name, _ in promised_frames(dome):
        kinds.setdefault(kind, []).append(dome.folder / name)
    times = {}
    for kind, frames in kinds.items():
        decoded = frames[::stride] if len(frames) > 10 * stride else frames
        start = time.monotonic(), time.process_time()
        with ThreadPoolExecutor(threads(dome)) as pool:
            for _ in pool.map(decode, decoded):
                pass
        scale = len(frames) / len(decoded)
        spent = {
            "wall": scale * (time.monotonic() - start[0]),
            "cpu": scale * (time.process_time() - start[1]),
        }
        times[kind] = spent | {"frames": len(frames)}
    return times


def measure(capture: Path, *, spacing: float = 1.5, stride: int = 10) -> dict[str, Any]:
    """Times of decoding and of the stages, and their ratio."""
    before = decoding(capture, stride)
    with (
        tempfile.TemporaryDirectory(dir=capture.parent) as folder,
        Stages() as stages,
    ):
        record = ingest_take(
            skindb.open(folder),
            capture,
            spacing_mm=spacing,
            progress=stages,
        )
        stages.end("commit")
    after = decoding(capture, stride)
    alone = {
        kind: {key: (before[kind][key] + after[kind][key]) / 2 for key in before[kind]}
        for kind in before
    }
    decoded = {
        key: sum(kind[key] for kind in alone.values())
        for key in ("wall", "cpu", "frames")
    }
    table = stages.table()
    return {
        "capture": capture.name,
        "spacing_mm": spacing,
        "decoding": alone | {"all": decoded},
        "stages": table,
        "ratio_cpu": table["all"]["cpu"] / decoded["cpu"],
        "bytes": record.bytes,
        "samples": record.provenance["summary"]["samples"],
    }


def main(
    capture: Path,
    *,
    spacing: float = 1.5,
    stride: int = 10,
    json_: Path | None = None,
) -> None:
    """Print a table, and write the results."""
    result = measure(capture, spacing=spacing, stride=stride)
    rows = {
        f"decode {kind} ({spent['frames']:.0f})": spent
        for kind, spent in result["decoding"].items()
    }
    print("\n".join(stage_lines(rows | result["stages"])))
    print(f"ratio {result['ratio_cpu']:.2f}, {result['bytes'] / 1e6:.0f} MB")
    print("\n".join(sample_lines(result["samples"])))
    if json_:
        json_.write_text(json.dumps(result, indent=1), encoding="utf-8")
