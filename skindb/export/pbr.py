"""Approximation of a fitted skin surface by glTF's metallic-roughness material, and how wrong it is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from skindb.optics.angles import directions
from skindb.optics.brdf_table import lookup
from skindb.optics.fresnel import fresnel_transmittance

Float = NDArray[np.floating[Any]]
F0 = 0.04  # reflectance at normal incidence of glTF's dielectric, index 1.5
PEAK_QUANTILE = 0.995  # share of the points whose specular factor must not exceed glTF's limit
ROUGHNESS = np.linspace(0.05, 1.0, 77)  # perceptual roughness tried for each component
MIN_PERCEPTUAL_VALUE = 1e-3  # sr^-1 cos: below this the perceptual weight grows no further


@dataclass(frozen=True)
class Lobes:
    """Each component b_k as diffuse_k / pi + strength_k GGX(roughness_k), and the gain of the skin's diffuse term."""

    diffuse: Float  # (k,)
    strength: Float  # (k,) glTF specular factor per unit of weight
    roughness: Float  # (k,) perceptual; alpha is its square
    diffuse_gain: float  # base colour per R_d
    f0: float = F0  # reflectance at normal incidence where the specular factor is 1


@dataclass(frozen=True)
class Material:
    """Values of glTF's material at points."""

    base_color: Float  # (n, 3) linear
    specular: Float  # (n,) factor of KHR_materials_specular, 0 to 1
    roughness: Float  # (n,)


@dataclass(frozen=True)
class _Pairs:
    """Direction pairs above the horizon in the local frame, uniform in the coordinates of the tables."""

    angles: tuple[Float, Float, Float]
    cos_i: Float
    cos_o: Float
    cos_h: Float
    cos_d: Float
    share: Float  # solid angles of light and camera times cos_o


def fit_lobes(tables: NDArray[np.float32], weights: Float, *, eta: float) -> Lobes:
    """Lobes of the components, with glTF's F0 raised where the surface shines more than its default allows.

    Parameters
    ----------
    tables
        (nh, nd, np, k) sr^-1.
    weights
        (n, k) of points of the surface.
    eta
        Refractive index of the skin's diffuse term.
    """
    lobes = _fitted(tables, eta, F0)
    peak = float(np.quantile(weights @ lobes.strength, PEAK_QUANTILE))
    return _fitted(tables, eta, min(F0 * peak, 1.0)) if peak > 1 else lobes


def _fitted(tables: NDArray[np.float32], eta: float, f0: float) -> Lobes:
    """Least squares of each component's f_r cos, weighted as between cube roots (MODEL.md section 4, `perceptual`)."""
    pairs = _pairs()
    target = lookup(tables, *pairs.angles) * pairs.cos_i[:, None]
    weight = 1 / np.maximum(target, MIN_PERCEPTUAL_VALUE) ** (2 / 3)
    flat = pairs.cos_i / np.pi
    fresnel = _fresnel(pairs, np.ones(1), f0)
    lobes = [_specular(pairs, np.full(1, r), fresnel)[0] * pairs.cos_i for r in ROUGHNESS]
    found = []
    for k in range(target.shape[1]):
        w = weight[:, k]
        trials = [nnls(np.stack([flat, lobe], 1) * w[:, None], target[:, k] * w) for lobe in lobes]
        best = int(np.argmin([residual for _, residual in trials]))
        found.append((*trials[best][0], ROUGHNESS[best]))
    diffuse, strength, roughness = np.array(found).reshape(-1, 3).T
    ours = fresnel_transmittance(pairs.cos_i, eta) * fresnel_transmittance(pairs.cos_o, eta)
    theirs = 1 - fresnel[0]
    use = pairs.cos_i * pairs.cos_o
    return Lobes(diffuse, strength, roughness, float((ours * theirs * use).sum() / (theirs**2 * use).sum()), f0)


def material(lobes: Lobes, diffuse: Float, weights: Float) -> Material:
    """Values of glTF's material for R_d (n, 3) and weights (n, k).

    One lobe stands for the mix: its roughness keeps the mix's peak, sum of strength / (pi alpha^2). On two lobes of
    roughness 0.55 and 0.35 that leaves 11 % relative RMS error, the mean of the roughnesses 47 %.
    """
    strength = weights * lobes.strength
    total = strength.sum(axis=-1)
    peak = (strength / lobes.roughness**4).sum(axis=-1)
    roughness = np.where(total > 0, (total / np.maximum(peak, 1e-12)) ** 0.25, 1.0)
    base = diffuse * lobes.diffuse_gain + (weights @ lobes.diffuse)[..., None]
    return Material(np.clip(base, 0, 1), np.clip(total, 0, 1), roughness)


