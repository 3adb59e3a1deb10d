"""R(r) by transport theory, at any distance and albedo and without the noise of a random walk.

R / sigma_s'^2 depends only on r sigma_s' and sigma_a / sigma_s' for a given index of
refraction and anisotropy. It is tabulated once per index (4 to 6 s, cached on disk):
from the moments of `_moments` beyond 0.9 transport mean free paths, and from a short
random walk at smaller distances, where moments up to degree 11 oscillate. Light enters
at a point along the normal.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RectBivariateSpline, make_interp_spline

from skindb.cache import cached_arrays
from skindb.optics._moments import half_space_profile, moments
from skindb.optics.random_walk import radial_profile, random_walk

Array = NDArray[np.float64]
ANISOTROPY = 0.8  # of skin; for a given sigma_s' the profile hardly depends on it
DEGREE = 11
# sigma_a / sigma_s', for reduced albedos of 0.99999 to 0.09
RATIO_MIN = 1e-5
RATIO_MAX = 10.0
RATIOS = 15
# r sigma_s'
NEAREST = 0.03
SEAM = 0.9
FARTHEST = 300.0
RADII = 72
# of the walk near the source, whose error is 1 %
PACKETS = 250_000
SEED = 1955
LONGEST = 60.0
# rings about the source, and powers of the polynomial through them
RINGS = 16
POWERS = 4
# modules that determine the table; a change of their source invalidates the cache
SOURCES = tuple(
    f"skindb.optics.{name}"
    for name in ("transport", "_moments", "random_walk", "_walk_kernels", "fresnel")
)


@dataclass(frozen=True)
class Table:
    """Splines over log(sigma_a / sigma_s') and log(r sigma_s')."""

    level: Callable[[Array, Array], Array]  # log R + kappa r, per sigma_s'^2
    decay: Callable[[Array], Array]  # kappa / sigma_tr


def transport_profile(
    r: ArrayLike, sigma_a: ArrayLike, sigma_s_prime: ArrayLike, *, eta: float
) -> Array:
    """R(r) in mm^-2 at distance r [mm] per photon that enters; coefficients in mm^-1,
    which broadcast, sigma_s' > 0.

    Outside 1e-5 <= sigma_a / sigma_s' <= 10 only the decay varies further, below this
    range as (1 + kappa r) exp(-kappa r) of diffusion. At distances below 0.03 /
    sigma_s', R is proportional to 1/r (single scattering); above 300 / sigma_s' to
    exp(-kappa r) / r^2.
    """
    r, a, s = (np.asarray(x, np.float64) for x in (r, sigma_a, sigma_s_prime))
    ratio = a / s
    held = np.log(np.clip(ratio, RATIO_MIN, RATIO_MAX))
    known = _table(float(eta))
    # finite, as infinity times zero absorption would be NaN
    radius = np.minimum(r * s, 1e30)
    inside = np.clip(radius, NEAREST, FARTHEST)
    log_ratio, log_radius = np.broadcast_arrays(held, np.log(inside))
    decay = known.decay(held)
    kappa = decay * np.sqrt(3 * ratio * (1 + ratio))
    least = decay * np.sqrt(3 * RATIO_MIN * (1 + RATIO_MIN))
    level = known.level(log_ratio, log_radius) - kappa * radius
    level = (
        level + np.log1p(kappa * radius) - np.log1p(np.maximum(kappa, least) * radius)
    )
    with np.errstate(divide="ignore"):
        outside = np.where(
            radius < NEAREST,
            np.log(NEAREST / radius),
            np.minimum(2 * np.log(FARTHEST / radius), 0),
        )
    return np.asarray(s * s * np.exp(level + outside))


@lru_cache(maxsize=4)
def _table(eta: float) -> Table:
    ratio = np.geomspace(RATIO_MIN, RATIO_MAX, RATIOS)
    radius = np.geomspace(NEAREST, FARTHEST, RADII)
    found = cached_arrays(
        "transport", (eta,), sources=SOURCES, make=lambda: _tabulate(ratio, radius, eta)
    )
    surface = RectBivariateSpline(
        np.log(ratio), np.log(radius), found["level"], kx=5, s=0
    )
    decay = make_interp_spline(
        np.log(ratio), found["kappa"] / np.sqrt(3 * ratio * (1 + ratio)), k=5
    )
    return Table(surface.ev, decay)


def _tabulate(ratio: Array, radius: Array, eta: float) -> dict[str, Array]:
    """Level (ratio, radius) and kappa (ratio,), see `Table`."""
    far = radius >= SEAM
    basis = moments(DEGREE, eta=eta, anisotropy=ANISOTROPY)
    with ThreadPoolExecutor(2) as pool:
        rows = list(
            pool.map(
                lambda a: half_space_profile(
                    np.append(SEAM, radius[far]), float(a), basis
                ),
                ratio,
            )
        )
    kappa = np.array([k for _, k in rows])
    level = np.empty((len(ratio), len(radius)))
    for i, (rings, (row, k)) in enumerate(
        zip(_near_profiles(ratio, eta), rows, strict=True)
    ):
        level[i, far] = row[1:]
        level[i, ~far] = (
            row[0]
            - k * SEAM
            + _near_polynomial(radius[~far], *rings, row[0] - k * SEAM)
            + k * radius[~far]
        )
    return {"level": level, "kappa": kappa}


def _near_profiles(ratio: Array, eta: float) -> list[tuple[Array, Array, Array]]:
    """For each ratio: r, log R and its relative error in rings about the source, from a
    random walk.
    """
    rng = np.random.default_rng(SEED)
    walk = random_walk(
        PACKETS, eta=eta, anisotropy=ANISOTROPY, longest=LONGEST, rng=rng
    )
    edges = np.geomspace(NEAREST, SEAM, RINGS + 1)
    rings = [radial_profile(walk, float(a), 1.0, edges) for a in ratio]
    return [
        (np.sqrt(edges[1:] * edges[:-1]), np.log(value), error / value)
        for value, error in rings
    ]


def _near_polynomial(
    r: Array, ring: Array, value: Array, error: Array, level: float
) -> Array:
    """Polynomial in log(r / SEAM) without constant, fitted to `value` minus `level` by
    weighted least squares.
    """
    x = np.vander(np.log(ring / SEAM), POWERS + 1, increasing=True)[:, 1:]
    found = np.linalg.lstsq(x / error[:, None], (value - level) / error, rcond=None)[0]
    return np.asarray(
        np.vander(np.log(r / SEAM), POWERS + 1, increasing=True)[:, 1:] @ found
    )
