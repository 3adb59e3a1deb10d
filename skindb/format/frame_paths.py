"""Paths of the frames of a capture: templates, exposures, and files that must stay
inside the folder.
"""

from __future__ import annotations

import contextlib
import stat
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from skindb.elementwise import thread_count
from skindb.errors import Fault, InputError
from skindb.format.fields import IDENTIFIER, Fields
from skindb.format.frames import read_frame
from skindb.format.json_file import short
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
    items = fields.items("exposures", most=MAX_EXPOSURES)
    least, most = EXPOSURE_SECONDS
    return {
        item.text("id", rule=IDENTIFIER): item.number("seconds", least=least, most=most)
        for item in items
    }


def require_merged(fields: Fields, exposures: Mapping[str, float]) -> None:
    """Require one exposure of one second: merged radiance is per second, and another
    time would scale it again.
    """
    if exposures and [*exposures.values()] != [1.0]:
        found = ", ".join(f"{seconds:g} s" for seconds in exposures.values())
        rule = "OpenEXR frames are merged radiance: one exposure of 1 second"
        fields.fault(
            "exposures",
            rule,
            found,
            "merge them, divide by their seconds, and give one exposure of 1 second",
        )


def require_own_files(
    fields: Fields, views: Iterable[tuple[str, str, dict[str, str]]]
) -> None:
    """Require a separate file for every view: ids such as a_b and a with c and b_c can
    form the same path.
    """
    first = dict[Path, dict[str, str]]()
    shared = list[tuple[str, str]]()
    for key, name, names in views:
        if (other := first.setdefault(Path(name), names)) != names:
            one, two = (
                ", ".join(f"{k} {v}" for k, v in view.items() if other[k] != names[k])
                for view in (other, names)
            )
            shared.append((key, f"{Path(name).name} of {one} and of {two}"))
    if shared:
        key, found = shared[0]
        cure = "rename the ids, or separate them by folders in the template"
        fields.fault(
            key,
            "every view must have its own file",
            f"{len(shared)} shared, {found}",
            cure,
        )


def inside(
    folder: Path,
    name: str,
    where: str,
    faults: list[Fault],
    known: dict[Path, bool] | None = None,
) -> Path | None:
    """The file `name` of the folder; None and a fault if it lies outside, directly or
    through a link.

    `known` caches which folders lie inside; it is updated.
    """
    path = folder / name
    try:
        within = _within(path, folder, {} if known is None else known)
    except (OSError, ValueError, RuntimeError) as error:
        rule = "must be a path that this system can follow"
        cure = "rename the file, and correct the path"
        faults.append(Fault(where, rule, f"{short(name)}: {_reason(error)}", cure))
        return None
    given = Path(name)
    if given.is_absolute() or ".." in given.parts or not within:
        rule = "every path must stay inside the capture folder"
        found = short(name) if within else f"{short(name)}, which leads out of it"
        faults.append(Fault(where, rule, found, "copy the file into the folder"))
        return None
    return path


def _within(path: Path, folder: Path, known: dict[Path, bool]) -> bool:
    """Whether a path stays inside a folder with every link followed; the parent folders
    are checked once.
    """
    try:
        link = stat.S_ISLNK(path.lstat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        link = False
    if link:
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            # fails for cyclic links and names that are too long, which `resolve` of
            # Python 3.13 ignores
            path.stat()
        return path.resolve().is_relative_to(folder.resolve())
    parent = path.parent
    if parent not in known:
        known[parent] = parent.resolve().is_relative_to(folder.resolve())
    return known[parent]


def _reason(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


def decoding_faults(paths: Iterable[Path], known: Iterable[Fault]) -> list[Fault]:
    """Faults of frames with valid headers, within the first `MAX_RECHECKED_BYTES` of files.

    They are reported together with those of a folder that is refused.

    Parameters
    ----------
    paths
        Frames of the dome and of the probe, as far as these could be read.
    known
        Faults found so far; the frames that they name are not decoded.
    """
    named = {fault.where.partition(" (")[0] for fault in known}
    left = [path for path in dict.fromkeys(paths) if str(path) not in named]
    with ThreadPoolExecutor(thread_count()) as pool:
        return [fault for found in pool.map(_faults, _first(left)) for fault in found]


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