def approximation_error(
    tables: NDArray[np.float32], diffuse: Float, weights: Float, lobes: Lobes, *, eta: float
) -> dict[str, float]:
    """Relative RMS difference of f_r cos between the model and the material, over points and directions.

    Parameters
    ----------
    tables
        (nh, nd, np, k) sr^-1.
    diffuse, weights
        (n, 3) and (n, k) of points of the surface.
    lobes
        `fit_lobes` of the same tables.
    eta
        Refractive index of the skin's diffuse term.

    Returns
    -------
    dict
        `relative_rms` and `relative_rms_perceptual` (between cube roots) over lights and cameras anywhere above the
        surface, weighted by the area a pixel sees; `relative_rms_lobes` over directions uniform in (sqrt theta_h,
        theta_d, phi_d), where highlights and grazing light count most; `clipped_share` of points whose specular factor
        exceeds glTF's limit.
    """
    pairs = _pairs()
    through = fresnel_transmittance(pairs.cos_i, eta) * fresnel_transmittance(pairs.cos_o, eta) / np.pi
    ours = diffuse[:, None, :] * through[:, None] + (weights @ lookup(tables, *pairs.angles).T)[..., None]
    values = material(lobes, diffuse, weights)
    fresnel = _fresnel(pairs, values.specular, lobes.f0)
    gloss = _specular(pairs, values.roughness, fresnel)
    theirs = (1 - fresnel)[..., None] * values.base_color[:, None, :] / np.pi + gloss[..., None]
    ours, theirs = ours * pairs.cos_i[:, None], theirs * pairs.cos_i[:, None]
    return {
        "relative_rms": _relative(ours, theirs, pairs.share),
        "relative_rms_perceptual": _relative(np.cbrt(ours), np.cbrt(theirs), pairs.share),
        "relative_rms_lobes": _relative(ours, theirs, np.ones_like(pairs.share)),
        "clipped_share": float(((weights @ lobes.strength) > 1).mean()),
    }


def _relative(ours: Float, theirs: Float, share: Float) -> float:
    off, whole = ((share[:, None] * values**2).sum() for values in (ours - theirs, ours))
    return float(np.sqrt(off / whole)) if whole > 0 else 0.0  # a black model: its material reflects nothing either


def _pairs() -> _Pairs:
    theta_h = (np.arange(45) + 0.5) ** 2 / 45**2 * np.pi / 2
    theta_d, phi_d = np.radians(np.arange(4, 88, 7.0)), np.radians(np.arange(15, 180, 30.0))
    angles = tuple(x.ravel() for x in np.meshgrid(theta_h, theta_d, phi_d, indexing="ij"))
    wi, wo = directions(*angles)
    above = (wi[:, 2] > 0.05) & (wo[:, 2] > 0.05)
    h, d, p = (x[above] for x in angles)
    cos_i, cos_o = wi[above, 2], wo[above, 2]
    # d omega_i d omega_o = 4 cos(theta_d) d omega_h d omega_d, d theta_h = 2 sqrt(theta_h) d sqrt(theta_h)
    share = np.cos(d) * np.sin(d) * np.sin(h) * np.sqrt(h) * cos_o
    return _Pairs((h, d, p), cos_i, cos_o, np.cos(h), np.cos(d), share)


def _fresnel(pairs: _Pairs, specular: Float, f0: float) -> Float:
    """(n, pairs) Schlick's reflectance with KHR_materials_specular's factor."""
    return np.asarray(np.asarray(specular)[:, None] * (f0 + (1 - f0) * (1 - pairs.cos_d) ** 5))


def _specular(pairs: _Pairs, roughness: Float, fresnel: Float) -> Float:
    """(n, pairs) GGX lobe with Smith's separable masking (glTF 2.0, appendix B) times the reflectance."""
    a2 = (np.asarray(roughness)[:, None]) ** 4
    spread = a2 / (np.pi * (pairs.cos_h**2 * (a2 - 1) + 1) ** 2)
    masking = [1 / (c + np.sqrt(a2 + (1 - a2) * c * c)) for c in (pairs.cos_i, pairs.cos_o)]
    return np.asarray(fresnel * spread * masking[0] * masking[1])
