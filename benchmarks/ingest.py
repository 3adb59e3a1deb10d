"""Ingest against decoding alone: CPU and wall seconds of every stage, and its peak of anonymous memory.

    python benchmarks/ingest.py CAPTURE [--spacing MM] [--every N] [--json FILE]

Processor seconds are what is compared. Every N-th frame of each kind (of the face, of the white target, dark ones) is
decoded by the same two threads, before and after the ingest: a processor that others use as well is slower at times,
and the mean of both counts. The first run after a change of the code compiles: run it twice.
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
from skindb.ingest.devices import promised_frames
from skindb.ingest.folder import read_capture
from skindb.ingest.frames import FrameKind, read_frame
from skindb.ingest.report import sample_lines
from skindb.ingest.run import THREADS


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
        with ThreadPoolExecutor(THREADS) as pool:
            for _ in pool.map(lambda frame: len(read_frame(*frame)), some):
                pass
        scale = len(frames) / len(some)
        spent = {"wall": scale * (time.monotonic() - start[0]), "cpu": scale * (time.process_time() - start[1])}
        found[kind] = spent | {"frames": len(frames)}
    return found


class Memory:
    """Peak of anonymous pages [MiB], looked at twenty times a second: files in the page cache are not the process's."""

    def __init__(self) -> None:
        self.peak, self._lately, self._stop = 0.0, 0.0, threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Memory:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def take(self) -> float:
        """The peak since it was taken last."""
        self._look()
        taken, self._lately = self._lately, 0.0
        return taken

    def _watch(self) -> None:
        while not self._stop.wait(0.05):
            self._look()

    def _look(self) -> None:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        (anonymous,) = [int(line.split()[1]) / 1024 for line in lines if line.startswith("RssAnon")]
        self.peak, self._lately = max(self.peak, anonymous), max(self._lately, anonymous)


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
    stages: dict[str, dict[str, float]] = {}
    last = [time.monotonic(), time.process_time()]

    with tempfile.TemporaryDirectory(dir=options.capture.parent) as folder, Memory() as memory:

        def note(name: str) -> None:
            now = [time.monotonic(), time.process_time()]
            stages[name] = {"wall": now[0] - last[0], "cpu": now[1] - last[1], "mib": memory.take()}
            last[:] = now

        record = ingest_capture(
            skindb.open(folder),
            options.capture,
            spacing_mm=options.spacing,
            footprint=options.footprint,
            progress=lambda stage, step, steps: note(stage) if step == steps else None,
        )
        note("commit")
    after = decoding(options.capture, options.every)
    alone = {kind: {key: (before[kind][key] + after[kind][key]) / 2 for key in before[kind]} for kind in before}
    whole = {key: sum(stage[key] for stage in stages.values()) for key in ("wall", "cpu")}
    decoded = {key: sum(kind[key] for kind in alone.values()) for key in ("wall", "cpu")}
    ratio = whole["cpu"] / decoded["cpu"]
    result: dict[str, Any] = {"capture": options.capture.name, "spacing_mm": options.spacing, "decoding": alone}
    result |= {"stages": stages, "ingest": whole, "ratio_cpu": ratio, "anonymous_mib": memory.peak}
    result |= {"bytes": record.bytes, "samples": record.provenance["summary"]["samples"]}
    rows = {f"decode {kind} ({spent['frames']:.0f})": spent for kind, spent in alone.items()}
    for name, spent in {**rows, "decode all": decoded, **stages, "ingest": whole | {"mib": memory.peak}}.items():
        peak = f"   peak {spent['mib']:6.0f} MiB" if "mib" in spent else ""
        print(f"{name:<21} cpu {spent['cpu']:7.1f} s   wall {spent['wall']:7.1f} s{peak}")
    print(f"ratio {ratio:.2f}, {record.bytes / 1e6:.0f} MB")
    print("\n".join(sample_lines(result["samples"])))
    if options.json:
        options.json.write_text(json.dumps(result, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
