"""Normals and diffuse reflectance: curves on samples of the model, and stress cases, which
must be the planted values or NaN.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr

from skindb.bench.case import SCALES, close, combinations, expect, stress_cases
from skindb.bench.curve import Curve, Point, cpu_time
from skindb.bench.surface_cases import (
    WEIGHT,
    Surfels,
    brightened,
    filled,
    first,
    spiral,
    spoiled,
    surfels,
    unit,
    without_surfels,
)
from skindb.fit import albedo, estimate_diffuse_reflectance, estimate_normals, normals
from skindb.fit.albedo import block_reflectance
from skindb.fit.normals import _normals as fit_normals
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance.rows import basis_rows
from skindb.reflectance.separation import surface_lobes
from skindb.schema import dataset, label, variables
from skindb.schema.status import LARGEST_R_D, SMALLEST_R_D
from skindb.types import Array

# degree
ETA = 1.3
SCAN_ERROR = 3.0
DOMES = ((12, 2), (16, 4), (32, 6), (64, 8), (150, 16))  # lights, cameras
NOISE = 0.03
GLOSS = 0.1
NORMALS = ("combined", "chromatic", "photometric", "peak")
METHODS = ("separated", "quantile", "minimum")


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
            shading_normal=label(variables.SHADING_NORMAL, self.normal)
        )


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
    normal = unit(spiral(surfels, 0.6) + 0.05 * rng.normal(size=(surfels, 3)))
    position = 80 * spiral(surfels, 0.6)
    light = 880 * spiral(lights, 0.1)
    camera = 830 * spiral(cameras, 0.5)
    wi = unit(light - position[:, None])
    wo = unit(camera - position[:, None])
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
    lumitexels = dataset(
        {
            variables.REFLECTANCE_SAMPLE: sample,
            variables.SURFEL_POSITION: position,
            variables.SURFEL_NORMAL: unit(
                normal
                + np.deg2rad(SCAN_ERROR / np.sqrt(2)) * rng.normal(size=normal.shape)
            ),
            variables.SURFEL_AREA: np.ones(surfels),
            variables.LIGHT_POSITION: light,
            variables.LIGHT_DISC_RADIUS: np.zeros(lights),
            variables.CAMERA_POSITION: camera,
        },
        coords={"channel": ["R", "G", "B"]},
    )
    return ModelSamples(lumitexels, normal, diffuse, weight)


def _domes(quick: bool) -> list[tuple[str, ModelSamples]]:
    """Samples of every dome, named by their mean number per surfel."""
    rng = np.random.default_rng(11)
    domes = []
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
            np.isfinite(skin.lumitexels[variables.REFLECTANCE_SAMPLE].values[..., 0])
            .sum((1, 2))
            .mean()
        )
        domes.append((f"{count:.0f} samples", skin))
    return domes


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
            took, estimate = cpu_time(
                lambda s=skin, a=ask: estimate_normals(s.lumitexels, **a),  # type: ignore[misc]
                len(skin.normal),
            )
            cosine = np.einsum(
                "nk,nk->n", estimate[variables.SHADING_NORMAL].values, skin.normal
            ).clip(-1, 1)
            angle = np.degrees(np.arccos(cosine))
            details = {
                "p95": float(np.nanquantile(angle, 0.95)),
                "estimated": float(np.isfinite(angle).mean()),
            }
            points.append(
                Point(method, samples, took, float(np.nanmedian(angle)), "", details)
            )
    scan = np.einsum(
        "nk,nk->n",
        domes[0][1].lumitexels[variables.SURFEL_NORMAL].values,
        domes[0][1].normal,
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
    lumitexels = skin.with_normals
    # compiles
    estimate_diffuse_reflectance(lumitexels.isel(surfel=slice(0, 2)), eta=ETA, **ask)
    took, estimate = cpu_time(
        lambda: estimate_diffuse_reflectance(lumitexels, eta=ETA, **ask),
        len(skin.normal),
    )
    relative = estimate[variables.DIFFUSE_REFLECTANCE].values / skin.diffuse - 1
    known_share = float(np.isfinite(relative).all(1).mean())
    failure = (
        ""
        if known_share > 0.5
        else f"{1 - known_share:.0%} of the surfels have too few samples"
    )
    details = {"bias": float(np.nanmedian(relative)), "estimated": known_share}
    return Point(
        name, samples, took, float(np.nanmedian(np.abs(relative))), failure, details
    )


# normals


def _normals(
    skin: Surfels,
    method: str = "combined",
    eta: float = ETA,
    scan: Array | None = None,
) -> Array:
    """Normals (3, 3); those of the scan have an error of three degrees."""
    scan = _scan(skin) if scan is None else scan
    geometry = skin.position, skin.light, skin.camera, scan
    return fit_normals(skin.sample, *geometry, method=method, eta=eta, scan_error=3.0)[
        0
    ]


def _scan(skin: Surfels) -> Array:
    return unit(skin.normal + np.deg2rad(3.0) * np.array([0.6, 0.8, 0.0]))


def _angle(estimate: Array, true: Array) -> Array:
    return np.asarray(
        np.degrees(np.arccos(np.clip(np.einsum("nk,nk->n", estimate, true), -1, 1)))
    )


def _matte_normals(method: str, eta: float) -> None:
    skin = surfels(150, 16, eta=eta, weight=0 * WEIGHT)
    off = _angle(_normals(skin, method, eta), skin.normal)
    # half a degree, because the prior of the scan has an error of three degrees that
    # noise-free samples outweigh
    expect(off.max() < 0.5, off)


def _no_normals(method: str, value: float) -> None:
    skin = surfels()
    estimate = _normals(spoiled(skin, filled(value)), method)
    unchanged = _normals(skin, method)
    expect(np.isnan(estimate[0]).all(), estimate[0])
    close(estimate[1:], unchanged[1:], atol=1e-7)


def _few_normals(method: str, lights: int, cameras: int) -> None:
    """Too few samples give NaN, or a unit vector near the scan."""
    skin = surfels(lights, cameras)
    estimate = _normals(skin, method)
    finite = np.isfinite(estimate).all(axis=1)
    close(np.linalg.norm(estimate[finite], axis=1), 1.0, atol=1e-6)
    off = _angle(estimate[finite], _scan(skin)[finite])
    expect((off < (45 if method == "peak" else 10)).all(), off)


def _scaled_normals(method: str, scale: float) -> None:
    skin = surfels(weight=0 * WEIGHT)
    close(_normals(brightened(skin, scale), method), _normals(skin, method), atol=1e-5)


def _one_sample_lost(method: str, value: float) -> None:
    skin = surfels(weight=0 * WEIGHT)
    off = _angle(_normals(first(skin, value), method), skin.normal)
    expect(off[0] < 0.5, off)


def _even_light() -> None:
    """Constant samples have no shading and give a unit vector or NaN, never an invalid vector."""
    skin = replace(surfels(), sample=np.full((3, 40, 6, 3), 0.2, np.float32))
    for method in ("combined", "chromatic", "photometric", "peak"):
        estimate = _normals(skin, method)
        length = np.linalg.norm(estimate, axis=1)
        expect((np.isnan(length) | (np.abs(length - 1) < 1e-6)).all(), estimate)


def _no_scan(method: str) -> None:
    skin = surfels(weight=0 * WEIGHT)
    estimate = _normals(skin, method, scan=np.full((3, 3), np.nan))
    expect(np.isnan(estimate).all(), estimate)


def _no_surfels_normals() -> None:
    empty = without_surfels(surfels())
    expect(_normals(empty).shape == (0, 3), _normals(empty).shape)


# albedo


def _estimated_albedo(
    skin: Surfels, method: str, eta: float = ETA
) -> tuple[Array, Array]:
    arrays = {
        "reflectance_sample": skin.sample,
        "surfel_position": skin.position,
        "light_position": skin.light,
        "camera_position": skin.camera,
        "shading_normal": skin.normal,
    }
    estimate, error, _, _ = block_reflectance(
        arrays, method=method, eta=eta, even_reflection=0.0
    )
    return estimate, error


def _matte_albedo(method: str, eta: float) -> None:
    skin = surfels(150, 16, eta=eta, weight=0 * WEIGHT)
    close(_estimated_albedo(skin, method, eta)[0], skin.diffuse, rtol=1e-5)


def _few_albedo(method: str, lights: int, cameras: int) -> None:
    estimate, error = _estimated_albedo(surfels(lights, cameras), method)
    expect(np.isnan(estimate).all() and np.isnan(error).all(), (estimate, error))


def _no_albedo(method: str) -> None:
    skin = surfels()
    estimate = _estimated_albedo(spoiled(skin, filled(np.nan)), method)[0]
    unchanged = _estimated_albedo(skin, method)[0]
    expect(np.isnan(estimate[0]).all(), estimate[0])
    close(estimate[1:], unchanged[1:], rtol=1e-7)


def _one_albedo_lost(method: str, value: float) -> None:
    skin = surfels(weight=0 * WEIGHT)
    close(_estimated_albedo(first(skin, value), method)[0], skin.diffuse, rtol=1e-3)


def _clamped_albedo(method: str, factor: float) -> None:
    skin = surfels(weight=0 * WEIGHT)
    estimate = _estimated_albedo(brightened(skin, factor), method)[0]
    close(estimate, SMALLEST_R_D if factor < 1 else LARGEST_R_D, rtol=1e-6)


def _grazing_albedo(method: str) -> None:
    skin = replace(
        surfels(weight=0 * WEIGHT),
        normal=np.tile([0.0, 0, 1], (3, 1)),
        position=np.zeros((3, 3)),
    )
    low = 900 * np.array([[np.cos(a), np.sin(a), 0.2] for a in (0.1, 2.0, 4.0)])
    wild = np.full((3, 3, *skin.sample.shape[2:]), 1e-3, np.float32)
    extended = replace(
        skin,
        light=np.concatenate([skin.light, low]),
        sample=np.concatenate([skin.sample, wild], axis=1),
    )
    close(
        _estimated_albedo(extended, method)[0],
        _estimated_albedo(skin, method)[0],
        rtol=1e-6,
    )


def _precision_albedo(method: str) -> None:
    skin = surfels()
    half = skin.sample.astype(np.float16)
    estimates = [
        _estimated_albedo(replace(skin, sample=half.astype(t)), method)[0]
        for t in ("float16", "float32", "float64")
    ]
    close(estimates[1:], [estimates[0]] * 2, rtol=1e-6)


def _no_surfels_albedo(method: str) -> None:
    empty = without_surfels(surfels())
    expect(
        _estimated_albedo(empty, method)[0].shape == (0, 3),
        _estimated_albedo(empty, method)[0].shape,
    )


NORMAL = stress_cases(
    "normals",
    (
        "{}: 2400 samples of matte skin, eta {}",
        "Normals are accurate to half a degree.",
        _matte_normals,
        combinations(NORMALS[:3], 1.0, 1.3),
    ),
    (
        "{}: all {}",
        "The normal is NaN; neighbours are unchanged.",
        _no_normals,
        combinations(NORMALS, np.nan, 0.0),
    ),
    (
        "{}: {} light(s), {} camera",
        "The normal is NaN, or a unit vector near the scan.",
        _few_normals,
        combinations(NORMALS, (1, 1), (3, 1)),
    ),
    (
        "{}: samples times {:g}",
        "Normals are unchanged.",
        _scaled_normals,
        combinations(NORMALS, *SCALES),
    ),
    (
        "{}: a sample is {}",
        "One sample changes the normal by less than half a degree.",
        _one_sample_lost,
        combinations(NORMALS[:3], np.nan, np.inf),
    ),
    ("constant", "Normals are unit vectors or NaN.", _even_light),
    ("{}: no normal of the scan", "The normal is NaN.", _no_scan, NORMALS[:3]),
    ("no surfels", "Arrays are empty and have the right shapes.", _no_surfels_normals),
)
ALBEDO = stress_cases(
    "albedo",
    (
        "{}: 2400 samples of matte skin, eta {}",
        "R_d is accurate to rounding.",
        _matte_albedo,
        combinations(METHODS, 1.0, 1.3),
    ),
    (
        "{}: {} light(s), {} camera",
        "R_d and its error are NaN.",
        _few_albedo,
        combinations(METHODS, (1, 1), (3, 1)),
    ),
    ("{}: all saturated", "R_d is NaN; neighbours are unchanged.", _no_albedo, METHODS),
    (
        "{}: a sample is {}",
        "One sample of 240 changes R_d by less than 1e-3.",
        _one_albedo_lost,
        combinations(METHODS, np.nan, np.inf),
    ),
    (
        "{}: samples times {:g}",
        "R_d is clamped to the range of eq. 5.",
        _clamped_albedo,
        combinations(METHODS, 0.0, 1e-30, 1000.0, 1e30),
    ),
    ("{}: grazing lights", "Their samples are ignored.", _grazing_albedo, METHODS),
    ("{}: any precision", "Results agree to rounding.", _precision_albedo, METHODS),
    (
        "{}: no surfels",
        "Arrays are empty and have the right shapes.",
        _no_surfels_albedo,
        METHODS,
    ),
)
