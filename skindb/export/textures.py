"""Textures of a material that approximates a fitted model, for glTF and USD, and the
error of the approximation.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import imagecodecs
import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import ndimage

from skindb.export.inputs import chosen_size, required
from skindb.export.maps import atlas_images, tangent_frames, to_tangent_space
from skindb.export.pbr import Material, approximation_error, fit_material
from skindb.export.translucency import thickness, transmitted_fraction
from skindb.reflectance.kinds import as_mixture
from skindb.reflectance.tables import kernel_tables
from skindb.render.image import encode_srgb
from skindb.render.texels import surfel_confidence

ERROR_POINTS = 512  # surfels on which the approximation is compared with the model
MIN_F0 = 1e-3  # reflectance at normal incidence, for the index of refraction in files
# largest fraction of transmitted diffuse light below which there is no texture for it
MIN_TRANSMITTED = 0.01


@dataclass(frozen=True)
class Skin:
    """8-bit textures, the vertices of the mesh, and constants of the material.

    `error` is the `approximation_error` of the glTF material, with
    `normal_error_degrees`, the median angle between the shading normals and those of
    the texture at the surfels. `error_of_one_index` is the error of a material with the
    same index of refraction everywhere, as in OpenPBR, and `error_of_preview` that of
    one that has no specular factor either, as UsdPreviewSurface.
    """

    # baseColor, metallicRoughness, specular, specularColor, normal, and
    # diffuseTransmission if parts are thin
    pictures: dict[str, NDArray[np.uint8]]
    shape: Shape
    top_f0: float  # reflectance at normal incidence for a white specularColor
    mean_f0: float  # mean over all points, weighted by their specular factor
    # mean over all points of what is reflected at normal incidence
    mean_reflection: float
    error: dict[str, float]
    error_of_one_index: dict[str, float]
    error_of_preview: dict[str, float]
    # largest fraction of the diffuse light at a point that comes through the skin from
    # behind
    transmitted: float

    def files(self) -> dict[str, bytes]:
        """PNG files with one quantity each: baseColor, roughness, specularFactor and normal."""
        grey = {
            "roughness": self.pictures["metallicRoughness"][..., 1],
            "specularFactor": self.pictures["specular"][..., 3],
        }
        planes = {name: self.pictures[name] for name in ("baseColor", "normal")}
        planes |= {
            name: np.repeat(value[..., None], 3, axis=-1)
            for name, value in grey.items()
        }
        return {
            name: bytes(imagecodecs.png_encode(np.ascontiguousarray(value)))
            for name, value in planes.items()
        }


def skin_of(model: xr.DataTree, *, size: int | None = None) -> Skin:
    """Fit the material of a model at every surfel, and write it into textures of `size`
    (default `texture_size`).

    Raises
    ------
    InputError
        If no surfel was fitted.
    """
    model = as_mixture(model)
    fitted = required(model)
    eta = float(fitted["refractive_index"])
    mesh = model["mesh"].to_dataset()
    trust = surfel_confidence(fitted)
    tables = kernel_tables(model["basis"].to_dataset())
    trusted = np.flatnonzero(trust > 0)
    diffuse, weights = (
        fitted[name].values[trusted] for name in ("diffuse_reflectance", "basis_weight")
    )
    skin = fit_material(tables, diffuse, weights, eta=eta)
    mean_f0 = (
        float(np.average(skin.f0, weights=skin.specular))
        if skin.specular.any()
        else float(skin.f0.mean())
    )
    reflection = max(float((skin.specular * skin.f0).mean()), MIN_F0)
    one_index = replace(skin, f0=np.full_like(skin.f0, mean_f0))
    preview = replace(
        skin, specular=np.ones_like(skin.f0), f0=np.full_like(skin.f0, reflection)
    )
    error, of_one_index, of_preview = _errors(
        tables, diffuse, weights, (skin, one_index, preview), eta=eta
    )
    shape = _shape(fitted, mesh["triangle"].values)
    top = float(max(skin.f0.max(), MIN_F0))
    through = _through(fitted, shape, trusted, eta)
    columns = _columns(skin, trusted, shape, top, through)
    images, layout = atlas_images(model, columns, trust, size=chosen_size(model, size))
    values = np.split(images, np.cumsum([*layout.values()])[:-1], axis=-1)
    pictures = _textures(dict(zip(layout, values, strict=True)))
    error["normal_error_degrees"] = _normal_error(pictures["normal"], shape, trusted)
    f0 = (top, max(mean_f0, MIN_F0), reflection)
    return Skin(
        pictures, shape, *f0, error, of_one_index, of_preview, float(through.max())
    )


def _errors(
    tables: NDArray[np.float32],
    diffuse: NDArray[Any],
    weights: NDArray[Any],
    materials: tuple[Material, ...],
    *,
    eta: float,
) -> list[dict[str, float]]:
    """`approximation_error` of each material, at some of the points."""
    chosen = np.linspace(0, len(diffuse) - 1, min(ERROR_POINTS, len(diffuse))).astype(
        int
    )
    samples = [
        Material(*(getattr(material, part.name)[chosen] for part in fields(material)))
        for material in materials
    ]
    return [
        approximation_error(tables, diffuse[chosen], weights[chosen], material, eta=eta)
        for material in samples
    ]


@dataclass(frozen=True)
class Shape:
    """Vertices of the mesh, one for each surfel."""

    position: NDArray[np.float32]  # (n, 3) mm
    normal: NDArray[np.float64]  # (n, 3) of the mesh
    shading: NDArray[np.float64]  # (n, 3) as fitted
    tangent: NDArray[np.float64]  # (n, 4)
    uv: NDArray[np.float32]  # (n, 2)
    triangles: NDArray[Any]


def _shape(fitted: xr.Dataset, triangles: NDArray[Any]) -> Shape:
    place = fitted["surfel_position"].values
    uv = fitted["surfel_uv"].values.astype(np.float32)
    normal, shading = (
        _unit(fitted, name) for name in ("surfel_normal", "shading_normal")
    )
    tangent = tangent_frames(place, normal, uv, triangles)
    return Shape(place.astype(np.float32), normal, shading, tangent, uv, triangles)


def _through(
    fitted: xr.Dataset, shape: Shape, known: NDArray[np.int64], eta: float
) -> NDArray[np.float64]:
    """Fraction of the diffuse light (n, 3) at the known surfels that comes through the
    skin from the other side.
    """
    if "sigma_tr" not in fitted:
        return np.zeros((len(known), 3))
    diffuse, sigma_tr = (
        fitted[name].values[known] for name in ("diffuse_reflectance", "sigma_tr")
    )
    deep = thickness(shape.position.astype(np.float64), shape.normal, shape.triangles)[
        known
    ]
    return np.asarray(
        transmitted_fraction(deep, diffuse, sigma_tr, eta=eta), np.float64
    )


def _columns(
    skin: Material,
    known: NDArray[np.int64],
    shape: Shape,
    top: float,
    through: NDArray[np.float64],
) -> dict[str, NDArray[np.float32]]:
    """Values (n, c) of the textures at every surfel; 0 where nothing was fitted."""

    def spread(values: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        out = np.zeros((len(shape.position), values.shape[1]), np.float32)
        out[known] = values
        return out

    bent = to_tangent_space(shape.shading, shape.normal, shape.tangent)
    columns = {
        "base": spread(skin.base_color),
        "roughness": spread(skin.roughness[:, None]),
        "specular": spread(skin.specular[:, None]),
        "f0": spread(np.minimum(skin.f0 / top, 1.0)[:, None]),
        "bent": spread(bent[known]),
    }
    # strength times colour is `through` times the base colour
    if through.max() >= MIN_TRANSMITTED:
        strength = through.max(axis=1, keepdims=True)
        columns["strength"] = spread(strength / through.max())
        columns["passed"] = spread(
            skin.base_color * through / np.maximum(strength, 1e-12)
        )
    return columns


def _textures(values: dict[str, NDArray[np.float32]]) -> dict[str, NDArray[np.uint8]]:
    """8-bit textures, by their name in the material."""
    full = np.full(values["roughness"].shape, 255, np.uint8)
    bent = values["bent"] / np.maximum(
        np.linalg.norm(values["bent"], axis=-1, keepdims=True), 1e-9
    )
    pictures = {
        "baseColor": _eight_bits(encode_srgb(values["base"])),
        "metallicRoughness": np.concatenate(
            [full, _eight_bits(values["roughness"]), 0 * full], axis=-1
        ),
        "specular": np.concatenate(
            [full, full, full, _eight_bits(values["specular"])], axis=-1
        ),
        "specularColor": np.repeat(_eight_bits(encode_srgb(values["f0"])), 3, axis=-1),
        "normal": _eight_bits(0.5 * bent + 0.5),
    }
    if "passed" in values:
        colour = _eight_bits(encode_srgb(values["passed"]))
        strength = _eight_bits(values["strength"])
        pictures["diffuseTransmission"] = np.concatenate([colour, strength], axis=-1)
    return pictures


def _eight_bits(values: NDArray[Any]) -> NDArray[np.uint8]:
    return np.asarray(np.round(np.clip(values, 0, 1) * 255), np.uint8)


def _normal_error(
    picture: NDArray[np.uint8], shape: Shape, known: NDArray[np.int64]
) -> float:
    """Median angle [degree] between the shading normals and those of the texture at the surfels."""
    size = len(picture)
    places = (shape.uv[known].astype(np.float64) * size - 0.5)[:, ::-1].T
    bent = np.stack(
        [
            ndimage.map_coordinates(
                picture[..., c] / 127.5 - 1, places, order=1, mode="nearest"
            )
            for c in range(3)
        ],
        1,
    )
    normal = shape.normal[known]
    tangent = shape.tangent[known]
    bitangent = np.cross(normal, tangent[:, :3]) * tangent[:, 3:]
    normals = (
        bent[:, :1] * tangent[:, :3] + bent[:, 1:2] * bitangent + bent[:, 2:] * normal
    )
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    cosine = np.clip((normals * shape.shading[known]).sum(axis=1), -1, 1)
    return float(np.degrees(np.median(np.arccos(cosine))))


def _unit(fitted: xr.Dataset, name: str) -> NDArray[np.float64]:
    """Unit normals (n, 3) in a variable; those of the scan where they are unknown."""
    normal = fitted[name].values.astype(np.float64)
    normal = np.where(
        np.isfinite(normal).all(axis=1, keepdims=True),
        normal,
        fitted["surfel_normal"].values,
    )
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.where(length > 1e-6, normal / np.maximum(length, 1e-6), [0.0, 0.0, 1.0])


def shading_normals(fitted: xr.Dataset) -> NDArray[np.float64]:
    """Unit shading normals (n, 3) of the surfels; those of the scan where they are unknown."""
    return _unit(fitted, "shading_normal")
