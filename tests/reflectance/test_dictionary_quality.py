"""The report of a dictionary, compared with surfaces in closed form, integrals by
SciPy, and brute force.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from skindb.optics.angles import half_difference
from skindb.reflectance.abc_low2012 import PARAMETERS, evaluate_abc
from skindb.reflectance.dictionary import (
    Dictionary,
    average_disc,
    convolve_disc,
    dictionary_quality,
    embedded_dictionary,
    sample_pairs,
)
from skindb.reflectance.tables import DEFAULT_GRID, TableGrid, lookup, tabulate

DISC = np.radians(0.8)
NAMES = tuple(PARAMETERS)
PAIRS = 900


@pytest.fixture(scope="module")
def embedded() -> dict[str, np.ndarray]:
    return dictionary_quality(embedded_dictionary(), DISC, pairs=PAIRS)


def _flat(*albedo, grid=DEFAULT_GRID):
    shape = (grid.n_theta_h, grid.n_theta_d, grid.n_phi_d)
    table = np.stack([np.full(shape, a / np.pi, np.float32) for a in albedo], axis=-1)
    return Dictionary(tuple(map(str, albedo)), table, grid, "flat")


def test_dictionary_quality__lambertian_surfaces():
    """Albedo as given to the quadrature's 3e-4 (horizon), excess above 1 only, nothing
    to break by a disc.
    """
    found = dictionary_quality(_flat(0.2, 1.25), DISC, pairs=PAIRS)
    np.testing.assert_allclose(found["normal_albedo"], [0.2, 1.25], rtol=3e-4)
    np.testing.assert_allclose(found["largest_albedo"], [0.2, 1.25], rtol=1e-3)
    np.testing.assert_allclose(found["energy_excess"], [0, 0.25], atol=1.5e-3)
    for name in (
        "reciprocity_error",
        "one_sided_error",
        "disc_quadrature_error",
        "disc_table_error",
    ):
        assert found[name].max() < 1e-5, name  # single precision
    # the origin of these tables is unknown
    assert np.isnan(found["interpolation_error"]).all()
    assert np.isnan(found["hole_fraction"]).all()


def test_dictionary_quality__energy_above_one_at_grazing_light_only():
    """f = 1 / (pi (cos_i + cos_o)) returns 2 (1 - c ln(1 + 1/c)) at the cosine c: 0.61
    at the normal, 1.56 at 85.
    """
    table = tabulate(
        lambda wi, wo: 1 / (np.pi * np.maximum(wi[..., 2:] + wo[..., 2:], 0.02)),
        DEFAULT_GRID,
    )
    found = dictionary_quality(
        Dictionary(("dusty",), table, DEFAULT_GRID, "dusty"), 0.0, pairs=PAIRS
    )
    cosine = np.cos(np.radians(85))
    most = 2 * (1 - cosine * np.log1p(1 / cosine))
    assert found["normal_albedo"][0] == pytest.approx(2 * (1 - np.log(2)), rel=0.002)
    assert found["largest_albedo"][0] == pytest.approx(most, rel=0.01)
    assert found["energy_excess"][0] == pytest.approx(most - 1, rel=0.02)


def test_dictionary_quality__tables_of_a_disc_are_not_averaged_again():
    flat = _flat(0.5)
    found = dictionary_quality(
        Dictionary(flat.names, flat.table, flat.grid, "averaged", DISC),
        0.1,
        pairs=PAIRS,
    )
    assert np.isnan(found["disc_quadrature_error"]).all()
    assert found["normal_albedo"][0] == pytest.approx(0.5, rel=3e-4)


AZIMUTH = (np.arange(720) + 0.5) / 720 * 2 * np.pi


def _reflected(cosine, row, wo):
    """Integrand over the cosine of the light: the mean over its azimuth, of the formula."""
    sine = np.sqrt(1 - cosine**2)
    wi = np.stack(
        [sine * np.cos(AZIMUTH), sine * np.sin(AZIMUTH), np.full(720, cosine)], axis=-1
    )
    return (
        2 * np.pi * cosine * evaluate_abc(row, wi, np.broadcast_to(wo, wi.shape)).mean()
    )


@pytest.mark.parametrize("name", ["blue-rubber", "pearl-paint", "teflon"])
def test_dictionary_quality__albedo_by_scipy(embedded, name):
    """Compared with the albedo of the formula, not of the table; 1 % is the trilinear error."""
    row = np.array([PARAMETERS[name]])
    slope = np.radians(85)
    normal, grazing = (
        quad(_reflected, 0, 1, args=(row, wo), epsrel=1e-4, limit=200)[0]
        for wo in ([0.0, 0.0, 1.0], [np.sin(slope), 0.0, np.cos(slope)])
    )
    assert embedded["normal_albedo"][NAMES.index(name)] == pytest.approx(
        normal, rel=0.01
    )
    assert embedded["largest_albedo"][NAMES.index(name)] == pytest.approx(
        max(grazing, normal), rel=0.01
    )


def test_dictionary_quality__disc_errors_by_brute_force(embedded):
    """1,500 points of a sunflower over the disc around either direction;
    specular-red-phenolic: narrower than it.
    """
    index = NAMES.index("specular-red-phenolic")
    table = embedded_dictionary().table[..., index : index + 1].astype(np.float64)
    wi, wo = sample_pairs(PAIRS)
    k = np.arange(1500)
    radius = np.sqrt((k + 0.5) / 1500) * np.tan(DISC)
    turn = k * 2.399963
    sides = []
    for a, b in ((wi, wo), (wo, wi)):
        first = np.cross(a, [0.3, 0.9, 0.1])
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        second = np.cross(a, first)
        mean = np.zeros(len(a))
        for u, v in np.stack([radius * np.cos(turn), radius * np.sin(turn)], 1):
            moved = a + u * first + v * second
            moved /= np.linalg.norm(moved, axis=1, keepdims=True)
            mean += lookup(table, *half_difference(moved, b))[:, 0] / len(k)
        sides.append(mean)
    exact = (sides[0] + sides[1]) / 2
    weight = wi[:, 2] * wo[:, 2]

    def rms(off):
        return np.sqrt((weight * off**2).sum() / (weight * exact**2).sum())

    assert embedded["one_sided_error"][index] == pytest.approx(
        rms(sides[0] - sides[1]), rel=0.1
    )
    # brute force itself is good to 0.3 %
    one = Dictionary(("one",), table.astype(np.float32), DEFAULT_GRID, "one")
    used = (average_disc(one, wi, wo, DISC) + average_disc(one, wo, wi, DISC))[:, 0] / 2
    between = lookup(convolve_disc(one, DISC).table, *half_difference(wi, wo))[:, 0]
    assert embedded["disc_quadrature_error"][index] == pytest.approx(
        rms(used - exact), abs=0.004
    )
    assert embedded["disc_table_error"][index] == pytest.approx(
        rms(between - exact), abs=0.004
    )


def test_dictionary_quality__the_embedded_materials(embedded):
    """The figures of docs/validation.md, with a tolerance for another sample of directions."""
    assert embedded["energy_excess"].max() == 0
    assert embedded["reciprocity_error"].max() < 1e-12
    assert embedded["disc_quadrature_error"].max() < 0.02
    assert embedded["disc_table_error"].max() < 0.03
    assert np.median(embedded["interpolation_error"]) < 0.01
    # the difference that the mean of both sides removes
    assert 0.01 < embedded["one_sided_error"].max() < 0.06
    assert embedded["hole_fraction"].max() == 0


def test_dictionary_quality__a_coarse_table_is_reported():
    """With a third of the nodes along each axis, the error of interpolation is at least
    five times as large.
    """
    rows = np.array(list(PARAMETERS.values()))
    grid = TableGrid(30, 40, 8)
    coarse = Dictionary(
        NAMES, tabulate(lambda wi, wo: evaluate_abc(rows, wi, wo), grid), grid, "coarse"
    )
    found = dictionary_quality(coarse, 0.0, pairs=PAIRS)
    fine = dictionary_quality(embedded_dictionary(), 0.0, pairs=PAIRS)
    assert np.isnan(found["disc_quadrature_error"]).all()
    assert np.median(found["interpolation_error"]) > 5 * np.median(
        fine["interpolation_error"]
    )
