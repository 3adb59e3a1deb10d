"""Surface fit per surfel against loops over SciPy's nnls, in one run: rows of docs/performance.md.

    python benchmarks/fit.py [--surfels N] [--json FILE]

A coherent strip of a head-sized ball under 150 lights and 16 cameras, samples mixed from the embedded BRDFs with
5 % noise. Times are the processor's, the best of three rounds; every method meets the same samples.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import nnls

from skindb.fit._surface_kernels import Tables, surface_weights
from skindb.numerics.factorise import nmf
from skindb.optics.angles import half_difference
from skindb.optics.brdf_table import lookup
from skindb.optics.dictionary import convolve_disc, embedded_dictionary
from skindb.optics.fresnel import fresnel_transmittance
from skindb.optics.rows import basis_rows, reduce_dictionary

ETA, GRAZING = 1.3, 0.1


def spiral(count: int, radius: float, share: float) -> Any:
    """(count, 3) points evenly over the front `share` of a sphere."""
    z = 1 - (np.arange(count) + 0.5) / count * share
    phi, s = np.pi * (1 + 5**0.5) * np.arange(count), np.sqrt(1 - z * z)
    return radius * np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=-1)


def scene(surfels: int, dictionary: Any, *, noise: float = 0.05, seed: int = 0) -> dict[str, Any]:
    """Samples of a strip of surfels, and the directions a loop over SciPy needs."""
    rng = np.random.default_rng(seed)
    light, camera = spiral(150, 1000, 1.0), spiral(16, 1200, 0.8)
    side = int(np.sqrt(surfels))
    a, b = 0.9 * (np.arange(surfels) // side) / side - 0.45, 0.9 * (np.arange(surfels) % side) / side - 0.45
    normal = np.stack([np.sin(b), np.sin(a) * np.cos(b), np.cos(a) * np.cos(b)], -1)
    normal += 0.01 * rng.normal(size=normal.shape)
    normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32).astype(float)
    position = (90 * normal).astype(np.float32).astype(float)
    wi, wo = ((t[None] - position[:, None]) for t in (light, camera))
    wi, wo = wi / np.linalg.norm(wi, axis=-1, keepdims=True), wo / np.linalg.norm(wo, axis=-1, keepdims=True)
    ci, co = np.einsum("nk,ntk->nt", normal, wi), np.einsum("nk,ntk->nt", normal, wo)
    seen = (rng.random((surfels, 150, 1)) < 0.85) & (rng.random((surfels, 1, 16)) < 0.8)
    seen &= (ci > GRAZING)[:, :, None] & (co > GRAZING)[:, None]
    rows, offsets, index = basis_rows(dictionary.table, dictionary.grid, normal, wi, wo, seen)
    owner, (i, o) = np.repeat(np.arange(surfels), np.diff(offsets)), index.T
    diffuse, weight = rng.uniform(0.2, 0.6, (surfels, 3)), np.zeros((surfels, rows.shape[1]))
    for w in weight:
        w[rng.choice(len(w), 4, replace=False)] = rng.uniform(0, 0.4, 4)
    c, d = ci[owner, i], co[owner, o]
    scattered = (c * fresnel_transmittance(c, ETA) * fresnel_transmittance(d, ETA) / np.pi)[:, None] * diffuse[owner]
    value = np.einsum("tm,tm->t", rows, weight[owner])[:, None] + scattered
    value *= 1 + noise * rng.normal(size=value.shape)
    sample = np.full((surfels, 150, 16, 3), np.nan, np.float16)
    sample[owner, i, o] = value
    target = sample[owner, i, o].astype(float) - scattered
    arrays = [sample, position, light, camera, normal, diffuse]
    return {
        "arrays": arrays, "target": target, "offsets": offsets, "rows": rows, "wi": wi[owner, i], "wo": wo[owner, o],
        "normal": normal[owner], "cosine": c,
    }  # fmt: skip


def seconds(work: Callable[[], Any], surfels: int) -> tuple[float, Any]:
    """Processor seconds a surfel, best of three, and the result."""
    times = []
    for _ in range(3):
        start = time.process_time()
        result = work()
        times.append((time.process_time() - start) / surfels)
    return min(times), result


def scipy_loop(made: dict[str, Any], count: int, *, channels: int, form: bool, table: Any) -> Any:
    """Weights of `count` surfels by SciPy: target the mean of channels or all three, rows ready or formed by NumPy."""
    found = []
    for lo, hi in zip(made["offsets"][:count], made["offsets"][1 : count + 1], strict=True):
        if form:
            angles = half_difference(made["wi"][lo:hi], made["wo"][lo:hi], made["normal"][lo:hi])
            M = lookup(table, *angles) * made["cosine"][lo:hi, None]
        else:
            M = made["double"][lo:hi]
        target = made["target"][lo:hi]
        found.append(nnls(np.repeat(M, 3, 0), target.ravel())[0] if channels == 3 else nnls(M, target.mean(1))[0])
    return np.array(found)


def linear_residual(made: dict[str, Any], weight: Any) -> float:
    """Median over surfels of |M x - R| / |R| of the surface's share, with rows at full rank."""
    errors = []
    for s, x in enumerate(weight):
        part = slice(*made["offsets"][s : s + 2])
        gap = (made["rows"][part].astype(float) @ x)[:, None] - made["target"][part]
        errors.append(np.linalg.norm(gap) / np.linalg.norm(made["target"][part]))
    return float(np.median(errors))


