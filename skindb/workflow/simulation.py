"""Virtual captures, several at a time."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from skindb._types import Progress
from skindb.virtual.takes import simulate_takes
from skindb.workflow.takes import map_takes, results_of


def simulate(
    out: str | Path, *, takes: int = 8, workers: int | None = None, progress: Progress | None = None, **options: Any
) -> list[Path]:
    """Write virtual captures, one folder for each take, with their truth beside them.

    Parameters
    ----------
    out
        Folder of the captures.
    takes
        Number of takes, at most 8.
    workers
        Number of takes at a time, each in a process of its own; default one, in this process.
    progress
        Called with the stage, the steps done and the steps in all; only in this process.
    **options
        Of `skindb.virtual.takes.simulate_takes`: cameras, lights, width, height, head, subsurface, seed.

    Returns
    -------
    list of Path
        The folders, in the order of the takes.
    """
    call = partial(simulate_one, Path(out), progress=progress, **options)
    folders = dict(results_of(map_takes(call, range(takes), workers=workers)))
    return [folders[number] for number in sorted(folders)]


def simulate_one(out: Path, number: int, **options: Any) -> tuple[int, Path]:
    """One of the virtual takes, by its number; see `simulate`."""
    (folder,) = simulate_takes(out, takes=[number], **options)
    return number, folder
