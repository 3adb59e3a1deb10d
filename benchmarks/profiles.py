"""Error and time of every profile R(r) against a random walk: `work_precision()`, or run this file for the table."""

from __future__ import annotations

from time import perf_counter

import numpy as np

from skindb.fit._probe_kernels import MODELS
from skindb.optics.random_walk import random_walk

ALBEDO = (0.1, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.99, 0.999)  # reduced
DISTANCE = (0.1, 0.3, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)  # transport mean free paths 1 / sigma_t'
WIDTH = 1.05  # rings from r / WIDTH to r WIDTH
REPEAT = 50


def work_precision(
    packets: int = 200_000, *, eta: float = 1.3, longest: float = 2400.0, seed: int = 0
) -> list[dict[str, float | str]]:
    """One row per model, albedo and distance.

    `error`: of the ring's mean relative to the walk; `noise`: relative standard error of the walk itself, NaN where no
    photon came; `seconds`: per 1000 distances, tables made before.
    """
    walk = random_walk(packets, eta=eta, longest=longest, rng=np.random.default_rng(seed))
    rows: list[dict[str, float | str]] = []
    for albedo in ALBEDO:
        sigma_s = albedo  # sigma_t' = 1
        low, high = np.array(DISTANCE) / WIDTH, np.array(DISTANCE) * WIDTH
        value, noise = _rings(walk, 1 - albedo, sigma_s, low, high)
        r = np.linspace(low, high, 21)
        for name, model in MODELS.items():
            mean = (model.profile(r, 1 - albedo, sigma_s, eta=eta) * r).sum(axis=0) / r.sum(axis=0)
            seconds = _seconds(model.profile, 1 - albedo, sigma_s, eta)
            for d, v, e, m in zip(DISTANCE, value, noise, mean, strict=True):
                off = m / v - 1 if v > 0 else np.nan
                rows.append(
                    {"model": name, "albedo": albedo, "distance": d, "error": off, "noise": e, "seconds": seconds}
                )
    return rows


def _rings(walk, sigma_a, sigma_s, low, high):
    """Mean of R in each ring, and its relative error from the spread of the photons' weights."""
    share = walk.weight * np.exp(-(sigma_a / sigma_s) * walk.path.astype(np.float64))
    radius, value, noise = walk.radius / sigma_s, [], []
    for a, b in zip(low, high, strict=True):
        part = share[(radius >= a) & (radius < b)]
        value.append(part.sum() / walk.packets / (np.pi * (b * b - a * a)))
        noise.append(np.sqrt((part**2).sum()) / part.sum() if part.sum() > 0 else np.nan)
    return np.array(value), np.array(noise)


def _seconds(profile, sigma_a, sigma_s, eta) -> float:
    r = np.linspace(0.5, 20, 1000)
    profile(r, sigma_a, sigma_s, eta=eta)
    start = perf_counter()
    for _ in range(REPEAT):
        profile(r, sigma_a, sigma_s, eta=eta)
    return (perf_counter() - start) / REPEAT


def main() -> None:
    """Print the table: error (noise of the walk) in per cent."""
    rows = work_precision()
    print("| model | albedo | " + " | ".join(f"r = {d:g}" for d in DISTANCE) + " | ms per 1000 |")
    print("|---" * (len(DISTANCE) + 3) + "|")
    for i in range(0, len(rows), len(DISTANCE)):
        part = rows[i : i + len(DISTANCE)]
        cells = [
            f"{100 * r['error']:+.1f} ({100 * r['noise']:.1f})" if r["noise"] < 0.1 else "lost in noise" for r in part
        ]
        print(
            f"| {part[0]['model']} | {part[0]['albedo']} | "
            + " | ".join(cells)
            + f" | {1e3 * part[0]['seconds']:.2f} |"
        )


if __name__ == "__main__":
    main()
