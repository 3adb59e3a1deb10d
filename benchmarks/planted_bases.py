"""How many of the bases that the simulator plants an exact fit could tell apart.

    skindb simulate captures --paper
    skindb ingest db captures/*/ && skindb fit db
    python -m benchmarks planted_bases captures db A001 A001.lotion A001.powder

The samples are those of the planted BRDFs without any error, divided by the noise that
`analyze brdf` assumes or that is given; every surfel has a free diffuse term and a free even
reflection, as there. The table has the best bases of every size: their variance over that of the
noise, and by how much the next size lowers the error. A step below 1 % cannot be distinguished
from errors of geometry (`skindb.analysis.brdf.choose_size`).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr

import skindb
from skindb.analysis.brdf import NOISE_FLOOR, RELATIVE_NOISE
from skindb.fit.lumitexels import lumitexels
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance.dictionary import Dictionary
from skindb.reflectance.mixture import basis_rows
from skindb.reflectance.reduction import Systems, factor_reflectance, residuals
from skindb.schema import FitStatus
from skindb.types import dots, finite_rows, unit
from skindb.virtual.capture import _materials, at_foot_points, foot_points


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


def planted(captures: Path, db: str, take: str, surfels: int, noise: float) -> Systems:
    """Systems of the planted materials of a take."""
    database = skindb.open(db)
    samples = lumitexels(database.read("capture", take))
    fitted = database.read("model", take)["fitted"].to_dataset().load()
    truth = np.load(captures / f"{take}.truth.npz")
    materials = _materials(tuple(truth["surface_names"].tolist()))[0]
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
    return systems(samples, materials, normal, diffuse, weights, noise)


def main(
    captures: Path,
    db: str,
    takes: Sequence[str],
    *,
    surfels: int = 1400,
    noise: float = RELATIVE_NOISE,
) -> None:
    """Print the table."""
    share = surfels // len(takes)
    joined = Systems.joined(
        [planted(captures, db, take, share, noise) for take in takes]
    )
    total = joined.samples.sum()
    errors = [
        residuals(joined, H)[1].sum() / total
        for H in factor_reflectance(joined, joined.rhs.shape[1])
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
