"""Measured BRDFs from files: a folder of MERL binaries, or tables of one's own in an .npz."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from skindb.errors import Fault, InputError
from skindb.optics.brdf_table import DEFAULT_GRID, Table
from skindb.optics.dictionary import Dictionary, Origin
from skindb.optics.merl import SHAPE, read_merl
from skindb.optics.merl_published import SHA256
from skindb.optics.resample import on_grid
from skindb.optics.table_file import read_tables

GENUINE, DIFFERS, UNKNOWN = "genuine", "differs from the published file of that name", "not of the published set"


def read_dictionary(path: str | Path) -> Dictionary:
    """The dictionary of a folder of MERL binaries, of an .npz of tables, or of the folder `bases` of an export."""
    path = Path(path)
    if path.is_dir():  # bases.npz of an export knows its disc, the MERL files beside it do not
        inside = path / "bases.npz"
        return read_tables(inside) if inside.is_file() else read_merl_folder(path)
    return read_tables(path)


def read_merl_folder(path: str | Path) -> Dictionary:
    """Every `*.binary` of a folder, in the order of the names, resampled to the default grid.

    Cells without a measurement continue the value at the next smaller theta_d; all damaged files are reported together.
    """
    files = sorted(Path(path).glob("*.binary"))
    if not files:
        rule, cure = "a folder of measured BRDFs holds MERL .binary files", "give their folder, or an .npz of tables"
        raise InputError(Fault(str(path), rule, "none", cure))
    h, d, p = ((np.arange(n) + 0.5) / n for n in SHAPE)  # bins' centres; theta_h quadratic
    nodes = (h**2 * np.pi / 2, d * np.pi / 2, p * np.pi)
    tables: list[Table] = []
    origins: list[Origin] = []
    faults: list[Fault] = []
    for file in files:
        try:
            table, origin = on_grid(read_merl(file)[0].mean(axis=-1), nodes, *_published(file))
        except InputError as error:
            faults.extend(error.faults)
        else:
            tables.append(table)
            origins.append(origin)
    if faults:
        raise InputError(faults)
    names = tuple(file.stem for file in files)
    return Dictionary(names, np.stack(tables, axis=-1), DEFAULT_GRID, Path(path).resolve().name, origins=tuple(origins))


def _published(file: Path) -> tuple[str, str]:
    """Whether a file is the published one, and its SHA-256."""
    with file.open("rb") as data:
        found = hashlib.file_digest(data, "sha256").hexdigest()
    if found in SHA256.values():
        name = next(name for name, value in SHA256.items() if value == found)
        return GENUINE if name == file.stem else f"published under the name {name}", found
    return DIFFERS if file.stem in SHA256 else UNKNOWN, found
