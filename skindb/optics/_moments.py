"""Radiative transport in a half-space by moments of spherical harmonics, for a beam
that enters along the normal.

After a Fourier transform along the surface the radiance is sum_lm psi_lm(z) Y_lm with

    Z psi' + (Sigma + i k X) psi = q exp(-sigma_t z),   Sigma_l = sigma_a + sigma_s (1 - g^l)

(P_N equations; Marshak's boundary conditions with Fresnel reflection at z = 0). R(r) is
the inverse Hankel transform F of the exitance. The only singularity of F is a branch
cut that starts at i kappa_0, where kappa_0 is the exact decay constant of transport
theory, so

    R(r) = -1 / pi^2  integral over kappa > kappa_0 of  Im F(i kappa) K_0(kappa r) kappa

(the idea of Liemert and Kienle 2013, "Exact and efficient solution of the radiative
transport equation for the semi-infinite medium", with a different contour). This
integrand does not oscillate, so the far tail is accurate. Lengths are in units of
1/sigma_s'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, k0e, lpmv

from skindb.optics.fresnel import fresnel_reflectance

Array = NDArray[np.float64]
PER_PANEL = 8  # Gauss points between two branch points, for an error of 2e-4 of R
# number of geometric panels after the first branch point and after the last
PANELS_FIRST = 8
PANELS_LAST = 2


@dataclass(frozen=True)
class Moments:
    """Matrices of the moments l <= N, 0 <= m <= l that do not depend on the medium."""

    order: Array  # (n,) l
    even: NDArray[np.bool_]  # (n,) whether l + m is even
    source: Array  # (n,) Y_lm along the beam
    along: Array  # (n, n) Z: moments of the cosine
    across: Array  # (n, n) X: moments of the direction along k
    boundary: Array  # (odd, n) linear forms that must vanish at the surface
    leaving: Array  # (n,) exitance of each moment
    anisotropy: float


def moments(degree: int, *, eta: float, anisotropy: float) -> Moments:
    """Matrices for odd `degree`, index of refraction `eta` and Henyey-Greenstein scattering."""
    degrees, m = np.array([(i, j) for i in range(degree + 1) for j in range(i + 1)]).T
    same = m[:, None] == m
    even = (degrees + m) % 2 == 0
    x, w = np.polynomial.legendre.leggauss(degree + 2)
    y = _harmonics(degrees, m, x)
    near = np.where((m[:, None] == 0) | (m == 0), np.sqrt(0.5), 0.5) * (
        np.abs(m[:, None] - m) == 1
    )
    inside, weight = _half_range(eta)
    back = np.asarray(fresnel_reflectance(inside, 1 / eta), np.float64)
    h = _harmonics(degrees, m, inside)
    kept = (h.T * (weight * (1 + back))) @ h * same
    passed = (h.T * (weight * (1 - back))) @ h * same
    flux = np.sqrt(2 * np.pi) * h.T @ (weight * inside * (1 - back))
    return Moments(
        order=degrees.astype(np.float64),
        even=even,
        source=np.where(m == 0, np.sqrt((2 * degrees + 1) / (4 * np.pi)), 0.0),
        along=(y.T * (w * x)) @ y * same,
        across=(y.T * (w * np.sqrt(1 - x * x))) @ y * near,
        boundary=np.where(even, passed, kept)[~even],
        leaving=np.where(m == 0, flux, 0.0) * np.where(even, 1, -1),
        anisotropy=anisotropy,
    )


def _harmonics(n: NDArray[np.int64], m: NDArray[np.int64], x: Array) -> Array:
    """(x, lm) normalised associated Legendre functions, orthonormal over [-1, 1] at equal m."""
    scale = (
        np.exp((np.log(n + 0.5) + gammaln(n - m + 1) - gammaln(n + m + 1)) / 2)
        * (-1.0) ** m
    )
    return np.asarray(lpmv(m, n, x[:, None]) * scale)


def _half_range(eta: float) -> tuple[Array, Array]:
    """Gauss points on (0, 1), split at the critical cosine, above which the
    transmittance rises like a square root.
    """
    t, w = np.polynomial.legendre.leggauss(64)
    t = (t + 1) / 2
    w = w / 2
    critical = np.sqrt(max(1 - 1 / eta**2, 0.0))
    rest = 1 - critical
    return np.concatenate([critical * t, critical + rest * t * t]), np.concatenate(
        [critical * w, 2 * rest * t * w]
    )


def leaving_transform(
    kappa: Array, sigma_a: float, basis: Moments
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
    medium = (
        np.diag(sigma_a + scattering * (1 - g**n)) - kappa[:, None, None] * basis.across
    )
    up = basis.along[np.ix_(even, ~even)]
    # even moments follow from the odd ones; the remaining matrix has the eigenvalues lambda^2
    lifted = np.linalg.solve(
        medium[:, even][:, :, even], np.broadcast_to(up, (len(kappa), *up.shape))
    )
    square, vector = np.linalg.eig(
        np.linalg.solve(up.T @ lifted, medium[:, ~even][:, :, ~even])
    )
    square = np.asarray(square.real)
    root = np.sqrt(square + 0j)  # decaying, or outgoing beyond a branch point
    modes = np.zeros((len(kappa), len(n), square.shape[1]), complex)
    modes[:, ~even], modes[:, even] = vector, (lifted @ vector) * root[:, None, :]
    beam = scattering * (g**n - forward) * basis.source
    driven = np.linalg.solve(
        medium - extinction * basis.along,
        np.broadcast_to(beam[:, None], (len(kappa), len(n), 1)),
    )
    amplitude = np.linalg.solve(basis.boundary @ modes, -basis.boundary @ driven)
    return (driven + modes @ amplitude)[..., 0] @ basis.leaving, square


def half_space_profile(r: Array, sigma_a: float, basis: Moments) -> tuple[Array, float]:
    """Log R(r) + kappa_0 r, and kappa_0, with R per photon that enters; accurate to 1 %
    for r >= 0.7 at degree 11.
    """
    _, square = leaving_transform(np.array([1e-9]), sigma_a, basis)
    branch = np.sqrt(np.sort(square[0]))
    first = branch[0] + (branch[1] - branch[0]) * 4.0 ** -np.arange(PANELS_FIRST, 0, -1)
    edge = np.concatenate(
        [
            branch[:1],
            first,
            branch[1:],
            branch[-1] * 2.0 ** np.arange(1, PANELS_LAST + 1),
        ]
    )
    edge = edge[np.concatenate([[True], np.diff(edge) > 1e-6 * edge[1:]])]
    t, w = np.polynomial.legendre.leggauss(PER_PANEL)
    t = (t + 1) / 2
    w = w / 2
    width = np.diff(edge)[:, None]
    # the substitution by sin^2 removes the square roots at both ends of a panel
    kappa = (edge[:-1, None] + width * np.sin(np.pi * t / 2) ** 2).ravel()
    weight = (width * np.pi / 2 * np.sin(np.pi * t) * w).ravel()
    f, _ = leaving_transform(kappa, sigma_a, basis)
    reach = k0e(np.outer(r, kappa)) * np.exp(-np.outer(r, kappa - branch[0]))
    return np.log(-(reach @ (f.imag * kappa * weight)) / np.pi**2), float(branch[0])
