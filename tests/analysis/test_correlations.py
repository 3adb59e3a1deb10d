"""Correlations of the components of skin, on planted cohorts."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from planted_tables import planted_tables
from scipy import stats

from skindb.analysis import (
    component_correlations,
    describe_correlations,
    plot_correlations,
)
from skindb.errors import InputError

PAIR = "R_d G with log sigma_tr G"


def subjects(n):
    return [f"S{i}" for i in range(n)]


def found(cohort, **options):
    return component_correlations(
        cohort, **({"permutations": 300, "rng": np.random.default_rng(0)} | options)
    )


def linked(n, strength, seed=0):
    """Albedo and log sigma_tr are correlated: a change of albedo times `strength` is
    subtracted from log sigma_tr.
    """
    dark = np.random.default_rng([7, seed]).normal(size=n)
    return planted_tables(
        subjects(n), albedo=0.05 * dark, log_tr=-strength * 0.1 * dark, seed=seed
    )


def test_component_correlations__are_numpys():
    cohort = linked(40, 3.0)
    table = found(cohort)
    albedo = cohort["region_diffuse_reflectance"].sel(region="face").isel(channel=1)
    log = np.log(cohort["site_sigma_tr"].isel(site=0, channel=1))
    one = table.sel(pair=PAIR)
    want = np.corrcoef(albedo, log)[0, 1]
    assert float(one["component_correlation"]) == pytest.approx(want, abs=1e-9)
    assert (
        float(one["component_correlation_low"])
        < want
        < float(one["component_correlation_high"])
    )
    assert float(one["correlation_p"]) < 0.02
    assert int(one["correlation_count"]) == 40
    assert table.sizes["pair"] == 21


def test_component_correlations__intervals_are_those_of_scipy():
    """The values are normally distributed, so that Fisher's interval is valid."""
    cohort = linked(60, 1.0)
    one = found(cohort).sel(pair=PAIR)
    albedo = cohort["region_diffuse_reflectance"].sel(region="face").isel(channel=1)
    log = np.log(cohort["site_sigma_tr"].isel(site=0, channel=1))
    want = stats.pearsonr(albedo, log).confidence_interval()
    assert float(one["component_correlation_low"]) == pytest.approx(want.low, abs=0.08)
    assert float(one["component_correlation_high"]) == pytest.approx(
        want.high, abs=0.08
    )


@pytest.mark.slow
def test_component_correlations__p_is_even_without_any():
    p = [
        float(
            found(linked(20, 0.0, seed=s), permutations=99)["correlation_p"].sel(
                pair=PAIR
            )
        )
        for s in range(60)
    ]
    assert stats.kstest(p, "uniform").pvalue > 0.001


def test_component_correlations__p_counts_every_permutation_and_both_orders_alike():
    cohort = linked(6, 1.0)
    albedo = (
        cohort["region_diffuse_reflectance"].sel(region="face").isel(channel=1).values
    )
    log = np.log(cohort["site_sigma_tr"].isel(site=0, channel=1).values)
    one = float(found(cohort, permutations=720)["correlation_p"].sel(pair=PAIR))
    for x, y in ((albedo, log), (log, albedo)):
        largest = abs(np.corrcoef(x, y)[0, 1]) * (1 - 1e-12)
        as_large = [
            abs(np.corrcoef(np.array(order), y)[0, 1]) >= largest
            for order in permutations(x)
        ]
        assert one == pytest.approx(np.mean(as_large))


def test_component_correlations__sites_do_not_pass_for_skin():
    """Dark subjects were measured at another, less translucent site; within a site
    there is no correlation.
    """
    cohort = linked(40, 0.0).isel(site=[0, 0]).assign_coords(site=["cheek", "neck"])
    touched = np.arange(40) % 2
    level = np.where(np.arange(2) == 1, 3.0, 1.0)
    cohort["site_sigma_tr"] = cohort["site_sigma_tr"] * level[None, :, None]
    cohort["site_sigma_tr"] = cohort["site_sigma_tr"].where(
        touched[:, None, None] == np.arange(2)[None, :, None]
    )
    darker = cohort["region_diffuse_reflectance"] - 0.1 * touched[:, None, None]
    cohort["region_diffuse_reflectance"] = darker
    one = found(cohort).sel(pair=PAIR)
    assert int(one["correlation_count"]) == 40
    # by chance, 40 subjects have a correlation of 0.16
    assert abs(float(one["component_correlation"])) < 0.4


def test_component_correlations__few_subjects():
    table = found(linked(7, 1.0))
    assert np.isnan(table["component_correlation_low"]).all()
    assert "fewer than 10 subjects" in describe_correlations(table)[-1]
    with pytest.raises(InputError, match="5 subjects must have two components"):
        found(linked(3, 1.0))


def test_component_correlations__skips_quantities_without_values():
    cohort = linked(20, 1.0).drop_vars(["site_sigma_tr", "site_status"])
    assert found(cohort).sizes["pair"] == 6
    ax = plot_correlations(found(cohort))
    assert "(n = 20)" in ax.get_xlabel()
