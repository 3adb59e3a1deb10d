"""Runs commands in this process, which has its own file system, and prints the outcomes as JSON.

    unshare --mount --map-root-user python hostile_disc.py

Each line of standard input is a place, a command that makes it what it is to be, and
steps. A step is ["run", arguments of skindb], ["leave", bytes that stay free],
["free"], or ["read"], which reads by the functions of a database.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from test_cli import _run

import skindb


def fill(place: Path, left: int) -> None:
    """Write a file until at most so many bytes are free."""
    with (place / "filler").open("wb", buffering=0) as file, suppress(OSError):
        while (status := os.statvfs(place)).f_bavail * status.f_frsize > left:
            file.write(
                bytes(
                    max(4096, (status.f_bavail * status.f_frsize - left) // 8192 * 4096)
                )
            )


def read(place: Path) -> dict[str, object]:
    """Results of functions that read a database."""
    db = skindb.open(str(place / "db"))
    cohort = db.cohort("tables").region_diffuse_reflectance.values
    table = json.loads(db.table().to_json(date_format="iso"))
    return {
        "takes": db.takes(where="age > 0"),
        "table": table,
        "cohort": cohort.tolist().__repr__(),
    }


def outcomes(place: Path, mount: str, steps: list[list[object]]) -> list[object]:
    """Mount, make every step, and return the outcomes of "run" and "read"."""
    subprocess.run(["sh", "-c", mount], check=True)
    told: list[object] = []
    for what, *arguments in steps:
        if what == "leave":
            fill(place, *arguments)
        elif what == "free":
            (place / "filler").unlink()
        elif what == "read":
            told.append(read(place))
        else:
            done = _run(*arguments[0])
            told.append([done.returncode, done.stdout, done.stderr])
    return told


if __name__ == "__main__":
    for line in sys.stdin:
        folder, *rest = json.loads(line)
        print(json.dumps(outcomes(Path(folder), *rest)), flush=True)
