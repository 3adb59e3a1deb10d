"""Ingest against decoding alone: CPU and wall seconds of every stage, and the peak of anonymous memory.

    python benchmarks/ingest.py CAPTURE [--spacing MM] [--every N] [--json FILE]

Processor seconds are what is compared: they hold on a machine that others use too. Decoding is that of every N-th frame
of the face by the same two threads, times N; white and dark frames are not in it.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import skindb
from skindb.ingest import ingest_capture
from skindb.ingest.folder import read_capture
from skindb.ingest.radiance import read_view
from skindb.ingest.report import sample_lines
from skindb.ingest.run import THREADS


def decoding(folder: Path, every: int) -> dict[str, float]:
    """Seconds to decode the frames of the face."""
    dome = read_capture(folder).dome
    if dome is None:
        raise SystemExit(f"{folder}: no dome")
    views = [(light.id, camera) for light in dome.lights for camera in dome.cameras][::every]
    start = time.monotonic(), time.process_time()
    with ThreadPoolExecutor(THREADS) as pool:
        for _ in pool.map(lambda view: len(read_view(dome, *view)), views):
            pass
    scale = len(dome.lights) * len(dome.cameras) / len(views)
    return {"wall": scale * (time.monotonic() - start[0]), "cpu": scale * (time.process_time() - start[1])}


class Memory:
    """Peak of anonymous pages [MiB], looked at twenty times a second: files in the page cache are not the process's."""

    def __init__(self) -> None:
        self.peak, self._stop = 0.0, threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Memory:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._stop.wait(0.05):
            lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
            (anonymous,) = [int(line.split()[1]) for line in lines if line.startswith("RssAnon")]
            self.peak = max(self.peak, anonymous / 1024)


def main() -> None:
    """Print a table, and write what was measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--spacing", type=float, default=1.5)
    parser.add_argument("--every", type=int, default=10)
    parser.add_argument("--footprint", action="store_true")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    alone = decoding(options.capture, options.every)
    stages: dict[str, dict[str, float]] = {}
    last = [time.monotonic(), time.process_time()]

    def note(name: str) -> None:
        now = [time.monotonic(), time.process_time()]
        stages[name] = {"wall": now[0] - last[0], "cpu": now[1] - last[1]}
        last[:] = now

    with tempfile.TemporaryDirectory(dir=options.capture.parent) as folder, Memory() as memory:
        record = ingest_capture(
            skindb.open(folder),
            options.capture,
            spacing_mm=options.spacing,
            footprint=options.footprint,
            progress=lambda stage, step, steps: note(stage) if step == steps else None,
        )
        note("commit")
    whole = {kind: sum(stage[kind] for stage in stages.values()) for kind in ("wall", "cpu")}
    result: dict[str, Any] = {"capture": options.capture.name, "spacing_mm": options.spacing, "decoding": alone}
    result |= {"stages": stages, "ingest": whole, "ratio_cpu": whole["cpu"] / alone["cpu"]}
    result |= {"anonymous_mib": memory.peak, "bytes": record.bytes, "samples": record.provenance["summary"]["samples"]}
    for name, spent in {"decoding alone": alone, **stages, "ingest": whole}.items():
        print(f"{name:<16} cpu {spent['cpu']:7.1f} s   wall {spent['wall']:7.1f} s")
    print(f"ratio {result['ratio_cpu']:.2f}, anonymous memory {memory.peak:.0f} MiB, {record.bytes / 1e6:.0f} MB")
    print("\n".join(sample_lines(result["samples"])))
    if options.json:
        options.json.write_text(json.dumps(result, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
