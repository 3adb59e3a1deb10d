"""Comparisons of so few subjects that nothing can be told: they say so instead of giving numbers."""

from __future__ import annotations

import numpy as np
import pytest
from planted_tables import planted_tables

from skindb.analysis import group_effects
from skindb.analysis.group_effects import describe_group_effects
from skindb.analysis.members import subjects_without_normal
from skindb.errors import InputError
from skindb.numerics.inference import effects, permutation_p


@pytest.mark.parametrize("others", [3, 5, 20])
def test_effects__a_group_of_one_has_no_error(others):
    """A p value would be a tie that rounding breaks: 5 against 1 gave 0.006, where 1/6 is the least."""
    values = np.random.default_rng(others).standard_normal((others + 1, 40))
    group = np.array([1.0] + [0.0] * others)
    for call in (lambda: effects(values, group), lambda: permutation_p(values, group, rng=np.random.default_rng(0))):
        with pytest.raises(ValueError, match="the effect depends on one subject"):
            call()


def test_effects__alone_in_a_covariate_is_no_reason():
    """A subject alone in a category that is held fixed tells nothing of the effect, and does no harm."""
    rng = np.random.default_rng(1)
    values, group = rng.standard_normal((12, 5)), np.array([0.0, 1.0] * 6)
    alone = np.eye(12)[:1].T
    without = effects(values[1:], group[1:])
    found = effects(values, group, alone)
    np.testing.assert_allclose(found.slope, without.slope)
    np.testing.assert_allclose(found.error, without.error, rtol=1e-6)


def test_effects__quantities_that_only_one_of_a_group_has_are_unknown():
    rng = np.random.default_rng(2)
    values, group = rng.standard_normal((10, 2)), np.array([1.0] * 3 + [0.0] * 7)
    values[:2, 1] = np.nan
    found = effects(values, group)
    assert np.isfinite(found.error[0])
    assert np.isnan(found.error[1])
    assert np.isnan(found.slope[1])


def _compare(cohort, group_by):
    return group_effects(cohort, group_by=group_by, permutations=500, rng=np.random.default_rng(0))


def test_group_effects__a_group_of_one_is_refused():
    cohort = planted_tables([f"S{i}" for i in range(6)], gender=["male"] + ["female"] * 5)
    with pytest.raises(InputError, match="the effect depends on one subject"):
        _compare(cohort, "gender")


def test_group_effects__nothing_can_differ_with_so_few_subjects():
    """Two against three: ten assignments, so that no p is below 0.1; a detectable effect would be a lie."""
    cohort = planted_tables([f"S{i}" for i in range(5)], gender=["male"] * 2 + ["female"] * 3)
    found = _compare(cohort, "gender")
    assert np.nanmin(found["effect_p"]) >= 0.1
    assert np.isnan(found["effect_detectable"]).all()
    lines = describe_group_effects(found)
    assert any(
        "with 5 subjects no p value can be below 0.1, so that no difference can be significant at 5 %" in line
        for line in lines
    )
    assert not any("detectable differences" in line for line in lines if "nan" in line)


def test_group_effects__older_means_older_than_the_median_of_all_subjects():
    """A subject without a take in the condition normal is not compared, but has an age."""
    people = ["A", "B", "C", "D", "E", "F", "G.makeup"]
    age = np.array([20.0, 30.0, 38.0, 50.0, 60.0, 70.0, 80.0])
    cohort = planted_tables(people, age=age)
    cohort = cohort.assign_coords(
        subject=("take", np.array(list("ABCDEFG"))),
        condition=("take", np.array(["normal"] * 6 + ["makeup"])),
    )
    found = _compare(cohort, "age:older")
    with_it, without = found["effect_count"].isel(contrast=0).max("quantity").values
    assert (with_it, without) == (2, 4)  # above 50, the median of seven; of six it would be 44, and three
    assert subjects_without_normal(cohort) == ["G: no take in the condition normal"]
