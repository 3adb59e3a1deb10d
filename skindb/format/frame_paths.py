"""Paths of the frames of a capture: templates, exposures, and files that must stay
inside the folder.
"""

from __future__ import annotations

import contextlib
import stat
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from skindb.elementwise import thread_count
from skindb.errors import Fault, attempt
from skindb.format.fields import IDENTIFIER, Fields, short
from skindb.format.frames import read_frame
from skindb.limits import MAX_EXPOSURES, MAX_RECHECKED_BYTES

EXPOSURE = "exposure"
LIGHT = "light"
CAMERA = "camera"
SITE = "site"
PLACEMENT = "placement"
EXPOSURE_SECONDS = (1e-9, 1e5)  # s: from a laser pulse to a day


def filled(template: str, **names: str) -> str:
    """The template with its placeholders replaced."""
    for name, value in names.items():
        template = template.replace(f"{{{name}}}", value)
    return template


def read_exposures(fields: Fields) -> dict[str, float]:
    """Exposure times in s by id, in the order of the file."""
    items = fields.items("exposures", maximum=MAX_EXPOSURES)
    shortest, longest = EXPOSURE_SECONDS
    return {
        item.text("id", rule=IDENTIFIER): item.number(
            "seconds", minimum=shortest, maximum=longest
        )
        for item in items
    }


def require_merged(fields: Fields, exposures: Mapping[str, float]) -> None:
    """Require one exposure of one second: merged radiance is per second, and another
    time would scale it again.
    """
    if exposures and [*exposures.values()] != [1.0]:
        finding = ", ".join(f"{seconds:g} s" for seconds in exposures.values())
        rule = "OpenEXR frames are merged radiance: one exposure of 1 second"
        cure = "merge them, divide by their seconds, and give one exposure of 1 second"
        fields.fault("exposures", rule, finding, cure)


def require_own_files(
    fields: Fields, views: Iterable[tuple[str, str, dict[str, str]]]
) -> None:
    """Require a separate file for every view: ids such as a_b and a with c and b_c can
    form the same path.

    `views` are the key of the template, the path, and the names in it.
    """
    owners = dict[Path, dict[str, str]]()
    shared = list[tuple[str, str]]()
    for key, name, names in views:
        owner = owners.setdefault(Path(name), names)
        if owner != names:
            pair = (
                ", ".join(f"{k} {v}" for k, v in view.items() if owner[k] != names[k])
                for view in (owner, names)
            )
            shared.append((key, f"{Path(name).name} of {' and of '.join(pair)}"))
    if shared:
        key, pair_text = shared[0]
        rule = "every view must have its own file"
        cure = "rename the ids, or separate them by folders in the template"
        fields.fault(key, rule, f"{len(shared)} shared, {pair_text}", cure)


def inside(
    folder: Path,
    name: str,
    where: str,
    faults: list[Fault],
    parents: dict[Path, bool] | None = None,
) -> Path | None:
    """The file `name` of the folder; None and a fault if it lies outside, directly or
    through a link.

    `parents` caches which folders lie inside; it is updated.
    """
    path = folder / name
    try:
        within = _within(path, folder, {} if parents is None else parents)
    except (OSError, ValueError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        rule = "must be a path that this system can follow"
        cure = "rename the file, and correct the path"
        faults.append(Fault(where, rule, f"{short(name)}: {reason}", cure))
        return None
    relative = Path(name)
    if within and not relative.is_absolute() and ".." not in relative.parts:
        return path
    rule = "every path must stay inside the capture folder"
    finding = short(name) + ("" if within else ", which leads out of it")
    faults.append(Fault(where, rule, finding, "copy the file into the folder"))
    return None


def _within(path: Path, folder: Path, parents: dict[Path, bool]) -> bool:
    """Whether a path stays inside a folder with every link followed; the parent folders
    are checked once.
    """
    missing = contextlib.suppress(FileNotFoundError, NotADirectoryError)
    with missing:
        if stat.S_ISLNK(path.lstat().st_mode):
            with missing:
                # fails for cyclic links and names that are too long, which `resolve` of
                # Python 3.13 ignores
                path.stat()
            return path.resolve().is_relative_to(folder.resolve())
    parent = path.parent
    if parent not in parents:
        parents[parent] = parent.resolve().is_relative_to(folder.resolve())
    return parents[parent]


def decoding_faults(paths: Iterable[Path], known: Iterable[Fault]) -> list[Fault]:
    """Faults of frames with valid headers, within the first `MAX_RECHECKED_BYTES` of files.

    They are reported together with those of a folder that is refused.

    Parameters
    ----------
    paths
        Frames of the dome and of the probe, as far as these could be read.
    known
        Faults of the folder; the frames that they name are not decoded.
    """
    named = {fault.where.partition(" (")[0] for fault in known}
    total = 0
    chosen = []
    for path in dict.fromkeys(paths):
        if str(path) in named:
            continue
        with contextlib.suppress(OSError, ValueError):
            total += path.stat().st_size
            if total > MAX_RECHECKED_BYTES:
                break
            chosen.append(path)

    def frame_faults(path: Path) -> list[Fault]:
        faults = list[Fault]()
        attempt(faults, lambda: read_frame(path))
        return faults

    with ThreadPoolExecutor(thread_count()) as pool:
        return [fault for faults in pool.map(frame_faults, chosen) for fault in faults]
