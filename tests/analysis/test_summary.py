"""Summaries of models for cohorts: means by hand, errors by simulation, distribution of samples."""

from __future__ import annotations

import numpy as np
import pytest
from planted_population import model_of, population

from skindb.analysis import cohort_of, region_tables, sample_surfels, summary_tables
from skindb.analysis.summary import (
    MAX_HALF_ANGLE,
    MODEL_ERRORS,
    PATCH_SIZE,
    trusted_surfels,
)
from skindb.errors import InputError
from skindb.schema import dataset
from skindb.schema.declaration import MAX_CONDITION_TRUSTED, MIN_SAMPLES_TRUSTED

N = 400


def _fitted(seed=0, *, noise=0.02, common=0.0):
    """Surfels of equal albedo, measured with independent errors and one common error."""
    rng = np.random.default_rng(seed)
    area = rng.uniform(0.5, 2.0, N)
    sigma = noise * rng.uniform(0.5, 2.0, (N, 3))
    colour = (
        np.array([0.5, 0.3, 0.2])
        + sigma * rng.normal(size=(N, 3))
        + common * rng.normal(size=3)
    )
    return dataset(
        {
            "diffuse_reflectance": colour,
            "diffuse_reflectance_error": sigma,
            "diffuse_reflectance_total_error": np.hypot(sigma, common),
            "surface_reflectance": 0.03 + 0.01 * rng.normal(size=N),
            "surface_reflectance_error": np.full(N, 0.01),
            "surfel_area": area,
            "surfel_position": rng.uniform(0, 80, (N, 3)) * [1, 1, 0],
            "fit_status": np.zeros(N),
        },
        coords={"channel": ["R", "G", "B"]},
    )


def test_region_tables__means_by_hand():
    fitted = _fitted()
    mask = np.arange(N) < 100
    table = region_tables(
        fitted, {"face": np.ones(N, bool), "left": mask, "none": np.zeros(N, bool)}
    )
    area, colour = (
        fitted[name].values.astype(float)
        for name in ("surfel_area", "diffuse_reflectance")
    )
    want = (area[mask, None] * colour[mask]).sum(0) / area[mask].sum()
    np.testing.assert_allclose(
        table["region_diffuse_reflectance"].sel(region="left"), want, rtol=1e-6
    )
    assert table["region_surfels"].values.tolist() == [N, 100, 0]
    assert float(table["region_area"].sel(region="left")) == pytest.approx(
        area[mask].sum()
    )
    empty = table.sel(region="none")
    assert np.isnan(empty["region_diffuse_reflectance"]).all()
    assert float(empty["region_area"]) == 0


@pytest.mark.slow
@pytest.mark.parametrize("common", [0.0, 0.01])
def test_region_tables__stated_errors_are_the_scatter_of_means(common):
    """300 measurements of one face give the scatter of means to 4 %; three times that
    is allowed.
    """
    face = {"face": np.ones(N, bool)}
    tables = [
        region_tables(_fitted(seed, common=common), face).isel(region=0)
        for seed in range(300)
    ]
    means = np.array([one["region_diffuse_reflectance"].values for one in tables])
    stated = np.array(
        [one["region_diffuse_reflectance_total_error"].values for one in tables]
    ).mean(0)
    np.testing.assert_allclose(stated, means.std(axis=0, ddof=1), rtol=0.13)
    noise = np.array(
        [one["region_diffuse_reflectance_error"].values for one in tables]
    ).mean(0)
    assert (noise < stated).all() if common else np.allclose(noise, stated, rtol=1e-4)


def test_region_tables__surfels_without_an_error_leave_the_mean_one():
    """A surfel with all weights at the bound has no error, but the mean of 400 surfels
    must have one.
    """
    fitted = _fitted()
    face = {"face": np.ones(N, bool)}
    whole = float(region_tables(fitted, face)["region_surface_reflectance_error"][0])
    fitted["surface_reflectance_error"][:5] = np.nan
    assert float(
        region_tables(fitted, face)["region_surface_reflectance_error"][0]
    ) == pytest.approx(whole, rel=1e-6)


def test_region_tables__surface_reflectance_is_of_surfels_seen_in_their_highlight():
    fitted = _fitted()
    seen = np.arange(N) < 100
    angle = np.where(seen, MAX_HALF_ANGLE, MAX_HALF_ANGLE + 1)
    fitted["surface_reflectance"][~seen] = 0.01
    face = {"face": np.ones(N, bool)}
    table = region_tables(fitted.assign(smallest_half_angle=("surfel", angle)), face)
    area, gloss = (
        fitted[name].values[seen] for name in ("surfel_area", "surface_reflectance")
    )
    mean = np.average(gloss, weights=area)
    assert table["region_surface_reflectance"].item() == pytest.approx(mean)
    plain = region_tables(fitted, face)
    nowhere = fitted.assign(smallest_half_angle=("surfel", np.full(N, 90.0)))
    assert region_tables(nowhere, face).equals(plain)


