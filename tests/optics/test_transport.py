"""Moments and their profile compared with the random walk, a closed formula and the energy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from skindb.optics._moments import leaving_transform, moments
from skindb.optics.random_walk import radial_profile, random_walk, total_reflectance
from skindb.optics.transport import transport_profile

SIGMA = 4.5  # standard errors allowed: one failure in 150,000
NOWHERE = np.array([1e-9])  # the transform there is the total


@pytest.fixture(scope="module")
def walk():
    return random_walk(
        120_000, eta=1.3, anisotropy=0.8, longest=60.0, rng=np.random.default_rng(77)
    )


@pytest.mark.parametrize("ratio", [0.1, 1.0])
def test_leaving_transform__total_is_that_of_the_walk(walk, ratio):
    found = leaving_transform(NOWHERE, ratio, moments(11, eta=1.3, anisotropy=0.8))[0][
        0
    ].real
    value, error = total_reflectance(walk, ratio, 1.0)
    # 2e-4: between degrees 11 and 15
    assert found == pytest.approx(value, abs=SIGMA * error + 2e-4)


def test_leaving_transform__without_absorption_everything_comes_back():
    found = leaving_transform(NOWHERE, 1e-10, moments(5, eta=1.4, anisotropy=0.5))[0][
        0
    ].real
    assert found == pytest.approx(1.0, abs=1e-4)  # sqrt of the absorption is 1e-5


def test_leaving_transform__matched_index_is_chandrasekhar():
    """No boundary, isotropic, albedo 0.9, normal incidence: 0.41522 (van de Hulst 1980,
    table 12).
    """
    found = leaving_transform(NOWHERE, 1 / 9, moments(11, eta=1.0, anisotropy=0.0))[0][
        0
    ].real
    assert found == pytest.approx(0.41522, abs=1e-3)  # error of degree 11


@pytest.mark.parametrize("albedo", [0.6, 0.8, 0.99])
def test_leaving_transform__decay_of_isotropic_scattering(albedo):
    """kappa_0 = 1 / nu with albedo nu atanh(1 / nu) = 1 (Case and Zweifel 1967)."""
    kappa = brentq(lambda k: albedo / k * np.arctanh(k) - 1, 1e-6, 1 - 1e-12)
    _, square = leaving_transform(
        NOWHERE, (1 - albedo) / albedo, moments(11, eta=1.3, anisotropy=0.0)
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
    total = leaving_transform(NOWHERE, 0.2, moments(11, eta=1.3, anisotropy=0.8))[0][
        0
    ].real
    integral = (transport_profile(r, 0.2, 1.0, eta=1.3) * area).sum()
    # a tenth of the light is where the walk has 5 %
    assert integral == pytest.approx(total, rel=0.01)
