"""Transport of light in a half-space below a smooth boundary, for a beam that enters at
a point along the normal: R(r) at any distance and albedo.

R / sigma_s'^2 depends only on r sigma_s' and sigma_a / sigma_s' for a given index of
refraction and anisotropy. It is tabulated once per index (4 to 6 s, cached on disk):
from moments beyond 0.9 transport mean free paths, and from a short random walk at
smaller distances, where moments up to degree 11 oscillate. Lengths are in units of
1/sigma_s'.

The random walk of photons is also a reference that is independent of diffusion theory
(Prahl et al. 1989, "A Monte Carlo model of light propagation in tissue"), with
Henyey-Greenstein scattering and exact Fresnel reflection at the surface. It is
simulated without absorption, which is applied afterwards as exp(-sigma_a path). This is
exact, so that one walk is valid for every wavelength and site.

The moments are those of spherical harmonics. After a Fourier transform along the surface
the radiance is sum_lm psi_lm(z) Y_lm with

    Z psi' + (Sigma + i k X) psi = q exp(-sigma_t z),   Sigma_l = sigma_a + sigma_s (1 - g^l)

(P_N equations; Marshak's boundary conditions with Fresnel reflection at z = 0). R(r) is
the inverse Hankel transform F of the exitance. The only singularity of F is a branch
cut that starts at i kappa_0, where kappa_0 is the exact decay constant of transport
theory, so

    R(r) = -1 / pi^2  integral over kappa > kappa_0 of  Im F(i kappa) K_0(kappa r) kappa

(the idea of Liemert and Kienle 2013, "Exact and efficient solution of the radiative
transport equation for the semi-infinite medium", with a different contour). This
integrand does not oscillate, so the far tail is accurate.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RectBivariateSpline, make_interp_spline
from scipy.special import gammaln, k0e, lpmv

from skindb.cache import cached_arrays
from skindb.optics._walk_kernels import walk
from skindb.optics.fresnel import fresnel_reflectance
from skindb.types import Array, Bytes, Float32, Index, Mask, float64

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
MAX_PATH = 60.0
# rings about the source, and powers of the polynomial through them
RINGS = 16
POWERS = 4
# modules that determine the table; a change of their source invalidates the cache
SOURCES = tuple(
    f"skindb.optics.{name}" for name in ("transport", "_walk_kernels", "fresnel")
)
PER_PANEL = 8  # Gauss points between two branch points, for an error of 2e-4 of R
# number of geometric panels after the first branch point and after the last
INNER_PANELS = 8
OUTER_PANELS = 2
EVENTS_PER_PACKET = 6  # memory reserved; two to three are used
BATCHES = 16


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
    r, a, s = (float64(x) for x in (r, sigma_a, sigma_s_prime))
    ratio = a / s
    log_clipped = np.log(np.clip(ratio, RATIO_MIN, RATIO_MAX))
    table = _table(float(eta))
    # finite, as infinity times zero absorption would be NaN
    radius = np.minimum(r * s, 1e30)
    log_inside = np.log(np.clip(radius, NEAREST, FARTHEST))
    log_ratio, log_radius = np.broadcast_arrays(log_clipped, log_inside)
    decay = table.decay(log_clipped)
    kappa = decay * np.sqrt(3 * ratio * (1 + ratio))
    min_kappa = decay * np.sqrt(3 * RATIO_MIN * (1 + RATIO_MIN))
    level = table.level(log_ratio, log_radius) - kappa * radius
    level = level + np.log1p(kappa * radius)
    level = level - np.log1p(np.maximum(kappa, min_kappa) * radius)
    with np.errstate(divide="ignore"):
        near = np.log(NEAREST / radius)
        far = np.minimum(2 * np.log(FARTHEST / radius), 0)
    outside = np.where(radius < NEAREST, near, far)
    return s * s * np.exp(level + outside)


@lru_cache(maxsize=4)
def _table(eta: float) -> Table:
    ratio = np.geomspace(RATIO_MIN, RATIO_MAX, RATIOS)
    radius = np.geomspace(NEAREST, FARTHEST, RADII)
    arrays = cached_arrays(
        "transport", (eta,), sources=SOURCES, make=lambda: _tabulate(ratio, radius, eta)
    )
    x = np.log(ratio)
    surface = RectBivariateSpline(x, np.log(radius), arrays["level"], kx=5, s=0)
    sigma_tr = np.sqrt(3 * ratio * (1 + ratio))
    return Table(surface.ev, make_interp_spline(x, arrays["kappa"] / sigma_tr, k=5))


def _tabulate(ratio: Array, radius: Array, eta: float) -> dict[str, Array]:
    """Level (ratio, radius) and kappa (ratio,), see `Table`."""
    far = radius >= SEAM
    radii = np.append(SEAM, radius[far])
    basis = moment_basis(DEGREE, eta=eta, anisotropy=ANISOTROPY)

    def profile(ratio: float) -> tuple[Array, float]:
        return half_space_profile(radii, float(ratio), basis)

    with ThreadPoolExecutor(2) as pool:
        rows = list(pool.map(profile, ratio))
    kappa = np.array([k for _, k in rows])
    level = np.empty((len(ratio), len(radius)))
    near = _near_profiles(ratio, eta)
    for i, (rings, (row, k)) in enumerate(zip(near, rows, strict=True)):
        seam = row[0] - k * SEAM
        step = _near_polynomial(radius[~far], *rings, seam)
        level[i, far] = row[1:]
        level[i, ~far] = seam + step + k * radius[~far]
    return {"level": level, "kappa": kappa}


def _near_profiles(ratio: Array, eta: float) -> list[tuple[Array, Array, Array]]:
    """For each ratio: r, log R and its relative error in rings about the source, from a
    random walk.
    """
    rng = np.random.default_rng(SEED)
    escapes = random_walk(
        PACKETS, eta=eta, anisotropy=ANISOTROPY, max_path=MAX_PATH, rng=rng
    )
    edges = np.geomspace(NEAREST, SEAM, RINGS + 1)
    middle = np.sqrt(edges[1:] * edges[:-1])
    rings = [radial_profile(escapes, float(a), 1.0, edges) for a in ratio]
    return [(middle, np.log(value), error / value) for value, error in rings]


def _near_polynomial(
    r: Array, ring: Array, value: Array, error: Array, level: float
) -> Array:
    """Polynomial in log(r / SEAM) without constant, fitted to `value` minus `level` by
    weighted least squares.
    """
    x = np.vander(np.log(ring / SEAM), POWERS + 1, increasing=True)[:, 1:]
    solution = np.linalg.lstsq(x / error[:, None], (value - level) / error)
    powers = np.vander(np.log(r / SEAM), POWERS + 1, increasing=True)[:, 1:]
    return powers @ solution[0]


@dataclass(frozen=True)
class MomentBasis:
    """Matrices of the moments l <= N, 0 <= m <= l that do not depend on the medium."""

    order: Array  # (n,) l
    even: Mask  # (n,) whether l + m is even
    source: Array  # (n,) Y_lm along the beam
    along: Array  # (n, n) Z: moments of the cosine
    across: Array  # (n, n) X: moments of the direction along k
    boundary: Array  # (odd, n) linear forms that must vanish at the surface
    leaving: Array  # (n,) exitance of each moment
    anisotropy: float


def moment_basis(degree: int, *, eta: float, anisotropy: float) -> MomentBasis:
    """Matrices for odd `degree`, index of refraction `eta` and Henyey-Greenstein scattering."""
    degrees, m = np.array([(i, j) for i in range(degree + 1) for j in range(i + 1)]).T
    same = m[:, None] == m
    even = (degrees + m) % 2 == 0
    x, w = np.polynomial.legendre.leggauss(degree + 2)
    y = _harmonics(degrees, m, x)
    adjacent = np.abs(m[:, None] - m) == 1
    near = np.where((m[:, None] == 0) | (m == 0), np.sqrt(0.5), 0.5) * adjacent
    inside, weight = _half_range(eta)
    back = float64(fresnel_reflectance(inside, 1 / eta))
    h = _harmonics(degrees, m, inside)
    plus = (h.T * (weight * (1 + back))) @ h * same
    minus = (h.T * (weight * (1 - back))) @ h * same
    flux = np.sqrt(2 * np.pi) * h.T @ (weight * inside * (1 - back))
    return MomentBasis(
        order=degrees.astype(float),
        even=even,
        source=np.where(m == 0, np.sqrt((2 * degrees + 1) / (4 * np.pi)), 0.0),
        along=(y.T * (w * x)) @ y * same,
        across=(y.T * (w * np.sqrt(1 - x * x))) @ y * near,
        boundary=np.where(even, minus, plus)[~even],
        leaving=np.where(m == 0, flux, 0.0) * np.where(even, 1, -1),
        anisotropy=anisotropy,
    )


def _harmonics(n: Index, m: Index, x: Array) -> Array:
    """(x, lm) normalised associated Legendre functions, orthonormal over [-1, 1] at equal m."""
    logarithm = np.log(n + 0.5) + gammaln(n - m + 1) - gammaln(n + m + 1)
    scale = np.exp(logarithm / 2) * (-1.0) ** m
    return lpmv(m, n, x[:, None]) * scale


def _half_range(eta: float) -> tuple[Array, Array]:
    """Gauss points on (0, 1), split at the critical cosine, above which the
    transmittance rises like a square root.
    """
    t, w = _gauss_points(64)
    critical = np.sqrt(max(1 - 1 / eta**2, 0.0))
    span = 1 - critical
    cosine = np.concatenate([critical * t, critical + span * t * t])
    return cosine, np.concatenate([critical * w, 2 * span * t * w])


def _gauss_points(n: int) -> tuple[Array, Array]:
    """Gauss points and weights on (0, 1)."""
    x, w = np.polynomial.legendre.leggauss(n)
    return (x + 1) / 2, w / 2


def leaving_transform(
    kappa: Array, sigma_a: float, basis: MomentBasis
) -> tuple[NDArray[np.complex128], Array]:
    """F(i kappa + 0) (k,) per photon that enters, and the squares (k, odd) of the decay
    constants in depth.
    """
    n = basis.order
    even = basis.even
    g = basis.anisotropy
    # the forward peak beyond these moments counts as unscattered (delta-M)
    forward = g ** (n.max() + 1)
    scattering = 1 / (1 - g)
    extinction = scattering * (1 - forward) + sigma_a
    losses = np.diag(sigma_a + scattering * (1 - g**n))
    medium = losses - kappa[:, None, None] * basis.across
    up = basis.along[np.ix_(even, ~even)]
    # even moments follow from the odd ones; the remaining matrix has the eigenvalues lambda^2
    ups = np.broadcast_to(up, (len(kappa), *up.shape))
    lifted = np.linalg.solve(medium[:, even][:, :, even], ups)
    reduced = np.linalg.solve(up.T @ lifted, medium[:, ~even][:, :, ~even])
    square, vector = np.linalg.eig(reduced)
    square = np.asarray(square.real)
    root = np.sqrt(square + 0j)  # decaying, or outgoing beyond a branch point
    modes = np.zeros((len(kappa), len(n), square.shape[1]), complex)
    modes[:, ~even] = vector
    modes[:, even] = (lifted @ vector) * root[:, None, :]
    beam = scattering * (g**n - forward) * basis.source
    beams = np.broadcast_to(beam[:, None], (len(kappa), len(n), 1))
    driven = np.linalg.solve(medium - extinction * basis.along, beams)
    amplitude = np.linalg.solve(basis.boundary @ modes, -basis.boundary @ driven)
    return (driven + modes @ amplitude)[..., 0] @ basis.leaving, square


def half_space_profile(
    r: Array, sigma_a: float, basis: MomentBasis
) -> tuple[Array, float]:
    """Log R(r) + kappa_0 r, and kappa_0, with R per photon that enters; accurate to 1 %
    for r >= 0.7 at degree 11.
    """
    _, square = leaving_transform(np.array([1e-9]), sigma_a, basis)
    branch = np.sqrt(np.sort(square[0]))
    step = branch[1] - branch[0]
    inner = branch[0] + step * 4.0 ** -np.arange(INNER_PANELS, 0, -1)
    outer = branch[-1] * 2.0 ** np.arange(1, OUTER_PANELS + 1)
    edge = np.concatenate([branch[:1], inner, branch[1:], outer])
    edge = edge[np.concatenate([[True], np.diff(edge) > 1e-6 * edge[1:]])]
    t, w = _gauss_points(PER_PANEL)
    width = np.diff(edge)[:, None]
    # the substitution by sin^2 removes the square roots at both ends of a panel
    kappa = (edge[:-1, None] + width * np.sin(np.pi * t / 2) ** 2).ravel()
    weight = (width * np.pi / 2 * np.sin(np.pi * t) * w).ravel()
    f, _ = leaving_transform(kappa, sigma_a, basis)
    reach = k0e(np.outer(r, kappa)) * np.exp(-np.outer(r, kappa - branch[0]))
    return np.log(-(reach @ (f.imag * kappa * weight)) / np.pi**2), float(branch[0])


@dataclass(frozen=True)
class Walk:
    """Escapes of photons in a walk without absorption; lengths in units of 1/sigma_s'."""

    radius: Float32  # (m,) distance between entry and escape
    path: Float32  # (m,) length of the path before the escape
    weight: Float32  # (m,) fraction of the packet that escapes
    batch: Bytes  # (m,) index of the independent batch of packets
    packets: int
    max_path: float  # length of the path after which packets are discarded


