from __future__ import annotations

import numpy as np
import pytest

from skindb.export.pbr import Lobes, _pairs, approximation_error, fit_lobes, material

DULL = np.full((4, 2), 0.1)


def test_fit_lobes__recovers_planted_lobes(tables: np.ndarray) -> None:
    # tolerances: trilinear tables of 90 x 46 x 36 nodes and steps of 0.0125 in roughness
    lobes = fit_lobes(tables, DULL, eta=1.3)
    np.testing.assert_allclose(lobes.roughness, [0.55, 0.35], atol=0.0126)
    np.testing.assert_allclose(lobes.strength, [0.8, 0.5], rtol=0.05)
    np.testing.assert_allclose(lobes.diffuse, [0.02, 0.0], atol=2e-3)


def test_fit_lobes__diffuse_gain_is_the_ratio_of_transmittances(tables: np.ndarray) -> None:
    # at eta = 1 all light enters the skin, while glTF's dielectric lets 1 - F through: the gain exceeds 1
    assert fit_lobes(tables, DULL, eta=1.0).diffuse_gain > 1 / 0.96
    # at normal incidence and index 1.3 both ways: 0.983^2 against 0.96
    assert fit_lobes(tables, DULL, eta=1.3).diffuse_gain == pytest.approx(0.983**2 / 0.96, rel=0.05)


def test_fit_lobes__raises_f0_for_a_shiny_surface(tables: np.ndarray) -> None:
    # weight 5 of a lobe of strength 0.8: four times glTF's default at normal incidence
    weights, diffuse = np.full((3, 1), 5.0), np.full((3, 3), 0.3)
    lobes = fit_lobes(tables[..., :1], weights, eta=1.3)
    assert lobes.f0 == pytest.approx(4 * 0.04, rel=0.05)
    raised = approximation_error(tables[..., :1], diffuse, weights, lobes, eta=1.3)
    default = approximation_error(
        tables[..., :1], diffuse, weights, fit_lobes(tables[..., :1], DULL[:, :1], eta=1.3), eta=1.3
    )
    assert default["clipped_share"] == 1
    # the planted lobe grows four times at grazing angles too, which no F0 can say
    assert raised["relative_rms"] < 0.7 * default["relative_rms"]


def test_approximation_error__small_for_what_gltf_can_say_large_for_what_it_cannot(tables: np.ndarray) -> None:
    diffuse, weights = np.full((3, 3), 0.3), np.array([[0.2], [0.5], [1.0]])
    lobes = fit_lobes(tables[..., :1], weights, eta=1.0)
    good = approximation_error(tables[..., :1], diffuse, weights, lobes, eta=1.0)
    assert good["relative_rms"] < 0.05
    assert good["clipped_share"] == 0
    wrong = Lobes(lobes.diffuse, lobes.strength * 2, lobes.roughness, lobes.diffuse_gain)
    bad = approximation_error(tables[..., :1], diffuse, weights, wrong, eta=1.0)
    assert bad["relative_rms"] > 3 * good["relative_rms"]
    assert bad["clipped_share"] == pytest.approx(1 / 3)


def test_material__keeps_the_peak_and_stays_in_range() -> None:
    lobes = Lobes(np.array([0.1, 0.0]), np.array([0.5, 0.25]), np.array([0.6, 0.3]), 1.0)
    found = material(lobes, np.full((3, 3), 0.5), np.array([[1.0, 2.0], [0.0, 0.0], [9.0, 0.0]]))
    np.testing.assert_allclose(1 / found.roughness**4, [(0.6**-4 + 0.3**-4) / 2, 1.0, 0.6**-4])
    np.testing.assert_allclose(found.specular, [1.0, 0.0, 1.0])
    np.testing.assert_allclose(found.base_color[:, 0], [0.6, 0.5, 1.0])


def test_approximation_error__weights_directions_like_a_picture() -> None:
    # lights uniform over the hemisphere: mean cosine 1/2; cameras by projected area: 2/3; cut off at a cosine of 0.05
    pairs = _pairs()
    total = pairs.share.sum()
    assert (pairs.share * pairs.cos_i).sum() / total == pytest.approx(0.5 * 1.05, rel=0.02)
    assert (pairs.share * pairs.cos_o).sum() / total == pytest.approx(2 / 3, rel=0.02)
