"""Material that approximates a fitted model, for glTF and USD: its fit, its textures, and the
error of the approximation.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import xarray as xr

from skindb.export.inputs import chosen_size, required
from skindb.export.maps import Atlas, tangent_axes, tangent_frames, texel_detail
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
    dots,
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
# of the triangle of (a, b) that glTF can represent, see `fit_material`
CORNERS = np.array([[0, 0], [0, 1], [MAX_F0, 1 - MAX_F0]])
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

    def parts(self, tables: Float32, eta: float) -> Array:
        """Diffuse term for an albedo of 1, and the components (pairs, 1 + k) [sr^-1]."""
        through = (
            fresnel_transmittance(self.cos_i, eta)
            * fresnel_transmittance(self.cos_o, eta)
            / np.pi
        )
        return np.column_stack([through, lookup(tables, *self.angles)])

    @property
    def rises(self) -> Array:
        """1 and the term `rise` of Schlick (pairs, 2)."""
        return np.stack([np.ones_like(self.cos_d), (1 - self.cos_d) ** 5], axis=1)

    def product(self, first: Array, second: Array) -> Array:
        """Inner products (a, b) of functions (pairs, a) and (pairs, b), as in a picture."""
        return first.T @ ((self.weight * self.cos_i**2)[:, None] * second)

    def gloss(self, roughness: float) -> Array:
        """The lobe times `rises` (pairs, 2)."""
        return self.lobe(roughness)[:, None] * self.rises

    def lobe(self, roughness: float | Array) -> Array:
        """GGX distribution with Smith's separable masking, divided by 4 cos_i cos_o (glTF
        2.0, appendix B).
        """
        a2 = np.asarray(roughness) ** 4
        spread = a2 / (np.pi * (self.cos_h**2 * (a2 - 1) + 1) ** 2)
        masking = [
            1 / (c + np.sqrt(a2 + (1 - a2) * c * c)) for c in (self.cos_i, self.cos_o)
        ]
        return np.asarray(spread * masking[0] * masking[1])


def _amounts(diffuse: Array, weights: Array) -> Array:
    """Factors (3, n, 1 + k) on the parts of the model in each channel."""
    return np.stack(
        [np.column_stack([colour, weights]) for colour in diffuse.T]
    ).astype(float)


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
    parts = pairs.parts(tables, eta)
    amounts = _amounts(diffuse, weights)
    base: Array = float64(diffuse)
    for _ in range(ROUNDS):
        lobe, roughness = _fit_lobe(pairs, parts, amounts, base)
        base = _fit_base(pairs, parts, amounts, lobe, roughness)
    specular = lobe.sum(axis=1)
    shines = specular > 0
    f0 = np.where(shines, lobe[:, 0] / np.where(shines, specular, 1.0), DEFAULT_F0)
    return Material(base, specular, f0, roughness)


def _fit_lobe(
    pairs: _Pairs, parts: Array, amounts: Array, base: Array
) -> tuple[Array, Array]:
    """(a, b) (n, 2) and roughness (n,) for base colours (n, 3), where the model is
    `amounts` (3, n, m) of `parts` (pairs, m).
    """
    matt = pairs.rises / np.pi
    # sums over the three channels, which share the lobe
    colour = base.sum(axis=1)[:, None]
    square = (base**2).sum(axis=1)[:, None]
    of_matt = pairs.product(matt, matt)
    of_model = (base.T[..., None] * amounts).sum(axis=0) @ pairs.product(parts, matt)
    lobe = np.zeros((len(base), 2))
    chosen = np.zeros(len(base))
    best = np.full(len(base), -np.inf)
    for roughness in ROUGHNESS:
        gloss = pairs.gloss(roughness)
        cross = pairs.product(gloss, matt)
        gram = (
            3 * pairs.product(gloss, gloss)
            - colour[..., None] * (cross + cross.T)
            + square[..., None] * of_matt
        )
        rhs = (
            amounts.sum(axis=0) @ pairs.product(parts, gloss)
            - colour * cross[:, 0]
            - of_model
            + square * of_matt[0]
        )
        x, gain = _best_pair(gram, rhs)
        better = gain > best
        best[better] = gain[better]
        lobe[better] = x[better]
        chosen[better] = roughness
    return lobe, chosen


def _best_pair(gram: Array, rhs: Array) -> tuple[Array, Array]:
    """Pairs x >= 0 (n, 2) that minimise x G x - 2 x r, and the decrease (n,).

    The constraints are that the sum of x is at most 1, and f0 at most MAX_F0: x lies in
    a triangle, inside it or on one of its sides.
    """
    adjugate = gram[:, ::-1, ::-1] * [[1, -1], [-1, 1]]
    determinant = gram[:, 0, 0] * gram[:, 1, 1] - gram[:, 0, 1] ** 2
    inverse = adjugate / np.maximum(determinant, 1e-30)[:, None, None]
    tried = [np.einsum("nij,nj->ni", inverse, rhs)]
    for start, end in itertools.combinations(CORNERS, 2):
        way = end - start
        pull = gram @ way
        steepness = np.maximum(pull @ way, 1e-30)
        along = np.clip((rhs @ way - pull @ start) / steepness, 0, 1)
        tried.append(start + along[:, None] * way)
    best = np.zeros_like(rhs)
    gain = np.zeros(len(rhs))
    for x in tried:
        fall = dots(x, 2 * rhs - np.einsum("nij,nj->ni", gram, x))
        total = x.sum(axis=1)
        inside = (x[:, 0] >= 0) & (x[:, 0] <= MAX_F0 * total + 1e-9)
        better = inside & (total <= 1 + 1e-9) & (fall > gain)
        gain[better] = fall[better]
        best[better] = x[better]
    return best, gain


def _fit_base(
    pairs: _Pairs, parts: Array, amounts: Array, lobe: Array, roughness: Array
) -> Array:
    """Base colours (n, 3), from 0 to 1, for given lobes (n, 2)."""
    matt = pairs.rises / np.pi
    kept = [1.0, 0.0] - lobe  # factors of 1 and `rise` in 1 - F
    square = np.einsum("ni,nj,ij->n", kept, kept, pairs.product(matt, matt))
    shine = np.zeros(len(lobe))
    for value in np.unique(roughness):
        rows = roughness == value
        both = pairs.product(matt, pairs.gloss(value))
        shine[rows] = np.einsum("ni,nj,ij->n", kept[rows], lobe[rows], both)
    seen = (amounts @ pairs.product(parts, matt) * kept).sum(axis=-1) - shine
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
    parts = pairs.parts(tables, eta)
    model = np.moveaxis(_amounts(diffuse, weights) @ parts.T, 0, -1)
    cosine = pairs.cos_i[:, None]
    ours = model * cosine
    theirs = gltf_brdf(values, pairs) * cosine
    return {
        "relative_rms": _relative(ours, theirs, pairs.weight),
        "relative_rms_perceptual": _relative(
            np.cbrt(ours), np.cbrt(theirs), pairs.weight
        ),
    }


def gltf_brdf(values: Material, pairs: _Pairs) -> Array:
    """BRDF (n, pairs, 3) of the material, by the equations of glTF 2.0, appendix B, and
    KHR_materials_specular.
    """
    f0 = values.f0[:, None]
    fresnel = values.specular[:, None] * (f0 + (1 - f0) * pairs.rises[:, 1])
    gloss = fresnel * pairs.lobe(values.roughness[:, None])
    matt = (1 - fresnel)[..., None] * values.base_color[:, None, :] / np.pi
    return matt + gloss[..., None]


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


@dataclass(frozen=True)
class Skin:
    """8-bit textures, the vertices of the mesh, and constants of the material.

    `error` is the `approximation_error` of the glTF material, `error_of_one_index` that of
    a material with the same index of refraction everywhere, as in OpenPBR, and
    `error_of_preview` that of one that has no specular factor either, as UsdPreviewSurface.
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
    trust = surfel_confidence(fitted)
    tables = kernel_tables(model["basis"].to_dataset())
    trusted = np.flatnonzero(trust > 0)
    diffuse = even_diffuse(fitted)[trusted]
    weights = fitted[variables.BASIS_WEIGHT].values[trusted]
    skin = fit_material(tables, diffuse, weights, eta=eta)
    ones = np.ones_like(skin.f0)
    shares = skin.specular if skin.specular.any() else ones
    mean_f0 = float(np.average(skin.f0, weights=shares))
    reflection = max(float((skin.specular * skin.f0).mean()), MIN_F0)
    some = np.linspace(0, len(ones) - 1, min(ERROR_POINTS, len(ones))).astype(int)
    errors = [
        approximation_error(
            tables,
            diffuse[some],
            weights[some],
            Material(
                skin.base_color[some], specular[some], f0[some], skin.roughness[some]
            ),
            eta=eta,
        )
        for specular, f0 in (
            (skin.specular, skin.f0),
            (skin.specular, mean_f0 * ones),
            (ones, reflection * ones),
        )
    ]
    shape = _shape(fitted, model["mesh"].dataset[variables.TRIANGLE].values)
    top = float(max(skin.f0.max(), MIN_F0))
    axes = tangent_axes(shape.normal, shape.tangent)
    bent = np.einsum("nkc,nc->nk", axes, shape.shading)
    columns = np.zeros((len(trust), 9), np.float32)
    columns[trusted] = np.column_stack(
        [
            skin.base_color,
            skin.roughness,
            skin.specular,
            np.minimum(skin.f0 / top, 1.0),
            bent[trusted],
        ]
    )
    atlas = Atlas.of(model, chosen_size(model, size))
    planes = atlas.spread(columns, trust)
    if detail := texel_detail(model, atlas, axes, trust):
        planes[..., :3] *= detail["albedo"]
        planes[..., 6:] += detail["normal_tangent"]
    return Skin(
        _textures(planes), shape, top, max(mean_f0, MIN_F0), reflection, *errors
    )


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


def _textures(planes: Float32) -> dict[str, Bytes]:
    """8-bit textures, by their name in the material, from base colour, roughness, specular
    factor, f0 relative to its largest value, and normals in tangent space (size, size, 9).
    """
    base, roughness, specular, f0, bent = np.split(planes, [3, 4, 5, 6], axis=-1)
    full = np.full(f0.shape, 255, np.uint8)
    return {
        "baseColor": _eight_bits(encode_srgb(base)),
        "metallicRoughness": np.concatenate(
            [full, _eight_bits(roughness), 0 * full], axis=-1
        ),
        "specular": np.concatenate([full, full, full, _eight_bits(specular)], axis=-1),
        "specularColor": np.repeat(_eight_bits(encode_srgb(f0)), 3, axis=-1),
        "normal": _eight_bits(0.5 * unit(bent) + 0.5),
    }


def _eight_bits(values: AnyArray) -> Bytes:
    return np.asarray(np.round(np.clip(values, 0, 1) * 255), np.uint8)


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


def index_of(f0: float) -> float:
    """Index of refraction with this reflectance at normal incidence."""
    return float((1 + np.sqrt(f0)) / (1 - np.sqrt(f0)))
