"""Eq. 5, its inverse and the dipole, compared with mpmath and integrals."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
from scipy.integrate import quad

from skindb.optics.diffusion import (
    diffuse_reflectance,
    dipole_profile,
    dipole_s,
    reduced_albedo,
    scattering_coefficients,
    sigma_tr,
)
from skindb.optics.fresnel import (
    boundary_factor,
    fresnel_reflectance,
    internal_diffuse_reflectance,
    internal_diffuse_reflectance_polynomial,
)


def _exact(s, eta):
    b = mpmath.mpf(4) / 3 * mpmath.mpf(boundary_factor(eta))
    return (1 - s * s / 3) / 2 * (1 + mpmath.exp(-b * s)) * mpmath.exp(-s)


@pytest.mark.parametrize("eta", [1.0, 1.3, 1.45])
def test_dipole_s__twelve_digits_against_mpmath(eta):
    for value in [1e-6, 1e-3, 0.1, 0.33, 0.7, 0.99, 0.9999, 1 - 1e-6, 1 - 1e-9]:
        with mpmath.workdps(40):
            bracket = (mpmath.mpf("1e-12"), mpmath.sqrt(3))
            s = mpmath.findroot(
                lambda t, value=value: _exact(t, eta) - mpmath.mpf(value),
                bracket,
                solver="anderson",
                tol=1e-60,
            )
            got, clamped = dipole_s(value, eta=eta)
            assert not clamped
            assert abs(float((mpmath.mpf(float(got)) - s) / s)) < 1e-12


def test_scattering_coefficients__give_back_sigma_tr_and_albedo():
    s = np.array([0.2, 0.7, 1.2])
    tr = np.array([0.5, 1.0, 1.5])
    a, scattered = scattering_coefficients(s, tr)
    np.testing.assert_allclose(sigma_tr(a, scattered), tr, rtol=1e-14)
    np.testing.assert_allclose(
        scattered / (a + scattered), reduced_albedo(s), rtol=1e-14
    )
    assert np.isfinite(scattering_coefficients(0.0, 1.0)).all()


@pytest.mark.parametrize("sigma_a", [1e-3, 0.05, 1.0])
def test_dipole_profile__plane_integral_is_equation_5(sigma_a):
    total, _ = quad(
        lambda r: 2 * np.pi * r * dipole_profile(r, sigma_a, 1.2, eta=1.3),
        0,
        1,
        epsrel=1e-12,
    )
    tail, _ = quad(
        lambda r: 2 * np.pi * r * dipole_profile(r, sigma_a, 1.2, eta=1.3),
        1,
        np.inf,
        epsrel=1e-11,
    )
    s = np.sqrt(3 * sigma_a / (sigma_a + 1.2))
    assert total + tail == pytest.approx(
        float(diffuse_reflectance(s, eta=1.3)), rel=1e-9
    )


def test_fresnel__known_values():
    assert fresnel_reflectance(1.0, 1.5) == pytest.approx(0.04)
    assert fresnel_reflectance(0.0, 1.5) == pytest.approx(1.0)
    np.testing.assert_array_equal(fresnel_reflectance([0.0, 0.3, 1.0], 1.0), 0.0)
    # the parallel part vanishes: half the perpendicular one is left
    brewster = np.cos(np.arctan(1.5))
    across = ((1.5**2 - 1) / (1.5**2 + 1)) ** 2
    assert fresnel_reflectance(brewster, 1.5) == pytest.approx(across / 2)
    assert fresnel_reflectance(0.1, 1 / 1.5) == 1.0  # total internal reflection


@pytest.mark.parametrize("eta", [1.1, 1.3, 1.5])
def test_internal_diffuse_reflectance__against_quadrature_and_polynomial(eta):
    critical = np.sqrt(1 - 1 / eta**2)
    inside, _ = quad(
        lambda c: 2 * c * float(fresnel_reflectance(c, 1 / eta)),
        0,
        1,
        points=[critical],
        epsabs=1e-11,
    )
    assert internal_diffuse_reflectance(eta) == pytest.approx(inside, abs=1e-8)
    polynomial = internal_diffuse_reflectance_polynomial(eta)
    # error of the usual approximation over this range
    assert polynomial == pytest.approx(inside, abs=0.02)
    assert internal_diffuse_reflectance_polynomial(1.3) == pytest.approx(
        0.4448, abs=5e-5
    )
