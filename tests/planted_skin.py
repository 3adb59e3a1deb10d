"""A small dome, and skin with known truth: one made without the package's tables and
rows, one from its tables.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from skindb.optics.angles import half_difference
from skindb.optics.fresnel import fresnel_transmittance
from skindb.optics.transport import transport_profile
from skindb.reflectance.tables import lookup
from skindb.schema import dataset, label

ETA = 1.3


def _unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _fibonacci(n, top):
    """n directions, evenly spread around +z down to the cosine `top`."""
    z = 1 - (np.arange(n) + 0.5) / n * (1 - top)
    phi = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)


def _transmitted(cosine):
    """Fresnel transmittance from Snell's law and the two polarisations."""
    c = np.clip(cosine, 1e-9, 1)
    t = np.sqrt(1 - (1 - c**2) / ETA**2)
    s = (c - ETA * t) / (c + ETA * t)
    p = (t - ETA * c) / (t + ETA * c)
    return 1 - (s**2 + p**2) / 2


@dataclass
class Skin:
    """Lumitexels and their true parameters."""

    lumitexels: xr.Dataset
    normal: np.ndarray
    diffuse: np.ndarray


def make_skin(
    *,
    surfels=40,
    lights=60,
    cameras=8,
    gloss=0.04,
    sharpness=40.0,
    noise=0.005,
    scan_error=3.0,
    grey=False,
    seed=1,
):
    """Points on a head-sized cap with BRDF F_t F_t R_d / pi plus a white Blinn-Phong
    lobe of albedo `gloss`.
    """
    rng = np.random.default_rng(seed)
    normal = _unit(_fibonacci(surfels, 0.6) + 0.05 * rng.normal(size=(surfels, 3)))
    position = 80 * _fibonacci(surfels, 0.6)
    light = 880 * _fibonacci(lights, 0.1)
    camera = 830 * _fibonacci(cameras, 0.5)
    base = np.array([0.45, 0.45, 0.45]) if grey else np.array([0.5, 0.33, 0.24])
    diffuse = (
        base
        * rng.uniform(0.7, 1.2, (surfels, 1))
        * rng.uniform(0.95, 1.05, (surfels, 3))
    )
    wi = _unit(light[None] - position[:, None])
    wo = _unit(camera[None] - position[:, None])
    ci = np.einsum("nk,ntk->nt", normal, wi)
    co = np.einsum("nk,ntk->nt", normal, wo)
    half = _unit(wi[:, :, None] + wo[:, None])
    lobe = (
        np.clip(np.einsum("nk,nlck->nlc", normal, half), 0, 1) ** sharpness
        * (sharpness + 8)
        / (8 * np.pi)
    )
    body = (_transmitted(ci)[:, :, None] * _transmitted(co)[:, None] / np.pi)[
        ..., None
    ] * diffuse[:, None, None]
    sample = ci[:, :, None, None] * (body + gloss * lobe[..., None])
    sample = sample * (1 + noise * rng.normal(size=sample.shape))
    sample[(ci <= 0)[:, :, None] | (co <= 0)[:, None]] = np.nan
    scan = _unit(
        normal + np.deg2rad(scan_error) / np.sqrt(2) * rng.normal(size=normal.shape)
    )
    lumitexels = dataset(
        {
            "reflectance_sample": sample,
            "surfel_position": position,
            "surfel_normal": scan,
            "surfel_area": rng.uniform(0.5, 1.5, surfels),
            "light_position": light,
            "light_disc_radius": np.full(lights, 12.5),
            "camera_position": camera,
            "noise_floor": 0.0,
        },
        coords={
            "channel": ["R", "G", "B"],
            "light": [f"l{i:02d}" for i in range(lights)],
            "camera": [f"c{i}" for i in range(cameras)],
        },
    )
    return Skin(lumitexels, normal, diffuse)


