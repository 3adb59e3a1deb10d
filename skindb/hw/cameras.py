"""Cameras that write files, and the assignment of their frames to triggers."""

import os
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from skindb.clock import SYSTEM_CLOCK, Clock
from skindb.errors import InputError, input_error, system_fault
from skindb.format.frames import frame_size
from skindb.types import Float64, Index

FRAME_SUFFIXES = (".png", ".tif", ".tiff", ".exr")
LOOK_SECONDS = 0.05  # interval at which the folders are polled
# fraction of the reach: two assignments whose mean errors differ by less are ambiguous
AMBIGUOUS = 0.2
# number of frames tried with every trigger to find the offset of the clocks
CANDIDATES = 3
PRECISE = 0.2  # fraction of the reach within which times are precise
# of the frames, with which precise times overrule their number
MIN_PRECISE_FRACTION = 0.8
MIN_PRECISE_FRAMES = 8
QUIET_SECONDS = 2.0  # without a new file, after which no more are expected


@dataclass(frozen=True)
class Shot:
    """A complete image file of a camera."""

    path: Path
    time: float  # s, modification time of the file


class Cameras(Protocol):
    """Cameras that take a frame at every trigger of the controller; see
    docs/howto/capture.md on adding others.
    """

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the cameras."""

    def start(self, since: float | None = None) -> None:
        """Prepare for a run; existing frames are ignored from now on.

        With `since`, a time [s since 1970], the frames that were taken later are those
        of a run that was interrupted. Cameras that do not have them any more may ignore
        it.
        """

    def collect(self, expected: int, seconds: float) -> Mapping[str, list[Shot]]:
        """Return the frames of every camera since `start`, in the order in which they were taken.

        Returns when every camera has delivered the expected number, or after the given
        number of seconds.
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
    clock
        Clock by which the folders are watched.

    Raises
    ------
    InputError
        If a camera has no subfolder.
    """

    def __init__(
        self,
        root: str | Path,
        ids: Sequence[str],
        *,
        quiet: float = QUIET_SECONDS,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self.root = Path(root)
        self._ids = tuple(ids)
        self._quiet = quiet
        self._clock = clock
        if missing := [name for name in ids if not (self.root / name).is_dir()]:
            raise input_error(
                str(self.root),
                "must have a subfolder for each camera",
                f"no subfolder {', '.join(missing[:5])}",
                "set the folders in the tethering tool",
            )
        self._before: dict[Path, int] = {}  # file -> modification time [ns]

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return self._ids

    def start(self, since: float | None = None) -> None:
        """Record the existing files, or those before a time [s since 1970], which
        `collect` ignores.

        That time is compared with when a file came into the folder (`st_ctime`), not
        with the clock of the camera.
        """
        begin = np.inf if since is None else since
        files = [file for name in self._ids for file in self._files(name)]
        self._before = {
            path: status.st_mtime_ns
            for path, status in files
            if status.st_ctime < begin
        }

    def collect(self, expected: int, seconds: float) -> dict[str, list[Shot]]:
        """Return the complete frames since `start`: files whose size is stable and
        whose header can be read.
        """
        end = self._clock.monotonic() + seconds
        changed = self._clock.monotonic()
        sizes = dict[Path, int]()
        complete: dict[str, dict[Path, Shot]] = {name: {} for name in self._ids}
        while True:
            for name in self._ids:
                for path, status in self._files(name, complete[name]):
                    if self._before.get(path) == status.st_mtime_ns:
                        continue
                    if (
                        sizes.get(path) == status.st_size > 0
                        and frame_size(path) is not None
                    ):
                        complete[name][path] = Shot(path, status.st_mtime)
                    if sizes.get(path) != status.st_size:
                        sizes[path] = status.st_size
                        changed = self._clock.monotonic()
            now = self._clock.monotonic()
            enough = all(len(shots) >= expected for shots in complete.values())
            if enough or now > end or now > changed + self._quiet:
                break
            self._clock.sleep(LOOK_SECONDS)
        return {
            name: sorted(shots.values(), key=lambda shot: (shot.time, shot.path))
            for name, shots in complete.items()
        }

    def _files(
        self, name: str, complete: Collection[Path] = ()
    ) -> list[tuple[Path, os.stat_result]]:
        """Image files of a camera that are not complete; one that is renamed or removed
        at this moment is skipped.
        """
        files = list[tuple[Path, os.stat_result]]()
        try:
            for path in (self.root / name).iterdir():
                if path.suffix.lower() in FRAME_SUFFIXES and path not in complete:
                    with suppress(FileNotFoundError):
                        files.append((path, path.stat()))
        except OSError as error:
            raise InputError(system_fault(error, f"camera {name}")) from None
        return files


def match_frames(shots: Sequence[Shot], triggers: Sequence[float]) -> list[Path | None]:
    """Assign a frame to every trigger, or None if its frame is missing.

    If there are as many frames as triggers, they are assigned in order, unless precise
    times of the files contradict it. Otherwise they are assigned by time: the clocks of
    camera and controller are assumed to differ by a constant offset, the one that
    matches most frames to a trigger. A frame matches a trigger if it is off by less
    than half of the shortest interval between triggers. If two offsets match equally
    well, no frame is assigned, because repeating frames is better than confusing them.

    Parameters
    ----------
    shots
        Frames of one camera, in the order in which they were taken.
    triggers
        Times of the triggers [s].
    """
    if not shots or not triggers:
        return [None] * len(triggers)
    times = np.array([shot.time for shot in shots])
    due = np.array(triggers)
    reach = 0.5 * float(np.diff(due).min()) if len(due) > 1 else np.inf
    if len(shots) == len(triggers) and not _contradicted(times, due, reach):
        return [shot.path for shot in shots]
    best = _assignment(times, due, reach)
    if best is None:
        return [None] * len(triggers)
    return [shots[i].path if i >= 0 else None for i in best]


def _contradicted(times: Float64, due: Float64, reach: float) -> bool:
    """Whether nearly all frames fit triggers precisely, but not in their order.

    This happens if a file is written again, or if the controller reports another trigger as lost.
    """
    if len(due) < MIN_PRECISE_FRAMES:
        return False
    precise = _assignment(times, due, PRECISE * reach)
    if precise is None:
        return False
    matched = precise >= 0
    moved = precise[matched] != np.flatnonzero(matched)
    return bool(matched.sum() >= MIN_PRECISE_FRACTION * len(due) and moved.any())


def _assignment(times: Float64, due: Float64, reach: float) -> Index | None:
    """Index of the frame of every due time, -1 if there is none; None if two offsets of
    the clocks fit equally well.
    """
    tried = times[:: max(len(times) // CANDIDATES, 1)]
    offsets = np.unique((tried[:, None] - due).ravel())
    fits = [_nearest(times - offset, due, reach) for offset in offsets]
    count = np.array([(index >= 0).sum() for index in fits])
    error = np.empty(len(fits))
    for k, (index, offset) in enumerate(zip(fits, offsets, strict=True)):
        matched = index >= 0
        error[k] = np.abs(times[index[matched]] - offset - due[matched]).sum()
    order = np.lexsort((error, -count))
    best: Index = fits[order[0]]
    limit = 2 * error[order[0]] + AMBIGUOUS * reach * len(times)
    for candidate in order[1:]:
        rivals = count[candidate] == count[order[0]] and error[candidate] <= limit
        if rivals and not np.array_equal(fits[candidate], best):
            return None
    return best


def _nearest(times: Float64, due: Float64, reach: float) -> Index:
    """Index of the frame nearest to each due time within reach, -1 if there is none."""
    index = np.searchsorted((times[:-1] + times[1:]) / 2, due)
    return np.where(np.abs(times[index] - due) < reach, index, -1)
