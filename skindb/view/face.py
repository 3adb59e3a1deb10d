"""Data of the viewer's page for a fitted model: arrays at the surfels, tables of the bases
and distant lights in place of an environment, compressed as text.
"""

import base64
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from sklearn.cluster import KMeans

from skindb.errors import require
from skindb.geometry.mesh import vertex_areas
from skindb.optics.diffusion import S_FLOOR
from skindb.optics.fresnel import boundary_factor
from skindb.reflectance.model import MAX_TABLES
from skindb.reflectance.tables import directional_albedo
from skindb.render.image import image_url, tone_map
from skindb.render.rendering import chosen_camera, chosen_lights, fixed_exposure, render
from skindb.render.scene import LUMINANCE, Environment, Lighting, Surface, from_model
from skindb.render.surfels import surfel_confidence, with_matt_surfels
from skindb.schema import variables
from skindb.schema.consent import honour_consent
from skindb.schema.notes import Omission
from skindb.types import AnyArray, Array, Faces, Float32, Half, float64, lengths, unit
from skindb.view.photographs import photograph_records
from skindb.view.transfer import sky_transfer

COUNT = 256  # lights, in 64 passes of four
MAX_TEXELS = 10_000  # of an environment, of which clusters are made
ROUNDS = 20  # of clustering
SKY_ROWS = 32  # rows of the image of the default sky
GROUND = 0.2  # radiance below the horizon, relative to that of the zenith
MAX_STILL_SIDE = 640  # px; a picture of a camera of 4 megapixels took 6 GB and minutes
STILL_SAMPLES = 16  # rays per pixel of the picture that is shown without WebGL
LOBE_COSINES = 16  # of the directional albedo of the bases
MIN_ALBEDO = 1e-4  # below it, ratios of albedos are meaningless
MEASURED = (  # differences from skindb render (docs/howto/view.md)
    "half precision of albedo, weights, normals and tables: values differ by at most 0.05 %",
    (
        "shadow maps of 1,024 texels, and lights as points: pictures of faces differ by 0.4 "
        "to 1.1 % (light from the front), 1.2 to 2.3 % (side) and 3.9 to 4.6 % (above)"
    ),
    (
        "light under the skin as one Gaussian in a texture of 384 texels: pictures "
        "differ by 1.0 %, and by 1.4 % while something moves (measured)"
    ),
    (
        "light from all directions as harmonics of visibility and 256 reflected lights: "
        "pictures differ by 2.7 % (sky) to 4.7 % (window), and by 3.9 to 13 % while "
        "something moves (measured)"
    ),
)
KEPT = (  # measured by benchmarks/omissions.py on a face of 23,393 surfels
    ("not skipped: surfels, because each is visible from some direction"),
    (
        "not skipped: texels of the BRDF tables, because bases with half of them along "
        "an axis differ by 0.2 to 8 %"
    ),
    "not skipped: lights of the surroundings, because none is below the horizon of all surfels",
)
DETAIL = "approximated: the detail of texels in steps of 0.8 %"
KINDS = {"float16": "f2", "float32": "f4", "uint32": "u4", "uint8": "u1"}


@dataclass(frozen=True)
class DistantLights:
    """Directions of distant lights, and the irradiance of each on a surface that faces it."""

    direction: Array  # (n, 3) unit vectors towards the lights
    irradiance: Array  # (n, 3)


def overcast_sky() -> Environment:
    """The CIE standard overcast sky, (1 + 2 sin(elevation)) / 3, above a dark ground."""
    elevation = np.pi / 2 - np.pi * (np.arange(SKY_ROWS) + 0.5) / SKY_ROWS
    sky = np.where(elevation > 0, (1 + 2 * np.sin(elevation)) / 3, GROUND)
    return Environment(np.tile(sky[:, None, None], (1, 2 * SKY_ROWS, 3)))