def random_walk(
    packets: int,
    *,
    eta: float,
    anisotropy: float = 0.8,
    max_path: float = 240.0,
    rng: np.random.Generator,
) -> Walk:
    """Simulate the random walk of photon packets that enter along the normal.

    Parameters
    ----------
    packets
        Number of packets.
    eta
        Index of refraction of the medium relative to air.
    anisotropy
        Mean cosine g of the Henyey-Greenstein phase function; 0 is isotropic.
    max_path
        Length of the path, in units of 1/sigma_s', after which a packet is discarded.
        The error is below exp(-max_path sigma_a/sigma_s').
    rng
        Random generator. Each batch has its own stream, so that the result does not
        depend on the number of threads.

    Returns
    -------
    Walk
        Escapes in the order of the batches.
    """
    per_batch = max(packets // BATCHES, 1)

    def run(stream: np.random.Generator) -> Float32:
        events = np.empty((per_batch * EVENTS_PER_PACKET + 64, 3), np.float32)
        count = walk(stream, per_batch, anisotropy, eta, max_path, events)
        if count == len(events):
            raise ValueError(
                "eta must be an index of refraction with at most "
                f"{EVENTS_PER_PACKET} escapes per packet, found {eta}"
            )
        return events[:count]

    with ThreadPoolExecutor(2) as pool:
        parts = list(pool.map(run, rng.spawn(BATCHES)))
    batch = np.repeat(np.arange(BATCHES, dtype=np.uint8), [len(part) for part in parts])
    radius, path, weight = np.ascontiguousarray(np.concatenate(parts).T)
    return Walk(radius, path, weight, batch, per_batch * BATCHES, max_path)


def radial_profile(
    escapes: Walk, sigma_a: float, sigma_s_prime: float, edges: Array
) -> tuple[Array, Array]:
    """R(r) in mm^-2 per photon that enters, as mean over rings between `edges` (k + 1,)
    mm, and its standard error.
    """
    ratio = sigma_a / sigma_s_prime
    escaped = np.asarray(escapes.weight * np.exp(-ratio * escapes.path.astype(float)))
    ring = np.searchsorted(edges, escapes.radius / sigma_s_prime, side="right") - 1
    count = len(edges) - 1
    inside = (ring >= 0) & (ring < count)
    index = escapes.batch[inside].astype(int) * count + ring[inside]
    energy = np.bincount(index, escaped[inside], BATCHES * count)
    area = np.pi * np.diff(edges**2)
    density = energy.reshape(BATCHES, count) * (BATCHES / escapes.packets) / area
    return density.mean(axis=0), density.std(axis=0, ddof=1) / np.sqrt(BATCHES)
