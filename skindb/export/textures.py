"""Material that approximates a fitted model, for glTF and USD: its fit, its textures, and the
error of the approximation.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import imagecodecs
import numpy as np
import xarray as xr
from scipy import ndimage

from skindb.export.inputs import chosen_size, required
from skindb.export.maps import Atlas, tangent_frames, to_tangent_space
from skindb.optics.angles import directions
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance.kinds import as_mixture, even_diffuse
from skindb.reflectance.tables import kernel_tables, lookup
from skindb.render.image import encode_srgb
from skindb.render.surfels import surfel_confidence
from skindb.schema import variables
from skindb.types import (
    AnyArray,
    Array,
    Bytes,
    Float32,
    Float64,
    Index,
    float64,
    lengths,
    unit,
)

# values of perceptual roughness that are tried for each point
ROUGHNESS = np.linspace(0.1, 1.0, 46)
# of fitting lobe and base colour in turn; after the third, the error changes by less
# than 1 % of itself
ROUNDS = 4
MAX_F0 = 0.3  # reflectance at normal incidence, for an index of refraction of 3.4
# of points without a highlight; the reflectance of the dielectric of glTF, index 1.5
DEFAULT_F0 = 0.04
ERROR_POINTS = 512  # surfels on which the approximation is compared with the model
MIN_F0 = 1e-3  # reflectance at normal incidence, for the index of refraction in files


@dataclass(frozen=True)
class Material:
    """Parameters of the glTF material with KHR_materials_specular at points."""

    base_color: Array  # (n, 3) linear, 0 to 1
    specular: Array  # (n,) factor on all reflection, 0 to 1
    f0: Array  # (n,) reflectance at normal incidence, before that factor
    roughness: Array  # (n,) perceptual; alpha is its square


@dataclass(frozen=True)
class _Pairs:
    """Pairs of directions above the horizon in the local frame, uniform in the
    coordinates of the tables.
    """

    angles: tuple[Array, Array, Array]
    cos_i: Array
    cos_o: Array
    cos_h: Array
    cos_d: Array
    weight: Array  # solid angles of light and camera times cos_o, as in a picture


def fit_material(
    tables: Float32, diffuse: Array, weights: Array, *, eta: float
) -> Material:
    """Fit the material whose pictures differ least from those of the model, separately
    at each point.

    The reflectance of the material is base / pi + (lobe - base / pi) (a + b rise), with
    a GGX lobe, the term `rise` of Schlick, a = specular * f0 and a + b = specular. It
    is linear in the base colour and in (a, b). These are found by least squares in
    turn; (a, b) is found for every roughness, and the best roughness is chosen. The fit
    is over lights and cameras in all directions, weighted by the area that a pixel
    sees.

    Parameters
    ----------
    tables
        (nh, nd, np, k) sr^-1.
    diffuse, weights
        (n, 3) and (n, k) at points of the surface.
    eta
        Refractive index of the diffuse term of skin.
    """
    pairs = _pairs()
    through = (
        fresnel_transmittance(pairs.cos_i, eta)
        * fresnel_transmittance(pairs.cos_o, eta)
        / np.pi
    )
    parts = np.concatenate([through[:, None], lookup(tables, *pairs.angles)], axis=1)
    amounts = np.stack(
        [np.concatenate([diffuse[:, [c]], weights], axis=1) for c in range(3)]
    ).astype(float)
    base: Array = float64(diffuse)
    low: Array
    high: Array
    roughness: Array
    low = high = np.zeros(len(base))
    roughness = np.full(len(base), 0.5)
    for _ in range(ROUNDS):
        low, high, roughness = _fit_lobe(pairs, parts, amounts, base)
        base = _fit_base(pairs, parts, amounts, low, high, roughness)
    specular = low + high
    f0 = np.where(specular > 0, low / np.where(specular > 0, specular, 1.0), DEFAULT_F0)
    return Material(base, specular, f0, roughness)


def _fit_lobe(
    pairs: _Pairs, parts: Array, amounts: Array, base: Array
) -> tuple[Array, Array, Array]:
    """a, b and roughness (n,) for base colours (n, 3), where the model is `amounts` (3,
    n, m) of `parts` (pairs, m).
    """
    use = pairs.weight * pairs.cos_i**2
    rise = (1 - pairs.cos_d) ** 5
    matt = np.stack([np.ones_like(rise), rise], axis=1) / np.pi
    of_matt = parts.T @ (use[:, None] * matt)
    parameters = np.zeros((len(base), 3))
    best = np.full(len(base), -np.inf)
    for roughness in ROUGHNESS:
        lobe = _ggx(
            np.full((1, 1), roughness**4), pairs.cos_i, pairs.cos_o, pairs.cos_h
        )[0]
        gloss = lobe[:, None] * matt * np.pi
        squares = [
            a.T @ (use[:, None] * b)
            for a, b in ((gloss, gloss), (gloss, matt), (matt, matt))
        ]
        of_gloss = parts.T @ (use[:, None] * gloss)
        flat_gloss = (matt[:, 0] * use) @ gloss
        flat_matt = (matt[:, 0] * use) @ matt
        gram = np.zeros((len(base), 2, 2))
        rhs = np.zeros((len(base), 2))
        for c in range(3):  # the three channels share the lobe
            colour = base[:, c, None]
            cross = squares[1] + squares[1].T
            gram += (
                squares[0]
                - colour[..., None] * cross
                + (colour**2)[..., None] * squares[2]
            )
            rhs += (
                amounts[c] @ of_gloss
                - colour * flat_gloss
                - colour * (amounts[c] @ of_matt - colour * flat_matt)
            )
        x, gain = _best_pair(gram, rhs)
        better = gain > best
        best[better] = gain[better]
        parameters[better] = np.column_stack([x, np.full(len(x), roughness)])[better]
    return parameters[:, 0], parameters[:, 1], parameters[:, 2]


def _best_pair(gram: Array, rhs: Array) -> tuple[Array, Array]:
    """Pairs x >= 0 (n, 2) that minimise x G x - 2 x r, and the decrease (n,).

    The constraints are that the sum of x is at most 1, and f0 at most MAX_F0.
    """
    a = gram[:, 0, 0]
    b = gram[:, 0, 1]
    d = gram[:, 1, 1]
    p, q = rhs.T
    zero = np.zeros_like(p)
    determinant = np.maximum(a * d - b * b, 1e-30)
    slope = np.maximum(a - 2 * b + d, 1e-30)
    # first element of x on the edge where the sum is 1
    edge = np.clip((p - q - b + d) / slope, 0, MAX_F0)
    ratio = (1 - MAX_F0) / MAX_F0  # second over first element of x where f0 is MAX_F0
    ray = np.clip(
        (p + ratio * q) / np.maximum(a + 2 * b * ratio + d * ratio**2, 1e-30), 0, MAX_F0
    )
    candidates = [
        ((d * p - b * q) / determinant, (a * q - b * p) / determinant),
        (ray, ratio * ray),
        (zero, np.clip(q / np.maximum(d, 1e-30), 0, 1)),
        (edge, 1 - edge),
    ]
    best = np.zeros_like(rhs)
    gain = zero.copy()
    for x, y in candidates:
        fall = 2 * (x * p + y * q) - (a * x * x + 2 * b * x * y + d * y * y)
        better = (
            (x >= 0)
            & (y >= ratio * x * (1 - 1e-9))
            & (x + y <= 1 + 1e-9)
            & (fall > gain)
        )
        gain[better] = fall[better]
        best[better] = np.stack([x, y], axis=1)[better]
    return best, gain


def _fit_base(
    pairs: _Pairs,
    parts: Array,
    amounts: Array,
    low: Array,
    high: Array,
    roughness: Array,
) -> Array:
    """Base colours (n, 3), from 0 to 1, for given lobes (n,)."""
    use = pairs.weight * pairs.cos_i**2
    rise = (1 - pairs.cos_d) ** 5
    moment = [float((use * rise**i).sum()) / np.pi**2 for i in range(3)]
    # 1 - F = constant + slope rise
    constant = 1 - low
    slope = -high
    square = (
        constant**2 * moment[0]
        + 2 * constant * slope * moment[1]
        + slope**2 * moment[2]
    )
    of_flat, of_rise = (
        parts.T @ (use * factor) / np.pi for factor in (np.ones_like(rise), rise)
    )
    gloss = np.zeros((len(low), 3))
    for value in np.unique(roughness):
        lobe = (
            _ggx(np.full((1, 1), value**4), pairs.cos_i, pairs.cos_o, pairs.cos_h)[0]
            * use
            / np.pi
        )
        gloss[roughness == value] = [float((lobe * rise**i).sum()) for i in range(3)]
    shine = low * (constant * gloss[:, 0] + slope * gloss[:, 1]) + high * (
        constant * gloss[:, 1] + slope * gloss[:, 2]
    )
    seen = constant * (amounts @ of_flat) + slope * (amounts @ of_rise) - shine
    return np.asarray(np.clip(seen / np.maximum(square, 1e-12), 0, 1).T)


def approximation_error(
    tables: Float32,
    diffuse: Array,
    weights: Array,
    values: Material,
    *,
    eta: float,
) -> dict[str, float]:
    """Relative RMS difference of f_r cos between the model and the material, over
    points and directions.

    Parameters
    ----------
    tables
        (nh, nd, np, k) sr^-1.
    diffuse, weights
        (n, 3) and (n, k) at points of the surface.
    values
        Material at these points.
    eta
        Refractive index of the diffuse term of skin.

    Returns
    -------
    dict
        `relative_rms` and `relative_rms_perceptual` (in cube-root space) over lights
        and cameras in all directions above the surface, weighted by the area that a
        pixel sees.
    """
    pairs = _pairs()
    through = (
        fresnel_transmittance(pairs.cos_i, eta)
        * fresnel_transmittance(pairs.cos_o, eta)
        / np.pi
    )
    ours = (
        diffuse[:, None, :] * through[:, None]
        + (weights @ lookup(tables, *pairs.angles).T)[..., None]
    )
    theirs = gltf_brdf(values, pairs.cos_i, pairs.cos_o, pairs.cos_h, pairs.cos_d)
    ours = ours * pairs.cos_i[:, None]
    theirs = theirs * pairs.cos_i[:, None]
    return {
        "relative_rms": _relative(ours, theirs, pairs.weight),
        "relative_rms_perceptual": _relative(
            np.cbrt(ours), np.cbrt(theirs), pairs.weight
        ),
    }


def gltf_brdf(
    values: Material, cos_i: Array, cos_o: Array, cos_h: Array, cos_d: Array
) -> Array:
    """BRDF (n, directions, 3) of the material, by the equations of glTF 2.0, appendix
    B, and KHR_materials_specular.

    Parameters
    ----------
    values
        Material at n points.
    cos_i, cos_o, cos_h, cos_d
        Cosines (directions,) between the normal and light, camera and half vector, and
        between light and half vector.
    """
    f0 = np.asarray(values.f0)[:, None]
    fresnel = np.asarray(values.specular)[:, None] * (f0 + (1 - f0) * (1 - cos_d) ** 5)
    a2 = (np.asarray(values.roughness)[:, None]) ** 4
    gloss = fresnel * _ggx(a2, cos_i, cos_o, cos_h)
    return np.asarray(
        (1 - fresnel)[..., None] * values.base_color[:, None, :] / np.pi
        + gloss[..., None]
    )


def _relative(ours: Array, theirs: Array, weight: Array) -> float:
    off, all_of_it = (
        (weight[:, None] * values**2).sum() for values in (ours - theirs, ours)
    )
    return (
        float(np.sqrt(off / all_of_it)) if all_of_it > 0 else 0.0
    )  # for a black model, the material reflects nothing either


def _pairs() -> _Pairs:
    theta_h = (np.arange(45) + 0.5) ** 2 / 45**2 * np.pi / 2
    theta_d = np.radians(np.arange(4, 88, 7.0))
    phi_d = np.radians(np.arange(15, 180, 30.0))
    angles = tuple(
        x.ravel() for x in np.meshgrid(theta_h, theta_d, phi_d, indexing="ij")
    )
    wi, wo = directions(*angles)
    above = (wi[:, 2] > 0.05) & (wo[:, 2] > 0.05)
    h, d, p = (x[above] for x in angles)
    cos_i = wi[above, 2]
    cos_o = wo[above, 2]
    # d omega_i d omega_o = 4 cos(theta_d) d omega_h d omega_d, d theta_h = 2
    # sqrt(theta_h) d sqrt(theta_h)
    weight = np.cos(d) * np.sin(d) * np.sin(h) * np.sqrt(h) * cos_o
    return _Pairs((h, d, p), cos_i, cos_o, np.cos(h), np.cos(d), weight)


def _ggx(a2: Array, cos_i: Array, cos_o: Array, cos_h: Array) -> Array:
    """GGX distribution with Smith's separable masking, divided by 4 cos_i cos_o (glTF
    2.0, appendix B).
    """
    spread = a2 / (np.pi * (cos_h**2 * (a2 - 1) + 1) ** 2)
    masking = [1 / (c + np.sqrt(a2 + (1 - a2) * c * c)) for c in (cos_i, cos_o)]
    return np.asarray(spread * masking[0] * masking[1])


@dataclass(frozen=True)
class Skin:
    """8-bit textures, the vertices of the mesh, and constants of the material.

    `error` is the `approximation_error` of the glTF material, with
    `normal_error_degrees`, the median angle between the shading normals and those of
    the texture at the surfels. `error_of_one_index` is the error of a material with the
    same index of refraction everywhere, as in OpenPBR, and `error_of_preview` that of
    one that has no specular factor either, as UsdPreviewSurface.
    """

    # baseColor, metallicRoughness, specular, specularColor and normal
    pictures: dict[str, Bytes]
    shape: Shape
    top_f0: float  # reflectance at normal incidence for a white specularColor
    mean_f0: float  # mean over all points, weighted by their specular factor
    # mean over all points of what is reflected at normal incidence
    mean_reflection: float
    error: dict[str, float]
    error_of_one_index: dict[str, float]
    error_of_preview: dict[str, float]

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
    eta = float(fitted[variables.REFRACTIVE_INDEX])
    mesh = model["mesh"].to_dataset()
    trust = surfel_confidence(fitted)
    tables = kernel_tables(model["basis"].to_dataset())
    trusted = np.flatnonzero(trust > 0)
    diffuse = even_diffuse(fitted)[trusted]
    weights = fitted[variables.BASIS_WEIGHT].values[trusted]
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
    shape = _shape(fitted, mesh[variables.TRIANGLE].values)
    top = float(max(skin.f0.max(), MIN_F0))
    columns = _columns(skin, trusted, shape, top)
    atlas = Atlas.of(model, chosen_size(model, size))
    pictures = _textures(atlas.spread_known(columns, trust))
    error["normal_error_degrees"] = _normal_error(pictures["normal"], shape, trusted)
    f0 = (top, max(mean_f0, MIN_F0), reflection)
    return Skin(pictures, shape, *f0, error, of_one_index, of_preview)


def _errors(
    tables: Float32,
    diffuse: AnyArray,
    weights: AnyArray,
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

    position: Float32  # (n, 3) mm
    normal: Float64  # (n, 3) of the mesh
    shading: Float64  # (n, 3) as fitted
    tangent: Float64  # (n, 4)
    uv: Float32  # (n, 2)
    triangles: AnyArray


def _shape(fitted: xr.Dataset, triangles: AnyArray) -> Shape:
    place = fitted[variables.SURFEL_POSITION].values
    uv = fitted[variables.SURFEL_UV].values.astype(np.float32)
    normal, shading = (
        unit_normals(fitted, name)
        for name in (variables.SURFEL_NORMAL, variables.SHADING_NORMAL)
    )
    tangent = tangent_frames(place, normal, uv, triangles)
    return Shape(place.astype(np.float32), normal, shading, tangent, uv, triangles)


def _columns(
    skin: Material, surfels: Index, shape: Shape, top: float
) -> dict[str, Float32]:
    """Values (n, c) of the textures at every surfel; 0 where nothing was fitted."""

    def spread(values: Array) -> Float32:
        out = np.zeros((len(shape.position), values.shape[1]), np.float32)
        out[surfels] = values
        return out

    bent = to_tangent_space(shape.shading, shape.normal, shape.tangent)
    return {
        "base": spread(skin.base_color),
        "roughness": spread(skin.roughness[:, None]),
        "specular": spread(skin.specular[:, None]),
        "f0": spread(np.minimum(skin.f0 / top, 1.0)[:, None]),
        "bent": spread(bent[surfels]),
    }


def _textures(values: dict[str, Float32]) -> dict[str, Bytes]:
    """8-bit textures, by their name in the material."""
    full = np.full(values["roughness"].shape, 255, np.uint8)
    bent = unit(values["bent"])
    return {
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


def _eight_bits(values: AnyArray) -> Bytes:
    return np.asarray(np.round(np.clip(values, 0, 1) * 255), np.uint8)


def _normal_error(picture: Bytes, shape: Shape, surfels: Index) -> float:
    """Median angle [degree] between the shading normals and those of the texture at the surfels."""
    size = len(picture)
    places = (shape.uv[surfels].astype(float) * size - 0.5)[:, ::-1].T
    bent = np.stack(
        [
            ndimage.map_coordinates(
                picture[..., c] / 127.5 - 1, places, order=1, mode="nearest"
            )
            for c in range(3)
        ],
        1,
    )
    normal = shape.normal[surfels]
    tangent = shape.tangent[surfels]
    bitangent = np.cross(normal, tangent[:, :3]) * tangent[:, 3:]
    normals = (
        bent[:, :1] * tangent[:, :3] + bent[:, 1:2] * bitangent + bent[:, 2:] * normal
    )
    normals = unit(normals)
    cosine = np.clip((normals * shape.shading[surfels]).sum(axis=1), -1, 1)
    return float(np.degrees(np.median(np.arccos(cosine))))


def unit_normals(fitted: xr.Dataset, name: str) -> Float64:
    """Unit normals (n, 3) in a variable; those of the scan where they are unknown."""
    normal = fitted[name].values.astype(float)
    normal = np.where(
        np.isfinite(normal).all(axis=1, keepdims=True),
        normal,
        fitted[variables.SURFEL_NORMAL].values,
    )
    length = lengths(normal)[..., None]
    return np.where(length > 1e-6, normal / np.maximum(length, 1e-6), [0.0, 0.0, 1.0])
