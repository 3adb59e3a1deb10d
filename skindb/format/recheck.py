"""Decoding the frames of a folder that is refused, so that their faults are reported
together with the others.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from skindb.elementwise import thread_count
from skindb.errors import Fault, InputError
from skindb.format.devices import DomeRecord, ProbeRecord, promised_frames
from skindb.format.frames import read_frame
from skindb.limits import MAX_FRAMES, MAX_RECHECKED_BYTES


def decoding_faults(
    dome: DomeRecord | None, probe: ProbeRecord | None, known: Iterable[Fault]
) -> list[Fault]:
    """Faults of frames with valid headers, within the first `MAX_RECHECKED_BYTES` of files.

    Parameters
    ----------
    dome, probe
        As far as they could be read.
    known
        Faults found so far; the frames that they name are not decoded.
    """
    named = {fault.where.partition(" (")[0] for fault in known}
    paths = [
        path for path in dict.fromkeys(_frames(dome, probe)) if str(path) not in named
    ]
    with ThreadPoolExecutor(thread_count()) as pool:
        return [fault for found in pool.map(_faults, _first(paths)) for fault in found]


def _frames(dome: DomeRecord | None, probe: ProbeRecord | None) -> Iterator[Path]:
    if dome is not None and dome.frame_count <= MAX_FRAMES:
        yield from (dome.folder / name for _, name, _ in promised_frames(dome))
    if probe is not None and probe.frames:
        yield from probe.frame_files()


def _first(paths: Iterable[Path]) -> Iterator[Path]:
    """The existing files until their total size reaches the limit."""
    total = 0
    for path in paths:
        try:
            total += path.stat().st_size
        except (OSError, ValueError):
            continue
        if total > MAX_RECHECKED_BYTES:
            return
        yield path


def _faults(path: Path) -> list[Fault]:
    try:
        read_frame(path)
    except InputError as error:
        return list(error.faults)
    return []
