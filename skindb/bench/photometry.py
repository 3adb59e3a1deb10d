"""Normals and diffuse albedo from samples of the model, compared with the true values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.bench.curve import Curve, Point, cpu_time
from skindb.fit import albedo, estimate_diffuse_reflectance, estimate_normals, normals
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance.dictionary import surface_lobes
from skindb.reflectance.rows import basis_rows
from skindb.schema import dataset, label

Array = NDArray[np.float64]
# degree
ETA = 1.3
SCAN_ERROR = 3.0
DOMES = ((12, 2), (16, 4), (32, 6), (64, 8), (150, 16))  # lights, cameras
NOISE = 0.03
GLOSS = 0.1


@dataclass(frozen=True)
class ModelSamples:
    """Lumitexels of points on a head-sized cap, and their true parameters."""

    lumitexels: xr.Dataset
    normal: Array
    diffuse: Array
    weight: Array  # of the lobes used by the fit of R_d

    @property
    def with_normals(self) -> xr.Dataset:
        """The lumitexels with the true normals."""
        return self.lumitexels.assign(
            shading_normal=label("shading_normal", self.normal)
        )


def _unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def _spiral(n: int, top: float) -> Array:
    z = 1 - (np.arange(n) + 0.5) / n * (1 - top)
    phi = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)


def model_samples(
    rng: np.random.Generator,
    *,
    surfels: int,
    lights: int,
    cameras: int,
    noise: float,
    gloss: float,
    floor: float = 0.0,
    lobes: tuple[int, ...] = (),
) -> ModelSamples:
    """Samples of diffuse light and of lobes that the fit uses, made with the public
    functions of `skindb.optics`.

    Every surfel has two random lobes with weights up to `gloss`, or the given `lobes`,
    each with at least a fifth of `gloss`. Noise is relative, with `floor` [sr^-1] added
    in quadrature.
    """
    normal = _unit(_spiral(surfels, 0.6) + 0.05 * rng.normal(size=(surfels, 3)))
    position = 80 * _spiral(surfels, 0.6)
    light = 880 * _spiral(lights, 0.1)
    camera = 830 * _spiral(cameras, 0.5)
    wi = _unit(light - position[:, None])
    wo = _unit(camera - position[:, None])
    lit = np.einsum("nk,ntk->nt", normal, wi)
    seen = np.einsum("nk,ntk->nt", normal, wo)
    diffuse = (
        np.array([0.5, 0.33, 0.24])
        * rng.uniform(0.7, 1.2, (surfels, 1))
        * rng.uniform(0.95, 1.05, (surfels, 3))
    )
    table, grid = surface_lobes()
    rows, offsets, index = basis_rows(
        table, grid, normal, wi, wo, (lit > 0)[:, :, None] & (seen > 0)[:, None]
    )
    s, (i, o) = np.repeat(np.arange(surfels), np.diff(offsets)), index.T
    chosen = rng.permuted(np.tile(np.arange(table.shape[-1]), (surfels, 1)), axis=1) < 2
    weight = rng.uniform(0, gloss, chosen.shape) * chosen
    if lobes:
        weight[:] = 0
        weight[:, list(lobes)] = rng.uniform(gloss / 5, gloss, (surfels, len(lobes)))
    body = (lit * fresnel_transmittance(lit.clip(0, 1), ETA))[
        s, i
    ] * fresnel_transmittance(seen.clip(0, 1), ETA)[s, o]
    value = (
        body[:, None] / np.pi * diffuse[s]
        + np.einsum("tm,tm->t", rows, weight[s])[:, None]
    )
    sample = np.full((surfels, lights, cameras, 3), np.nan)
    sample[s, i, o] = value + np.hypot(noise * value, floor) * rng.normal(
        size=value.shape
    )
    found = dataset(
        {
            "reflectance_sample": sample,
            "surfel_position": position,
            "surfel_normal": _unit(
                normal
                + np.deg2rad(SCAN_ERROR / np.sqrt(2)) * rng.normal(size=normal.shape)
            ),
            "surfel_area": np.ones(surfels),
            "light_position": light,
            "light_disc_radius": np.zeros(lights),
            "camera_position": camera,
        },
        coords={"channel": ["R", "G", "B"]},
    )
    return ModelSamples(found, normal, diffuse, weight)


def _domes(quick: bool) -> list[tuple[str, ModelSamples]]:
    """Samples of every dome, named by their mean number per surfel."""
    rng = np.random.default_rng(11)
    made = []
    for lights, cameras in DOMES[1::2] if quick else DOMES:
        skin = model_samples(
            rng,
            surfels=60 if quick else 300,
            lights=lights,
            cameras=cameras,
            noise=NOISE,
            gloss=GLOSS,
        )
        count = (
            np.isfinite(skin.lumitexels["reflectance_sample"].values[..., 0])
            .sum((1, 2))
            .mean()
        )
        made.append((f"{count:.0f} samples", skin))
    return made


def normals_curves(quick: bool) -> list[Curve]:
    """Every method by size of the dome; all methods share one kernel, so the time only
    depends on the dome.
    """
    points = []
    domes = _domes(quick)
    for samples, skin in domes:
        for method in normals.METHODS:
            ask: dict[str, Any] = {
                "eta": ETA,
                "scan_error": SCAN_ERROR,
                "method": method,
            }
            # compiles
            estimate_normals(skin.lumitexels.isel(surfel=slice(0, 2)), **ask)
            took, found = cpu_time(
                lambda s=skin, a=ask: estimate_normals(s.lumitexels, **a),  # type: ignore[misc]
                len(skin.normal),
            )
            cosine = np.einsum(
                "nk,nk->n", found["shading_normal"].values, skin.normal
            ).clip(-1, 1)
            angle = np.degrees(np.arccos(cosine))
            more = {
                "p95": float(np.nanquantile(angle, 0.95)),
                "estimated": float(np.isfinite(angle).mean()),
            }
            points.append(
                Point(method, samples, took, float(np.nanmedian(angle)), "", more)
            )
    scan = np.einsum(
        "nk,nk->n", domes[0][1].lumitexels["surfel_normal"].values, domes[0][1].normal
    ).clip(-1, 1)
    points.append(
        Point(
            "normals of the scan",
            "",
            np.nan,
            float(np.degrees(np.median(np.arccos(scan)))),
        )
    )
    reference = f"true normals of samples of the model, {NOISE:.0%} noise"
    base = f"peak, {domes[-1][0]}"
    return [
        Curve(
            "normals",
            "median angle [degree]",
            reference,
            "a surfel",
            base,
            tuple(points),
        )
    ]


def albedo_curves(quick: bool) -> list[Curve]:
    """Every method by size of the dome, and the paper's rule by the number of smallest
    ratios that it discards.
    """
    points = []
    domes = _domes(quick)
    for samples, skin in domes:
        points += [
            _albedo(skin, method, samples, method=method) for method in albedo.METHODS
        ]
    samples, skin = domes[-1]
    for k in (0, 8, 32) if quick else (0, 1, 4, 8, 16, 32, 64):
        points.append(
            _albedo(
                skin,
                "minimum by discard",
                f"{k} discarded",
                method="minimum",
                discard=k,
            )
        )
    reference = f"true R_d of samples of the model, {NOISE:.0%} noise, true normals"
    error = "median relative error of R_d"
    return [
        Curve(
            "albedo",
            error,
            reference,
            "a surfel",
            f"minimum, {domes[-1][0]}",
            tuple(points),
        )
    ]


def _albedo(skin: ModelSamples, name: str, samples: str, **ask: Any) -> Point:
    known = skin.with_normals
    # compiles
    estimate_diffuse_reflectance(known.isel(surfel=slice(0, 2)), eta=ETA, **ask)
    took, found = cpu_time(
        lambda: estimate_diffuse_reflectance(known, eta=ETA, **ask), len(skin.normal)
    )
    relative = found["diffuse_reflectance"].values / skin.diffuse - 1
    known_share = float(np.isfinite(relative).all(1).mean())
    why = (
        ""
        if known_share > 0.5
        else f"{1 - known_share:.0%} of the surfels have too few samples"
    )
    more = {"bias": float(np.nanmedian(relative)), "estimated": known_share}
    return Point(name, samples, took, float(np.nanmedian(np.abs(relative))), why, more)