def distant_lights(environment: Environment, count: int = COUNT) -> DistantLights:
    """Distant lights that approximate an environment: clusters of its texels by direction,
    weighted by their light (k-means), each at its centre of brightness.

    Parameters
    ----------
    environment
        Light from all directions.
    count
        Maximum number of lights.

    Returns
    -------
    DistantLights
        The sum of their irradiance is that of the environment, in each channel.
    """
    direction, energy = environment.texels()
    bright = energy @ LUMINANCE
    lit = bright > 0
    points = direction[lit]
    weight = bright[lit]
    chosen = np.arange(len(points))
    if len(points) > MAX_TEXELS:
        # drawn by their light, each once, so that a sun leaves some for the sky; those
        # that are drawn for certain are weighted by their light
        rng = np.random.default_rng(0)
        share = weight / weight.sum()
        chosen = rng.choice(len(points), MAX_TEXELS, replace=False, p=share)
        weight = np.maximum(share, 1 / MAX_TEXELS)
    clusters = KMeans(min(count, len(points)), random_state=0, max_iter=ROUNDS)
    clusters.fit(points[chosen], sample_weight=weight[chosen])
    found, label = np.unique(clusters.predict(points), return_inverse=True)
    sums = np.zeros((len(found), 6))
    moments = points * bright[lit, None]
    np.add.at(sums, label, np.concatenate([moments, energy[lit]], axis=1))
    return DistantLights(unit(sums[:, :3]), sums[:, 3:])


@dataclass(frozen=True)
class Trait:
    """A model edited along one trait by `amount`, and by half of it to measure the
    error of interpolating the edit.
    """

    name: str
    whole: xr.DataTree
    half: xr.DataTree
    amount: float = 1.0
    symmetric: bool = False  # whether its slider begins at -amount


def face_record(
    model: xr.DataTree,
    *,
    take: str,
    attributes: Mapping[str, Any],
    traits: tuple[Trait, ...] = (),
    environment: Environment | None = None,
    capture: xr.DataTree | None = None,
) -> dict[str, Any]:
    """Data of one face for the page, which can be written as JSON.

    Parameters
    ----------
    model
        Version of kind "model" or "edit", with the same basis as the models in `traits`.
    take, attributes
        Name of the take, and attributes that the page displays.
    traits
        Edits that the sliders of the page apply.
    environment
        Light from all directions; default an overcast sky. It is scaled such that a
        white surface that faces the front is displayed white.
    capture
        Version of kind "capture" of the take, for the photographs beside the model.

    Returns
    -------
    dict
        about, arrays and traits. Positions of surfels are in single precision, all
        other values in half precision (0.05 %).

    Raises
    ------
    InputError
        If the subject does not consent to exports, no surfel was fitted, or there are
        more than eight bases.
    """
    honour_consent(model.attrs, "export")
    surface = _surface(model, edited=bool(traits))[0]
    resampled, weights = surface.model.resample(surface.parameters)
    require(
        weights.shape[1] <= MAX_TABLES,
        take,
        f"the viewer needs at most {MAX_TABLES} bases",
        str(weights.shape[1]),
        f"fit again with --k {MAX_TABLES} or less",
    )
    values = _values(surface, weights)
    uv = model["fitted"].dataset[variables.SURFEL_UV].values.astype(np.float32)
    tables = _tables(resampled)
    arrays: dict[str, AnyArray] = {
        **{name: value.astype(np.float16) for name, value in values.items()},
        "position": surface.vertices.astype(np.float32),
        "triangles": np.asarray(surface.faces, np.uint32),
        "uv": uv,
        "spacing": uv_spacing(surface.vertices, surface.faces, uv).astype(np.float32),
        "quality": _quality(model, surface).astype(np.float16),
        "transfer": sky_transfer(surface).astype(np.float16),
        "tableLobes": _lobes(resampled),
        "tableA": tables[0],
        **({"tableB": tables[1]} if len(tables) > 1 else {}),
    }
    if surface.detail is not None:
        # rows of the albedo, then of the normal; bytes of -1 to 1
        changes = np.concatenate(np.split(surface.detail, 2, axis=2))
        steps = np.clip(np.round(127 * changes), -127, 127) + 128
        arrays["detail"] = steps.astype(np.uint8)
    about = _about(model, surface, take, attributes, resampled.shape)
    about["surroundings"] = _surroundings(environment, about["exposure"])
    about["photographs"] = [] if capture is None else photograph_records(model, capture)
    return {
        "about": about,
        "arrays": {name: _encode(value) for name, value in arrays.items()},
        "traits": [_trait(trait, values) for trait in traits],
    }


def page_omissions(model: xr.DataTree, *, edited: bool = False) -> list[str]:
    """One line for each thing that the page of a model skips or approximates, with the
    bound or the measured error.

    Further lines state what is not skipped, with the reason.

    Parameters
    ----------
    model
        Version of kind "model" or "edit".
    edited
        Whether the page has sliders of traits, which require all bases.
    """
    surface, omissions = _surface(model, edited=edited)
    detail = [] if surface.detail is None else [DETAIL]
    return [*map(str, omissions), *detail, *MEASURED, *KEPT]


