"""Trait vectors of numbers, adjusted ones, and their standard errors, on planted cohorts."""

from __future__ import annotations

import numpy as np
import pytest
from planted_tables import planted_tables

from skindb.analysis import trait_vectors
from skindb.analysis.traits import tabulate_traits
from skindb.errors import InputError
from skindb.schema import dataset

LOG_TR = "trait_log_sigma_tr_shift"


def _vectors(cohort, *, coefficient=None, **options):
    """Trait vectors of a cohort whose takes have these coefficients (take,) and
    otherwise equal histograms.
    """
    takes = cohort["take"].values
    n = len(takes)
    values = np.zeros(n) if coefficient is None else np.asarray(coefficient)
    basis = dataset(
        {
            "population_mixture": np.eye(2),
            "component_vector": np.diag([1.0, 2.0]),
            "take_coefficient": np.stack([values, -values], axis=1),
        },
        coords={"take": takes, "dictionary": ["a", "b"]},
    )
    edges = np.tile(np.linspace(-3, 3, 257), (3, 1))
    shares = np.zeros((n, 1, 3, 256))
    shares[..., 120:136] = 1 / 16
    albedo = dataset(
        {"albedo_histogram": shares, "histogram_edge": edges},
        coords={"take": takes, "region": ["face"]},
    )
    return trait_vectors(cohort, basis=basis, albedo=albedo, **options)


def _people(n):
    return [f"S{i:02d}" for i in range(n)]


def test_trait_vectors__a_number_has_the_vector_of_one_unit():
    age = np.random.default_rng(1).uniform(20, 60, 40)
    cohort = planted_tables(_people(40), log_tr=0.01 * age, age=age)
    found = _vectors(cohort, coefficient=0.002 * age).sel(trait="age")
    np.testing.assert_allclose(found["trait_brdf_shift"], [0.002, -0.002], rtol=1e-9)
    assert (np.abs(found[LOG_TR] - 0.01) < 3 * found[f"{LOG_TR}_error"]).all()
    assert found["trait_count"].values.tolist() == [40, 0]


def test_trait_vectors__visits_of_a_subject_count_once():
    """One man at two visits, and a woman whose age is unknown."""
    subjects = ["S0", "S0", "S1", "S1", "S2", "S3"]
    age = [30.0, 31.0, 40.0, 41.0, 50.0, np.nan]
    gender = ["male"] * 2 + ["female"] * 4
    cohort = planted_tables(subjects, gender=gender, age=age)
    for adjust, women in (([], 3), (["age"], 2)):
        found = _vectors(cohort, adjust=adjust)
        count = found["trait_count"].to_pandas().T
        assert count["gender:male"].tolist() == [1, women]
        assert adjust or count["age"].tolist() == [3, 0]
        assert (
            "gender:male: only one subject with it, so that the vector contains an individual"
            in found.attrs["flags"]
        )
    lotion = ["normal", "lotion"] * 2 + ["lotion"] * 2
    paired = _vectors(
        planted_tables(["S0", "S0", "S1", "S1", "S1", "S2"], conditions=lotion)
    )
    assert paired["trait_count"].values.tolist() == [[2, 2]]


def test_trait_vectors__names_of_attributes_may_contain_colons():
    hair = ["fair", "fair", "dark"]
    cohort = planted_tables(
        _people(3), **{"hair:colour": hair, "a:b": [True] * 2 + [False]}
    )
    found = _vectors(cohort)
    counts = dict(
        zip(found["trait"].values, found["trait_count"].values.tolist(), strict=True)
    )
    fair, dark = [2, 1], [1, 2]
    assert counts == {"a:b": fair, "hair:colour:dark": dark, "hair:colour:fair": fair}


def test_trait_vectors__a_subject_is_older_at_all_visits_or_at_none():
    subjects = ["S0", "S1", "S1", "S2", "S3", "S4"]
    cohort = planted_tables(subjects, age=[20.0, 38, 42, 39.0, 50.0, 60.0])
    found = _vectors(cohort)["trait_count"].sel(trait="age:older")
    assert found.values.tolist() == [2, 3]


def test_trait_vectors__refuses_adjustments_for_words_that_differ_within_subjects():
    cohort = planted_tables(["S0", "S0", "S1"], side=["a", "b", "a"])
    with pytest.raises(InputError, match="same in all takes of a subject; found a, b"):
        _vectors(cohort, adjust=["side"])
    cohort = planted_tables(["S0", "S1", "S2"], age=["30", "old", "40"])
    with pytest.raises(InputError, match="found numbers and 'old'"):
        _vectors(cohort, adjust=["age"])


