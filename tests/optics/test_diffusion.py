"""Eq. 5, its inverse and the dipole, compared with mpmath and integrals."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
from scipy.integrate import quad

from skindb.optics.diffusion import (
    S_MAX,
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


@pytest.mark.parametrize(
    ("eta", "albedo"), [(1.0, 0.5), (1.3, 0.01), (1.3, 0.5), (1.3, 0.96), (1.3, 0.999)]
)
def test_dipole_profile__plane_integral_is_equation_5(eta, albedo):
    sigma_a = 1 - albedo
    far = max(60 / float(sigma_tr(sigma_a, albedo)), 31)

    def ring(r):
        return 2 * np.pi * r * float(dipole_profile(r, sigma_a, albedo, eta=eta))

    total = sum(
        quad(ring, low, high, epsrel=1e-10, limit=400)[0]
        for low, high in ((0, 1), (1, 30), (30, far))
    )
    expected = float(diffuse_reflectance(np.sqrt(3 * sigma_a), eta=eta))
    assert total == pytest.approx(expected, rel=1e-6)


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
    # Egan and Hilgeman (1973), which the paper uses; its error over this range
    polynomial = -1.440 / eta**2 + 0.710 / eta + 0.668 + 0.0636 * eta
    assert polynomial == pytest.approx(inside, abs=0.02)


# extreme inputs


def test_dipole_s__black_white_and_beyond_are_clamped_and_flagged():
    outside = [-np.inf, -1.0, 0.0, 1e-30]
    s, clamped = dipole_s([*outside, 0.5, 1.0, 2.0, 1e30, np.inf, np.nan], eta=1.3)
    assert clamped.tolist() == [True] * 4 + [False] + [True] * 4 + [False]
    assert np.isnan(s[-1])
    assert ((s[:-1] > 0) & (s[:-1] < S_MAX)).all()
    assert (np.diff(s[:-1]) <= 0).all()


def test_dipole_s__any_precision_and_no_values():
    value = np.linspace(0.01, 0.99, 25).astype(np.float32)
    np.testing.assert_array_equal(
        dipole_s(value, eta=1.3)[0], dipole_s(value.astype(np.float64), eta=1.3)[0]
    )
    assert dipole_s(np.zeros((0, 3)), eta=1.3)[0].shape == (0, 3)


def test_scattering_coefficients__extremes_give_back_sigma_tr():
    s = np.array([0.0, 1e-30, 1e-4, 0.5, S_MAX])
    for transport in (1e-30, 1.0, 1e30):
        coefficients = np.array(scattering_coefficients(s, transport))
        assert np.isfinite(coefficients).all()
        assert (coefficients >= 0).all()
        np.testing.assert_allclose(sigma_tr(*coefficients), transport, rtol=1e-12)


@pytest.mark.parametrize("eta", [1.05, 1.3, 2.0])
def test_fresnel__everything_is_reflected_at_the_horizon(eta):
    np.testing.assert_allclose(
        fresnel_reflectance([0.0, 1e-30, 1e-12], eta), 1.0, atol=1e-10
    )
    assert (np.diff(fresnel_reflectance(np.linspace(0, 0.2, 50), eta)) < 0).all()
    np.testing.assert_allclose(fresnel_reflectance([0.0, 0.1], 1 / eta), 1.0)


def test_internal_diffuse_reflectance__is_zero_without_a_boundary():
    assert internal_diffuse_reflectance(1.0) == pytest.approx(0.0, abs=1e-15)
