"""Cache on disk for tables that take seconds to compute and do not depend on measured data."""

import hashlib
import json
import shutil
import uuid
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from skindb.files import cache_folder, file_digest, make_private, private_file
from skindb.threads import one_blas_thread
from skindb.types import AnyArray

Arrays = dict[str, AnyArray]
MAX_ENTRIES = 8  # per name; the oldest are removed
SUMS = "sums.json"  # digests of the files of an entry


def cached_arrays(
    name: str,
    arguments: tuple[Any, ...],
    *,
    sources: tuple[str, ...],
    make: Callable[[], Mapping[str, AnyArray]],
) -> Arrays:
    """Result of `make`, from the cache if available.

    Parameters
    ----------
    name
        Name of the tables.
    arguments
        Arguments on which the tables depend; their `repr` must distinguish all values.
    sources
        Names of the modules that compute the tables; if their source changes, the
        tables are computed again.
    make
        Function without arguments that returns arrays by name.

    Returns
    -------
    dict
        Read-only arrays, memory-mapped if there is a cache. Files whose digests do not
        match are computed again; a cache that cannot be written is ignored.
    """
    folder = cache_folder()
    if folder is None:
        return dict(make())
    place = folder / f"{name}-{_key(arguments, sources)}"
    stored = _read(place)
    if stored is not None:
        return stored
    with one_blas_thread():
        arrays = {key: np.asarray(array, order="C") for key, array in make().items()}
    try:
        _write(place, arrays)
        _remove_oldest(folder, name)
    except OSError:
        return arrays
    return _read(place) or arrays


def _key(arguments: tuple[Any, ...], sources: tuple[str, ...]) -> str:
    digest = hashlib.sha256(repr((arguments, np.__version__)).encode())
    for source in sources:
        spec = find_spec(source)
        assert spec is not None
        assert spec.origin is not None
        digest.update(Path(spec.origin).read_bytes())
    return digest.hexdigest()[:24]


def _read(place: Path) -> Arrays | None:
    """The arrays of an entry; None if it is missing or damaged."""
    try:
        sums = json.loads((place / SUMS).read_text(encoding="utf-8"))
        if any(
            file_digest(place / f"{key}.npy") != digest for key, digest in sums.items()
        ):
            return None
        return {
            key: np.asarray(np.load(place / f"{key}.npy", mmap_mode="r"))
            for key in sums
        }
    except (OSError, ValueError, AttributeError, EOFError):
        return None


def _write(place: Path, arrays: Arrays) -> None:
    """Write an entry to a temporary folder and rename it, so that it is complete or absent."""
    staged = place.with_name(f".{uuid.uuid4().hex}")
    try:
        make_private(staged)
        for key, array in arrays.items():
            np.save(private_file(staged / f"{key}.npy"), array)
        sums = {key: file_digest(staged / f"{key}.npy") for key in arrays}
        private_file(staged / SUMS).write_text(json.dumps(sums), encoding="utf-8")
        shutil.rmtree(place, ignore_errors=True)  # a damaged entry
        staged.rename(place)
    finally:
        shutil.rmtree(staged, ignore_errors=True)


def _remove_oldest(folder: Path, name: str) -> None:
    entries = sorted(folder.glob(f"{name}-*"), key=lambda place: place.stat().st_mtime)
    for place in entries[:-MAX_ENTRIES]:
        shutil.rmtree(place, ignore_errors=True)
