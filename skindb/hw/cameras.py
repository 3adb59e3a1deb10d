"""Cameras that write files, and the assignment of their frames to triggers."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.ingest.frames import frame_size

FRAME_SUFFIXES = (".png", ".tif", ".tiff", ".exr")
LOOK_SECONDS = 0.05  # interval at which the folders are polled
AMBIGUOUS = 0.2  # fraction of the reach: two assignments whose mean errors differ by less are ambiguous
CANDIDATES = 3  # number of frames tried with every trigger to find the offset of the clocks
QUIET_SECONDS = 2.0  # without a new file, after which no more are expected


@dataclass(frozen=True)
class Shot:
    """A complete image file of a camera."""

    path: Path
    time: float  # s, modification time of the file


class Cameras(Protocol):
    """Cameras that take a frame at every trigger of the controller; see docs/howto/capture.md on adding others."""

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the cameras."""

    def start(self, since: float | None = None) -> None:
        """Prepare for a run; existing frames are ignored from now on.

        With `since`, a time [s since 1970], the frames that were taken later are those of a run that was interrupted.
        Cameras that do not have them any more may ignore it.
        """

    def collect(self, expected: int, seconds: float) -> Mapping[str, list[Shot]]:
        """Return the frames of every camera since `start`, in the order in which they were taken.

        Returns when every camera has delivered the expected number, or after the given number of seconds.
        """


class FolderCameras:
    """Cameras whose tethering tool writes every frame into a folder of that camera.

    Parameters
    ----------
    root
        Folder with one subfolder for each camera.
    ids
        Names of the cameras, which are also the names of the subfolders.
    quiet
        Seconds without a new file after which no more are expected.

    Raises
    ------
    InputError
        If a camera has no subfolder.
    """

    def __init__(self, root: str | Path, ids: Sequence[str], *, quiet: float = QUIET_SECONDS) -> None:
        self.root, self._ids, self._quiet = Path(root), tuple(ids), quiet
        if missing := [name for name in ids if not (self.root / name).is_dir()]:
            rule, cure = "must have a subfolder for each camera", "set the folders in the tethering tool"
            raise InputError(Fault(str(self.root), rule, f"no subfolder {', '.join(missing[:5])}", cure))
        self._before: dict[Path, int] = {}  # file -> modification time [ns]

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return self._ids

    def start(self, since: float | None = None) -> None:
        """Record the existing files, or those before a time [s since 1970], which `collect` ignores.

        That time is compared with when a file came into the folder (`st_ctime`), not with the clock of the camera.
        """
        last = np.inf if since is None else since
        files = [one for name in self._ids for one in self._files(name)]
        self._before = {path: status.st_mtime_ns for path, status in files if status.st_ctime < last}

    def collect(self, expected: int, seconds: float) -> dict[str, list[Shot]]:
        """Return the complete frames since `start`: files whose size is stable and whose header can be read."""
        end, sizes, changed = time.monotonic() + seconds, dict[Path, int](), time.monotonic()
        complete: dict[str, dict[Path, Shot]] = {name: {} for name in self._ids}
        while True:
            for name in self._ids:
                for path, status in self._files(name):
                    if path in complete[name]:
                        continue
                    if self._before.get(path) == status.st_mtime_ns:
                        continue
                    if sizes.get(path) == status.st_size > 0 and frame_size(path) is not None:
                        complete[name][path] = Shot(path, status.st_mtime)
                    if sizes.get(path) != status.st_size:
                        sizes[path], changed = status.st_size, time.monotonic()
            now = time.monotonic()
            enough = all(len(shots) >= expected for shots in complete.values())
            if enough or now > end or now > changed + self._quiet:
                return {
                    name: sorted(shots.values(), key=lambda s: (s.time, s.path)) for name, shots in complete.items()
                }
            time.sleep(LOOK_SECONDS)

    def _files(self, name: str) -> list[tuple[Path, os.stat_result]]:
        """Image files of a camera; one that is renamed or removed at this moment is skipped."""
        found = list[tuple[Path, os.stat_result]]()
        for path in (self.root / name).iterdir():
            if path.suffix.lower() in FRAME_SUFFIXES:
                with suppress(FileNotFoundError):
                    found.append((path, path.stat()))
        return found


def match_frames(shots: Sequence[Shot], triggers: Sequence[float]) -> list[Path | None]:
    """Assign a frame to every trigger, or None if its frame is missing.

    If there are as many frames as triggers, they are assigned in order. Otherwise they are assigned by time: the clocks
    of camera and controller are assumed to differ by a constant offset, the one that matches most frames to a trigger.
    A frame matches a trigger if it is off by less than half of the shortest interval between triggers. If two offsets
    match equally well, no frame is assigned, because repeating frames is better than confusing them.

    Parameters
    ----------
    shots
        Frames of one camera, in the order in which they were taken.
    triggers
        Times of the triggers [s].
    """
    if len(shots) == len(triggers):
        return [shot.path for shot in shots]
    if not shots or not triggers:
        return [None] * len(triggers)
    at, due = np.array([shot.time for shot in shots]), np.array(triggers)
    reach = 0.5 * float(np.diff(due).min()) if len(due) > 1 else np.inf
    tried = at[:: max(len(at) // CANDIDATES, 1)]
    offsets = np.unique((tried[:, None] - due).ravel())
    found = [_nearest(at - offset, due, reach) for offset in offsets]
    count = np.array([(index >= 0).sum() for index in found])
    error = np.array([np.abs(at[i[i >= 0]] - o - due[i >= 0]).sum() for i, o in zip(found, offsets, strict=True)])
    order = np.lexsort((error, -count))
    best = found[order[0]]
    for other in order[1:]:
        rivals = count[other] == count[order[0]] and error[other] <= 2 * error[order[0]] + AMBIGUOUS * reach * len(at)
        if rivals and not np.array_equal(found[other], best):
            return [None] * len(triggers)
    return [shots[i].path if i >= 0 else None for i in best]


def _nearest(at: NDArray[np.float64], due: NDArray[np.float64], reach: float) -> NDArray[np.int64]:
    """Index of the frame nearest to each due time within reach, -1 if there is none."""
    right = np.clip(np.searchsorted(at, due), 1, max(len(at) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(at) - 1)
    index = np.where(np.abs(at[left] - due) <= np.abs(at[right] - due), left, right)
    return np.where(np.abs(at[index] - due) < reach, index, -1)
