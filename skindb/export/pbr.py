"""Approximation of a fitted surface by the metallic-roughness material of glTF, and the
error of this approximation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skindb.optics.angles import directions
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance.tables import lookup

Float = NDArray[np.floating]
# values of perceptual roughness that are tried for each point
ROUGHNESS = np.linspace(0.1, 1.0, 46)
# of fitting lobe and base colour in turn; after the third, the error changes by less
# than 1 % of itself
ROUNDS = 4
MAX_F0 = 0.3  # reflectance at normal incidence, for an index of refraction of 3.4
# of points without a highlight; the reflectance of the dielectric of glTF, index 1.5
DEFAULT_F0 = 0.04


@dataclass(frozen=True)
class Material:
    """Parameters of the glTF material with KHR_materials_specular at points."""

    base_color: Float  # (n, 3) linear, 0 to 1
    specular: Float  # (n,) factor on all reflection, 0 to 1
    f0: Float  # (n,) reflectance at normal incidence, before that factor
    roughness: Float  # (n,) perceptual; alpha is its square


@dataclass(frozen=True)
class _Pairs:
    """Pairs of directions above the horizon in the local frame, uniform in the
    coordinates of the tables.
    """

    angles: tuple[Float, Float, Float]
    cos_i: Float
    cos_o: Float
    cos_h: Float
    cos_d: Float
    weight: Float  # solid angles of light and camera times cos_o, as in a picture


def fit_material(
    tables: NDArray[np.float32], diffuse: Float, weights: Float, *, eta: float
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
    ).astype(np.float64)
    base: Float = np.asarray(diffuse, np.float64)
    low: Float
    high: Float
    roughness: Float
    low = high = np.zeros(len(base))
    roughness = np.full(len(base), 0.5)
    for _ in range(ROUNDS):
        low, high, roughness = _fit_lobe(pairs, parts, amounts, base)
        base = _fit_base(pairs, parts, amounts, low, high, roughness)
    specular = low + high
    f0 = np.where(specular > 0, low / np.where(specular > 0, specular, 1.0), DEFAULT_F0)
    return Material(base, specular, f0, roughness)


def _fit_lobe(
    pairs: _Pairs, parts: Float, amounts: Float, base: Float
) -> tuple[Float, Float, Float]:
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
            left.T @ (use[:, None] * right)
            for left, right in ((gloss, gloss), (gloss, matt), (matt, matt))
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


def _best_pair(gram: Float, rhs: Float) -> tuple[Float, Float]:
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
    parts: Float,
    amounts: Float,
    low: Float,
    high: Float,
    roughness: Float,
) -> Float:
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
    tables: NDArray[np.float32],
    diffuse: Float,
    weights: Float,
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
        pixel sees; `relative_rms_lobes` over directions uniform in (sqrt theta_h,
        theta_d, phi_d), which gives more weight to highlights and grazing light.
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
        "relative_rms_lobes": _relative(ours, theirs, np.ones_like(pairs.weight)),
    }


def gltf_brdf(
    values: Material, cos_i: Float, cos_o: Float, cos_h: Float, cos_d: Float
) -> Float:
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


def _relative(ours: Float, theirs: Float, weight: Float) -> float:
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


def _ggx(a2: Float, cos_i: Float, cos_o: Float, cos_h: Float) -> Float:
    """GGX distribution with Smith's separable masking, divided by 4 cos_i cos_o (glTF
    2.0, appendix B).
    """
    spread = a2 / (np.pi * (cos_h**2 * (a2 - 1) + 1) ** 2)
    masking = [1 / (c + np.sqrt(a2 + (1 - a2) * c * c)) for c in (cos_i, cos_o)]
    return np.asarray(spread * masking[0] * masking[1])