def plant_skin(skin, dictionary, rng, *, noise=0.0, scale=0.3):
    """Replace the samples by F_t F_t R_d / pi plus a random mixture of interpolated
    BRDFs of the dictionary.
    """
    ds = skin.lumitexels
    position = ds["surfel_position"].values.astype(float)
    wi = ds["light_position"].values - position[:, None]
    wo = ds["camera_position"].values - position[:, None]
    wi = wi / np.linalg.norm(wi, axis=-1, keepdims=True)
    wo = wo / np.linalg.norm(wo, axis=-1, keepdims=True)
    normal = skin.normal
    ci = np.einsum("nk,ntk->nt", normal, wi)
    co = np.einsum("nk,ntk->nt", normal, wo)
    weight = rng.uniform(0, scale, (len(normal), len(dictionary.names))) * (
        rng.uniform(size=len(dictionary.names)) < 0.7
    )
    shape = ci.shape[1], co.shape[1]
    sample = np.empty((len(normal), *shape, 3))
    for i, n in enumerate(normal):
        a, b = np.broadcast_arrays(wi[i][:, None], wo[i][None])
        table = lookup(
            dictionary.table, *half_difference(a, b, np.broadcast_to(n, a.shape))
        )
        body = (
            fresnel_transmittance(np.abs(ci[i]), 1.3)[:, None]
            * fresnel_transmittance(np.abs(co[i]), 1.3)[None]
        )
        sample[i] = (body / np.pi)[..., None] * skin.diffuse[i] + (table @ weight[i])[
            ..., None
        ]
        sample[i] *= ci[i][:, None, None]
    sample *= 1 + noise * rng.normal(size=sample.shape)
    sample[(ci <= 0)[:, :, None] | (co <= 0)[:, None]] = np.nan
    return ds.assign(
        reflectance_sample=label("reflectance_sample", sample),
        shading_normal=label("shading_normal", normal),
        diffuse_reflectance=label("diffuse_reflectance", skin.diffuse),
    ), weight


SIGMA_A = np.array([0.05, 0.17, 0.36])
SIGMA_S = np.array([2.4, 2.3, 2.9])


def capture_of(skin, *, scope=("fit",), probe=True, unseen=(), **attrs):
    """Capture with the lumitexels of a skin; surfels in `unseen` have no samples."""
    ds = skin.lumitexels.copy(deep=True)
    ds["reflectance_sample"].values[list(unseen)] = np.nan
    sample = ds["reflectance_sample"].values
    n = ds.sizes["surfel"]
    coords = {name: ds[name].values for name in ("light", "camera", "channel")}
    lit = np.isfinite(sample).any((2, 3))
    seen = np.isfinite(sample).any((1, 3))
    count = {"sample_count": np.isfinite(sample).all(-1).sum((1, 2))}
    flags = {
        "surfel_uv": np.zeros((n, 2)),
        "light_visible_fraction": lit,
        "camera_visible_fraction": seen,
        "region_mask": np.ones((n, 1)),
    }
    labels = {"light": coords["light"], "camera": coords["camera"], "region": ["beard"]}
    surfels = ds[["surfel_position", "surfel_normal", "surfel_area"]]
    groups = {
        "samples": ds[["reflectance_sample", "noise_floor"]].merge(dataset(count)),
        "surfels": surfels.merge(dataset(flags, coords=labels)),
        "mesh": dataset({"triangle": np.array([[0, 1, 2]])}),
        "dome": ds[["light_position", "light_disc_radius", "camera_position"]],
    }
    if probe:
        distance = 1 + 0.5 * np.arange(28)
        profile = transport_profile(distance[:, None], SIGMA_A, SIGMA_S, eta=1.3)[None]
        groups["probe"] = dataset(
            {
                "fibre_distance": distance,
                "fibre_profile": profile,
                "fibre_profile_error": 0.004 * profile,
                "site_position": [[30.0, 0, 75]],
                "gain_known": 1,
                "fibre_radius": 0.0,
            },
            coords={"site": ["cheek"], "channel": ["R", "G", "B"]},
        )
    tree = xr.DataTree.from_dict(groups)
    tree.attrs = {
        "subject": "S1",
        "condition": "normal",
        "traits": {"age": 30},
        "consent_scope": list(scope),
    } | attrs
    return tree
