"""Cameras that write files: which frame belongs to which trigger, and which are missing."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.ingest.frames import frame_size

FRAME_SUFFIXES = (".png", ".tif", ".tiff", ".exr")
LOOK_SECONDS = 0.05  # between two looks at the folders
AMBIGUOUS = 0.2  # of the reach: difference of mean errors that decides between two ways to match
CANDIDATES = 3  # frames that are tried as those of every trigger, to find how the clocks differ
QUIET_SECONDS = 2.0


@dataclass(frozen=True)
class Shot:
    """A complete file of a camera."""

    path: Path
    time: float  # s, when it was written


class Cameras(Protocol):
    """Cameras that take a frame at every trigger of the controller; how to add others: docs/howto/capture.md."""

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the cameras."""

    def start(self) -> None:
        """Get ready: what is there already does not count."""

    def collect(self, expected: int, seconds: float) -> Mapping[str, list[Shot]]:
        """The frames of every camera since `start`, in the order in which they were taken.

        Returns when every camera has as many as expected, or after so many seconds.
        """


class FolderCameras:
    """Cameras whose tethering tool writes every frame into a folder of that camera.

    Parameters
    ----------
    root
        Folder with a folder for each camera.
    ids
        Names of the cameras, which are those of the folders.
    quiet
        Seconds without a new file after which no more are expected.

    Raises
    ------
    InputError
        For cameras without a folder.
    """

    def __init__(self, root: str | Path, ids: Sequence[str], *, quiet: float = QUIET_SECONDS) -> None:
        self.root, self._ids, self._quiet = Path(root), tuple(ids), quiet
        if missing := [name for name in ids if not (self.root / name).is_dir()]:
            rule, cure = "every camera must have a folder of its name", "set the folders in the tethering tool"
            raise InputError(Fault(str(self.root), rule, f"none of {', '.join(missing[:5])}", cure))
        self._before: dict[Path, int] = {}  # file -> when it was written

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return self._ids

    def start(self) -> None:
        """What is there already does not count."""
        self._before = {path: path.stat().st_mtime_ns for name in self._ids for path in self._files(name)}

    def collect(self, expected: int, seconds: float) -> dict[str, list[Shot]]:
        """Complete frames since `start`: files whose size does not change any more and whose header can be read."""
        end, sizes, changed = time.monotonic() + seconds, dict[Path, int](), time.monotonic()
        complete: dict[str, dict[Path, Shot]] = {name: {} for name in self._ids}
        while True:
            for name in self._ids:
                for path in self._files(name):
                    if path in complete[name]:
                        continue
                    status = path.stat()
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

    def _files(self, name: str) -> list[Path]:
        return [path for path in (self.root / name).iterdir() if path.suffix.lower() in FRAME_SUFFIXES]


def match_frames(shots: Sequence[Shot], triggers: Sequence[float]) -> list[Path | None]:
    """The frame of every trigger, or None for those that are missing.

    If there are as many frames as triggers, they correspond in order. Otherwise times decide: clocks of cameras and
    controller differ by a constant, which is the one that lets most frames fall on a trigger; a frame belongs to a
    trigger if it is off by less than half of the least time between two triggers. If two constants do equally well, no
    frame is assigned: a frame that is taken for another one would be worse than one that is taken again.

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
    """Number of the frame nearest to each time within reach, -1 if there is none."""
    right = np.clip(np.searchsorted(at, due), 1, max(len(at) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(at) - 1)
    index = np.where(np.abs(at[left] - due) <= np.abs(at[right] - due), left, right)
    return np.where(np.abs(at[index] - due) < reach, index, -1)
