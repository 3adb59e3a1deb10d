"""Measured bases: errors of the embedded ABC set, of grids of tables, and of dense
reconstructions of MERL.

    python -m benchmarks measured_bases            the embedded materials at a disc of 0.8 degrees
    python -m benchmarks measured_bases --grid       error of the tables by number of nodes and size
    python -m benchmarks measured_bases --merl DIR with nbrdf_weights.npz, merl_slices_phid90.npz

`--merl`: networks fitted to MERL (Sztrajman et al. 2021) are written as MERL binaries,
read back, compared with the measured slices at phi_d = 90 degrees and with the ABC
formula, and fitted with mixtures of the embedded 59.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from time import process_time
from types import SimpleNamespace

import numpy as np
from scipy.optimize import nnls

from skindb.fit import dictionary_report
from skindb.optics.angles import directions, half_difference
from skindb.reflectance.brdf_files import SHAPE, read_dictionary, write_merl
from skindb.reflectance.dictionary import (
    FAR_RULE,
    NEAR_RULE,
    abc_parameters,
    average_disc,
    convolve_disc,
    embedded_dictionary,
    evaluate_abc,
    sample_pairs,
    weighted_error,
)
from skindb.reflectance.tables import lookup, tabulate

DISC = np.radians(0.8)
ROWS = np.array(list(abc_parameters().values()))
GRIDS = [
    *[(90, n, 16) for n in (45, 60, 90, 120, 180, 240)],
    *[(n, 120, 16) for n in (45, 60, 180)],
    *[(90, 120, n) for n in (8, 24, 32)],
]


def embedded() -> None:
    """Print the report of the 59 materials, and the errors of quadrature rules of the disc."""
    start = process_time()
    report = dictionary_report(embedded_dictionary(), disc_angular_radius=DISC)
    print(f"{process_time() - start:.1f} s of CPU time\n")
    _summary(report)
    print(
        "\n| rule of the disc, far and near | s | median | worst above 6 degrees | 12 | 17 | 30 |\n"
        + "|---" * 7
        + "|"
    )
    pairs = sample_pairs(24_000)
    exact = _disc(pairs, (24, 72), (24, 72))
    for far, near in (
        (FAR_RULE, FAR_RULE),
        (FAR_RULE, (8, 24)),
        (FAR_RULE, NEAR_RULE),
        (NEAR_RULE, NEAR_RULE),
        (FAR_RULE, (16, 48)),
    ):
        start = process_time()
        convolve_disc(embedded_dictionary(), DISC, far=far, near=near)
        spent = process_time() - start
        averaged = _disc(pairs, far, near)
        cells = [
            _above(averaged, exact, *pairs, lowest) for lowest in (0.1, 0.2, 0.3, 0.5)
        ]
        worst = " | ".join(f"{100 * error.max():.2f} %" for error in cells)
        print(
            f"| {far}, {near} | {spent:.1f} | {100 * np.median(cells[0]):.4f} % | {worst} |"
        )


def _disc(pairs, far, near):
    turned = (pairs, pairs[::-1])
    return (
        sum(
            average_disc(embedded_dictionary(), *p, DISC, far=far, near=near).astype(
                float
            )
            for p in turned
        )
        / 2
    )


def _above(values, exact, wi, wo, lowest):
    up = np.minimum(wi[:, 2], wo[:, 2]) > lowest
    return weighted_error(values[up], exact[up], wi[up], wo[up])


def _summary(report) -> None:
    print("| figure | median | worst | material |\n|---|---|---|---|")
    for name, values in report.items():
        worst = report["dictionary"].values[int(np.argmax(values.fillna(-1).values))]
        print(
            f"| {name} | {float(values.median()):.3g} | {float(values.max()):.3g} | {worst} |"
        )


def grid() -> None:
    """Print trilinear errors of tables of the formula, theta_d uniform or uniform in 1
    - sqrt(1 - theta_d / 90).
    """
    wi, wo = sample_pairs()
    th, td, pd = half_difference(wi, wo)
    exact = evaluate_abc(ROWS, wi, wo)
    print(
        "| nodes | MB of 59 | theta_d nodes | median, worst above 6 degrees | above 12 |\n"
        + "|---" * 5
        + "|"
    )
    for shape in GRIDS:
        for name, warp, back in (
            ("uniform", lambda x: x, lambda u: u),
            ("dense to 90", lambda x: 1 - np.sqrt(1 - x), lambda u: 1 - (1 - u) ** 2),
        ):
            axes = {
                "theta_h": np.linspace(0, 1, shape[0]) ** 2 * np.pi / 2,
                "theta_d": back(np.linspace(0, 1, shape[1])) * np.pi / 2,
                "phi_d": np.arange(shape[2]) / shape[2] * np.pi,
            }
            table = tabulate(
                lambda a, b: evaluate_abc(ROWS, a, b),
                SimpleNamespace(**axes, n_theta_h=shape[0]),
            )
            values = lookup(
                table, th, warp(np.minimum(td / (np.pi / 2), 1)) * np.pi / 2, pd
            )
            six, twelve = (
                _above(values, exact, wi, wo, lowest) for lowest in (0.1, 0.2)
            )
            cells = [
                f"{100 * np.median(e):.2f} %, {100 * e.max():.2f} %"
                for e in (six, twelve)
            ]
            size = " x ".join(map(str, shape))
            print(
                f"| {size} | {table.nbytes / 1e6:.0f} | {name} | {cells[0]} | {cells[1]} |",
                flush=True,
            )


def merl(folder: Path) -> None:
    """Read reconstructions of the 59 with the MERL reader, and compare them with slices
    and with the embedded set.
    """
    networks = np.load(folder / "nbrdf_weights.npz")
    slices = np.load(folder / "merl_slices_phid90.npz")
    with tempfile.TemporaryDirectory() as scratch:
        for name in abc_parameters():  # 35 MB each
            write_merl(
                Path(scratch) / f"{name}.binary",
                reconstruction(networks[f"merl/{name}"]),
            )
        compare(Path(scratch), slices)


def compare(files: Path, slices) -> None:
    """Compare tables read from MERL binaries of the 59 with the measured slices, and
    fit them with mixtures.
    """
    start = process_time()
    dictionary = read_dictionary(files)
    print(
        f"{len(dictionary.names)} files read in {process_time() - start:.0f} s of CPU time; ",
        end="",
    )
    print("; ".join(note[:60] for note in dictionary.notes), end="\n\n")
    _summary(dictionary_report(dictionary, disc_angular_radius=DISC))
    order = [slices["names"].tolist().index(name) for name in abc_parameters()]
    # theta_d, theta_h, material
    measured = np.moveaxis(slices["f"][order].mean(-1), 0, -1)
    td, th = np.meshgrid(slices["theta_d_rad"], slices["theta_h_rad"], indexing="ij")
    wi, wo = directions(th, td, np.pi / 2)
    up = np.minimum(wi[..., 2], wo[..., 2]) > 0.2
    want = measured[up]
    abc = evaluate_abc(ROWS, wi[up], wo[up])
    angles = th[up], td[up], np.full(up.sum(), np.pi / 2)
    print(
        "\n| against the measured slices, above 12 degrees | median of the medians "
        "| worst median |\n|---|---|---|"
    )
    for name, weights in (
        ("tables read from MERL binaries", lookup(dictionary.table, *angles)),
        ("ABC formula", abc),
    ):
        off = np.median(np.abs(weights / np.maximum(want, 1e-5) - 1), axis=0)
        print(f"| {name} | {100 * np.median(off):.1f} % | {100 * off.max():.1f} % |")
    _mixtures(dictionary)


def _mixtures(dictionary) -> None:
    """Fit each reconstruction with non-negative mixtures of the embedded ABC materials,
    with and without its own.

    Light and camera are above a given elevation, because a few very large values at
    grazing angles dominate the error.
    """
    print(
        "\n| mixture of embedded materials | above | median rms error | worst |\n|---|---|---|---|"
    )
    for lowest, degrees in ((0.1, 6), (0.3, 17), (0.5, 30)):
        pairs = sample_pairs(6000)
        up = np.minimum(pairs[0][:, 2], pairs[1][:, 2]) > lowest
        pairs = pairs[0][up], pairs[1][up]
        angles = half_difference(*pairs)
        want = lookup(dictionary.table, *angles)
        bases = lookup(embedded_dictionary().table, *angles)
        without = [np.delete(bases, m, axis=1) for m in range(want.shape[1])]
        weights = weighted_error(bases, want, *pairs)
        rows = {
            "all 59": [_mixed(bases, values, pairs) for values in want.T],
            "the other 58": [
                _mixed(remaining, values, pairs)
                for remaining, values in zip(without, want.T, strict=True)
            ],
            "the material's own ABC parameters, unmixed": weights,
        }
        for name, errors in rows.items():
            worst = f"{100 * np.max(errors):.0f} %"
            print(
                f"| {name} | {degrees} degrees | {100 * np.median(errors):.1f} % | {worst} |"
            )


def _mixed(bases, want, pairs) -> float:
    root = np.sqrt(pairs[0][:, 2] * pairs[1][:, 2])  # of the error's weight
    rows = bases * root[:, None]
    _, residual = nnls(rows / np.linalg.norm(rows, axis=0), want * root, maxiter=3000)
    return residual / np.linalg.norm(want * root)


def reconstruction(weights) -> np.ndarray:
    """Table (90, 90, 180, 3) [sr^-1] of one network with layers 6-21-21-3: ReLU, ReLU,
    max(exp - 1, 0).
    """
    h, d, p = ((np.arange(n) + 0.5) / n for n in SHAPE)
    out = np.empty((*SHAPE, 3))
    for i, theta_h in enumerate(h**2 * np.pi / 2):
        td, pd = np.meshgrid(d * np.pi / 2, p * np.pi, indexing="ij")
        ones = np.ones_like(td)
        x = [np.sin(theta_h) * ones, 0 * ones, np.cos(theta_h) * ones]
        x = np.stack(
            [*x, np.sin(td) * np.cos(pd), np.sin(td) * np.sin(pd), np.cos(td)], axis=-1
        )
        out[i] = _network(np.asarray(weights, np.float64), x)
    return out


def _network(weights, x):
    start = 0
    for layer, (rows, columns) in enumerate(((6, 21), (21, 21), (21, 3))):
        matrix = weights[start : start + rows * columns].reshape(rows, columns)
        start += rows * columns
        x = x @ matrix + weights[start : start + columns]
        start += columns
        x = np.maximum(x, 0) if layer < 2 else np.maximum(np.exp(x) - 1, 0)
    return x


def main(*, grid_: bool = False, merl_: Path | None = None) -> None:
    """Print the requested tables."""
    if grid_:
        grid()
    elif merl_:
        merl(merl_)
    else:
        embedded()
