"""Moments and their profile compared with the random walk, a closed formula and the energy."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.optimize import brentq

from skindb.optics.diffusion import dipole_profile, sigma_tr
from skindb.optics.transport import (
    BATCHES,
    Walk,
    leaving_transform,
    moment_basis,
    radial_profile,
    random_walk,
    transport_profile,
)

SIGMA = 4.5  # standard errors allowed: one failure in 150,000
NOWHERE = np.array([1e-9])  # the transform there is the total


def total_reflectance(escapes, sigma_a, sigma_s_prime):
    """Diffuse reflectance per photon that enters, and its standard error from the batches."""
    ratio = sigma_a / sigma_s_prime
    escaped = escapes.weight * np.exp(-ratio * escapes.path.astype(float))
    batch = np.bincount(escapes.batch, escaped, BATCHES) * BATCHES / escapes.packets
    return float(batch.mean()), float(batch.std(ddof=1) / np.sqrt(BATCHES))


@pytest.fixture(scope="module")
def walk():
    return random_walk(
        120_000, eta=1.3, anisotropy=0.8, max_path=60.0, rng=np.random.default_rng(77)
    )


@pytest.mark.parametrize("ratio", [0.1, 1.0])
def test_leaving_transform__total_is_that_of_the_walk(walk, ratio):
    found = leaving_transform(
        NOWHERE, ratio, moment_basis(11, eta=1.3, anisotropy=0.8)
    )[0][0].real
    value, error = total_reflectance(walk, ratio, 1.0)
    # 2e-4: between degrees 11 and 15
    assert found == pytest.approx(value, abs=SIGMA * error + 2e-4)


def test_leaving_transform__without_absorption_everything_comes_back():
    found = leaving_transform(NOWHERE, 1e-10, moment_basis(5, eta=1.4, anisotropy=0.5))[
        0
    ][0].real
    assert found == pytest.approx(1.0, abs=1e-4)  # sqrt of the absorption is 1e-5


def test_leaving_transform__matched_index_is_chandrasekhar():
    """No boundary, isotropic, albedo 0.9, normal incidence: 0.41522 (van de Hulst 1980,
    table 12).
    """
    found = leaving_transform(
        NOWHERE, 1 / 9, moment_basis(11, eta=1.0, anisotropy=0.0)
    )[0][0].real
    assert found == pytest.approx(0.41522, abs=1e-3)  # error of degree 11


@pytest.mark.parametrize("albedo", [0.6, 0.8, 0.99])
def test_leaving_transform__decay_of_isotropic_scattering(albedo):
    """kappa_0 = 1 / nu with albedo nu atanh(1 / nu) = 1 (Case and Zweifel 1967)."""
    kappa = brentq(lambda k: albedo / k * np.arctanh(k) - 1, 1e-6, 1 - 1e-12)
    _, square = leaving_transform(
        NOWHERE, (1 - albedo) / albedo, moment_basis(11, eta=1.3, anisotropy=0.0)
    )
    # lengths in units of 1/sigma_s; 1e-3: of degree 11 at the lowest albedo
    assert np.sqrt(square.min()) * albedo == pytest.approx(kappa, rel=1e-3)


@pytest.mark.parametrize("ratio", [0.1, 0.4, 1.0])
def test_transport_profile__is_the_walk_within_its_noise(walk, ratio):
    edges = np.array([0.9, 1.1, 1.4, 1.8, 2.4, 3.2, 4.2, 5.5])
    # sigma_s' 0.5: lengths double
    value, error = radial_profile(walk, ratio / 2, 0.5, 2 * edges)
    found = _rings(2 * edges, ratio / 2, 0.5)
    assert (np.abs(found / value - 1) < SIGMA * error / value + 0.01).all()


def test_transport_profile__near_the_source_within_6_percent(walk):
    edges = np.array([0.05, 0.08, 0.12, 0.2, 0.3, 0.45, 0.65, 0.9])
    value, error = radial_profile(walk, 0.2, 1.0, edges)
    assert (
        np.abs(_rings(edges, 0.2, 1.0) / value - 1) < 3 * error / value + 0.06
    ).all()


def _rings(edges, sigma_a, sigma_s):
    r = np.linspace(edges[:-1], edges[1:], 41)
    return (transport_profile(r, sigma_a, sigma_s, eta=1.3) * r).sum(axis=0) / r.sum(
        axis=0
    )


def test_transport_profile__plane_integral_is_the_total():
    r = np.geomspace(1e-4, 200, 4001)
    area = np.gradient(np.log(r)) * 2 * np.pi * r * r
    total = leaving_transform(NOWHERE, 0.2, moment_basis(11, eta=1.3, anisotropy=0.8))[
        0
    ][0].real
    integral = (transport_profile(r, 0.2, 1.0, eta=1.3) * area).sum()
    # a tenth of the light is where the walk has 5 %
    assert integral == pytest.approx(total, rel=0.01)


PACKETS = 40_000


@pytest.fixture(scope="module")
def isotropic():
    return random_walk(PACKETS, eta=1.3, anisotropy=0.0, rng=np.random.default_rng(3))


def test_random_walk__giovanelli_1955():
    """Isotropic scattering, albedo 0.9, index 1.5: 0.2600 with the reflection at the
    surface (Giovanelli 1955).
    """
    walk = random_walk(
        2 * PACKETS,
        eta=1.5,
        anisotropy=0.0,
        max_path=200.0,
        rng=np.random.default_rng(1),
    )
    diffuse, error = total_reflectance(walk, 0.1, 0.9)
    surface = 0.04
    assert (1 - surface) * diffuse + surface == pytest.approx(0.2600, abs=SIGMA * error)
    assert error < 0.002


def test_random_walk__matched_index_is_chandrasekhar():
    """No boundary, isotropic, albedo 0.9, normal incidence: 0.41522 (van de Hulst 1980,
    table 12).
    """
    walk = random_walk(
        2 * PACKETS,
        eta=1.0,
        anisotropy=0.0,
        max_path=200.0,
        rng=np.random.default_rng(2),
    )
    diffuse, error = total_reflectance(walk, 0.1, 0.9)
    assert diffuse == pytest.approx(0.41522, abs=SIGMA * error)


def test_random_walk__henyey_greenstein_and_matched_index():
    """At equal albedo, less light returns if more of it is scattered forward."""
    forward = random_walk(
        PACKETS, eta=1.0, anisotropy=0.75, max_path=200.0, rng=np.random.default_rng(4)
    )
    # single-scattering albedo 0.9: sigma_a / sigma_s' = (0.1 / 0.9) / (1 - g)
    value, error = total_reflectance(forward, 0.1 / 0.9 / 0.25, 1.0)
    assert value + SIGMA * error < 0.41522
    assert value - SIGMA * error > 0.1


@cache
def _a(eta):
    """A = (1 + F_dr) / (1 - F_dr), of the diffuse reflectance inside the boundary."""
    cosine, weight = np.polynomial.legendre.leggauss(400)
    cosine = (cosine + 1) / 2
    weight = weight / 2
    sine2 = (1 - cosine**2) * eta**2
    outside = np.sqrt(np.maximum(1 - sine2, 0))
    s = (eta * cosine - outside) / (eta * cosine + outside)
    p = (cosine - eta * outside) / (cosine + eta * outside)
    fresnel = np.where(sine2 >= 1, 1, (s * s + p * p) / 2)
    f_dr = (fresnel * 2 * cosine * weight).sum()
    return float((1 + f_dr) / (1 - f_dr))


@pytest.mark.parametrize(("albedo", "gap"), [(0.92, 0.03), (0.80, 0.09), (0.65, 0.14)])
def test_random_walk__near_eq_5(isotropic, albedo, gap):
    """Diffusion theory is a few per cent off, more where absorption is strong; light
    enters along the normal here.
    """
    s = np.sqrt(3 * (1 - albedo))
    diffusion = albedo / 2 * (1 + np.exp(-4 / 3 * _a(1.3) * s)) * np.exp(-s)
    value, error = total_reflectance(isotropic, 1 - albedo, albedo)
    assert value == pytest.approx(diffusion, rel=gap, abs=SIGMA * error)


def test_random_walk__without_absorption_everything_comes_back():
    walk = random_walk(
        4000, eta=1.3, anisotropy=0.0, max_path=1e5, rng=np.random.default_rng(5)
    )
    value, error = total_reflectance(walk, 0.0, 1.0)
    # 1 % may still be inside after 1e5 free paths
    assert value == pytest.approx(1.0, abs=SIGMA * error + 0.01)


def test_radial_profile__its_integral_is_the_total(isotropic):
    edges = np.linspace(0, 400, 2001)
    density, _ = radial_profile(isotropic, 0.2, 0.9, edges)
    total, _ = total_reflectance(isotropic, 0.2, 0.9)
    assert (density * np.pi * np.diff(edges**2)).sum() == pytest.approx(total, rel=1e-6)


def test_radial_profile__scales_with_the_medium(isotropic):
    edges = np.linspace(0.0, 10.0, 41)
    one, _ = radial_profile(isotropic, 0.1, 1.0, edges)
    half, _ = radial_profile(isotropic, 0.05, 0.5, 2 * edges)
    np.testing.assert_allclose(half, one / 4, rtol=1e-5)  # float32 radii at the edges


def _dipole(r, sigma_a, sigma_s):
    sigma_t = sigma_a + sigma_s
    z_r = 1 / (sigma_a + sigma_s)
    tr = np.sqrt(3 * sigma_a * sigma_t)
    z_v = z_r * (1 + 4 * _a(1.3) / 3)
    each = [
        z * (1 + tr * d) * np.exp(-tr * d) / d**3
        for z, d in ((z_r, np.hypot(r, z_r)), (z_v, np.hypot(r, z_v)))
    ]
    return sigma_s / sigma_t / (4 * np.pi) * sum(each)


def test_radial_profile__has_the_shape_of_the_dipole_at_a_distance(isotropic):
    edges = np.array([4.0, 6.0, 8.0, 10.0, 12.0])
    density, error = radial_profile(isotropic, 0.05, 0.95, edges)
    fine = np.linspace(edges[:-1], edges[1:], 200)
    dipole = (_dipole(fine, 0.05, 0.95) * fine).sum(axis=0) / fine.sum(axis=0)
    ratio = density / dipole
    # 5 %: error of diffusion theory
    assert (np.abs(ratio / ratio[0] - 1) < SIGMA * error / density + 0.05).all()
    assert (np.abs(ratio - 1) < 0.35).all()


def test_random_walk__same_seed_same_events_whatever_the_threads():
    first, second = (
        random_walk(640, eta=1.3, rng=np.random.default_rng(9)) for _ in range(2)
    )
    assert isinstance(first, Walk)
    np.testing.assert_array_equal(first.path, second.path)
    np.testing.assert_array_equal(first.radius, second.radius)


# extreme inputs of both profiles

PROFILES = [dipole_profile, transport_profile]
both_profiles = pytest.mark.parametrize("profile", PROFILES)


@both_profiles
def test_profile__near_the_source_is_no_steeper_than_single_scattering(profile):
    """R decreases with distance and grows towards 0 at most like exp(-sigma_t' r) / r."""
    r = np.geomspace(1e-12, 0.015, 60)  # mean free paths are 0.6
    value = profile(r, 0.1, 1.5, eta=1.3)
    assert np.isfinite(value).all()
    assert (value > 0).all()
    assert (np.diff(value) <= 0).all()
    ratio = value * r * np.exp(1.6 * r)
    assert (np.diff(ratio) >= -1e-12 * ratio[1:]).all()


@both_profiles
def test_profile__far_away_decays_at_the_rate_of_the_medium(profile):
    """The dipole decays with sigma_tr; absorption makes the exact rate lower."""
    r = np.array([40.0, 50.0, 60.0])
    rate = -np.diff(np.log(profile(r, 0.3, 1.0, eta=1.3) * r**2)) / np.diff(r)
    transport = sigma_tr(0.3, 1.0)
    assert (rate < transport * 1.02).all()
    assert (rate > 0.75 * transport).all()
    assert np.isfinite(profile(np.array([1e6, 1e30]), 0.3, 1.0, eta=1.3)).all()


@both_profiles
def test_profile__without_absorption_falls_with_the_third_power(profile):
    """The mean free path is the only length, and it is the limit of little absorption."""
    r = np.array([30.0, 100.0])
    value = profile(r, 0.0, 1.0, eta=1.3)
    power = np.log(value[0] / value[1]) / np.log(r[1] / r[0])
    assert power == pytest.approx(3, abs=0.1)
    np.testing.assert_allclose(profile(r, 1e-12, 1.0, eta=1.3)[0], value[0], rtol=1e-3)


@both_profiles
def test_profile__vanishes_with_the_scattering(profile):
    r = np.array([0.5, 1.0, 3.0])
    small = profile(r, 0.5, 1e-4, eta=1.3)
    smaller = profile(r, 0.5, 1e-6, eta=1.3)
    assert np.isfinite([small, smaller]).all()
    assert ((smaller >= 0) & (smaller < small)).all()
    if profile is dipole_profile:  # in proportion
        np.testing.assert_allclose(smaller / small, 0.01, rtol=1e-3)
        np.testing.assert_array_equal(profile(r, 0.5, 0.0, eta=1.3), 0.0)


@both_profiles
def test_profile__scales_with_lengths(profile):
    """If lengths are multiplied by f, coefficients are divided by f and R by f squared."""
    r = np.geomspace(0.1, 10, 9)
    expected = profile(r, 0.1, 1.5, eta=1.3)
    for f in (1e-30, 1e-12, 1e12, 1e30):
        value = profile(r * f, 0.1 / f, 1.5 / f, eta=1.3)
        np.testing.assert_allclose(value * f * f, expected, rtol=1e-9)


@both_profiles
def test_profile__any_precision_and_values_that_are_not_finite(profile):
    r = np.array([0.5, 2.0, 8.0], np.float32)
    np.testing.assert_array_equal(
        profile(r, np.float32(0.25), np.float32(1.5), eta=1.3),
        profile(r.astype(float), 0.25, 1.5, eta=1.3),
    )
    value = profile(np.array([np.nan, 1.0, np.inf]), 0.1, 1.5, eta=1.3)
    assert np.isnan(value[0])
    assert value[1] > 0
    assert not value[2] > 0  # zero or NaN
    assert np.isnan(profile(1.0, np.nan, 1.5, eta=1.3))
    assert profile(np.zeros(0), 0.1, 1.5, eta=1.3).shape == (0,)


@both_profiles
def test_profile__of_any_medium_is_finite_and_decreases(profile):
    r = np.geomspace(1e-6, 2000, 200)
    media = [(0.0, 1.0), (1e-12, 1.0), (0.1, 0.0001), (30.0, 1.0), (0.1, 100.0)]
    for sigma_a, sigma_s in media:
        value = profile(r, sigma_a, sigma_s, eta=1.3)
        assert np.isfinite(value).all()
        assert (np.diff(value) <= 0).all()
        # it may vanish only where absorption is far above scattering
        assert (value[:100] > 0).all() or sigma_a / sigma_s > 10


@both_profiles
def test_profile__more_absorption_is_less_light_at_every_distance(profile):
    r = np.geomspace(1e-6, 350, 120)
    assert (profile(r, 0.01, 1.0, eta=1.3) > profile(r, 0.02, 1.0, eta=1.3)).all()
