from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from skindb.export.textures import (
    MAX_F0,
    ROUGHNESS,
    Material,
    _best_pair,
    _pairs,
    approximation_error,
    fit_material,
)

DIFFUSE = np.array([[0.5, 0.35, 0.25]])


def error(tables, weights, values, diffuse=DIFFUSE, eta=1.3):
    return approximation_error(tables, diffuse, np.asarray(weights), values, eta=eta)[
        "relative_rms"
    ]


def test_fit_material__recovers_a_planted_lobe(tables: np.ndarray) -> None:
    """A table that is itself a GGX lobe of roughness 0.55, f0 0.04 and factor 0.8,
    beside 0.02 of matt reflection.
    """
    found = fit_material(tables[..., :1], DIFFUSE, np.ones((1, 1)), eta=1.0)
    # steps of 0.02, trilinear tables
    assert found.roughness[0] == pytest.approx(0.55, abs=0.03)
    # a lobe that is a bit narrower and stronger fits the table between its nodes as well
    assert found.specular[0] == pytest.approx(0.8, rel=0.15)
    assert found.specular[0] * found.f0[0] == pytest.approx(0.8 * 0.04, rel=0.1)
    # without a boundary (eta = 1) the matt part is R_d; the dielectric lets 1 - F
    # through: the colour is a bit higher
    np.testing.assert_allclose(
        found.base_color[0], (DIFFUSE[0] + 0.02) * 1.05, rtol=0.06
    )
    assert error(tables[..., :1], np.ones((1, 1)), found, eta=1.0) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("weights", [[1.0, 0.0], [0.2, 0.6], [0.5, 2.0], [3.0, 0.3]])
def test_fit_material__no_other_material_is_better(
    tables: np.ndarray, weights: list[float]
) -> None:
    """Against a search over all six values that starts at the solution and at random materials."""
    given = np.array([weights])
    found = fit_material(tables, DIFFUSE, given, eta=1.3)
    mine = error(tables, given, found)

    def cost(x: np.ndarray) -> float:
        x = np.clip(x, 1e-3, 1)
        f0 = np.minimum(x[4:5], MAX_F0)
        return error(
            tables,
            given,
            Material(x[None, :3], x[3:4], f0, np.maximum(x[5:], ROUGHNESS[0])),
        )

    start = np.concatenate(
        [found.base_color[0], found.specular, found.f0, found.roughness]
    )
    rng = np.random.default_rng(0)
    starts = [start, *rng.uniform(0.1, 0.9, (2, 6))]
    best = min(
        minimize(cost, one, method="Nelder-Mead", options={"maxiter": 600}).fun
        for one in starts
    )
    assert mine < 1.1 * best + 0.002  # steps of the roughness, and the rounds


def test_best_pair__against_a_search() -> None:
    rng = np.random.default_rng(1)
    root = rng.standard_normal((200, 2, 4))
    gram = root @ root.transpose(0, 2, 1)
    rhs = rng.standard_normal((200, 2)) * 2
    x, gain = _best_pair(gram, rhs)
    assert (x >= 0).all()
    assert (x.sum(axis=1) <= 1 + 1e-9).all()
    assert (x[:, 0] <= MAX_F0 * x.sum(axis=1) + 1e-9).all()
    total, share = np.meshgrid(np.linspace(0, 1, 201), np.linspace(0, MAX_F0, 121))
    tried = np.stack(
        [total.ravel() * share.ravel(), total.ravel() * (1 - share.ravel())], axis=1
    )
    fall = 2 * rhs @ tried.T - np.einsum("tj,njk,tk->nt", tried, gram, tried)
    # none of the grid is better
    np.testing.assert_array_less(fall.max(axis=1), gain + 1e-9)
    assert np.abs(fall.max(axis=1) - gain).max() < 0.02  # and the grid comes near


def test_fit_material__stays_in_the_range_of_gltf(tables: np.ndarray) -> None:
    rng = np.random.default_rng(2)
    diffuse = rng.uniform(0, 1, (300, 3))
    weights = rng.exponential(2.0, (300, 2)) * rng.integers(0, 2, (300, 2))
    found = fit_material(tables, diffuse, weights, eta=1.3)
    most = {"base_color": 1.0, "specular": 1.0, "f0": MAX_F0, "roughness": 1.0}
    for name, limit in most.items():
        values = getattr(found, name)
        assert np.isfinite(values).all()
        assert values.min() >= 0
        assert values.max() <= limit + 1e-9


def test_approximation_error__large_for_a_wrong_material(tables: np.ndarray) -> None:
    diffuse = np.full((3, 3), 0.3)
    weights = np.array([[0.2], [0.5], [0.9]])
    good = fit_material(tables[..., :1], diffuse, weights, eta=1.0)
    bad = replace(good, specular=good.specular / 2)
    assert error(tables[..., :1], weights, bad, diffuse, 1.0) > 3 * error(
        tables[..., :1], weights, good, diffuse, 1.0
    )


def test_approximation_error__weights_directions_like_a_picture() -> None:
    # lights uniform over the hemisphere: mean cosine 1/2; cameras by projected area:
    # 2/3; cut off at a cosine of 0.05
    pairs = _pairs()
    total = pairs.weight.sum()
    assert (pairs.weight * pairs.cos_i).sum() / total == pytest.approx(
        0.5 * 1.05, rel=0.02
    )
    assert (pairs.weight * pairs.cos_o).sum() / total == pytest.approx(2 / 3, rel=0.02)
