"""Copies of the database of `make demo`, for programs that add to it."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from shutil import copytree, ignore_patterns

ROOT = Path(__file__).resolve().parents[1]
DEMO = ROOT / "demo"


@contextmanager
def demo_copy() -> Iterator[Path]:
    """A temporary folder with a copy of `demo/db`.

    Stored versions are linked, because nothing changes their files: 400 MB for every
    notebook would keep the disk busy. Links need the file system of the demo.
    """
    with tempfile.TemporaryDirectory(dir=DEMO) as folder:
        target = Path(folder, "demo/db")
        copytree(DEMO / "db", target, ignore=ignore_patterns("data"))
        copytree(DEMO / "db/data", target / "data", copy_function=os.link)
        yield Path(folder)
