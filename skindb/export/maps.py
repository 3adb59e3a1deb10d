"""Texture maps of a fitted model in its texture atlas, and tangent frames as in glTF 2.0."""

from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy import ndimage

from skindb.export.inputs import chosen_size, mean_free_path, required
from skindb.geometry.atlas import atlas_values, push_pull, rasterise_atlas
from skindb.reflectance.kinds import as_mixture, even_diffuse
from skindb.render.surfels import surfel_confidence, surfel_texels, texel_codes
from skindb.schema import VARIABLES, TexelStatus, variables
from skindb.types import (
    AnyArray,
    Array,
    Faces,
    Float32,
    Float64,
    Index32,
    finite_rows,
    lengths,
    unit,
)

Image = Float32
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
TRANSLUCENCY = {
    "translucency": "translucency 1 / sigma_tr, the diffusion length",
    "mean_free_path": "mean free path with which a random walk under the skin, as of OpenPBR, "
    "spreads light as far as "
    "the dipole with this sigma_tr",
}
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
    """Texture coordinates of one model, and the triangle that covers each texel."""

    uv: Image  # (n, 2)
    triangles: Index32  # (f, 3)
    raster: tuple[Index32, Image]


def atlas_images(
    model: xr.DataTree,
    columns: dict[str, Float32],
    trust: Float32,
    *,
    size: int,
) -> tuple[Image, dict[str, int]]:
    """Texels (size, size, c) of concatenated values (n, c) at the surfels, and the
    number of channels of each name.
    """
    uv = model["fitted"].to_dataset()[variables.SURFEL_UV].values
    triangles = model["mesh"].to_dataset()[variables.TRIANGLE].values
    atlas = Atlas(uv, triangles, rasterise_atlas(uv, triangles, size))
    image, _ = _spread(np.concatenate(list(columns.values()), axis=1), trust, atlas)
    return image, {name: values.shape[1] for name, values in columns.items()}


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

        - `albedo`
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
    uv = fitted[variables.SURFEL_UV].values
    triangles = model["mesh"].to_dataset()[variables.TRIANGLE].values
    atlas = Atlas(
        uv, triangles, rasterise_atlas(uv, triangles, chosen_size(model, size))
    )
    columns, layout = _columns(fitted, triangles)
    image, confidence = _spread(columns, trust, atlas)
    status = texel_codes(surfel_texels(fitted), triangles, *atlas.raster)
    quality = {
        "confidence": _single_channel(confidence, CONFIDENCE),
        "status": _single_channel(status, STATUS),
    }
    return (
        _fitted_maps(image, layout)
        | _translucency(fitted, trust, atlas)
        | _measured(fitted, trust, atlas)
        | quality
    )


def _spread(columns: AnyArray, trust: Float32, atlas: Atlas) -> tuple[Image, Image]:
    """Texels (size, size, c), interpolated and filled in from the surroundings, and
    their confidence (size, size).
    """
    image, confidence = atlas_values(
        columns, trust, atlas.uv, atlas.triangles, atlas.raster
    )
    # texels are smoothed only if adjacent ones have a higher confidence, so that evenly
    # doubtful regions stay sharp
    surest = np.maximum(
        ndimage.maximum_filter(confidence, 3), np.finfo(np.float32).tiny
    )
    return push_pull(image, confidence / surest)[0], confidence


def _columns(
    fitted: xr.Dataset, triangles: AnyArray
) -> tuple[AnyArray, dict[str, slice]]:
    """Concatenated values (n, c) that every trusted surfel has, and the columns of each
    variable.
    """
    parts = {
        variables.DIFFUSE_REFLECTANCE: even_diffuse(fitted),
        variables.SHADING_NORMAL: fitted[variables.SHADING_NORMAL].values,
        variables.BASIS_WEIGHT: fitted[variables.BASIS_WEIGHT].values,
    }
    mesh = fitted[variables.SURFEL_NORMAL].values.astype(float)
    uv = fitted[variables.SURFEL_UV].values
    frames = tangent_frames(
        fitted[variables.SURFEL_POSITION].values, mesh, uv, triangles
    )
    parts["tangent"] = to_tangent_space(
        parts[variables.SHADING_NORMAL], mesh, frames
    ).astype(np.float32)
    layout = {}
    start = 0
    for name, part in parts.items():
        layout[name] = slice(start, start + part.shape[1])
        start += part.shape[1]
    return np.concatenate(list(parts.values()), axis=1), layout


def _translucency(
    fitted: xr.Dataset, trust: Float32, atlas: Atlas
) -> dict[str, TextureMap]:
    """Maps of the channels that are known at any trusted surfel, each filled
    separately; empty if there are none.
    """
    if variables.SIGMA_TR not in fitted:
        return {}
    sigma_tr = fitted[variables.SIGMA_TR].values
    diffuse = fitted[variables.DIFFUSE_REFLECTANCE].values
    sigma_tr = np.where(sigma_tr > 0, sigma_tr, np.nan)
    path = mean_free_path(
        diffuse, sigma_tr, eta=float(fitted[variables.REFRACTIVE_INDEX])
    ).astype(np.float32)
    values: dict[str, AnyArray] = {
        "translucency": 1 / sigma_tr,
        "mean_free_path": path,
    }
    parts = {
        name + channel: value[:, [c]]
        for name, value in values.items()
        for c, channel in enumerate("RGB")
    }
    planes = _spread_known(parts, trust, atlas)
    maps = {}
    for name, doc in TRANSLUCENCY.items():
        channels = tuple(channel for channel in "RGB" if name + channel in planes)
        if channels:
            image = np.concatenate(
                [planes[name + channel] for channel in channels], axis=-1
            )
            maps[name] = TextureMap(image, channels, "mm", doc)
    return maps


