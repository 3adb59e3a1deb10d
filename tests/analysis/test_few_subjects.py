"""Comparisons of too few subjects: a note replaces the numbers that would be meaningless."""

from __future__ import annotations

import numpy as np
import pytest
from planted_tables import planted_tables

from skindb.analysis import (
    component_correlations,
    coverage_report,
    effect_maps,
    group_effects,
    translucency_table,
)
from skindb.analysis.groups import describe_group_effects
from skindb.analysis.subjects import NORMAL, subjects_of, subjects_without
from skindb.analysis.translucency import describe_translucency
from skindb.errors import InputError
from skindb.numerics.inference import effects, permutation_p


@pytest.mark.parametrize("others", [3, 5, 20])
def test_effects__a_group_of_one_has_no_error(others):
    """Rounding would break ties of the p value: 5 against 1 gave 0.006, but the
    smallest valid value is 1/6.
    """
    values = np.random.default_rng(others).standard_normal((others + 1, 40))
    group = np.array([1.0] + [0.0] * others)
    for call in (
        lambda: effects(values, group),
        lambda: permutation_p(values, group, rng=np.random.default_rng(0)),
    ):
        with pytest.raises(ValueError, match="the effect depends on one subject"):
            call()


def test_effects__a_subject_alone_in_a_category_is_harmless():
    """The only subject of a category that is held fixed contains no information about
    the effect, and is harmless.
    """
    rng = np.random.default_rng(1)
    values = rng.standard_normal((12, 5))
    group = np.array([0.0, 1.0] * 6)
    alone = np.eye(12)[:1].T
    without = effects(values[1:], group[1:])
    found = effects(values, group, alone)
    np.testing.assert_allclose(found.slope, without.slope)
    np.testing.assert_allclose(found.error, without.error, rtol=1e-6)


def test_effects__quantities_that_only_one_of_a_group_has_are_unknown():
    rng = np.random.default_rng(2)
    values = rng.standard_normal((10, 2))
    group = np.array([1.0] * 3 + [0.0] * 7)
    values[:2, 1] = np.nan
    found = effects(values, group)
    assert np.isfinite(found.error[0])
    assert np.isnan(found.error[1])
    assert np.isnan(found.slope[1])


def _compare(cohort, group_by):
    return group_effects(
        cohort, group_by=group_by, permutations=500, rng=np.random.default_rng(0)
    )


def test_group_effects__a_group_of_one_is_refused():
    cohort = planted_tables(
        [f"S{i}" for i in range(6)], gender=["male"] + ["female"] * 5
    )
    with pytest.raises(InputError, match="the effect depends on one subject"):
        _compare(cohort, "gender")


def test_group_effects__nothing_can_differ_with_so_few_subjects():
    """Two against three subjects have ten assignments, so that no p is below 0.1 and no
    effect is detectable.
    """
    cohort = planted_tables(
        [f"S{i}" for i in range(5)], gender=["male"] * 2 + ["female"] * 3
    )
    found = _compare(cohort, "gender")
    assert np.nanmin(found["effect_p"]) >= 0.1
    assert np.isnan(found["effect_detectable"]).all()
    lines = describe_group_effects(found)
    assert any(
        (
            "with 5 subjects no p value can be below 0.1, so that no difference can be "
            "significant at 5 %"
        )
        in line
        for line in lines
    )
    assert not any("detectable differences" in line for line in lines if "nan" in line)


@pytest.mark.parametrize("most", [500, 720, 50])
def test_group_effects__three_against_three_cannot_differ(most):
    """Each of the twenty assignments has the same |t| as its mirror image, so that no p
    is below 0.1.
    """
    cohort = planted_tables(
        [f"S{i}" for i in range(6)],
        gender=["male", "female"] * 3,
        albedo=[0.2, 0.0] * 3,
    )
    found = group_effects(
        cohort, group_by="gender", permutations=most, rng=np.random.default_rng(0)
    )
    assert found.attrs["smallest_p"] == pytest.approx([0.1])
    if most == 720:
        assert np.nanmin(found["effect_p"]) == pytest.approx(0.1)
    assert np.isnan(found["effect_detectable"]).all()
    lines = describe_group_effects(found)
    assert any("no p value can be below 0.1" in line for line in lines)
    assert not any("detectable differences" in line for line in lines)