def _surface(
    model: xr.DataTree, *, edited: bool
) -> tuple[Surface, tuple[Omission, ...]]:
    """The surface of the page, without unused bases unless it is edited, and what was omitted."""
    surface = from_model(model)
    if edited:
        return surface, ()
    fewer, parameters, omissions = surface.model.simplified(surface.parameters)
    return replace(surface, model=fewer, parameters=parameters), omissions


def still_picture(model: xr.DataTree) -> str:
    """Picture under all lights of the dome as a data URL, for browsers without WebGL."""
    dome = model["dome"].to_dataset().load()
    camera = chosen_camera(dome, None)[0]
    scale = min(1.0, MAX_STILL_SIDE / max(camera.width, camera.height))
    seen = render(model, samples=STILL_SAMPLES, scale=scale)
    gain = fixed_exposure(Lighting(chosen_lights(dome, ())[0]), camera)
    return image_url(tone_map(seen["radiance"].values, exposure=gain))


def diffusion_width(s: Array, eta: float) -> Array:
    """Standard deviation of the Gaussian with the mean square distance of the dipole,
    in units of 1 / sigma_tr.

    The mean is taken over the profile (eq. 9) in the plane, whose sources are at the
    depths z_r and z_v. This profile has a sharper peak and longer tails than the
    Gaussian.

    Parameters
    ----------
    s
        (n,) dipole s.
    eta
        Relative index of refraction.
    """
    depth = np.maximum(float64(s), S_FLOOR)  # z_r sigma_tr
    above = depth * (1 + 4 / 3 * boundary_factor(eta))
    # one source at depth z: the integral of R is exp(-z) / 2, that of r^2 R is z
    # exp(-z), in units of 1 / sigma_tr
    power = (np.exp(-depth) + np.exp(-above)) / 2
    square = depth * np.exp(-depth) + above * np.exp(-above)
    return np.sqrt(square / power / 2)


def uv_spacing(vertices: Array, faces: Faces, uv: Array) -> Array:
    """Length (n,) [mm] of one unit of the texture coordinates at each vertex."""
    flat = np.concatenate([uv, np.zeros((len(uv), 1))], axis=1)
    square = vertex_areas(vertices, faces) / np.maximum(
        vertex_areas(flat.astype(float), faces), 1e-12
    )
    return np.sqrt(np.clip(square, 1e-6, 1e12))


def _values(surface: Surface, mixed: Array) -> dict[str, Array]:
    """Values that traits change: positions (n, 3) [mm], normals (n, 3), albedo (n, 3),
    weights (n, 4) twice, diffusion length (n, 3) [mm].
    """
    weights = np.zeros((len(surface.vertices), MAX_TABLES))
    weights[:, : mixed.shape[1]] = mixed
    diffusion = np.zeros((len(surface.vertices), 3))
    if surface.sigma_tr is not None:
        diffusion = np.nan_to_num(1 / float64(surface.sigma_tr), nan=0.0, posinf=0.0)
    return {
        "position": surface.vertices,
        "normal": surface.normals,
        "albedo": np.maximum(surface.diffuse, MIN_ALBEDO),
        "weightA": weights[:, :4],
        "weightB": weights[:, 4:],
        "diffusion": diffusion,
    }


def _trait(trait: Trait, plain: Mapping[str, Array]) -> dict[str, Any]:
    """Change of the arrays by a trait: log ratios of albedo and diffusion length,
    differences of the others.
    """
    edited = (from_model(tree) for tree in (trait.whole, trait.half))
    full, half = (
        _values(surface, surface.model.resample(surface.parameters)[1])
        for surface in edited
    )
    ratio = {
        name: np.log(
            np.maximum(full[name], MIN_ALBEDO) / np.maximum(plain[name], MIN_ALBEDO)
        )
        for name in ("albedo", "diffusion")
    }
    moves = {name: value - plain[name] for name, value in full.items()} | ratio
    errors = {}
    for name, change in ratio.items():
        between = plain[name] * np.exp(0.5 * change)
        wrong = np.abs(between / np.maximum(half[name], MIN_ALBEDO) - 1)
        if change.any():
            errors[name] = float(np.median(wrong))
    halves = {name: value.astype(np.float16) for name, value in moves.items()}
    if halves["position"].any():
        between = plain["position"] + 0.5 * moves["position"]
        errors["position"] = float(np.median(lengths(between - half["position"])))
    return {
        "name": trait.name,
        "amount": trait.amount,
        "least": -trait.amount if trait.symmetric else min(trait.amount, 0.0),
        "errors": errors,
        "arrays": {
            name: _encode(value) for name, value in halves.items() if value.any()
        },
    }


