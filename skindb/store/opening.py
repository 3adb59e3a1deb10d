"""`skindb.open`, which opens a database."""

from __future__ import annotations

from skindb.store.database import Database


def open(url: str) -> Database:  # noqa: A001  as in xarray and zarr
    """Open a database.

    Parameters
    ----------
    url
        Folder of the database, created by the first commit if it is absent, or
        ``s3://bucket/prefix``.

    Returns
    -------
    Database
        Handle with `takes()`, `table()`, `read(kind, take)`, `cohort(layout)` and `info()`.
    """
    return Database(url)
