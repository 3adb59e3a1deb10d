"""Cameras that write files, and the order in which their frames were taken."""

import os
import re
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Protocol

import numpy as np

from skindb.clock import SYSTEM_CLOCK, Clock
from skindb.errors import InputError, input_error, system_fault
from skindb.format.frames import frame_size

FRAME_SUFFIXES = (".png", ".tif", ".tiff", ".exr")
LOOK_SECONDS = 0.05  # interval at which the folders are polled
# without a new file of a camera, after which no more are expected of it
QUIET_SECONDS = 15.0
# fraction of the names with steps of one, of numbers that a camera counts
MIN_COUNTED = 0.9
MAX_GAP = 1000  # of such numbers within one run
# between the arrivals of two files, in which their order is certain
MIN_ARRIVAL_SECONDS = 0.02
# fraction of files whose names contradict their arrival, above which names tell nothing
MAX_CONTRADICTED = 0.25


@dataclass(frozen=True)
class Shot:
    """A complete image file of a camera."""

    path: Path
    is_doubtful: bool = False  # whether it may have been taken before its predecessor


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

    def collect(self, expected: int) -> Mapping[str, list[Shot]]:
        """Return the frames of every camera since `start`, in the order in which they were taken.

        Returns when every camera has delivered the expected number, or delivers no more.
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
        Seconds without a new file of a camera after which no more are expected of it.
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

    def collect(self, expected: int) -> dict[str, list[Shot]]:
        """Return the complete frames since `start`: files whose size is stable and
        whose header can be read.

        They are in the order of their numbers if a camera counts its files, and
        otherwise of their arrival in the folder, which is uncertain if it contradicts
        names that increase or if two arrive together.
        """
        now = self._clock.monotonic()
        changed = dict.fromkeys(self._ids, now)
        sizes = dict[Path, int]()
        complete: dict[str, dict[Path, float]] = {name: {} for name in self._ids}
        while True:
            for name in self._ids:
                for path, status in self._files(name, complete[name]):
                    if self._before.get(path) == status.st_mtime_ns:
                        continue
                    if (
                        sizes.get(path) == status.st_size > 0
                        and frame_size(path) is not None
                    ):
                        complete[name][path] = status.st_ctime
                    if sizes.get(path) != status.st_size:
                        sizes[path] = status.st_size
                        changed[name] = now
            now = self._clock.monotonic()
            if all(
                len(complete[name]) >= expected or now > changed[name] + self._quiet
                for name in self._ids
            ):
                break
            self._clock.sleep(LOOK_SECONDS)
        return {name: _ordered(files) for name, files in complete.items()}

    def _files(
        self, name: str, complete: Collection[Path] = ()
    ) -> list[tuple[Path, os.stat_result]]:
        """Image files of a camera that are not complete; one that is renamed or removed
        at this moment is skipped.
        """
        files = []
        try:
            for path in (self.root / name).iterdir():
                if path.suffix.lower() in FRAME_SUFFIXES and path not in complete:
                    with suppress(FileNotFoundError):
                        files.append((path, path.stat()))
        except OSError as error:
            raise InputError(system_fault(error, f"camera {name}")) from None
        return files


def _ordered(arrivals: Mapping[Path, float]) -> list[Shot]:
    """Files of one camera in the order in which they were taken."""
    named = sorted(arrivals, key=lambda path: (_numbers(path), path.name))
    if len(named) < 2:
        return [Shot(path) for path in named]
    if _are_counted(named):
        numbers = np.array([_numbers(path) for path in named]).T
        gaps = np.diff(numbers).max(axis=0)
        # a counter that began again at zero
        begin = int(gaps.argmax()) + 1 if gaps.max() > MAX_GAP else 0
        return [Shot(path) for path in [*named[begin:], *named[:begin]]]
    place = {path: i for i, path in enumerate(named)}
    paths = sorted(arrivals, key=lambda path: (arrivals[path], place[path]))
    times = np.array([arrivals[path] for path in paths])
    is_together = np.diff(times) < MIN_ARRIVAL_SECONDS
    contradicted = np.diff([place[path] for path in paths]) < 0
    if contradicted.mean() > MAX_CONTRADICTED:
        contradicted = np.zeros_like(contradicted)
    doubtful = [False, *(is_together | contradicted).tolist()]
    return [Shot(path, unsure) for path, unsure in zip(paths, doubtful, strict=True)]


def _numbers(path: Path) -> tuple[int, ...]:
    """Numbers in a name."""
    return tuple(map(int, re.findall(r"\d+", path.name)))


def _are_counted(paths: Sequence[Path]) -> bool:
    """Whether sorted names differ in one number only, which increases by one."""
    texts = {re.sub(r"\d+", "", path.name) for path in paths}
    varying = [
        numbers
        for numbers in zip(*map(_numbers, paths), strict=False)
        if len(set(numbers)) > 1
    ]
    if len(texts) > 1 or len(varying) != 1:
        return False
    steps = [b - a for a, b in pairwise(varying[0])]
    return steps.count(1) >= MIN_COUNTED * len(steps)
