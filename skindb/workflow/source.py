"""Digests of the source of skindb: whether two results, or two processes, are of the
very same code.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path


@cache
def method_digest(modules: tuple[str, ...] = ("",)) -> str:
    """Digest of the source of modules and subpackages of skindb, default all of it."""
    root = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for name in modules:
        files = (
            sorted((root / name).rglob("*.py"))
            if (root / name).is_dir()
            else [root / f"{name}.py"]
        )
        for file in files:
            digest.update(
                file.relative_to(root).as_posix().encode()
                + b"\0"
                + file.read_bytes()
                + b"\0"
            )
    return digest.hexdigest()
