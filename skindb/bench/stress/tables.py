"""Stress cases of BRDF tables: the average over a disc, and rows for the fits."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.bench.case import SCALES, Case, close, each, expect
from skindb.optics.angles import half_difference
from skindb.reflectance.dictionary import Dictionary, convolve_disc
from skindb.reflectance.rows import basis_rows
from skindb.reflectance.tables import TableGrid, lookup, tabulate

Array = NDArray[Any]
GRID = TableGrid(24, 20, 8)


def _dictionary(table: Array) -> Dictionary:
    table = np.ascontiguousarray(table, np.float32)
    return Dictionary(
        tuple(str(i) for i in range(table.shape[-1])), table, GRID, "stress"
    )


def _lobe(sharp: float = 40.0) -> Array:
    return tabulate(
        lambda wi, wo: np.exp(-sharp * half_difference(wi, wo)[0][..., None] ** 2), GRID
    )


def _even_table(radius: float, value: float) -> None:
    close(
        convolve_disc(_dictionary(np.full((24, 20, 8, 2), value)), radius).table,
        np.float32(value),
        rtol=1e-5,
    )


def _no_disc() -> None:
    lobe = _dictionary(_lobe())
    expect(convolve_disc(lobe, 0.0) is lobe, "a copy")
    close(convolve_disc(lobe, 1e-9).table, lobe.table, atol=1e-5)


def _scaled_table(scale: float) -> None:
    lobe = _lobe()
    found = convolve_disc(_dictionary(lobe * np.float32(scale)), 0.05).table
    close(
        found / np.float32(scale),
        convolve_disc(_dictionary(lobe), 0.05).table,
        rtol=1e-5,
        atol=1e-12,
    )


def _between_extremes(radius: float) -> None:
    lobe = _dictionary(_lobe(400.0))
    found = convolve_disc(lobe, radius).table
    expect(
        found.min() >= -1e-6 and found.max() <= lobe.table.max() * (1 + 1e-5),
        (found.min(), found.max()),
    )
    expect(
        found[0, 0, 0, 0] < lobe.table[0, 0, 0, 0], "a lobe not lowered by a wide lamp"
    )


# rows, for the fits


def _row_of(wi: Any, wo: Any) -> Array:
    table = np.concatenate([_lobe(), np.ones_like(_lobe())], axis=-1)
    every = np.ones((1, 1, 1), np.bool_)
    return basis_rows(
        table, GRID, np.array([[0.0, 0, 1]]), np.array([[wi]]), np.array([[wo]]), every
    )[0]


def _grazing_rows(height: float) -> None:
    """Towards the horizon a row decreases only with the cosine, times the value of the table."""
    wi = np.array([np.sqrt(1 - height**2), 0, height])
    wo = np.array([0.6, 0.0, 0.8])
    want = (
        lookup(
            np.concatenate([_lobe(), np.ones_like(_lobe())], axis=-1),
            *half_difference(wi, wo),
        )
        * height
    )
    close(_row_of(wi, wo)[0], want, rtol=1e-4, atol=1e-12)


def _special_rows() -> None:
    up = [0.0, 0.0, 1.0]
    down = [0.0, 0.0, -1.0]
    # light, camera and normal coincide, so phi_d is undefined
    close(_row_of(up, up), [[1.0, 1.0]], rtol=1e-6)
    expect(len(_row_of(down, up)) == len(_row_of(up, down)) == 0, "a row from below")
    expect(
        len(_row_of([np.nan, 0, 1], up)) == len(_row_of(up, [np.inf, 0, 1])) == 0,
        "a row of no finite direction",
    )
    # the mirror direction
    close(_row_of([0.6, 0, 0.8], [-0.6, 0, 0.8]), [[0.8, 0.8]], rtol=1e-5)


TABLES = (
    *each(
        "disc",
        "a table of {1:g}, disc of {0} rad",
        "A constant is unchanged.",
        _even_table,
        (0.014, 0.0),
        (0.014, 0.25),
        (0.3, 0.25),
        (0.014, 1e-30),
        (0.014, 1e30),
    ),
    Case("disc", "no disc", "The tables are unchanged, also in the limit.", _no_disc),
    *each(
        "disc",
        "tables times {:g}",
        "Averages are multiplied by it.",
        _scaled_table,
        *SCALES,
    ),
    *each(
        "disc",
        "a disc of {} rad",
        "Averages lie between the extremes; sharp lobes are lowered.",
        _between_extremes,
        0.05,
        0.5,
    ),
    *each(
        "surface",
        "rows: light {:g} above the horizon",
        "A row is the table's value times the cosine.",
        _grazing_rows,
        1e-8,
        1e-4,
        0.02,
    ),
    Case(
        "surface",
        "rows: overhead, mirror, below, not finite",
        "Rows are one, the cosine, none and none.",
        _special_rows,
    ),
)
