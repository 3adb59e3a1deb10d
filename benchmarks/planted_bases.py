"""How many of the bases that the simulator plants an exact fit could tell apart.

    skindb simulate captures --paper
    skindb ingest db captures/*/ && skindb fit db
    python -m benchmarks planted_bases captures db A001 A001.lotion A001.powder

The samples are those of the planted BRDFs without any error, divided by the noise that
`analyze brdf` assumes or that is given; every surfel has a free diffuse term and a free even
reflection, as there. The first table has the best bases of every size: their variance over
that of the noise, and by how much the next size lowers the error. A step below 1 % cannot be
distinguished from errors of geometry (`skindb.analysis.brdf.choose_size`). The second table has the
BRDFs of the dictionary that differ most, if every surfel had one of them alone, and by how
much each lowers the error.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr

import skindb
from skindb.analysis.brdf import NOISE_FLOOR, RELATIVE_NOISE
from skindb.fit.lumitexels import lumitexels
from skindb.numerics.nnls import solve_nnls
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance.dictionary import Dictionary, disc_dictionary
from skindb.reflectance.mixture import basis_rows
from skindb.reflectance.reduction import Systems, factor_reflectance, residuals
from skindb.reflectance.tables import directional_albedo
from skindb.schema import FitStatus
from skindb.types import dots, finite_rows, unit
from skindb.virtual.capture import _materials, at_foot_points, foot_points

LEVEL = 0.04  # what the surface of skin reflects
SIZES = (4, 6, 8)
EXCHANGES = 4
ROUGH = 60  # surfels on which BRDFs are compared


def systems(
    samples: xr.Dataset,
    dictionary: Dictionary,
    normal: np.ndarray,
    diffuse: np.ndarray,
    weights: np.ndarray,
    noise: float,
) -> Systems:
    """Normal equations of exact samples of surfels with the weights (n, m)."""
    position = samples["surfel_position"].values[:, None].astype(float)
    lights, cameras = (
        unit(samples[f"{name}_position"].values - position)
        for name in ("light", "camera")
    )
    usable = finite_rows(samples["reflectance_sample"].values)
    rows, offsets, index = basis_rows(
        dictionary.table, dictionary.grid, normal, lights, cameras, usable
    )
    surfel = np.repeat(np.arange(len(normal)), np.diff(offsets))
    lit = dots(normal[surfel], lights[surfel, index[:, 0]])
    seen = dots(normal[surfel], cameras[surfel, index[:, 1]])
    passed = lit * fresnel_transmittance(lit, 1.3) * fresnel_transmittance(seen, 1.3)
    gloss = (rows * weights[surfel]).sum(axis=1)
    sample = gloss + passed * diffuse[surfel].mean(axis=1) / np.pi
    deviation = np.hypot(NOISE_FLOOR, noise * sample)[:, None]
    besides = np.stack([passed, lit], axis=1) / deviation
    target = np.repeat(gloss[:, None] / deviation, 3, axis=1)
    return Systems.of(rows / deviation, offsets, target, besides)


def planted(
    captures: Path, db: str, take: str, surfels: int, noise: float
) -> tuple[Systems, Systems]:
    """Systems of the planted materials, and of all BRDFs at `LEVEL`, of a take."""
    database = skindb.open(db)
    samples = lumitexels(database.read("capture", take))
    fitted = database.read("model", take)["fitted"].to_dataset().load()
    truth = np.load(captures / f"{take}.truth.npz")
    face, corner = foot_points(fitted, truth)
    good = np.flatnonzero((fitted["fit_status"] == FitStatus.FITTED) & (face >= 0))
    good = np.random.default_rng(0).permutation(good)[:surfels]
    corners = truth["faces"][face[good]]
    names = ("normals", "diffuse_reflectance", "surface_weights")
    normal, diffuse, weights = (
        at_foot_points(truth[name][corners], corner[good]) for name in names
    )
    normal = unit(normal)
    samples = samples.isel(surfel=good).compute()
    materials = _materials()[0]
    exact = systems(samples, materials, normal, diffuse, weights, noise)
    whole = disc_dictionary(None, materials.disc_angular_radius)
    mean = np.full(len(whole.names), LEVEL / len(whole.names))
    mean /= directional_albedo(whole.table, 1.0)[0]
    few = slice(ROUGH)
    part = samples.isel(surfel=few)
    weights = np.broadcast_to(mean, (part.sizes["surfel"], len(mean)))
    other = systems(part, whole, normal[few], diffuse[few], weights, noise)
    return exact, other


def excess(systems: Systems, scale: np.ndarray, alone: int, others: list[int]) -> float:
    """Variance over noise of surfels with one BRDF at `LEVEL`, fitted by others."""
    gram = systems.gram * np.multiply.outer(scale, scale)
    square = gram[:, alone, alone]
    inner = gram[np.ix_(range(len(gram)), others, others)]
    right = gram[:, others, alone]
    x = solve_nnls(inner, right)[0]
    fitted = np.einsum("nk,nkl,nl->n", x, inner, x) - 2 * (x * right).sum(axis=1)
    return float(np.maximum(square + fitted, 0).sum() / systems.samples.sum())


def least(
    systems: Systems, scale: np.ndarray, chosen: list[int]
) -> tuple[float, list[float]]:
    """The smallest of the excesses of some BRDFs by the others, and all of them."""
    values = [excess(systems, scale, j, [i for i in chosen if i != j]) for j in chosen]
    return min(values), values


def most_different(
    systems: Systems, scale: np.ndarray, size: int
) -> tuple[list[int], list[float]]:
    """BRDFs that others represent worst: added one by one, then exchanged."""
    count = len(scale)
    square = np.einsum("njj->j", systems.gram) * scale**2
    chosen = [int(np.argmax(square))]
    while len(chosen) < size:
        gain = [excess(systems, scale, j, chosen) for j in range(count)]
        chosen.append(int(np.argmax(gain)))
    best, values = least(systems, scale, chosen)
    for _ in range(EXCHANGES):
        rest = [j for i, j in enumerate(chosen) if i != int(np.argmin(values))]
        tried = [
            (least(systems, scale, [*rest, j])[0], j)
            for j in range(count)
            if j not in rest
        ]
        better, added = max(tried)
        if better <= best:
            break
        chosen = [*rest, added]
        best, values = least(systems, scale, chosen)
    return chosen, values


def main(
    captures: Path,
    db: str,
    takes: Sequence[str],
    *,
    surfels: int = 1400,
    noise: float = RELATIVE_NOISE,
) -> None:
    """Print both tables."""
    share = surfels // len(takes)
    parts = [planted(captures, db, take, share, noise) for take in takes]
    joined = Systems.joined([part[0] for part in parts])
    total = joined.samples.sum()
    errors = [
        residuals(joined, H)[1].sum() / total for H in factor_reflectance(joined, 8)
    ]
    rms = np.sqrt(1 + np.array(errors))
    print(
        f"{share * len(takes)} surfels, {int(total)} values, noise of {100 * noise:g} %\n"
    )
    print("| k | excess over noise [%] | reduced by the next [%] |\n|---|---|---|")
    for k, (error, fall) in enumerate(
        zip(errors, 1 - rms[1:] / rms[:-1], strict=False)
    ):
        print(f"| {k + 1} | {100 * error:.2f} | {100 * fall:.2f} |")
    dictionary = disc_dictionary(None, _materials()[0].disc_angular_radius)
    scale = LEVEL / directional_albedo(dictionary.table, 1.0)[0]
    print(
        "\n| bases | BRDFs that differ most | error lowered by each [%] |\n|---|---|---|"
    )
    for size in SIZES:
        chosen, values = most_different(parts[0][1], scale, size)
        lowered = 100 * (np.sqrt(1 + np.array(values) / size) - 1)
        names = ", ".join(dictionary.names[j] for j in chosen)
        print(f"| {size} | {names} | {', '.join(f'{x:.1f}' for x in lowered)} |")