def _measured(
    fitted: xr.Dataset, trust: Float32, atlas: Atlas
) -> dict[str, TextureMap]:
    """Maps of errors and of surface reflectance, if any trusted surfel has them.

    Errors are interpolated like values, which overestimates them if the errors of
    surfels are independent.
    """
    values = {
        name: fitted[variable].values
        for name, variable in MEASURED.items()
        if variable in fitted
    }
    images = _spread_known(
        {name: value.reshape(len(trust), -1) for name, value in values.items()},
        trust,
        atlas,
    )
    maps = {}
    for name, image in images.items():
        spec = VARIABLES[MEASURED[name]]
        channels = ("R", "G", "B") if image.shape[-1] == 3 else ("Y",)
        maps[name] = TextureMap(image, channels, spec.units, spec.doc)
    return maps


def _spread_known(
    parts: dict[str, AnyArray], trust: Float32, atlas: Atlas
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
        columns = np.concatenate([parts[name] for name in names], axis=1)
        image, _ = _spread(
            columns, np.where(np.frombuffer(mask, bool), trust, np.float32(0)), atlas
        )
        ends = np.cumsum([parts[name].shape[1] for name in names])[:-1]
        images |= dict(zip(names, np.split(image, ends, axis=-1), strict=True))
    return {name: images[name] for name in parts if name in images}


def _single_channel(values: AnyArray, doc: str) -> TextureMap:
    return TextureMap(values.astype(np.float32)[..., None], ("Y",), "1", doc)


def _fitted_maps(image: Image, layout: dict[str, slice]) -> dict[str, TextureMap]:
    rgb = ("R", "G", "B")
    normal = image[..., layout[variables.SHADING_NORMAL]]
    normal = unit(normal)
    maps = {
        "albedo": TextureMap(
            image[..., layout[variables.DIFFUSE_REFLECTANCE]],
            rgb,
            "1",
            "diffuse reflectance R_d plus even_reflection of the surface",
        ),
        "normal": TextureMap(
            normal,
            rgb,
            "1",
            "unit shading normal, with x, y, z of the subject frame in R, G, B",
        ),
    }
    bent = image[..., layout["tangent"]]
    bent = unit(bent)
    doc = (
        "unit shading normal, with its parts along tangent, bitangent (towards v = 0) "
        "and normal in R, G, B"
    )
    maps["normal_tangent"] = TextureMap(bent, rgb, "1", doc)
    weights = image[..., layout[variables.BASIS_WEIGHT]]
    for k in range(weights.shape[-1]):
        maps[f"weight_{k}"] = TextureMap(
            weights[..., k : k + 1], ("Y",), "1", f"weight of component {k}"
        )
    return maps


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
    edge = corner[:, 1:] - corner[:, :1]
    step = place[:, 1:] - place[:, :1]
    area = step[:, 0, 0] * step[:, 1, 1] - step[:, 1, 0] * step[:, 0, 1]
    regular = np.abs(area) > 1e-20
    scale = np.where(regular, 1 / np.where(regular, area, 1.0), 0.0)[:, None]
    along_u = (edge[:, 0] * step[:, 1, 1:] - edge[:, 1] * step[:, 0, 1:]) * scale
    # towards decreasing v
    up = -(edge[:, 1] * step[:, 0, :1] - edge[:, 0] * step[:, 1, :1]) * scale
    along_u, up = (x / np.maximum(lengths(x)[..., None], 1e-30) for x in (along_u, up))
    sums = np.zeros((2, len(position), 3))
    for k in range(3):
        a, b = (corner[:, (k + i) % 3] - corner[:, k] for i in (1, 2))
        cosine = (a * b).sum(axis=1) / np.maximum(lengths(a) * lengths(b), 1e-30)
        angle = np.arccos(np.clip(cosine, -1, 1))[:, None]
        for total, direction in zip(sums, (along_u, up), strict=True):
            np.add.at(total, triangles[:, k], direction * angle)
    tangent = sums[0] - (sums[0] * normal).sum(axis=1, keepdims=True) * normal
    length = lengths(tangent)[..., None]
    tangent = np.where(
        length > 1e-9, tangent / np.maximum(length, 1e-9), _any_perpendicular(normal)
    )
    sign = np.where((np.cross(normal, tangent) * sums[1]).sum(axis=1) < 0, -1.0, 1.0)
    return np.concatenate([tangent, sign[:, None]], axis=1)


def to_tangent_space(direction: Array, normal: Array, tangent: Array) -> Float64:
    """Coordinates (n, 3) of directions along tangent, bitangent and normal, see
    `tangent_frames`.
    """
    bitangent = np.cross(normal, tangent[:, :3]) * tangent[:, 3:]
    return np.stack(
        [
            (direction * axis).sum(axis=1)
            for axis in (tangent[:, :3], bitangent, normal)
        ],
        axis=1,
    )


def _any_perpendicular(normal: Array) -> Float64:
    axis = np.where(np.abs(normal[:, :1]) < 0.9, [[1.0, 0, 0]], [[0.0, 1, 0]])
    tangent = np.cross(normal, axis)
    return unit(tangent)
