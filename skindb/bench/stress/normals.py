"""Stress cases of normals and diffuse reflectance, which must be the planted values or NaN."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.bench.case import SCALES, Case, close, combinations, each, expect
from skindb.bench.stress.surfels import (
    ETA,
    WEIGHT,
    Surfels,
    filled,
    first,
    spoiled,
    surfels,
    unit,
)
from skindb.fit.albedo import block_reflectance
from skindb.fit.normals import _normals as normals
from skindb.schema.status import LARGEST_R_D, SMALLEST_R_D

Array = NDArray[Any]
NORMALS = ("combined", "chromatic", "photometric", "peak")

# normals


def _normals(
    skin: Surfels, method: str = "combined", eta: float = ETA, scan: Array | None = None
) -> Array:
    """Normals (3, 3); those of the scan have an error of three degrees."""
    scan = _scan(skin) if scan is None else scan
    geometry = skin.position, skin.light, skin.camera, scan
    return normals(skin.sample, *geometry, method=method, eta=eta, scan_error=3.0)[0]


def _scan(skin: Surfels) -> Array:
    return unit(skin.normal + np.deg2rad(3.0) * np.array([0.6, 0.8, 0.0]))


def _angle(found: Array, true: Array) -> Array:
    return np.asarray(
        np.degrees(np.arccos(np.clip(np.einsum("nk,nk->n", found, true), -1, 1)))
    )


def _matte_normals(method: str, eta: float) -> None:
    skin = surfels(150, 16, eta=eta, weight=0 * WEIGHT)
    off = _angle(_normals(skin, method, eta), skin.normal)
    # half a degree, because the prior of the scan has an error of three degrees that
    # noise-free samples outweigh
    expect(off.max() < 0.5, off)


def _no_normals(method: str, value: float) -> None:
    skin = surfels()
    found = _normals(spoiled(skin, filled(value)), method)
    whole = _normals(skin, method)
    expect(np.isnan(found[0]).all(), found[0])
    close(found[1:], whole[1:], atol=1e-7)


def _few_normals(method: str, lights: int, cameras: int) -> None:
    """Too few samples give NaN, or a unit vector near the scan."""
    skin = surfels(lights, cameras)
    found = _normals(skin, method)
    known = np.isfinite(found).all(axis=1)
    close(np.linalg.norm(found[known], axis=1), 1.0, atol=1e-6)
    off = _angle(found[known], _scan(skin)[known])
    expect((off < (45 if method == "peak" else 10)).all(), off)


def _scaled_normals(method: str, scale: float) -> None:
    skin = surfels(weight=0 * WEIGHT)
    bright = replace(
        skin, sample=(skin.sample.astype(np.float64) * scale).astype(np.float32)
    )
    close(_normals(bright, method), _normals(skin, method), atol=1e-5)


def _one_sample_lost(method: str, value: float) -> None:
    skin = surfels(weight=0 * WEIGHT)
    off = _angle(_normals(first(skin, value), method), skin.normal)
    expect(off[0] < 0.5, off)


def _even_light() -> None:
    """Constant samples have no shading and give a unit vector or NaN, never an invalid vector."""
    skin = replace(surfels(), sample=np.full((3, 40, 6, 3), 0.2, np.float32))
    for method in ("combined", "chromatic", "photometric", "peak"):
        found = _normals(skin, method)
        length = np.linalg.norm(found, axis=1)
        expect((np.isnan(length) | (np.abs(length - 1) < 1e-6)).all(), found)


def _no_scan(method: str) -> None:
    skin = surfels(weight=0 * WEIGHT)
    found = _normals(skin, method, scan=np.full((3, 3), np.nan))
    expect(np.isnan(found).all(), found)


def _no_surfels_normals() -> None:
    skin = surfels()
    empty = replace(
        skin,
        **{
            f: getattr(skin, f)[:0] for f in ("sample", "position", "normal", "diffuse")
        },
    )
    expect(_normals(empty).shape == (0, 3), _normals(empty).shape)


# albedo

METHODS = ("separated", "quantile", "minimum")


def _albedo(skin: Surfels, method: str, eta: float = ETA) -> tuple[Array, Array]:
    arrays = {
        "reflectance_sample": skin.sample,
        "surfel_position": skin.position,
        "light_position": skin.light,
        "camera_position": skin.camera,
        "shading_normal": skin.normal,
    }
    found, error, _, _ = block_reflectance(
        arrays, method=method, eta=eta, even_reflection=0.0
    )
    return found, error


def _matte_albedo(method: str, eta: float) -> None:
    skin = surfels(150, 16, eta=eta, weight=0 * WEIGHT)
    close(_albedo(skin, method, eta)[0], skin.diffuse, rtol=1e-5)


def _few_albedo(method: str, lights: int, cameras: int) -> None:
    found, error = _albedo(surfels(lights, cameras), method)
    expect(np.isnan(found).all() and np.isnan(error).all(), (found, error))


def _no_albedo(method: str) -> None:
    skin = surfels()
    found = _albedo(spoiled(skin, filled(np.nan)), method)[0]
    whole = _albedo(skin, method)[0]
    expect(np.isnan(found[0]).all(), found[0])
    close(found[1:], whole[1:], rtol=1e-7)


def _one_albedo_lost(method: str, value: float) -> None:
    skin = surfels(weight=0 * WEIGHT)
    close(_albedo(first(skin, value), method)[0], skin.diffuse, rtol=1e-3)


def _clamped_albedo(method: str, factor: float) -> None:
    skin = surfels(weight=0 * WEIGHT)
    found = _albedo(
        replace(
            skin, sample=(skin.sample.astype(np.float64) * factor).astype(np.float32)
        ),
        method,
    )[0]
    close(found, SMALLEST_R_D if factor < 1 else LARGEST_R_D, rtol=1e-6)


def _grazing_albedo(method: str) -> None:
    skin = replace(
        surfels(weight=0 * WEIGHT),
        normal=np.tile([0.0, 0, 1], (3, 1)),
        position=np.zeros((3, 3)),
    )
    low = 900 * np.array([[np.cos(a), np.sin(a), 0.2] for a in (0.1, 2.0, 4.0)])
    wild = np.full((3, 3, *skin.sample.shape[2:]), 1e-3, np.float32)
    more = replace(
        skin,
        light=np.concatenate([skin.light, low]),
        sample=np.concatenate([skin.sample, wild], axis=1),
    )
    close(_albedo(more, method)[0], _albedo(skin, method)[0], rtol=1e-6)


def _precision_albedo(method: str) -> None:
    skin = surfels()
    half = skin.sample.astype(np.float16)
    found = [
        _albedo(replace(skin, sample=half.astype(t)), method)[0]
        for t in ("float16", "float32", "float64")
    ]
    close(found[1:], [found[0]] * 2, rtol=1e-6)


def _no_surfels_albedo(method: str) -> None:
    skin = surfels()
    empty = replace(
        skin,
        **{
            f: getattr(skin, f)[:0] for f in ("sample", "position", "normal", "diffuse")
        },
    )
    expect(_albedo(empty, method)[0].shape == (0, 3), _albedo(empty, method)[0].shape)


NORMAL = (
    *each(
        "normals",
        "{}: 2400 samples of matte skin, eta {}",
        "Normals are accurate to half a degree.",
        _matte_normals,
        *combinations(NORMALS[:3], 1.0, 1.3),
    ),
    *each(
        "normals",
        "{}: all {}",
        "The normal is NaN; neighbours are unchanged.",
        _no_normals,
        *combinations(NORMALS, np.nan, 0.0),
    ),
    *each(
        "normals",
        "{}: {} light(s), {} camera",
        "The normal is NaN, or a unit vector near the scan.",
        _few_normals,
        *combinations(NORMALS, (1, 1), (3, 1)),
    ),
    *each(
        "normals",
        "{}: samples times {:g}",
        "Normals are unchanged.",
        _scaled_normals,
        *combinations(NORMALS, *SCALES),
    ),
    *each(
        "normals",
        "{}: a sample is {}",
        "One sample changes the normal by less than half a degree.",
        _one_sample_lost,
        *combinations(NORMALS[:3], np.nan, np.inf),
    ),
    Case("normals", "constant", "Normals are unit vectors or NaN.", _even_light),
    *each(
        "normals",
        "{}: no normal of the scan",
        "The normal is NaN.",
        _no_scan,
        *NORMALS[:3],
    ),
    Case(
        "normals",
        "no surfels",
        "Arrays are empty and have the right shapes.",
        _no_surfels_normals,
    ),
)
ALBEDO = (
    *each(
        "albedo",
        "{}: 2400 samples of matte skin, eta {}",
        "R_d is accurate to rounding.",
        _matte_albedo,
        *combinations(METHODS, 1.0, 1.3),
    ),
    *each(
        "albedo",
        "{}: {} light(s), {} camera",
        "R_d and its error are NaN.",
        _few_albedo,
        *combinations(METHODS, (1, 1), (3, 1)),
    ),
    *each(
        "albedo",
        "{}: all saturated",
        "R_d is NaN; neighbours are unchanged.",
        _no_albedo,
        *METHODS,
    ),
    *each(
        "albedo",
        "{}: a sample is {}",
        "One sample of 240 changes R_d by less than 1e-3.",
        _one_albedo_lost,
        *combinations(METHODS, np.nan, np.inf),
    ),
    *each(
        "albedo",
        "{}: samples times {:g}",
        "R_d is clamped to the range of eq. 5.",
        _clamped_albedo,
        *combinations(METHODS, 0.0, 1e-30, 1e3, 1e30),
    ),
    *each(
        "albedo",
        "{}: grazing lights",
        "Their samples are ignored.",
        _grazing_albedo,
        *METHODS,
    ),
    *each(
        "albedo",
        "{}: any precision",
        "Results agree to rounding.",
        _precision_albedo,
        *METHODS,
    ),
    *each(
        "albedo",
        "{}: no surfels",
        "Arrays are empty and have the right shapes.",
        _no_surfels_albedo,
        *METHODS,
    ),
)
