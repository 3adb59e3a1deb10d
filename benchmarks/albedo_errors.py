"""Error and coverage of the albedo and normal estimates where the model is true.

    python benchmarks/albedo_errors.py

Samples are diffuse light, two of the lobes the fit knows and relative noise, all by public optics. Prints JSON.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.fit import estimate_diffuse_reflectance, estimate_normals
from skindb.fit._albedo_kernels import surface_lobes
from skindb.optics.fresnel import fresnel_transmittance
from skindb.optics.rows import basis_rows
from skindb.schema import dataset, label

Array = NDArray[np.float64]
ETA, SCAN_ERROR = 1.3, 3.0
ISOTROPIC_95 = float(np.sqrt(-np.log(0.05)))  # 1.73: 95 % of the angles of two equal normal axes, over their RMS


@dataclass(frozen=True)
class ModelSamples:
    """Lumitexels of points of a head-sized cap, and what is true about them."""

    lumitexels: xr.Dataset
    normal: Array
    diffuse: Array


def _unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def _spiral(n: int, top: float) -> Array:
    z = 1 - (np.arange(n) + 0.5) / n * (1 - top)
    phi, r = np.pi * (3 - np.sqrt(5)) * np.arange(n), np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)


def model_samples(
    rng: np.random.Generator, *, surfels: int, lights: int, cameras: int, noise: float, gloss: float
) -> ModelSamples:
    """Samples of the model; `noise` relative, `gloss` the largest weight of a lobe."""
    normal = _unit(_spiral(surfels, 0.6) + 0.05 * rng.normal(size=(surfels, 3)))
    position, light, camera = 80 * _spiral(surfels, 0.6), 880 * _spiral(lights, 0.1), 830 * _spiral(cameras, 0.5)
    wi, wo = _unit(light - position[:, None]), _unit(camera - position[:, None])
    lit, seen = np.einsum("nk,ntk->nt", normal, wi), np.einsum("nk,ntk->nt", normal, wo)
    diffuse = np.array([0.5, 0.33, 0.24]) * rng.uniform(0.7, 1.2, (surfels, 1)) * rng.uniform(0.95, 1.05, (surfels, 3))
    table, grid = surface_lobes()
    rows, offsets, index = basis_rows(table, grid, normal, wi, wo, (lit > 0)[:, :, None] & (seen > 0)[:, None])
    s, (i, o) = np.repeat(np.arange(surfels), np.diff(offsets)), index.T
    chosen = rng.permuted(np.tile(np.arange(table.shape[-1]), (surfels, 1)), axis=1) < 2
    weight = rng.uniform(0, gloss, chosen.shape) * chosen
    body = (lit * fresnel_transmittance(lit.clip(0, 1), ETA))[s, i] * fresnel_transmittance(seen.clip(0, 1), ETA)[s, o]
    value = body[:, None] / np.pi * diffuse[s] + np.einsum("tm,tm->t", rows, weight[s])[:, None]
    sample = np.full((surfels, lights, cameras, 3), np.nan)
    sample[s, i, o] = value * (1 + noise * rng.normal(size=value.shape))
    found = dataset(
        {
            "reflectance_sample": sample,
            "surfel_position": position,
            "surfel_normal": _unit(normal + np.deg2rad(SCAN_ERROR / np.sqrt(2)) * rng.normal(size=normal.shape)),
            "surfel_area": np.ones(surfels),
            "light_position": light,
            "light_disc_radius": np.zeros(lights),
            "camera_position": camera,
        },
        coords={"channel": ["R", "G", "B"]},
    )
    return ModelSamples(found, normal, diffuse)


def _errors(skin: ModelSamples, **options: Any) -> dict[str, float]:
    """Median relative error and bias of R_d [%], with the true normals."""
    known = skin.lumitexels.assign(shading_normal=label("shading_normal", skin.normal))
    found = estimate_diffuse_reflectance(known, eta=ETA, **options)["diffuse_reflectance"].values
    relative = 100 * (found / skin.diffuse - 1)
    return {
        "error_percent": float(np.nanmedian(np.abs(relative))),
        "bias_percent": float(np.nanmedian(relative)),
        "estimated": float(np.isfinite(found).all(1).mean()),
    }


def error_by_discard(
    rng: np.random.Generator, *, discards: tuple[int, ...] = (0, 1, 2, 4, 8, 16, 32, 64), noise: float = 0.03
) -> list[dict[str, Any]]:
    """The paper's stable minimum against the number of smallest ratios left out; the quantile beside it."""
    skin = model_samples(rng, surfels=300, lights=60, cameras=8, noise=noise, gloss=0.1)
    rows = [{"method": "minimum", "discard": k, **_errors(skin, method="minimum", discard=k)} for k in discards]
    return [*rows, *({"method": m, "discard": None, **_errors(skin, method=m)} for m in ("quantile", "separated"))]


def error_by_samples(
    rng: np.random.Generator, *, noise: float = 0.03, gloss: float = 0.1, surfels: int = 200
) -> list[dict[str, Any]]:
    """Every rule against the size of the dome."""
    rows: list[dict[str, Any]] = []
    for lights, cameras in ((12, 2), (16, 4), (32, 6), (64, 8), (150, 16)):
        skin = model_samples(rng, surfels=surfels, lights=lights, cameras=cameras, noise=noise, gloss=gloss)
        count = float(np.isfinite(skin.lumitexels["reflectance_sample"].values[..., 0]).sum((1, 2)).mean())
        methods = ("minimum", "quantile", "separated")
        rows += [{"samples": round(count), "method": method, **_errors(skin, method=method)} for method in methods]
    return rows


def coverage(rng: np.random.Generator, *, surfels: int = 400) -> list[dict[str, Any]]:
    """Share of the truth within the 95 % interval of the noise, for R_d (true normals) and for normals."""
    rows = []
    for lights, cameras in ((32, 6), (60, 8), (150, 16)):
        for noise in (0.01, 0.05):
            for gloss in (0.0, 0.3):
                skin = model_samples(rng, surfels=surfels, lights=lights, cameras=cameras, noise=noise, gloss=gloss)
                turned = estimate_normals(skin.lumitexels, eta=ETA, scan_error=SCAN_ERROR)
                cosine = (turned["shading_normal"].values * skin.normal).sum(1).clip(-1, 1)
                inside = np.degrees(np.arccos(cosine)) < ISOTROPIC_95 * turned["normal_error"].values
                known = skin.lumitexels.assign(shading_normal=label("shading_normal", skin.normal))
                found = estimate_diffuse_reflectance(known, eta=ETA)
                z = (found["diffuse_reflectance"].values - skin.diffuse) / found["diffuse_reflectance_error"].values
                dome = {"lights": lights, "cameras": cameras, "noise": noise, "gloss": gloss}
                rows.append(dome | {"albedo": float((np.abs(z) < 1.96).mean()), "normal": float(inside.mean())})
    return rows


def main() -> None:
    rng = np.random.default_rng(11)
    results = {"discard": error_by_discard(rng), "samples": error_by_samples(rng), "coverage": coverage(rng)}
    print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