def _tables(tables: Float32) -> list[Half]:
    """Tables (nh, nd, np, k) as arrays (np, nh, nd, 4), one for every four bases."""
    missing = -tables.shape[-1] % 4
    padded = np.pad(np.clip(tables, -60000, 60000), [(0, 0)] * 3 + [(0, missing)])
    turned = padded.transpose(2, 0, 1, 3).astype(np.float16)
    return [
        np.ascontiguousarray(turned[..., i : i + 4])
        for i in range(0, turned.shape[-1], 4)
    ]


def _lobes(tables: Float32) -> Half:
    """Directional albedo (2, LOBE_COSINES, 4) of eight bases, at the middles of equal
    intervals of the cosine.
    """
    cosine = (np.arange(LOBE_COSINES) + 0.5) / LOBE_COSINES
    albedo = np.zeros((LOBE_COSINES, 8))
    albedo[:, : tables.shape[-1]] = directional_albedo(tables, cosine)
    return albedo.reshape(LOBE_COSINES, 2, 4).transpose(1, 0, 2).astype(np.float16)


def _quality(model: xr.DataTree, surface: Surface) -> Array:
    """Confidence and relative standard error of the albedo (n, 2); an unknown error is 0."""
    fitted = model["fitted"].to_dataset()
    total = variables.DIFFUSE_REFLECTANCE_TOTAL_ERROR
    name = total if total in fitted else variables.DIFFUSE_REFLECTANCE_ERROR
    error = np.zeros(len(surface.vertices))
    if name in fitted:
        albedo = np.maximum(surface.diffuse, MIN_ALBEDO)
        error = np.clip(
            np.nan_to_num((fitted[name].values / albedo).mean(axis=1)), 0, 10
        )
    return np.stack([surfel_confidence(with_matt_surfels(fitted)), error], axis=1)


def _about(
    model: xr.DataTree,
    surface: Surface,
    take: str,
    attributes: Mapping[str, Any],
    shape: tuple[int, ...],
) -> dict[str, Any]:
    dome = model["dome"].to_dataset().load()
    corners = surface.vertices[np.unique(surface.faces)]
    centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
    distance = float(np.median(lengths(dome[variables.LIGHT_POSITION].values - centre)))
    intensity = np.median(dome[variables.LIGHT_INTENSITY].values, axis=0)
    translucent = (
        surface.s is not None
        and surface.sigma_tr is not None
        and bool(np.isfinite(surface.sigma_tr).all())
    )
    s = np.zeros((1, 3)) if surface.s is None else np.asarray(surface.s)
    return {
        "eta": surface.eta,
        "centre": centre.tolist(),
        "radius": float(lengths(corners - centre).max()),
        "lightDistance": distance,
        "lightIntensity": intensity.tolist(),
        "exposure": float(np.pi * distance**2 / intensity.mean()),
        "translucent": translucent,
        "diffusionWidth": [
            float(np.median(diffusion_width(s[:, c], surface.eta))) for c in range(3)
        ],
        "tableShape": [shape[2], shape[0], shape[1]],
        "attributes": {"take": take}
        | {str(name): str(value) for name, value in attributes.items()},
    }


def _surroundings(environment: Environment | None, exposure: float) -> dict[str, Any]:
    """Distant lights, scaled such that a white surface that faces the front is white at the
    exposure of the page.
    """
    lights = distant_lights(environment or overcast_sky())
    facing = lights.irradiance * np.maximum(lights.direction[:, 2:], 0)
    front = max(float(facing.sum(axis=0).mean()), 1e-30)
    return {
        "direction": lights.direction.tolist(),
        "irradiance": (lights.irradiance * (np.pi / exposure / front)).tolist(),
    }


def _encode(values: AnyArray) -> dict[str, str]:
    packed = zlib.compress(np.ascontiguousarray(values).tobytes(), 6)
    return {
        "kind": KINDS[str(values.dtype)],
        "data": base64.b64encode(packed).decode("ascii"),
    }