def test_trait_vectors__adjusted_ones_leave_out_what_goes_with_another_attribute():
    rng = np.random.default_rng(2)
    age = rng.uniform(20, 60, 60)
    gender = np.where(
        rng.random(60) < 1 / (1 + np.exp(-(age - 40) / 5)), "male", "female"
    )
    cohort = planted_tables(_people(60), gender=gender, age=age)
    plain = _vectors(cohort, coefficient=0.01 * age)
    held = _vectors(cohort, coefficient=0.01 * age, adjust=["age"])
    plain, held_shift = (
        found["trait_brdf_shift"].sel(trait="gender:male") for found in (plain, held)
    )
    assert plain[0] > 0.1
    np.testing.assert_allclose(held_shift, 0, atol=1e-12)
    assert held.attrs["adjust"] == ["age"]


def test_trait_vectors__errors_are_those_of_means():
    """Errors by bootstrap agree with the standard error of a difference of means; 200
    resamples give about 5 %.
    """
    gender = np.where(np.arange(80) % 4, "male", "female")
    values = np.random.default_rng(3).normal(size=80)
    found = _vectors(
        planted_tables(_people(80), gender=gender), coefficient=values
    ).sel(trait="gender:male")
    men = values[gender == "male"]
    women = values[gender == "female"]
    expected = np.sqrt(men.var(ddof=1) / len(men) + women.var(ddof=1) / len(women))
    np.testing.assert_allclose(found["trait_brdf_shift_error"], expected, rtol=0.2)
    # all BRDFs are multiples of one
    length = abs(values.mean())
    np.testing.assert_allclose(
        found["trait_brdf_distance"], abs(men.mean() - women.mean()) / length
    )
    np.testing.assert_allclose(
        found["trait_brdf_distance_error"],
        found["trait_brdf_shift_error"][0] / length,
    )
    assert found["trait_brdf_shift"].values[0] == pytest.approx(
        men.mean() - women.mean()
    )


@pytest.mark.slow
def test_trait_vectors__errors_cover_what_was_planted():
    """Over 60 cohorts, one standard error covers 68 % of the planted differences of log
    sigma_tr.
    """
    inside = []
    gender = np.where(np.arange(40) % 2, "male", "female")
    for seed in range(60):
        cohort = planted_tables(
            _people(40), log_tr=0.1 * (gender == "male"), seed=seed, gender=gender
        )
        found = _vectors(cohort).sel(trait="gender:male")
        inside.append(
            abs(found[LOG_TR].values[1] - 0.1) < found[f"{LOG_TR}_error"].values[1]
        )
    # three binomial standard deviations
    assert 0.68 - 3 * 0.06 < np.mean(inside) < 0.68 + 3 * 0.06


def test_trait_vectors__conditions_are_differences_within_subjects():
    who = np.repeat(_people(12), 2)
    conditions = ["normal", "lotion"] * 12
    own = np.repeat(np.random.default_rng(4).normal(size=12), 2)
    change = np.tile([0.0, 1.0], 12)
    found = _vectors(
        planted_tables(who.tolist(), conditions=conditions), coefficient=own + change
    )
    one = found.sel(trait="condition:lotion")
    np.testing.assert_allclose(one["trait_brdf_shift"], [1, -1], rtol=1e-12)
    assert (
        np.isnan(one["trait_brdf_shift_error"]).all()
        or (one["trait_brdf_shift_error"] < 1e-12).all()
    )


def test_trait_vectors__of_one_subject_have_no_error_and_say_so():
    gender = ["male", *["female"] * 5]
    found = _vectors(
        planted_tables(_people(6), gender=gender), coefficient=np.arange(6.0)
    )
    male = found.sel(trait="gender:male")
    assert np.isfinite(male["trait_brdf_shift"]).all()
    assert (
        "gender:male: only one subject with it, so that the vector contains an individual"
        in found.attrs["flags"]
    )
    assert np.isnan(found.sel(trait="gender:male")["trait_brdf_shift_error"]).all()


def test_trait_vectors__what_is_held_fixed_has_no_vector():
    gender = np.where(np.arange(20) % 2, "male", "female")
    hair = np.where(np.arange(20) % 2, "dark", "red")
    cohort = planted_tables(_people(20), gender=gender, hair=hair, age=np.arange(20.0))
    found = _vectors(cohort, adjust=["hair"])
    assert [str(name) for name in found["trait"].values] == ["age:older", "age"]
    assert (
        sum(line.startswith("excluded: trait gender:") for line in found.attrs["flags"])
        == 2
    )
    with pytest.raises(
        InputError,
        match="adjust wealth: must be an attribute other than the compared one",
    ):
        _vectors(cohort, adjust=["wealth"])


def test_trait_vectors__without_any_trait_say_why():
    found = _vectors(planted_tables(_people(3)))
    assert found.attrs["flags"] == [
        "no attribute and no condition differs between the takes"
    ]
    assert tabulate_traits(found)[1] == []
