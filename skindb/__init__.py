"""skindb: a database of measured faces."""

from __future__ import annotations

from typing import TYPE_CHECKING

from skindb.errors import Fault, InputError

if TYPE_CHECKING:
    from skindb.store import Database

__all__ = ["Fault", "InputError", "__version__", "open"]
__version__ = "0.1.0"


def open(url: str) -> Database:  # noqa: A001  the notebook's first word, as in xarray and zarr
    """Open a database.

    Parameters
    ----------
    url
        Folder of the database; made at the first write if it is absent.

    Returns
    -------
    Database
        Handle with `subjects()`, `read(kind, take)` and `info()`.
    """
    from skindb.store import Database

    return Database(url)
