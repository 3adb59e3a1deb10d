"""The location that a URL names."""

from __future__ import annotations

from pathlib import Path

from skindb.errors import Fault, InputError
from skindb.store.bucket import Bucket
from skindb.store.folder import Folder
from skindb.store.place import Place


def place_at(url: str) -> Place:
    """The folder or bucket of a URL; `InputError` for other URLs and for files."""
    if url.startswith("s3://"):
        return Bucket(url)
    if "://" in url:
        scheme = url.partition("://")[0]
        cure = "give a folder, or s3://BUCKET/PREFIX"
        rule = "a database must be a local folder or an S3 bucket"
        raise InputError(Fault(f"{scheme}://...", rule, "a different URL", cure))
    if Path(url).exists() and not Path(url).is_dir():
        raise InputError(
            Fault(url, "a database must be a folder", "a file", "choose another folder")
        )
    return Folder(Path(url))