def main() -> None:
    """Measure, print a table, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--surfels", type=int, default=400)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    dictionary = convolve_disc(embedded_dictionary(), np.radians(0.8))
    made, n = scene(args.surfels, dictionary), args.surfels
    made["double"] = made["rows"].astype(float)
    few = min(n, 60)
    results: dict[str, dict[str, float]] = {}

    def keep(name: str, took: float, weight: Any) -> None:
        results[name] = {"us": 1e6 * took, "residual": linear_residual(made, weight[:few])}  # of the same surfels

    for name, channels, form in (
        ("SciPy, ready rows, mean of channels", 1, False), ("SciPy, ready rows, three channels", 3, False),
        ("SciPy, rows by NumPy, mean of channels", 1, True), ("SciPy, rows by NumPy, three channels", 3, True),
    ):  # fmt: skip
        keep(
            name,
            *seconds(lambda c=channels, f=form: scipy_loop(made, few, channels=c, form=f, table=dictionary.table), few),
        )
    for mode in ("linear", "perceptual", "paper"):
        for rank in (8, 12, 16, 24, 59):
            table = np.cbrt(dictionary.table) if mode == "paper" else dictionary.table
            reduced, lift = reduce_dictionary(table, rank)
            options: dict[str, Any] = {"eta": ETA, "mode": mode, "noise_floor": 2e-3, "min_samples": 10}
            tables = Tables(reduced, dictionary.grid, lift)
            surface_weights(*(a[:4] if len(a) == n else a for a in made["arrays"]), tables=tables, **options)
            took, found = seconds(lambda t=tables, o=options: surface_weights(*made["arrays"], tables=t, **o), n)
            name = f"skindb {mode}, rank {rank}"
            keep(name, took, found.weight if mode != "paper" else np.full_like(found.weight, np.nan))
            results[name] |= {"kkt": float(found.kkt.max()), "perceptual": float(np.median(found.residual_perceptual))}
            results[name]["failures"] = int((found.status != 0).sum())
            if mode == "linear" and rank == 59:
                H = nmf(found.weight, 4, rng=np.random.default_rng(0)).H
    four = Tables(np.ascontiguousarray((dictionary.table @ H.T).astype(np.float32)), dictionary.grid, np.eye(4))
    for mode in ("linear", "perceptual"):
        options = {"eta": ETA, "mode": mode, "noise_floor": 2e-3, "min_samples": 10}
        surface_weights(*(a[:4] if len(a) == n else a for a in made["arrays"]), tables=four, **options)
        took, found = seconds(lambda o=options: surface_weights(*made["arrays"], tables=four, **o), n)
        keep(f"skindb {mode}, 4 bases", took, found.weight @ H)
    base = {name: results[name]["us"] for name in results if name.startswith("SciPy")}
    print(f"{n} surfels, {len(made['rows']) / n:.0f} samples a surfel\n")
    print("| method | us a surfel | against: " + " | ".join(base) + " | residual [%] |\n|" + "---|" * (3 + len(base)))
    for name, r in results.items():
        ratios = " | ".join(f"{b / r['us']:.1f} x" for b in base.values())
        print(f"| {name} | {r['us']:.0f} | {ratios} | {100 * r['residual']:.2f} |")
    if args.json:
        args.json.write_text(json.dumps(results, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
