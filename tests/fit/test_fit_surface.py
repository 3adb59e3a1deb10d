"""Surface fits: planted mixtures, certificates, statuses, prediction of unseen lights, reduced bases."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from skindb.errors import InputError
from skindb.fit import fit_surface, held_out_error, reduce_basis, refit
from skindb.fit.basis import table_gram
from skindb.schema import FitStatus, dataset, label

HALF = 2e-3  # samples are half floats: 5e-4 each, relative to the surface term more


@pytest.fixture(scope="module")
def planted(skin, small_dictionary, plant):
    return plant(skin, small_dictionary, np.random.default_rng(5))


@pytest.mark.parametrize("mode", ["linear", "perceptual"])
@pytest.mark.parametrize("rank", [6, 5])
def test_fit_surface__reproduces_planted_reflectance(planted, small_dictionary, mode, rank):
    lumitexels, weight = planted
    found = fit_surface(lumitexels, dictionary=small_dictionary, mode=mode, rank=rank)
    assert (found["fit_status"] == FitStatus.FITTED).all()
    # five dimensions do not hold six materials
    assert found["full_basis_residual"].max() < (HALF if rank == 6 else 0.05)
    assert found["kkt_residual"].max() < 1e-9
    assert (found["basis_weight"] >= 0).all()
    # compared as BRDFs: weights are not unique
    cells = small_dictionary.table[5:60, 5:60, ::6].reshape(-1, weight.shape[1]).astype(float)
    true, fitted = weight @ cells.T, found["basis_weight"].values @ cells.T
    assert np.median(np.abs(fitted - true)) < 0.02 * np.median(true)


def test_fit_surface__statuses(planted, small_dictionary):
    lumitexels = planted[0].copy(deep=True)
    sample, position = lumitexels["reflectance_sample"].values, lumitexels["surfel_position"].values
    diffuse, normal = lumitexels["diffuse_reflectance"].values, lumitexels["shading_normal"].values
    sample[0] = np.nan
    sample[1].reshape(-1, 3)[40:] = np.nan
    sample[1].reshape(-1, 3)[:35] = np.nan
    diffuse[2] = np.nan
    diffuse[3] = 1e-4
    sample[4, 0, 0] = np.inf
    position[5] = np.nan
    normal[6] = np.nan
    found = fit_surface(lumitexels, dictionary=small_dictionary)
    expected = [
        FitStatus.UNSEEN,
        FitStatus.TOO_FEW_SAMPLES,
        FitStatus.NO_DIFFUSE_ESTIMATE,
        FitStatus.DIFFUSE_CLAMPED,
        FitStatus.NOT_FINITE,
        FitStatus.NOT_FINITE,
        FitStatus.TOO_FEW_SAMPLES,
        FitStatus.FITTED,
    ]
    assert found["fit_status"].values[:8].tolist() == expected
    nothing = [0, 1, 2, 5, 6]
    assert np.isnan(found["basis_weight"].values[nothing]).all()
    assert np.isfinite(found["basis_weight"].values[[3, 7]]).all()


def test_fit_surface__any_chunking(planted, small_dictionary):
    lumitexels, _ = planted
    eager = fit_surface(lumitexels, dictionary=small_dictionary)
    lazy = fit_surface(lumitexels.chunk(surfel=9), dictionary=small_dictionary).compute()
    for name in ("basis_weight", "full_basis_residual"):
        np.testing.assert_allclose(lazy[name].values, eager[name].values, rtol=1e-4, atol=1e-6)


def test_fit_surface__asks_for_normals_and_diffuse(skin, small_dictionary):
    with pytest.raises(InputError, match="shading_normal") as caught:
        fit_surface(skin.lumitexels, dictionary=small_dictionary)
    assert len(caught.value.faults) == 2


def _identity_basis(dictionary):
    k = len(dictionary.names)
    return dataset({"component_weight": np.eye(k), "basis_brdf": np.moveaxis(dictionary.table, -1, 0)})


def test_refit__every_bases_as_components_is_the_full_fit(planted, small_dictionary):
    lumitexels, _ = planted
    full = fit_surface(lumitexels, dictionary=small_dictionary, rank=6)
    reduced = refit(lumitexels, basis=_identity_basis(small_dictionary))
    np.testing.assert_allclose(reduced["reduced_weight"], full["basis_weight"], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(reduced["fit_residual"], full["full_basis_residual"], rtol=1e-6)


def test_held_out_error__is_the_noise_for_the_true_model(skin, small_dictionary, plant):
    noise = 0.04
    lumitexels, weight = plant(skin, small_dictionary, np.random.default_rng(6), noise=noise)
    lumitexels = lumitexels.assign(reduced_weight=label("reduced_weight", weight))
    found = held_out_error(lumitexels.isel(light=slice(0, 20)), basis=_identity_basis(small_dictionary))
    assert abs(float(found["held_out_error"].median()) - noise) < 0.25 * noise
    # d cbrt(y) / cbrt(y) = dy / (3 y)
    assert abs(float(found["held_out_error_perceptual"].median()) - noise / 3) < 0.25 * noise / 3


def test_held_out_error__wrong_weights_show(planted, small_dictionary):
    lumitexels, weight = planted
    basis = _identity_basis(small_dictionary)
    right, wrong = (
        held_out_error(lumitexels.assign(reduced_weight=label("reduced_weight", f * weight)), basis=basis)
        for f in (1.0, 2.0)
    )
    assert right["held_out_error"].max() < HALF
    assert wrong["held_out_error"].min() > 0.05


def _fitted(weight, *, status=FitStatus.FITTED):
    n = len(weight)
    return dataset(
        {"basis_weight": weight, "fit_status": np.full(n, status), "surfel_area": np.linspace(1, 2, n)},
    )


@pytest.mark.parametrize("in_metric", [False, True])
def test_reduce_basis__finds_the_planted_space(small_dictionary, in_metric):
    rng = np.random.default_rng(7)
    rows = np.array([[1.0, 0, 0.5, 0, 0, 0], [0, 1.0, 0, 0, 0.2, 0]])
    weight = rng.uniform(0, 1, (300, 2)) @ rows
    found = reduce_basis(_fitted(weight), dictionary=small_dictionary, k=2, rng=rng, in_metric=in_metric)
    H = found["component_weight"].values
    left = weight - weight @ np.linalg.pinv(H) @ H
    assert np.linalg.norm(left) < 0.02 * np.linalg.norm(weight)
    tables = np.einsum("kj,hdpj->khdp", H, small_dictionary.table)
    np.testing.assert_allclose(found["basis_brdf"].values, tables, rtol=1e-4)
    area = np.linspace(1, 2, 300)
    np.testing.assert_allclose(found["mean_basis_weight"], area @ weight / area.sum(), rtol=1e-5)
    assert found["basis"].values.tolist() == list(small_dictionary.names)


def test_reduce_basis__same_seed_same_basis(small_dictionary):
    weight = np.random.default_rng(8).uniform(0, 1, (200, 6))
    twice = [
        reduce_basis(_fitted(weight), dictionary=small_dictionary, k=3, rng=np.random.default_rng(1)) for _ in range(2)
    ]
    xr.testing.assert_allclose(twice[0], twice[1], rtol=1e-6)  # BLAS rounds by the alignment of arrays


def test_reduce_basis__refuses_what_it_cannot_do(small_dictionary):
    weight = np.ones((20, 6))
    for k in (0, 7):
        with pytest.raises(InputError, match="a reduced basis has 1 to 6 components"):
            reduce_basis(_fitted(weight), dictionary=small_dictionary, k=k, rng=np.random.default_rng(0))
    with pytest.raises(InputError, match="a basis needs fitted surfels"):
        reduce_basis(
            _fitted(weight, status=FitStatus.UNSEEN), dictionary=small_dictionary, rng=np.random.default_rng(0)
        )


def test_table_gram__is_the_sum_over_cells(small_dictionary):
    grid, table = small_dictionary.grid, small_dictionary.table.astype(float)
    th, td = grid.theta_h, grid.theta_d
    total = 0.0
    for i in range(len(th)):
        for j in range(len(td)):
            step = np.gradient(th)[i] * np.sin(th[i]) * np.sin(td[j]) * np.cos(td[j]) ** 2 * np.cos(th[i])
            total += step * (table[i, j, :, 1] * table[i, j, :, 4]).mean()
    np.testing.assert_allclose(table_gram(small_dictionary)[1, 4], total, rtol=1e-5)
