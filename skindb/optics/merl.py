"""MERL binary files of measured isotropic BRDFs (Matusik et al. 2003)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from skindb.errors import Fault, InputError
from skindb.files import private_file
from skindb.types import Array

SHAPE = (90, 90, 180)  # theta_h (quadratic), theta_d, phi_d
SCALE = np.array([1.0, 1.15, 1.66]) / 1500.0


def read_merl(path: str | Path) -> tuple[Array, int]:
    """Read one material.

    Returns
    -------
    table, holes
        (90, 90, 180, 3) sr^-1 over theta_h (bins quadratic), theta_d and phi_d in [0,
        pi), and the number of cells with a negative channel. These were not measured
        and are NaN in every channel.

    Notes
    -----
    The reader that MERL provides takes bin floor(x). The value of bin i is thus for [i,
    i + 1), and its centre is i + 1/2.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        fault = Fault(
            str(path),
            "must be a readable file",
            str(error.strerror),
            "choose a MERL .binary file",
        )
        raise InputError(fault) from None
    dims = tuple(np.frombuffer(data[: min(len(data), 12) // 4 * 4], "<i4").tolist())
    want = 12 + 8 * 3 * int(np.prod(SHAPE))
    if dims != SHAPE or len(data) != want:
        found = f"the header {dims} and {len(data)} bytes"
        rule = f"a MERL binary must have the header {SHAPE} and {want} bytes"
        raise InputError(Fault(str(path), rule, found, "download it again"))
    values = np.frombuffer(data[12:], "<f8").reshape(3, *SHAPE)
    wrong = int((~np.isfinite(values)).sum())
    if wrong:
        raise InputError(
            Fault(
                str(path),
                "values must be finite",
                f"{wrong} that are not",
                "download it again",
            )
        )
    table = np.moveaxis(values, 0, -1) * SCALE
    hole = np.asarray((table < 0).any(axis=-1))
    if hole.all():
        rule = "some cells must be measured"
        found = "only negative values"
        raise InputError(Fault(str(path), rule, found, "download it again"))
    return np.where(hole[..., None], np.nan, table), int(hole.sum())


def write_merl(path: str | Path, table: Array) -> None:
    """Write a table (90, 90, 180, 3) in sr^-1, whose values must be finite and non-negative."""
    table = np.asarray(table, np.float64)
    wrong = int((~(np.isfinite(table) & (table >= 0))).sum())
    if table.shape != (*SHAPE, 3) or wrong:
        found = f"the shape {table.shape} and {wrong} other values"
        raise ValueError(
            f"a MERL table must have the shape {(*SHAPE, 3)}, finite and "
            f"non-negative; found {found}"
        )
    values = np.ascontiguousarray(np.moveaxis(table / SCALE, -1, 0))
    private_file(path).write_bytes(
        np.array(SHAPE, "<i4").tobytes() + values.astype("<f8").tobytes()
    )
