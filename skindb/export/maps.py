"""Texture maps of a fitted model in its texture atlas, and tangent frames as in glTF 2.0."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy import ndimage
from scipy.sparse import csr_array
from skimage.transform import resize

from skindb.export.inputs import chosen_size, mean_free_path, required
from skindb.geometry.atlas import atlas_values, push_pull, rasterise_atlas
from skindb.geometry.interreflection import tangent_frames as perpendicular_frames
from skindb.reflectance.kinds import as_mixture, even_diffuse
from skindb.render.surfels import surfel_confidence, surfel_texels, texel_codes
from skindb.schema import VARIABLES, TexelStatus, fitted_of, variables
from skindb.types import (
    AnyArray,
    Array,
    Faces,
    Float32,
    Float64,
    Index32,
    dots,
    finite_rows,
    lengths,
    unit,
)

Image = Float32
# values (n, c) at the surfels, which may be unknown in some channels, unit and description
Layer = tuple[AnyArray, str, str]
RGB = ("R", "G", "B")
MEASURED = {  # map: variable of the model; edited models have none of these
    "albedo_error": variables.DIFFUSE_REFLECTANCE_TOTAL_ERROR,
    "normal_error": variables.NORMAL_TOTAL_ERROR,
    "surface_reflectance": variables.SURFACE_REFLECTANCE,
    "surface_reflectance_error": variables.SURFACE_REFLECTANCE_ERROR,
}
CONFIDENCE = (
    "1 between fitted surfels, less towards doubtful ones, 0 where values are filled "
    "in from the surroundings"
)
STATUS = "; ".join(f"{int(code)} {code.explanation}" for code in TexelStatus)


@dataclass(frozen=True)
class TextureMap:
    """One map: values (size, size, c), the names of its channels, its unit and a description."""

    values: Image
    channels: tuple[str, ...]
    units: str
    doc: str


@dataclass(frozen=True)
class Atlas:
    """The triangles of one model (f, 3), and the triangle that covers each texel."""

    triangles: Index32
    raster: tuple[Index32, Image]

    @classmethod
    def of(cls, model: xr.DataTree, size: int) -> Atlas:
        """The atlas of a model with `size` texels along each side."""
        uv = fitted_of(model)[variables.SURFEL_UV].values
        triangles = model["mesh"].dataset[variables.TRIANGLE].values
        return cls(triangles, rasterise_atlas(uv, triangles, size))

    def confidence(self, trust: Float32) -> Image:
        """Mean trust (size, size) of the corners in each texel."""
        return atlas_values(trust[:, None], trust, self.triangles, self.raster)[1]

    def spread(self, columns: AnyArray, trust: Float32) -> Image:
        """Texels (size, size, c) of values (n, c), interpolated and filled in from the
        surroundings.
        """
        image, confidence = atlas_values(columns, trust, self.triangles, self.raster)
        # texels are smoothed only if adjacent ones have a higher confidence, so that
        # evenly doubtful regions stay sharp
        tiny = np.finfo(np.float32).tiny
        surest = np.maximum(ndimage.maximum_filter(confidence, 3), tiny)
        return push_pull(image, confidence / surest)

    def spread_known(
        self, parts: Mapping[str, AnyArray], trust: Float32
    ) -> dict[str, Image]:
        """Texels (size, size, c) by name of values (n, c), each from the trusted surfels
        where it is finite.

        Names that are known nowhere are omitted. Those that are known at the same surfels
        are processed together, as triangles take more time than values.
        """
        together: dict[bytes, list[str]] = {}
        for name, values in parts.items():
            finite = finite_rows(values) & (trust > 0)
            if finite.any():
                together.setdefault(finite.tobytes(), []).append(name)
        images: dict[str, Image] = {}
        for mask, names in together.items():
            known = np.where(np.frombuffer(mask, bool), trust, np.float32(0))
            columns = np.concatenate([parts[name] for name in names], axis=1)
            ends = np.cumsum([parts[name].shape[1] for name in names])[:-1]
            planes = np.split(self.spread(columns, known), ends, axis=-1)
            images |= dict(zip(names, planes, strict=True))
        return {name: images[name] for name in parts if name in images}


def texel_detail(
    model: xr.DataTree, atlas: Atlas, axes: Float64, trust: Float32
) -> dict[str, Image]:
    """What the detail of a model does to its maps (size, size, 3): "albedo" is a factor;
    "normal" and "normal_tangent" are added. Empty without detail.

    `axes` are the `tangent_axes` (n, 3, 3) of the surfels.
    """
    if "detail" not in model.children:
        return {}
    maps = model["detail"].dataset
    size = atlas.raster[0].shape
    albedo, normal = (
        resize(maps[name].values.astype(np.float32), size, anti_aliasing=True)
        for name in (variables.DIFFUSE_DETAIL, variables.NORMAL_DETAIL)
    )
    frames = atlas.spread(axes.reshape(-1, 9), trust).reshape(*size, 3, 3)
    turned = np.einsum("vukc,vuc->vuk", frames, normal)
    return {"albedo": 1 + albedo, "normal": normal, "normal_tangent": turned}


def texture_maps(
    model: xr.DataTree, *, size: int | None = None
) -> dict[str, TextureMap]:
    """Texture maps of albedo, normals, weights of components, translucency, confidence and status.

    Parameters
    ----------
    model
        Version of kind "model".
    size
        Texels along each side, default `texture_size`; texel (i, j) has its centre at v
        = (i + 0.5) / size and u = (j + 0.5) / size.

    Returns
    -------
    dict
        Maps by name:

        - `albedo`, like the normals with the detail of texels if the model has it
        - `normal`: unit vectors in the subject frame
        - `normal_tangent`: the same in the tangent frames of the mesh, see `tangent_frames`
        - `weight_<k>` per component
        - `translucency`: 1 / sigma_tr, of the channels in which the model has it
        - `mean_free_path`: for renderers that trace random walks under the skin, of the
          same channels
        - `confidence`: 1 between fitted surfels, lower towards doubtful ones, 0 where
          values are filled in from the surroundings (push-pull)
        - `status`: the reason, as a code of `skindb.schema.TexelStatus`
        - if the model has them, `albedo_error`, `normal_error` [degree] (both include
          the error of the model), `surface_reflectance` and `surface_reflectance_error`
    """
    model = as_mixture(model)
    fitted = required(model)
    trust = surfel_confidence(fitted)
    atlas = Atlas.of(model, chosen_size(model, size))
    layers = _layers(fitted, atlas.triangles)
    columns = {
        f"{name} {channel}": column[:, None]
        for name, (values, _, _) in layers.items()
        for channel, column in zip(_channels(values), values.T, strict=True)
    }
    images = atlas.spread_known(columns, trust)
    detail = texel_detail(model, atlas, _surfel_axes(fitted, atlas.triangles), trust)
    maps = {}
    for name, (values, units, doc) in layers.items():
        channels = tuple(c for c in _channels(values) if f"{name} {c}" in images)
        if channels:
            planes = np.concatenate([images[f"{name} {c}"] for c in channels], axis=-1)
            if name == "albedo":
                planes = planes * detail.get(name, 1)
            if name in ("normal", "normal_tangent"):
                planes = unit(planes + detail.get(name, 0))
            maps[name] = TextureMap(planes, channels, units, doc)
    status = texel_codes(surfel_texels(fitted), atlas.triangles, *atlas.raster)
    for name, plane, doc in (
        ("confidence", atlas.confidence(trust), CONFIDENCE),
        ("status", status.astype(np.float32), STATUS),
    ):
        maps[name] = TextureMap(plane[..., None], ("Y",), "1", doc)
    return maps


def _channels(values: AnyArray) -> tuple[str, ...]:
    """Names of the channels of values (n, c)."""
    return RGB if values.shape[1] == 3 else ("Y",)


def _layers(fitted: xr.Dataset, triangles: AnyArray) -> dict[str, Layer]:
    """What each map shows.

    Errors are interpolated like values, which overestimates them if the errors of
    surfels are independent.
    """
    shading = fitted[variables.SHADING_NORMAL].values
    axes = _surfel_axes(fitted, triangles)
    layers = {
        "albedo": (
            even_diffuse(fitted),
            "1",
            "diffuse reflectance R_d plus even_reflection of the surface",
        ),
        "normal": (
            shading,
            "1",
            "unit shading normal, with x, y, z of the subject frame in R, G, B",
        ),
        "normal_tangent": (
            np.einsum("nkc,nc->nk", axes, shading).astype(np.float32),
            "1",
            "unit shading normal, with its parts along tangent, bitangent (towards "
            "v = 0) and normal in R, G, B",
        ),
    }
    for k, weight in enumerate(fitted[variables.BASIS_WEIGHT].values.T):
        layers[f"weight_{k}"] = (weight[:, None], "1", f"weight of component {k}")
    if variables.SIGMA_TR in fitted:
        sigma_tr = fitted[variables.SIGMA_TR].values
        sigma_tr = np.where(sigma_tr > 0, sigma_tr, np.nan)
        diffuse = fitted[variables.DIFFUSE_REFLECTANCE].values
        eta = float(fitted[variables.REFRACTIVE_INDEX])
        layers["translucency"] = (
            1 / sigma_tr,
            "mm",
            "translucency 1 / sigma_tr, the diffusion length",
        )
        layers["mean_free_path"] = (
            mean_free_path(diffuse, sigma_tr, eta=eta).astype(np.float32),
            "mm",
            "mean free path with which a random walk under the skin, as of OpenPBR, "
            "spreads light as far as the dipole with this sigma_tr",
        )
    for name, variable in MEASURED.items():
        if variable in fitted:
            spec = VARIABLES[variable]
            values = fitted[variable].values.reshape(len(shading), -1)
            layers[name] = (values, spec.units, spec.doc)
    return layers


def _surfel_axes(fitted: xr.Dataset, triangles: AnyArray) -> Float64:
    """`tangent_axes` (n, 3, 3) of the surfels, with the normals of the mesh."""
    position = fitted[variables.SURFEL_POSITION].values
    normal = fitted[variables.SURFEL_NORMAL].values.astype(float)
    uv = fitted[variables.SURFEL_UV].values
    return tangent_axes(normal, tangent_frames(position, normal, uv, triangles))


def tangent_frames(
    position: Array, normal: Array, uv: Array, triangles: Faces
) -> Float64:
    """Tangents (n, 4) of vertices: unit vectors in the direction of increasing u, and
    the sign of the bitangent.

    The bitangent is sign * cross(normal, tangent) and points towards the top of the
    texture, where v = 0 (glTF 2.0, section 3.7.2.1). Tangents of triangles are averaged
    with their angles as weights, as in MikkTSpace.

    Parameters
    ----------
    position, normal, uv
        (n, 3), unit vectors (n, 3) and (n, 2) of the vertices; v = 0 is the top row of the texture.
    triangles
        (f, 3) indices of vertices.
    """
    corner = position[triangles].astype(float)
    place = uv[triangles].astype(float)
    first, second = (corner[:, i] - corner[:, 0] for i in (1, 2))
    one, other = (place[:, i] - place[:, 0] for i in (1, 2))
    area = one[:, 0] * other[:, 1] - other[:, 0] * one[:, 1]
    side = np.where(np.abs(area) > 1e-20, np.sign(area), 0.0)[:, None]
    along_u = side * (first * other[:, 1:] - second * one[:, 1:])
    # towards decreasing v
    up = side * (first * other[:, :1] - second * one[:, :1])
    after, before = (
        unit(np.roll(corner, k, axis=1) - corner).reshape(-1, 3) for k in (-1, 1)
    )
    angle = np.arccos(np.clip(dots(after, before), -1, 1))
    index = (triangles.ravel(), np.repeat(np.arange(len(triangles)), 3))
    at_vertices = csr_array((angle, index), shape=(len(position), len(triangles)))
    total, upwards = (at_vertices @ unit(x) for x in (along_u, up))
    tangent = total - dots(total, normal)[:, None] * normal
    is_clear = lengths(tangent)[:, None] > 1e-9
    tangent = np.where(is_clear, unit(tangent), perpendicular_frames(normal)[:, 0])
    sign = np.where(dots(np.cross(normal, tangent), upwards) < 0, -1.0, 1.0)
    return np.concatenate([tangent, sign[:, None]], axis=1)


def tangent_axes(normal: Array, tangent: Array) -> Float64:
    """Tangent, bitangent and normal (n, 3, 3), one per row, see `tangent_frames`. Their
    products with a direction are its coordinates in the tangent frame.
    """
    bitangent = np.cross(normal, tangent[:, :3]) * tangent[:, 3:]
    return np.stack([tangent[:, :3], bitangent, normal], axis=1)
