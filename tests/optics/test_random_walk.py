import numpy as np
import pytest

from skindb.optics.random_walk import (
    Walk,
    radial_profile,
    random_walk,
    total_reflectance,
)

PACKETS = 40_000
SIGMA = 4.5  # standard errors allowed: one failure in 150,000


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
        longest=200.0,
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
        longest=200.0,
        rng=np.random.default_rng(2),
    )
    diffuse, error = total_reflectance(walk, 0.1, 0.9)
    assert diffuse == pytest.approx(0.41522, abs=SIGMA * error)


def test_random_walk__henyey_greenstein_and_matched_index():
    """At equal albedo, less light returns if more of it is scattered forward."""
    forward = random_walk(
        PACKETS, eta=1.0, anisotropy=0.75, longest=200.0, rng=np.random.default_rng(4)
    )
    # single-scattering albedo 0.9: sigma_a / sigma_s' = (0.1 / 0.9) / (1 - g)
    value, error = total_reflectance(forward, 0.1 / 0.9 / 0.25, 1.0)
    assert value + SIGMA * error < 0.41522
    assert value - SIGMA * error > 0.1


def _internal_reflectance(eta):
    cosine, weight = np.polynomial.legendre.leggauss(400)
    cosine = (cosine + 1) / 2
    weight = weight / 2
    sine2 = (1 - cosine**2) * eta**2
    outside = np.sqrt(np.maximum(1 - sine2, 0))
    a = (eta * cosine - outside) / (eta * cosine + outside)
    b = (cosine - eta * outside) / (cosine + eta * outside)
    return float(
        (np.where(sine2 >= 1, 1, (a * a + b * b) / 2) * 2 * cosine * weight).sum()
    )


F_DR = _internal_reflectance(1.3)
A = (1 + F_DR) / (1 - F_DR)


@pytest.mark.parametrize(("albedo", "gap"), [(0.92, 0.03), (0.80, 0.09), (0.65, 0.14)])
def test_random_walk__near_eq_5(isotropic, albedo, gap):
    """Diffusion theory is a few per cent off, more where absorption is strong; light
    enters along the normal here.
    """
    s = np.sqrt(3 * (1 - albedo))
    diffusion = albedo / 2 * (1 + np.exp(-4 / 3 * A * s)) * np.exp(-s)
    value, error = total_reflectance(isotropic, 1 - albedo, albedo)
    assert value == pytest.approx(diffusion, rel=gap, abs=SIGMA * error)


def test_random_walk__without_absorption_everything_comes_back():
    walk = random_walk(
        4000, eta=1.3, anisotropy=0.0, longest=1e5, rng=np.random.default_rng(5)
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
    z_v = z_r * (1 + 4 * A / 3)
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
