"""Names of kinds, takes and files, and the conversion of keys to paths, which never leads
outside the database.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

from skindb.errors import Fault, InputError

STUDY = "population"  # results of a study of many takes
RELEASE = "release"  # one version of every take under a name
CALIBRATION = "calibration"  # of the lights of a dome
# tables, samples or maps of a take with other parameters than those of its model
SUMMARY = "summary"
# whose takes are names of studies, releases and calibrations
KINDS_WITHOUT_SUBJECT = (STUDY, RELEASE, CALIBRATION)
# kinds that hold data of their own subject only; an input of them is of that subject,
# or a product that many share
KINDS_OF_ONE_SUBJECT = ("capture", "first", "model", "consent")
TAKE = r"[A-Za-z0-9_-]{1,64}(\.[A-Za-z0-9_-]{1,64})?"
KIND = r"[a-z]{1,32}"
GROUP = r"[a-z_]{1,32}"
# start of the names of a version and of the files beside it
TIME_HEX = r"[0-9]{8}T[0-9]{6}-[0-9a-f]{8}"
STAGING = "staging"  # folder for temporary files of writers
AUDIT = "audit"  # folder of the audit log
# kinds of intermediate results of a run, removed when its result is committed
TRANSIENT = ("first",)
# kind -> kind of the lease under which it is written, if it differs
LEASE_KINDS = {"first": "model"}
VERSION = rf"data/{KIND}/{TAKE}/{TIME_HEX}\.zarr"


def subject_of(take: str) -> str:
    """The subject of a take, which is named `<subject>` or `<subject>.<condition>`."""
    return take.partition(".")[0]


def require_text(value: str, pattern: str, label: str) -> str:
    """Return `value` if it matches the whole pattern; otherwise raise an `InputError`."""
    if not isinstance(value, str) or not re.fullmatch(pattern, value):
        raise InputError(
            Fault(
                label, f"must match {pattern}", repr(value)[:200], "choose another name"
            )
        )
    return value


def inside(root: Path, key: str) -> Path:
    """The path of a key below `root`.

    Parameters
    ----------
    root
        Folder of the database, which may itself be a symbolic link.
    key
        Relative path with "/" as the separator.

    Raises
    ------
    InputError
        If the key is empty or absolute, contains "..", or passes through a symbolic link.
    """
    parts = key.split("/")
    if any(part in ("", ".", "..") or "\0" in part or "\\" in part for part in parts):
        raise InputError(outside_fault(root, key, "a path that leaves it"))
    # as text: `Path` takes four times as long, and a table of 1,000 takes needs 16,000
    # paths
    place = os.fspath(root)
    for number, part in enumerate(parts, 1):
        place = f"{place}/{part}"
        if os.path.islink(place):  # noqa: PTH114
            raise InputError(
                outside_fault(
                    root, key, f"a symbolic link at {'/'.join(parts[:number])}"
                )
            )
    return Path(place)


def outside_fault(root: Path | str, key: str, finding: str) -> Fault:
    """Fault for a key that leads outside the database."""
    cure = "restore the file that names this path from a backup"
    return Fault(
        f"{root}: {key[:200]!r}",
        "every path must stay inside the database",
        finding,
        cure,
    )
