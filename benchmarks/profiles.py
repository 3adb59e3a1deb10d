"""Error of every profile R(r) relative to a random walk, and its time.

    python -m benchmarks profiles [--png FILE]

`work_precision()` returns the rows; the command prints the table and plots the curves.
"""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import Annotated

import numpy as np

from benchmarks.curves_internal import MODELS, across, ring_mean, rings
from skindb.optics.transport import random_walk

ALBEDO = (0.1, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.99, 0.999)  # reduced
# transport mean free paths
DISTANCE = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0, 5.0, 7.0, 10.0, 14.0, 20.0)
PRINTED = (0.1, 0.3, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)
WIDTH = 1.1  # rings extend from r / WIDTH to r WIDTH
LOST = 0.15  # relative noise of the walk above which the error is not meaningful
REPEAT = 50
# largest albedo, packets, and path in units of 1 / sigma_s': from a dark medium few
# photons return, after short paths
WALKS = ((0.5, 3_000_000, 40.0), (0.95, 400_000, 600.0), (1.0, 200_000, 3000.0))


def work_precision(
    *, eta: float = 1.3, seed: int = 0, share: float = 1.0
) -> list[dict[str, float | str]]:
    """One row per model, albedo and distance, with a fraction `share` of the photons.

    `error` is that of the mean of a ring relative to the walk; `noise` is the relative
    standard error of the walk, infinite where no photon arrived; `seconds` is the time
    per 1000 distances, without that of making tables.
    """
    rows: list[dict[str, float | str]] = []
    darker = 0.0
    for limit, packets, longest in WALKS:
        walk = random_walk(
            int(packets * share),
            eta=eta,
            max_path=longest,
            rng=np.random.default_rng(seed),
        )
        for albedo in (a for a in ALBEDO if darker < a <= limit):
            rows += _compare(walk, albedo, eta)
        darker = limit
    return rows


def _compare(walk, albedo, eta):
    """Compare every model at every distance; sigma_s' = 1, so that a mean free path is `albedo`."""
    ratio = (1 - albedo) / albedo
    middle = np.array(DISTANCE) * albedo
    rows = []
    value, noise = rings(walk, ratio, middle, WIDTH)
    for name, model in MODELS.items():
        mean = ring_mean(
            model(across(middle, WIDTH), ratio, 1.0, eta=eta), middle, WIDTH
        )
        seconds = _seconds(model, 1 - albedo, albedo, eta)
        for d, v, e, m in zip(DISTANCE, value, noise, mean, strict=True):
            off = m / v - 1 if v > 0 else np.nan
            rows.append(
                {
                    "model": name,
                    "albedo": albedo,
                    "distance": d,
                    "error": off,
                    "noise": e,
                    "seconds": seconds,
                }
            )
    return rows


def _seconds(profile, sigma_a, sigma_s, eta) -> float:
    r = np.linspace(0.5, 20, 1000)
    profile(r, sigma_a, sigma_s, eta=eta)
    start = perf_counter()
    for _ in range(REPEAT):
        profile(r, sigma_a, sigma_s, eta=eta)
    return (perf_counter() - start) / REPEAT


def plot(rows, path: Path) -> None:
    """Plot the error over distance, one panel per model, one curve per albedo, with the
    noise of the walk.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(
        1, len(MODELS), figsize=(11, 4.2), constrained_layout=True
    )
    for ax, name in zip(axes, MODELS, strict=True):
        for albedo, colour in zip(
            ALBEDO,
            plt.get_cmap("viridis")(np.linspace(0, 0.95, len(ALBEDO))),
            strict=True,
        ):
            part = [
                r
                for r in rows
                if (r["model"], r["albedo"]) == (name, albedo) and r["noise"] < LOST
            ]
            x, y, e = (
                np.array([r[key] for r in part])
                for key in ("distance", "error", "noise")
            )
            ax.errorbar(
                x,
                100 * y,
                100 * e,
                color=colour,
                lw=1.2,
                capsize=2,
                label=f"{albedo:g}",
            )
        ax.axhline(0, color="k", lw=0.6)
        ax.set(
            xscale="log",
            title=name,
            xlabel="r [transport mean free paths]",
            ylabel="error relative to the random walk [%]",
        )
    axes[0].set_ylim(-30, 30)
    axes[1].set_yscale("symlog", linthresh=20)
    axes[0].legend(title="albedo", ncols=3, fontsize=8)
    figure.savefig(path, dpi=110)


def main(
    *, png: Annotated[Path | None, "File for the plot of the curves."] = None
) -> None:
    """Print the table of errors (noise of the walk) in per cent."""
    rows = work_precision()
    print(
        "| albedo | model | "
        + " | ".join(f"r = {d:g}" for d in PRINTED)
        + " | ms per 1000 |"
    )
    print("|---" * (len(PRINTED) + 3) + "|")
    for i in range(0, len(rows), len(DISTANCE)):
        part = rows[i : i + len(DISTANCE)]
        cells = [
            f"{100 * r['error']:+.1f} ({100 * r['noise']:.1f})"
            if r["noise"] < LOST
            else "lost in noise"
            for r in part
            if r["distance"] in PRINTED
        ]
        row = part[0]
        print(
            f"| {row['albedo']} | {row['model']} | {' | '.join(cells)} | "
            f"{1e3 * row['seconds']:.2f} |"
        )
    if png:
        plot(rows, png)
