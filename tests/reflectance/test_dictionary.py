"""The embedded dictionary, averages over the disc of the lights, and their quality."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import mpmath
import numpy as np
import pytest
from scipy.integrate import quad

from skindb.optics.angles import directions, half_difference
from skindb.optics.fresnel import fresnel_reflectance
from skindb.reflectance.dictionary import (
    Dictionary,
    abc_parameters,
    convolve_disc,
    dictionary_quality,
    embedded_dictionary,
    evaluate_abc,
    evaluate_embedded,
)
from skindb.reflectance.lobes import (
    GRADED_NAMES,
    GRADED_ROUGHNESS,
    SURFACE_INDEX,
    evaluate_lobe,
)
from skindb.reflectance.tables import (
    DEFAULT_GRID,
    TableGrid,
    directional_albedo,
    lookup,
    tabulate,
)

ROWS = np.array(list(abc_parameters().values()))
SHARED = Path(__file__).resolve().parents[2] / ".." / "shared" / "data" / "brdf"
needs_shared = pytest.mark.skipif(
    not SHARED.is_dir(), reason="the data beside the project are absent"
)
DISC = 0.0142  # rad, 0.8 degrees: a dome's lamp


@pytest.fixture(scope="module")
def convolved() -> Dictionary:
    return convolve_disc(embedded_dictionary(), DISC)


def _unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _pairs(rng, n, lowest):
    wi, wo = directions(
        rng.random(n) ** 2 * np.pi / 2, rng.random(n) * np.pi / 2, rng.random(n) * np.pi
    )
    up = np.minimum(wi[:, 2], wo[:, 2]) > lowest
    return wi[up], wo[up]


@needs_shared
def test_parameters__as_printed():
    with (SHARED / "abc_low2012.csv").open() as file:
        table = {
            row.pop("material"): tuple(map(float, row.values()))
            for row in csv.DictReader(file)
        }
    names = (SHARED / "merl_skindb59.txt").read_text().split()
    assert list(abc_parameters()) == names
    assert {name: table[name] for name in names} == abc_parameters()


def _by_the_book(row, wi, wo):
    """Loew et al. 2012, for one pair of directions with 40 digits, channel by channel."""
    mpmath.mp.dps = 40
    wi = mpmath.matrix(list(map(float, wi)))
    wo = mpmath.matrix(list(map(float, wo)))
    h = (wi + wo) / mpmath.norm(wi + wo)
    cos_d = (wi.T * h)[0]
    eta = mpmath.mpf(row[8])
    cos_t = mpmath.sqrt(1 - (1 - cos_d**2) / eta**2)
    parallel = (eta * cos_d - cos_t) / (eta * cos_d + cos_t)
    across = (cos_d - eta * cos_t) / (cos_d + eta * cos_t)
    masking = min(1, 2 * h[2] * wi[2] / cos_d, 2 * h[2] * wo[2] / cos_d)
    lobe = (
        (1 + row[6] * (1 - h[2])) ** -row[7] * (parallel**2 + across**2) / 2 * masking
    )
    channels = [
        row[c] / mpmath.pi + row[3 + c] * lobe / (mpmath.pi * wi[2] * wo[2])
        for c in range(3)
    ]
    return float(sum(channels) / 3)


def test_evaluate_abc__as_the_formula_in_forty_digits():
    wi, wo = _pairs(np.random.default_rng(7), 12, 0.05)
    got = evaluate_abc(ROWS, wi, wo)
    want = [
        [_by_the_book(row, a, b) for row in ROWS[::10]]
        for a, b in zip(wi, wo, strict=True)
    ]
    np.testing.assert_allclose(got[:, ::10], want, rtol=1e-9)


@needs_shared
def test_evaluate_abc__near_the_measured_slices():
    """phi_d = 90 degrees, above 12 degrees: the median error of the fit is 8.5 %, as
    its authors' fits have.
    """
    slices = np.load(SHARED / "merl_slices_phid90.npz")
    order = [slices["names"].tolist().index(name) for name in abc_parameters()]
    measured = np.moveaxis(slices["f"][order].mean(-1), 0, -1)
    centre = (np.arange(90) + 0.5) / 90
    th, td = np.meshgrid(centre**2 * np.pi / 2, centre * np.pi / 2)
    wi, wo = directions(th, td, np.pi / 2)
    up = np.minimum(wi[..., 2], wo[..., 2]) > 0.2
    relative = np.abs(
        evaluate_abc(ROWS, wi[up], wo[up]) / np.maximum(measured[up], 1e-5) - 1
    )
    assert np.median(np.median(relative, axis=0)) < 0.1
    assert np.median(relative, axis=0).max() < 0.4


def test_embedded_dictionary__trilinear_error_is_small():
    """0.8 % rms above 6 degrees of elevation, weighted by the two cosines, 1.8 % for
    the sharpest lobe.
    """
    wi, wo = _pairs(np.random.default_rng(0), 20000, 0.1)
    exact = np.concatenate(
        [
            evaluate_abc(ROWS, wi, wo),
            *(
                evaluate_lobe(wi, wo, alpha, SURFACE_INDEX)[:, None]
                for alpha in GRADED_ROUGHNESS
            ),
        ],
        axis=1,
    )
    table = lookup(embedded_dictionary().table, *half_difference(wi, wo))
    weight = (wi[:, 2] * wo[:, 2])[:, None]
    rms = np.sqrt((weight * (table - exact) ** 2).sum(0) / (weight * exact**2).sum(0))
    assert np.median(rms) < 0.01
    assert rms.max() < 0.03


@pytest.mark.parametrize("disc", [False, True])
def test_embedded_dictionary__physical_materials_and_lobes(disc, convolved):
    dictionary = convolved if disc else embedded_dictionary()
    assert dictionary.names == (*abc_parameters(), *GRADED_NAMES)
    assert len(set(dictionary.names)) == dictionary.table.shape[-1] == 59 + 8
    assert np.isfinite(dictionary.table).all()
    assert (dictionary.table >= 0).all()
    albedo = directional_albedo(dictionary.table, [1.0, 0.7, 0.4])
    assert (albedo < 1).all()
    # at least the diffuse part
    assert (albedo[:, :59] > ROWS[:, :3].mean(1) * 0.98).all()
    # the lobes reflect at most what a smooth surface does, all of it if they are narrow
    smooth = fresnel_reflectance(np.array([1.0, 0.7, 0.4]), SURFACE_INDEX)
    np.testing.assert_allclose(
        albedo[:2, -3:], smooth[:2, None].repeat(3, 1), rtol=0.03
    )


def test_embedded_dictionary__shared_and_not_writeable():
    assert embedded_dictionary() is embedded_dictionary()
    with pytest.raises(ValueError, match="read-only"):
        embedded_dictionary().table[0] = 1


def test_convolve_disc__matches_averaging_of_the_exact_model(convolved):
    """Away from the horizon: the average over a dense disc around either direction, as
    in the docstring.
    """
    # with the sharpest lobes, as narrow as the disc
    rng = np.random.default_rng(3)
    some = np.r_[0:59:5, 18, 46, 48]
    wi, wo = directions(
        rng.random(200) ** 2 * 0.8, rng.random(200) * 0.8, rng.random(200) * np.pi
    )
    k = np.arange(300)
    disc = (
        np.sqrt((k + 0.5) / 300)[:, None]
        * np.stack([np.cos(k * 2.399963), np.sin(k * 2.399963)], 1)
        * np.tan(DISC)
    )
    total = np.zeros((200, len(some)))
    for a, b in ((wi, wo), (wo, wi)):
        first = _unit(np.cross(a, [0.3, 0.9, 0.1]))
        second = np.cross(a, first)
        for u, v in disc:
            total += (
                evaluate_abc(ROWS[some], _unit(a + u * first + v * second), b) / 600
            )
    got = lookup(convolved.table[..., some], *half_difference(wi, wo))
    rms = np.sqrt(((got - total) ** 2).sum(0) / (total**2).sum(0))
    # sharp lobes are over-represented; of all 59 the median is 0.07 %
    assert np.median(rms) < 0.006
    assert rms.max() < 0.03


def test_convolve_disc__takes_the_mean_of_both_directions():
    """A disc of 0.2 rad before a BRDF that rises to the horizon: the averages around
    either differ by up to 20 %.
    """
    grid = TableGrid(40, 40, 8)
    radius = 0.2
    table = tabulate(
        lambda wi, wo: 1 / np.maximum(wi[..., 2:] * wo[..., 2:], 0.01), grid
    )
    got = convolve_disc(Dictionary(("rising",), table, grid, "test"), radius).table[
        ..., 0
    ]
    # both directions stay above 0.3 rad, at unlike elevations
    nodes = np.s_[10:20, 20:26, 0]
    mesh = np.meshgrid(grid.theta_h, grid.theta_d, grid.phi_d, indexing="ij")
    wi, wo = directions(*(a[nodes] for a in mesh))
    k = np.arange(500)
    disc = np.sqrt((k + 0.5) / 500)[:, None] * np.stack(
        [np.cos(k * 2.399963), np.sin(k * 2.399963)], 1
    )
    sides = []
    for a, b in ((wi, wo), (wo, wi)):
        first = _unit(np.cross(a, [0.3, 0.9, 0.1]))
        moved = [
            _unit(a + np.tan(radius) * (u * first + v * np.cross(a, first)))
            for u, v in disc
        ]
        sides.append(
            np.mean(
                [lookup(table, *half_difference(m, b))[..., 0] for m in moved], axis=0
            )
        )
    assert np.abs(sides[0] / sides[1] - 1).max() > 0.1
    np.testing.assert_allclose(got[nodes], (sides[0] + sides[1]) / 2, rtol=0.01)


def test_convolve_disc__keeps_constants_and_reports_its_change():
    grid = TableGrid(10, 8, 6)
    flat = Dictionary(("flat",), np.full((10, 8, 6, 1), 0.25, np.float32), grid, "test")
    assert convolve_disc(flat, 0.0) is flat
    wide = convolve_disc(flat, 0.1)
    np.testing.assert_allclose(wide.table, 0.25, rtol=1e-5)
    assert wide.disc_angular_radius == 0.1
    assert wide.grid == grid


def test_convolve_disc__is_done_once_for_fits_and_studies():
    """Averaging the embedded tables takes 3 s and 46 MB, so that edits and studies must
    not repeat it.
    """
    flat = Dictionary(
        ("flat",), np.full((4, 4, 4, 1), 0.2, np.float32), TableGrid(4, 4, 4), "test"
    )
    assert convolve_disc(flat, 0.01) is convolve_disc(flat, 0.01)


# extreme inputs

GRID = TableGrid(24, 20, 8)


def _tables(table):
    table = np.ascontiguousarray(table, np.float32)
    names = tuple(str(i) for i in range(table.shape[-1]))
    return Dictionary(names, table, GRID, "extreme")


def _lobe(sharpness=40.0):
    def brdf(wi, wo):
        return np.exp(-sharpness * half_difference(wi, wo)[0][..., None] ** 2)

    return tabulate(brdf, GRID)


def test_convolve_disc__keeps_constants_of_any_scale():
    for radius, value in ((0.014, 0.0), (0.014, 1e-30), (0.014, 1e30), (0.3, 0.25)):
        constant = convolve_disc(_tables(np.full((24, 20, 8, 2), value)), radius)
        np.testing.assert_allclose(constant.table, np.float32(value), rtol=1e-5)


def test_convolve_disc__any_scale_and_a_disc_of_nearly_zero():
    lobe = _lobe()
    expected = convolve_disc(_tables(lobe), 0.05).table
    for scale in np.float32([1e-30, 1e-12, 1e12, 1e30]):
        averaged = convolve_disc(_tables(lobe * scale), 0.05).table
        np.testing.assert_allclose(averaged / scale, expected, rtol=1e-5, atol=1e-12)
    nearly_zero = convolve_disc(_tables(lobe), 1e-9)
    np.testing.assert_allclose(nearly_zero.table, lobe, atol=1e-5)


def test_convolve_disc__lies_between_the_extremes_and_lowers_a_sharp_lobe():
    lobe = _lobe(400.0)
    for radius in (0.05, 0.5):
        averaged = convolve_disc(_tables(lobe), radius).table
        assert averaged.min() >= -1e-6
        assert averaged.max() <= lobe.max() * (1 + 1e-5)
        assert averaged[0, 0, 0, 0] < lobe[0, 0, 0, 0]


DISC_QUALITY = np.radians(0.8)
NAMES = tuple(abc_parameters())
PAIRS = 900


@pytest.fixture(scope="module")
def embedded() -> dict[str, np.ndarray]:
    return dictionary_quality(embedded_dictionary(), DISC_QUALITY, pairs=PAIRS)


def _flat(*albedo, grid=DEFAULT_GRID):
    shape = (grid.n_theta_h, grid.n_theta_d, grid.n_phi_d)
    table = np.stack([np.full(shape, a / np.pi, np.float32) for a in albedo], axis=-1)
    return Dictionary(tuple(map(str, albedo)), table, grid, "flat")


def test_dictionary_quality__lambertian_surfaces():
    """Albedo as given to the quadrature's 3e-4 (horizon), excess above 1 only, nothing
    to break by a disc.
    """
    found = dictionary_quality(_flat(0.2, 1.25), DISC_QUALITY, pairs=PAIRS)
    np.testing.assert_allclose(found["normal_albedo"], [0.2, 1.25], rtol=3e-4)
    np.testing.assert_allclose(found["largest_albedo"], [0.2, 1.25], rtol=1e-3)
    np.testing.assert_allclose(found["energy_excess"], [0, 0.25], atol=1.5e-3)
    for name in ("reciprocity_error",):
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
        Dictionary(flat.names, flat.table, flat.grid, "averaged", DISC_QUALITY),
        0.1,
        pairs=PAIRS,
    )
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
    row = np.array([abc_parameters()[name]])
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


def test_dictionary_quality__the_embedded_materials(embedded):
    """The figures of docs/results, with a tolerance for another sample of directions."""
    assert embedded["energy_excess"].max() == 0
    assert embedded["reciprocity_error"].max() < 1e-12
    assert np.median(embedded["interpolation_error"]) < 0.01
    assert embedded["hole_fraction"].max() == 0


def test_dictionary_quality__a_coarse_table_is_reported():
    """With a third of the nodes along each axis, the error of interpolation is at least
    five times as large.
    """
    grid = TableGrid(30, 40, 8)
    coarse = replace(
        embedded_dictionary(), table=tabulate(evaluate_embedded, grid), grid=grid
    )
    found = dictionary_quality(coarse, 0.0, pairs=PAIRS)
    fine = dictionary_quality(embedded_dictionary(), 0.0, pairs=PAIRS)
    assert np.median(found["interpolation_error"]) > 5 * np.median(
        fine["interpolation_error"]
    )