@pytest.mark.parametrize(("pairs", "least"), [(5, 2 / 32), (6, 2 / 64)])
def test_group_effects__pairs_with_all_signs_changed_count_as_well(pairs, least):
    people = [f"S{i}" for i in range(pairs)]
    conditions = ["normal"] * pairs + ["lotion"] * pairs
    cohort = planted_tables(
        people * 2, conditions=conditions, albedo=[0.0] * pairs + [0.2] * pairs
    )
    found = _compare(cohort, "condition")
    assert found.attrs["smallest_p"] == pytest.approx([least])
    assert np.nanmin(found["effect_p"]) == pytest.approx(least)
    assert np.isnan(found["effect_detectable"]).all() == (least >= 0.05)


def test_group_effects__values_of_two_kinds_are_refused_and_mistakes_are_named():
    people = [f"S{i}" for i in range(8)]
    age = np.array(["22", "55 years", "31", "40", "28", "61", "35", "50"])
    cohort = planted_tables(
        people, age=age, gender=["male", "Male", "male", "male"] + ["female"] * 4
    )
    with pytest.raises(
        InputError,
        match=r"attribute age: must be a number .* found numbers and '55 years'",
    ):
        _compare(cohort, "age")
    with pytest.raises(InputError, match="attribute age"):
        group_effects(
            cohort, group_by="gender", adjust="age", rng=np.random.default_rng(0)
        )
    cohort = planted_tables(people, age=age, gender=["male"] * 4 + ["female"] * 4)
    lines = describe_group_effects(_compare(cohort, "gender"))
    assert any(line.startswith("age: numbers and '55 years'") for line in lines)
    assert not any("correlated with age" in line for line in lines)
    years = np.array([22.0, 31, -3, 40, 492, 61, 35, 50])
    cohort = planted_tables(
        people, age=years, gender=["male", "Male", "male", "male"] + ["female"] * 4
    )
    notes = coverage_report(cohort).attrs["flags"]
    assert "age: must be in years, from 0 to 130; found -3, 492" in notes
    assert "gender: 'Male' and 'male' count as different values" in notes


def test_describe_translucency__names_small_groups_and_impossible_intervals():
    groups = ["male"] * 2 + ["female"] * 12
    cohort = planted_tables(
        [f"S{i}" for i in range(14)], gender=groups, log_tr=[1.5, -1.5] + [0.0] * 12
    )
    lines = describe_translucency(translucency_table(cohort, group_by="gender"))
    assert [
        line
        for line in lines
        if line.startswith("male: 2 subjects; with fewer than 10 the intervals")
    ]
    assert "some reach below 0" in lines[-1]
    assert not any(line.startswith("female") for line in lines)


def test_cohorts_of_another_layout_are_refused():
    cohort = planted_tables([f"S{i}" for i in range(6)], gender=["male", "female"] * 3)
    other = cohort.rename(take="person")
    rng = np.random.default_rng(0)
    for call in (
        lambda: group_effects(other, group_by="gender", rng=rng),
        lambda: component_correlations(other, rng=rng),
        lambda: translucency_table(other),
        lambda: coverage_report(other),
    ):
        with pytest.raises(
            InputError,
            match=r'cohort: must have the dimension take.*db.cohort\("tables"\)',
        ):
            call()
    with pytest.raises(InputError, match="must hold maps"):
        effect_maps(cohort, group_by="gender", rng=rng)


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
    # above the median of seven, 50; that of six is 44, with three above
    assert (with_it, without) == (2, 4)
    assert subjects_without(subjects_of(cohort), [NORMAL]) == [
        {"take": "G", "reason": "no take in the condition normal"}
    ]
