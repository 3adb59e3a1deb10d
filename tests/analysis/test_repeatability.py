"""Repeatability: published coefficients, planted variances, and too few subjects."""

from __future__ import annotations

import numpy as np
import pytest
from planted_tables import planted_tables

from skindb.analysis import repeatability
from skindb.errors import InputError
from skindb.numerics.statistics import (
    agreement_correlation,
    intraclass_correlation,
)

# Shrout and Fleiss 1979, table 2: six subjects and four judges
RATINGS = np.array(
    [
        [9, 2, 5, 8],
        [6, 1, 3, 2],
        [8, 4, 6, 8],
        [7, 1, 2, 6],
        [10, 5, 6, 9],
        [6, 2, 4, 7],
    ],
    float,
)
SUBJECTS = np.repeat(np.arange(6), 4)
PEOPLE, VISITS = 200, 3
BETWEEN, WITHIN = 0.03, 0.01


def planted(people=PEOPLE, visits=VISITS, *, change=0.0, seed=3):
    """R_d of subjects at visits; `change` (visits,) is common to all subjects."""
    rng = np.random.default_rng(seed)
    names = [f"S{i:03d}" for i in range(people) for _ in range(visits)]
    deviation = rng.normal(0, WITHIN, (people, visits)) + change
    cohort = planted_tables(names, albedo=deviation.ravel(), spread=BETWEEN)
    takes = [
        name if visit == 0 else f"{name}.normal.{visit + 1}"
        for name, visit in zip(names, [*range(visits)] * people, strict=True)
    ]
    return cohort.assign_coords(take=takes)


def test_correlations__are_the_published_ones():
    """Table 4 of Shrout and Fleiss, and the intervals that the manual of the package
    psych of R prints for these data, with two digits.
    """
    one_way = intraclass_correlation(RATINGS.ravel(), SUBJECTS)
    assert one_way[:3] == pytest.approx((0.17, -0.13, 0.72), abs=0.005)
    agreement = agreement_correlation(RATINGS)
    assert agreement == pytest.approx((0.29, 0.02, 0.76), abs=0.005)


def test_intraclass_correlation__of_equal_numbers_is_that_of_likelihood():
    values = (
        np.random.default_rng(2).normal(size=(40, 3)) + 2 * np.arange(40)[:, None] / 40
    )
    subject = np.repeat(np.arange(40), 3)
    statsmodels = pytest.importorskip("statsmodels.api")
    model = statsmodels.MixedLM(values.ravel(), np.ones(values.size), subject)
    found = model.fit(reml=True)
    between, within = float(found.cov_re[0, 0]), found.scale
    one_way = intraclass_correlation(values.ravel(), subject)
    assert one_way.correlation == pytest.approx(between / (between + within), rel=1e-4)
    assert one_way.within == pytest.approx(np.sqrt(within), rel=1e-4)


def test_repeatability__finds_what_was_planted():
    """With 200 subjects at three visits, the standard deviation within subjects is known
    to 1 / sqrt(2 * 400) = 3.5 %; three standard errors are allowed. The tables add
    noise of 0.002.
    """
    table = repeatability(planted()).sel(quantity="R_d face R")
    within = np.hypot(WITHIN, 0.002)
    expected = BETWEEN**2 / (BETWEEN**2 + within**2)
    assert table["icc_low"] < expected < table["icc_high"]
    assert table["icc_agreement_low"] < expected < table["icc_agreement_high"]
    assert float(table["within_subject_deviation"]) == pytest.approx(within, rel=0.11)
    coefficient = 1.96 * np.sqrt(2) * within
    assert float(table["repeatability_coefficient"]) == pytest.approx(
        coefficient, rel=0.11
    )
    limits = [float(table[f"agreement_{end}"]) for end in ("low", "high")]
    assert limits == pytest.approx([-coefficient, coefficient], rel=0.2)
    assert (int(table["repeat_subjects"]), int(table["repeat_takes"])) == (200, 600)


def test_repeatability__a_change_of_all_subjects_is_bias():
    changed = planted(change=np.array([0, 0.05, 0])).isel(take=slice(0, 90))
    table = repeatability(changed).sel(quantity="R_d face R")
    # three standard errors of a mean over 30 subjects
    error = 3 * np.sqrt(2) * np.hypot(WITHIN, 0.002) / np.sqrt(30)
    assert float(table["repeat_bias"]) == pytest.approx(0.05, abs=error)
    assert table["icc_agreement"] < 0.8


def test_repeatability__intervals_hold_the_truth_in_95_per_cent():
    """300 planted tables; a binomial of 95 % is between 0.905 and 0.985 at 1 in 1,000."""
    rng = np.random.default_rng(7)
    truth = 0.6
    hits = np.zeros(2)
    for _ in range(300):
        values = rng.normal(0, np.sqrt(truth), (12, 1))
        values = values + rng.normal(0, np.sqrt(1 - truth), (12, 3))
        one_way = intraclass_correlation(values.ravel(), np.repeat(np.arange(12), 3))
        _, low, high = agreement_correlation(values)
        hits += [one_way.low < truth < one_way.high, low < truth < high]
    assert (np.abs(hits / 300 - 0.945) < 0.04).all()


def test_repeatability__too_few_subjects():
    cohort = planted(3)
    with pytest.raises(
        InputError, match=r"at least 3 subjects .* found 2 of 3 subjects"
    ):
        repeatability(cohort.isel(take=slice(0, 7)))
    with pytest.raises(InputError, match=r"condition lotion: .* found 0 of 0 subjects"):
        repeatability(cohort, condition="lotion")
    cohort["region_diffuse_reflectance"][1:3, 0] = np.nan
    table = repeatability(cohort)
    assert np.isnan(table["icc"].sel(quantity="R_d face R"))
    assert np.isfinite(table["icc"].sel(quantity="R_d beard R"))


def test_repeatability__of_equal_values_is_unknown():
    cohort = planted()
    same = cohort["region_diffuse_reflectance"] * 0 + 0.3
    table = repeatability(cohort.assign(region_diffuse_reflectance=same))
    constant = table.sel(quantity="R_d face R")
    assert np.isnan(constant["icc"])
    assert np.isnan(constant["repeatability_coefficient"])


def test_repeatability__rare_visits_do_not_hide_the_agreement():
    """Third visits of 4 of 12 subjects, none of whom has a fourth."""
    cohort = planted(12, 4)
    visit = np.tile(np.arange(4), 12)
    person = np.repeat(np.arange(12), 4)
    both = (visit == 0) | (visit == 1)
    third = (visit == 2) & (person < 4)
    fourth = (visit == 3) & (person == 11)
    expected = repeatability(cohort.isel(take=both))
    found = repeatability(cohort.isel(take=both | third | fourth))
    name = "icc_agreement"
    assert np.isfinite(found[name].sel(quantity="R_d face R"))
    np.testing.assert_array_equal(found[name], expected[name])