def test_region_tables__surface_error_is_the_scatter_of_means_with_common_errors():
    """Surfels of a square of 20 mm have an error in common, which is as large as the
    independent ones; the stated error would be a fifth without it. The scatter of 100
    means is known to 7 %; three times that is allowed.
    """
    face = {"face": np.ones(N, bool)}
    means = []
    errors = []
    for seed in range(100):
        fitted = _fitted(seed)
        square = (fitted["surfel_position"].values // PATCH_SIZE).astype(int)
        common = 0.01 * np.random.default_rng([1, seed]).normal(size=(4, 4))
        fitted["surface_reflectance"] += common[square[:, 0], square[:, 1]]
        table = region_tables(fitted, face)
        means.append(table["region_surface_reflectance"].item())
        errors.append(table["region_surface_reflectance_error"].item())
    stated = np.sqrt(np.mean(np.square(errors)))
    np.testing.assert_allclose(stated, np.std(means, ddof=1), rtol=0.21)


def test_region_tables__glossiness_is_the_narrow_part_of_the_reflected_light():
    """Its error is that of a ratio of sums over patches (Cochran 1977, section 6.3)."""
    fitted = _fitted()
    rng = np.random.default_rng(5)
    shine = fitted["surface_reflectance"].values.astype(float)
    sharp = rng.uniform(0.3, 0.7, N)
    sharp[:50] = np.nan  # black surfels
    shine[:50] = 0
    fitted["surface_reflectance"][:] = shine
    table = region_tables(
        fitted.assign(glossiness=("surfel", sharp)), {"face": np.ones(N, bool)}
    )
    light = fitted["surfel_area"].values * shine
    narrow = np.nan_to_num(light * sharp)
    ratio = narrow.sum() / light.sum()
    square = (fitted["surfel_position"].values // PATCH_SIZE).astype(int)
    patch = square[:, 0] * 4 + square[:, 1]
    residual = np.bincount(patch, narrow - ratio * light)
    count = len(residual)
    error = np.sqrt((residual**2).sum() * count / (count - 1)) / light.sum()
    assert table["region_glossiness"].item() == pytest.approx(ratio, rel=1e-6)
    assert table["region_glossiness_error"].item() == pytest.approx(error, rel=1e-4)


def test_trusted_surfels__are_fitted_well_conditioned_and_seen_often():
    fitted = _fitted()
    fitted["fit_status"][0] = 4
    fitted = fitted.assign(
        fit_condition=(
            "surfel",
            np.where(np.arange(N) == 1, 2 * MAX_CONDITION_TRUSTED, 1.0),
        ),
        fit_samples=(
            "surfel",
            np.where(np.arange(N) == 2, MIN_SAMPLES_TRUSTED - 1, MIN_SAMPLES_TRUSTED),
        ),
    )
    fitted["diffuse_reflectance"][3] = np.nan
    np.testing.assert_array_equal(
        np.flatnonzero(~trusted_surfels(fitted)), [0, 1, 2, 3]
    )


def test_sample_surfels__is_of_fitted_surfels_in_the_order_of_the_draw():
    model = model_of(1)
    whole = sample_surfels(model)
    fitted = model["fitted"].to_dataset()
    assert sorted(whole["surfel_index"].values.tolist()) == list(
        range(1, fitted.sizes["surfel"])
    )
    few = sample_surfels(model, surfels=7)
    np.testing.assert_array_equal(few["surfel_index"], whole["surfel_index"][:7])
    index = few["surfel_index"].values
    np.testing.assert_array_equal(
        few["diffuse_reflectance"], fitted["diffuse_reflectance"].values[index]
    )
    assert (
        sample_surfels(model, surfels=7, seed=1)["surfel_index"].values != index
    ).any()
    model["fitted/fit_status"][:] = 1
    with pytest.raises(
        InputError, match="a take of a population must have fitted surfels"
    ):
        sample_surfels(model)


@pytest.mark.slow
def test_sample_surfels__every_surfel_is_as_likely_as_any_other():
    """Counts of 59 surfels in 2,000 samples of 10: chi-squared with 58 degrees exceeds
    110 once in 100,000 runs.
    """
    model = model_of(1)
    drawn = [
        sample_surfels(model, surfels=10, seed=seed)["surfel_index"].values
        for seed in range(2000)
    ]
    counts = np.bincount(np.concatenate(drawn))[1:]
    expected = 2000 * 10 / 59
    variance = expected * (1 - 10 / 59)  # drawn without replacement
    assert ((counts - expected) ** 2).sum() / variance < 110


def test_summary_tables__sites_keep_their_errors_and_statuses():
    tables = summary_tables(model_of(1))
    np.testing.assert_allclose(
        tables["site_sigma_tr"].sel(site="cheek"), [0.5, 1.0, 1.5], rtol=1e-6
    )
    assert (tables["site_status"] == 0).all()
    assert "site_sigma_tr" not in summary_tables(model_of(1, probe=False))


def test_cohort_of__who_refused_is_skipped():
    models = population()
    models["B"].attrs["consent_scope"] = ["fit"]
    cohort = cohort_of(models)
    assert cohort["take"].values.tolist() == ["A", "A.lotion", "C"]
    assert cohort.attrs["skipped"] == [
        {"take": "B", "reason": "its consent does not cover statistics"}
    ]
    assert cohort["age"].values.tolist() == [20, 20, 50]


def test_region_tables__errors_of_the_model_are_in_proportion_to_the_mean():
    fitted = _fitted().assign(
        glossiness=("surfel", np.full(N, 0.6)),
        glossiness_error=("surfel", np.full(N, 0.01)),
    )
    every = np.ones(N, bool)
    table = region_tables(fitted, {"lips": every, "chin": every})
    for name, relative in MODEL_ERRORS.items():
        squares = table[f"{name}_total_error"] ** 2 - table[f"{name}_error"] ** 2
        np.testing.assert_allclose(np.sqrt(squares) / table[name], relative)
