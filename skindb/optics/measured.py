"""Measured BRDFs from files: a folder of MERL binaries, or an .npz file of tables."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from skindb.errors import Fault, InputError
from skindb.optics.brdf_table import DEFAULT_GRID, Table
from skindb.optics.dictionary import Dictionary, Origin
from skindb.optics.merl import SHAPE, read_merl
from skindb.optics.merl_published import SHA256
from skindb.optics.resample import to_default_grid
from skindb.optics.table_file import read_tables

GENUINE = "genuine"
DIFFERS = "differs from the published file of that name"
UNKNOWN = "not in the published set"


def read_dictionary(path: str | Path) -> Dictionary:
    """Read the dictionary in a folder of MERL binaries, an .npz file of tables, or the
    folder `bases` of an export.
    """
    path = Path(path)
    # bases.npz of an export stores its disc, the MERL files beside it do not
    if path.is_dir():
        inside = path / "bases.npz"
        return read_tables(inside) if inside.is_file() else read_merl_folder(path)
    return read_tables(path)


def read_merl_folder(path: str | Path) -> Dictionary:
    """Read every `*.binary` file of a folder, in the order of their names, resampled to
    the default grid.

    Cells without a measurement take the value at the next smaller theta_d.

    Raises
    ------
    InputError
        With the faults of all damaged files.
    """
    files = sorted(Path(path).glob("*.binary"))
    if not files:
        rule = "the folder must contain MERL .binary files"
        cure = "choose their folder, or an .npz file of tables"
        raise InputError(Fault(str(path), rule, "none", cure))
    # centres of bins; theta_h is quadratic
    h, d, p = ((np.arange(n) + 0.5) / n for n in SHAPE)
    nodes = (h**2 * np.pi / 2, d * np.pi / 2, p * np.pi)
    tables: list[Table] = []
    origins: list[Origin] = []
    faults: list[Fault] = []
    for file in files:
        try:
            table, origin = to_default_grid(
                read_merl(file)[0].mean(axis=-1), nodes, *_publication_check(file)
            )
        except InputError as error:
            faults.extend(error.faults)
        else:
            tables.append(table)
            origins.append(origin)
    if faults:
        raise InputError(faults)
    names = tuple(file.stem for file in files)
    return Dictionary(
        names,
        np.stack(tables, axis=-1),
        DEFAULT_GRID,
        Path(path).resolve().name,
        origins=tuple(origins),
    )


def _publication_check(file: Path) -> tuple[str, str]:
    """Whether a file is the published one, in words, and its SHA-256."""
    with file.open("rb") as data:
        found = hashlib.file_digest(data, "sha256").hexdigest()
    if found in SHA256.values():
        name = next(name for name, value in SHA256.items() if value == found)
        return (
            GENUINE if name == file.stem else f"published under the name {name}",
            found,
        )
    return DIFFERS if file.stem in SHA256 else UNKNOWN, found
