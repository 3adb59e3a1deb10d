"""Texture maps of a fitted model, laid out by its atlas."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.geometry.texture import push_pull, rasterise_atlas
from skindb.schema import FitStatus, check

Image = NDArray[np.float32]
REQUIRED = ("surfel_uv", "shading_normal", "diffuse_reflectance", "reduced_weight", "fit_status", "fit_residual")
TRUSTED = {FitStatus.FITTED: 1.0, FitStatus.DIFFUSE_CLAMPED: 0.5, FitStatus.NOT_CONVERGED: 0.5}


@dataclass(frozen=True)
class TextureMap:
    """One map: values (size, size, c), the names of its channels, its unit and what it holds."""

    values: Image
    channels: tuple[str, ...]
    units: str
    doc: str


def texture_maps(model: xr.DataTree, *, size: int = 1024) -> dict[str, TextureMap]:
    """Albedo, normal, component weights, translucency and confidence as maps.

    Parameters
    ----------
    model
        Version of kind "model".
    size
        Texels along each side; texel (i, j) has its centre at v = (i + 0.5) / size, u = (j + 0.5) / size.

    Returns
    -------
    dict
        `albedo`, `normal` (unit vectors of the subject frame), `weight_<k>` per component, `translucency`
        (1 / sigma_tr, only where the model has it) and `confidence`: 1 where a texel lies between fitted surfels, lower
        towards doubtful ones, 0 where values were only filled in from around (push-pull).
    """
    fitted = model["fitted"].to_dataset()
    check(fitted, REQUIRED, where="fitted")
    triangles = model["mesh"].to_dataset()["triangle"].values
    face, barycentric = rasterise_atlas(fitted["surfel_uv"].values, triangles, size)
    trust = surfel_confidence(fitted)
    columns, layout = _columns(fitted, trust > 0)
    inside = face >= 0
    corners = triangles[face[inside]]
    share = barycentric[inside] * trust[corners]  # unfitted corners weigh nothing
    total = share.sum(axis=1)
    confidence = np.zeros((size, size), np.float32)
    confidence[inside] = total
    image = np.zeros((size, size, columns.shape[1]), np.float32)
    mixed = np.einsum("tk,tkc->tc", share, columns[corners]) / np.maximum(total, 1e-6)[:, None]
    image[inside] = np.where(total[:, None] > 0, mixed, 0)
    filled, _ = push_pull(image, confidence)
    return _named(np.asarray(filled, np.float32), confidence, layout)


def surfel_confidence(fitted: xr.Dataset) -> NDArray[np.float32]:
    """(n,) 1 for fitted surfels, 0.5 for doubtful ones (clamped, not converged), 0 for the rest."""
    status = fitted["fit_status"].values
    trust = np.zeros(status.shape, np.float32)
    for member, value in TRUSTED.items():
        trust[status == member] = value
    for name in ("shading_normal", "diffuse_reflectance", "reduced_weight"):
        trust[~np.isfinite(fitted[name].values).all(axis=1)] = 0
    if not trust.any():
        raise InputError(Fault("fitted[fit_status]", "an export needs fitted surfels", "none", "see the fit's report"))
    return trust


def _columns(fitted: xr.Dataset, trusted: NDArray[np.bool_]) -> tuple[NDArray[Any], dict[str, slice]]:
    """Everything that is interpolated, side by side, and where it lies."""
    parts = {name: fitted[name].values for name in ("diffuse_reflectance", "shading_normal", "reduced_weight")}
    if "effective_transport" in fitted and np.isfinite(fitted["effective_transport"].values[trusted]).all():
        parts["translucency"] = 1 / fitted["effective_transport"].values
    layout, start = {}, 0
    for name, part in parts.items():
        layout[name] = slice(start, start + part.shape[1])
        start += part.shape[1]
    columns = np.concatenate(list(parts.values()), axis=1).astype(np.float32)
    return np.where(trusted[:, None], columns, 0), layout


def _named(image: Image, confidence: Image, layout: dict[str, slice]) -> dict[str, TextureMap]:
    rgb = ("R", "G", "B")
    normal = image[..., layout["shading_normal"]]
    normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    maps = {
        "albedo": TextureMap(image[..., layout["diffuse_reflectance"]], rgb, "1", "diffuse reflectance R_d"),
        "normal": TextureMap(normal, rgb, "1", "unit shading normal, x y z of the subject frame in R G B"),
    }
    weights = image[..., layout["reduced_weight"]]
    for k in range(weights.shape[-1]):
        maps[f"weight_{k}"] = TextureMap(weights[..., k : k + 1], ("Y",), "1", f"weight of component {k}")
    if "translucency" in layout:
        doc = "translucency 1 / sigma_tr, the diffusion length"
        maps["translucency"] = TextureMap(image[..., layout["translucency"]], rgb, "mm", doc)
    doc = "1 between fitted surfels, less towards doubtful ones, 0 where values are filled in from around"
    maps["confidence"] = TextureMap(confidence[..., None], ("Y",), "1", doc)
    return maps
