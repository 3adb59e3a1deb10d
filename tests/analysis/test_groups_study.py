"""Comparisons of groups on planted cohorts, whose groups, confounders and gaps are known."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib import pyplot as plt
from planted_tables import planted_tables
from scipy import stats

from skindb.analysis import (
    describe_group_effects,
    group_effects,
    plot_group_effects,
    tidy,
)
from skindb.errors import InputError

FACE_R = "R_d face R"
CHEEK_G = "sigma_tr cheek G"


def _people(n):
    return [f"S{i:02d}" for i in range(n)]


def _compare(cohort, group_by, **options):
    options = {"permutations": 500, "rng": np.random.default_rng(0)} | options
    return group_effects(cohort, group_by=group_by, **options)


def test_group_effects__a_planted_difference_is_found_and_nothing_else():
    gender = np.where(np.arange(40) % 2, "male", "female")
    cohort = planted_tables(
        _people(40), albedo=-0.06 * (gender == "male"), gender=gender
    )
    found = _compare(cohort, "gender")
    assert found["contrast"].values.tolist() == ["male less female"]
    one = found.sel(contrast="male less female")
    r_d = one.sel(quantity=FACE_R)
    assert r_d["effect_low"] < -0.06 < r_d["effect_high"]
    assert r_d["effect_p_adjusted"] < 0.05
    assert one["effect_count"].sel(quantity=FACE_R).values.tolist() == [20, 20]
    rest = [
        name for name in one["quantity"].values.tolist() if not name.startswith("R_d")
    ]
    assert (one["effect_p_adjusted"].sel(quantity=rest) > 0.05).all()


def test_group_effects__numbers_that_differ_within_subjects_are_averaged_like_values():
    """A value that is measured at every visit, on which albedo depends."""
    rng = np.random.default_rng(4)
    hydration = np.repeat(rng.normal(50, 10, 20), 3) + rng.normal(0, 10, 60)
    cohort = planted_tables(
        np.repeat(_people(20), 3).tolist(),
        albedo=0.002 * hydration,
        spread=0.0,
        hydration=hydration,
    )
    found = _compare(cohort, "hydration").sel(quantity=FACE_R)
    assert abs(found["effect"].item() - 0.002) < 1e-4
    crossover = cohort.assign_coords(dose=("take", [0.0, 5.0, 10.0] * 20))
    with pytest.raises(InputError, match="only 5"):
        _compare(crossover, "dose")


def test_group_effects__angles_have_no_effect_in_per_cent():
    """Of dark skin, whose angle is negative: an increase would be a decrease in per cent."""
    gender = ["female", "male"] * 10
    cohort = planted_tables(_people(20), albedo=-0.25, gender=gender)
    found = _compare(cohort, "gender", quantities=("ITA", "L*")).isel(contrast=0)
    angle = found.sel(quantity="ITA face")
    assert np.isfinite(angle["effect"])
    for name in ("effect_percent", "effect_percent_low", "effect_percent_high"):
        assert np.isnan(angle[name])
        assert np.isfinite(found[name].sel(quantity="L* face"))


def test_group_effects__refuse_what_differs_within_subjects():
    """A crossover is compared within subjects, by a model."""
    arms = np.array(["b", "c", "c", "b"] * 10)
    cohort = planted_tables(np.repeat(_people(20), 2).tolist(), arm=arms)
    with pytest.raises(InputError, match="found b, c of S00"):
        _compare(cohort, "arm")
    with pytest.raises(InputError, match="attribute arm"):
        _compare(
            cohort.assign_coords(sex=("take", ["m", "m", "f", "f"] * 10)),
            "sex",
            adjust=("arm",),
        )


def test_group_effects__are_student_s_test_where_nothing_is_adjusted():
    """The permutation p of two groups against SciPy's Welch and permutation tests, on
    the log scale of sigma_tr.
    """
    gender = np.where(np.arange(30) < 12, "male", "female")
    cohort = planted_tables(
        _people(30), log_tr=0.08 * (gender == "male"), gender=gender
    )
    one = _compare(cohort, "gender", permutations=20_000).sel(
        contrast="male less female", quantity=CHEEK_G
    )
    logs = np.log(cohort["site_sigma_tr"].values[:, 0, 1])
    men = logs[gender == "male"]
    women = logs[gender == "female"]
    np.testing.assert_allclose(one["effect"], men.mean() - women.mean(), rtol=1e-12)
    np.testing.assert_allclose(
        one["effect_percent"], 100 * np.expm1(men.mean() - women.mean()), rtol=1e-12
    )
    # 20,000 draws, nearly normal values
    assert abs(float(one["effect_p"]) - stats.ttest_ind(men, women).pvalue) < 0.02


@pytest.mark.slow
def test_group_effects__a_confounder_misleads_the_plain_comparison_and_not_the_adjusted_one():
    """Ancestry is correlated with age, and albedo depends on age only; means over 100 cohorts."""
    plain = []
    held = []
    for seed in range(100):
        rng = np.random.default_rng([5, seed])
        age = rng.uniform(20, 60, 40)
        ancestry = np.where(
            rng.random(40) < 1 / (1 + np.exp(-(age - 40) / 5)), "asian", "european"
        )
        cohort = planted_tables(
            _people(40),
            albedo=-0.002 * (age - 40),
            seed=seed,
            age=age,
            ancestry=ancestry,
        )
        for adjust, into in (((), plain), (("age",), held)):
            found = _compare(cohort, "ancestry", adjust=adjust, permutations=100).isel(
                contrast=0
            )
            into.append(found["effect"].sel(quantity=FACE_R).item())
    # European minus Asian, of which age explains about 0.03; two standard errors of the
    # mean of 100 cohorts
    assert np.mean(plain) > 0.02
    assert abs(np.mean(held)) < 2 * np.std(held) / 10


def test_group_effects__of_one_s_own_attribute_that_another_explains_are_flagged():
    gender = np.where(np.arange(30) % 2, "male", "female")
    hair = np.where(np.arange(30) % 2, "dark", "red")
    cohort = planted_tables(
        _people(30), gender=gender, hair=hair, age=np.arange(30) + 20.0
    )
    found = _compare(cohort, "gender")
    assert found["attribute_association"].sel(attribute="hair") == pytest.approx(1)
    assert found["attribute_association"].sel(attribute="age") < 0.3
    assert any(
        "is correlated with hair (adjusted multiple correlation 1.00); adjust for hair"
        in line
        for line in found.attrs["flags"]
    )
    with pytest.raises(
        InputError, match="male less female: the subjects must determine the effect"
    ):
        _compare(cohort, "gender", adjust=["hair"])


def test_group_effects__a_number_is_an_axis():
    age = np.random.default_rng(3).uniform(20, 70, 50)
    found = _compare(
        planted_tables(_people(50), albedo=-0.003 * (age - 45), age=age), "age"
    )
    assert found["contrast"].values.tolist() == ["age, per unit"]
    one = found.sel(contrast="age, per unit", quantity=FACE_R)
    assert one["effect_low"] < -0.003 < one["effect_high"]
    assert one["effect_count"].values.tolist() == [50, 0]


def test_group_effects__conditions_are_compared_within_subjects():
    """A change that all subjects have is found although subjects differ ten times as much."""
    who = [name for name in _people(8) for _ in range(2)]
    conditions = ["normal", "lotion"] * 8
    change = 0.01 * (np.array(conditions) == "lotion")
    found = _compare(
        planted_tables(who, conditions=conditions, albedo=change, spread=0.1, seed=1),
        "condition",
    )
    one = found.sel(contrast="lotion less normal", quantity=FACE_R)
    assert one["effect_low"] < 0.01 < one["effect_high"]
    assert one["effect_high"] - one["effect_low"] < 0.01
    # all 2^8 signs: the observed one and its opposite
    assert one["effect_p"] == pytest.approx(2 / 256)


def test_group_effects__of_conditions_are_not_adjusted():
    cohort = planted_tables(["S00"] * 2, conditions=["normal", "lotion"])
    message = "adjust: conditions are compared within subjects.*omit this option"
    with pytest.raises(InputError, match=message):
        _compare(cohort, "condition", adjust=["gender"])


def test_group_effects__of_one_subject_have_the_intervals_of_its_errors(tmp_path):
    cohort = planted_tables(
        ["S00"] * 4 + ["S01"],
        conditions=["normal"] * 2 + ["lotion"] * 2 + ["powder"],
        albedo=[0.0, 0.0, 0.01, 0.01, 0.0],
        spread=0.0,
    )
    error = 0.004
    cohort["region_diffuse_reflectance_error"][:] = error
    table = _compare(cohort, "condition")
    assert table["contrast"].values.tolist() == ["lotion less normal"]
    one = table.sel(contrast="lotion less normal", quantity=FACE_R)
    assert one["effect"] == pytest.approx(0.01, abs=0.003)  # noise of four takes
    # the mean of two takes in both conditions
    half = stats.norm.ppf(0.975) * np.hypot(error, error) / np.sqrt(2)
    assert one["effect_high"] - one["effect"] == pytest.approx(half)
    assert not table["effect_p"].notnull().any()
    assert any("one subject" in line for line in describe_group_effects(table))
    plot_group_effects(table).figure.savefig(tmp_path / "a.png")


def test_group_effects__two_takes_of_a_subject_are_one_subject():
    who = [name for name in _people(10) for _ in range(3)]
    gender = np.repeat(np.where(np.arange(10) % 2, "male", "female"), 3)
    found = _compare(planted_tables(who, gender=gender), "gender")
    assert found["effect_count"].sel(quantity=FACE_R).values.tolist() == [[5, 5]]
    assert any(
        "5 subjects with and 5 without; with fewer than 10" in line
        for line in found.attrs["flags"]
    )


def test_group_effects__an_attribute_of_three_values_is_three_comparisons():
    ancestry = np.array(["asian", "european", "african"] * 8)
    found = _compare(
        planted_tables(
            _people(24), albedo=-0.2 * (ancestry == "african"), ancestry=ancestry
        ),
        "ancestry",
    )
    assert found["contrast"].values.tolist() == [
        "african less others",
        "asian less others",
        "european less others",
    ]
    assert found["effect"].sel(
        contrast="african less others", quantity=FACE_R
    ) == pytest.approx(-0.2, abs=0.05)


def test_group_effects__skips_subjects_without_the_quantity_or_attribute():
    gender = np.array(["male", "female"] * 10, object)
    cohort = planted_tables(_people(20), gender=gender)
    cohort["gender"].values[:3] = np.nan
    cohort["region_diffuse_reflectance"][5:8, 1] = np.nan
    found = _compare(cohort, "gender").isel(contrast=0)
    assert found["effect_count"].sum("side").sel(quantity=FACE_R) == 17
    assert found["effect_count"].sum("side").sel(quantity="R_d beard R") == 14


def test_group_effects__per_cent_hold_for_levels_that_are_all_wrong():
    """With a standard error of 0.02 of all levels, 0.15 may be 0.111 or 0.189: the true
    relative difference lies between -54 % and -32 %, not only at -40 %.
    """
    gender = np.where(np.arange(60) % 2, "male", "female")
    cohort = planted_tables(
        _people(60),
        albedo=-0.15 - 0.06 * (gender == "male"),
        gender=gender,
        spread=0.005,
    )
    one = _compare(cohort, "gender").isel(contrast=0).sel(quantity="R_d face B")
    assert one["effect_percent_low"] < 100 * -0.06 / (0.15 - 0.039)
    assert one["effect_percent_high"] > 100 * -0.06 / (0.15 + 0.039)
    assert -45 < one["effect_percent"] < -35
    darker = _compare(
        cohort.assign(
            region_diffuse_reflectance=cohort.region_diffuse_reflectance - 0.065
        ),
        "gender",
    )
    # not below black
    assert (
        darker["effect_percent_low"].isel(contrast=0).sel(quantity="R_d face B") == -100
    )


@pytest.mark.parametrize(
    ("group_by", "adjust", "message"),
    [
        ("wealth", (), "group by wealth: must be an attribute or a trait"),
        (
            "gender",
            ("gender",),
            "adjust gender: must be an attribute other than the compared one",
        ),
        (
            "gender",
            ("wealth",),
            (
                "adjust wealth: must be an attribute other than the compared one; "
                "found an unknown name; choose from: age"
            ),
        ),
        (
            "same",
            (),
            "group by same: there must be subjects of two groups; found only yes",
        ),
        (
            "condition",
            (),
            "group by condition: some subjects must be measured in both conditions; found none",
        ),
        ("lone", (), "the subjects must determine the effect"),
    ],
)
def test_group_effects__what_cannot_be_compared_is_one_line(group_by, adjust, message):
    gender = np.where(np.arange(4) % 2, "male", "female")
    cohort = planted_tables(
        _people(4), gender=gender, age=np.arange(4.0), same=["yes"] * 4
    )
    if group_by == "lone":
        cohort = cohort.isel(take=slice(2))
        group_by = "gender"
    with pytest.raises(InputError, match=message):
        _compare(cohort, group_by, adjust=adjust)


def test_group_effects__an_extreme_cohort_gives_no_number_that_is_none():
    """Two subjects in each group, constant values, and a region that only one take has."""
    gender = np.array(["male"] * 2 + ["female"] * 8)
    cohort = planted_tables(_people(10), gender=gender)
    cohort["region_surface_reflectance"][:] = 0.03
    cohort["region_diffuse_reflectance"][1:, 1] = np.nan
    one = _compare(cohort, "gender").isel(contrast=0)
    assert one["effect"].sel(quantity="surface reflectance face") == 0
    assert one["effect_p"].sel(quantity="surface reflectance face") == 1
    assert np.isnan(one["effect"].sel(quantity="R_d beard R"))
    assert not np.isinf(
        np.concatenate([one[name].values.ravel() for name in one])
    ).any()


def test_group_effects__small_differences_of_albedo_between_surfaces_that_differ_are_flagged():
    gender = np.where(np.arange(40) % 2, "male", "female")
    cohort = planted_tables(
        _people(40), albedo=0.02 * (gender == "male"), gender=gender, spread=0.005
    )
    line = (
        "male less female: the surface reflectance differs as well; differences of R_d "
        "up to 0.039 may be due"
    )
    assert not any(line in flag for flag in _compare(cohort, "gender").attrs["flags"])
    cohort["region_surface_reflectance"][np.flatnonzero(gender == "male")] += 0.01
    assert any(line in flag for flag in _compare(cohort, "gender").attrs["flags"])


def test_describe_group_effects__states_the_detectable_effect():
    gender = np.where(np.arange(30) % 2, "male", "female")
    lines = describe_group_effects(
        _compare(planted_tables(_people(30), gender=gender), "gender")
    )
    assert lines[0] == (
        "male less female: 0 of 11 quantities differ (adjusted p < 0.05; 500 "
        "permutations of 30 subjects)"
    )
    assert "detectable differences (power 80 %): R_d face R 0.0" in lines[1]


def test_plot_group_effects__has_a_row_for_each_quantity(tmp_path):
    age = np.random.default_rng(3).uniform(20, 70, 50)
    table = _compare(
        planted_tables(_people(50), albedo=-0.003 * (age - 45), age=age), "age"
    )
    ax = plot_group_effects(table)
    assert len(ax.get_yticklabels()) == table.sizes["quantity"]
    assert "(n = 50)" in ax.get_legend().get_texts()[0].get_text()
    ax.figure.savefig(tmp_path / "a.png", dpi=100, bbox_inches="tight")


def test_plot_group_effects__of_many_groups_has_room_and_names_all():
    """A group whose name begins with an underscore is in the legend too."""
    words = ["_a", *"bcdefghijkl"]
    cohort = planted_tables(_people(36), word=np.tile(words, 3))
    ax = plot_group_effects(_compare(cohort, "word", permutations=100))
    texts = [text.get_text().strip() for text in ax.get_legend().get_texts()]
    assert texts == [f"{word} less others (n = 36)" for word in words]
    inches = ax.figure.get_figheight() / len(ax.get_yticklabels())
    assert inches > 0.1 * len(words)
    plt.close(ax.figure)


def _repeated(stated: float, repeat: float, between: float = 0.002):
    """200 subjects at three visits; surface reflectance varies by `between` between and by
    `repeat` within subjects, and its stated error is `stated`.
    """
    rng = np.random.default_rng(6)
    names = np.repeat([f"S{i:03d}" for i in range(200)], 3)
    cohort = planted_tables(names.tolist(), gender=np.repeat(["f", "m"], 300))
    surface = 0.03 + np.repeat(rng.normal(0, between, (200, 2)), 3, axis=0)
    surface += rng.normal(0, repeat, surface.shape)
    dims = ("take", "region")
    return cohort.assign(
        region_surface_reflectance=(dims, surface),
        region_surface_reflectance_error=(dims, np.full(surface.shape, stated)),
    )


@pytest.mark.parametrize(
    ("stated", "repeat", "reliability"),
    [
        # stated errors that are too small: those of the repeats count, over three visits
        (0.0002, 0.002, 0.75),
        # where repeats agree, stated errors count, over three visits
        (0.002, 0.0, 1 - 1 / 3),
        (0.0002, 0.008, 1 / (1 + 16 / 3)),
    ],
)
def test_group_effects__reliability_is_what_was_planted(stated, repeat, reliability):
    """A variance of 200 subjects has a standard error of 10 %, and so has the fraction
    that it leaves; three of them are allowed.
    """
    effects = group_effects(
        _repeated(stated, repeat),
        group_by="gender",
        permutations=200,
        rng=np.random.default_rng(0),
    ).isel(contrast=0)
    name = "surface reflectance face"
    estimated = float(effects["effect_reliability"].sel(quantity=name))
    assert estimated == pytest.approx(reliability, abs=0.3 * (1 - reliability))
    is_withheld = bool(np.isnan(effects["effect_p_adjusted"].sel(quantity=name)))
    assert is_withheld == (reliability < 0.5)
    flags = " ".join(effects.attrs["flags"])
    assert (
        "no p values where the reliability is below 0.5: surface" in flags
    ) == is_withheld
    assert np.isfinite(effects["effect_p"].sel(quantity="R_d face R"))


@pytest.mark.parametrize("stated", [0.0002, 0.005])
def test_group_effects__reliability_and_colour_of_conditions(stated):
    """Changes that are not larger than their errors have no p values, whatever subjects
    differ by.
    """
    names = [f"S{i}" for i in range(30)]
    conditions = ["normal"] * 30 + ["tan"] * 30
    cohort = planted_tables(
        names * 2, conditions=conditions, albedo=[0.0] * 30 + [-0.004] * 30
    )
    dims = ("take", "region", "channel")
    error = np.full(cohort["region_diffuse_reflectance"].shape, stated)
    cohort = cohort.assign(region_diffuse_reflectance_error=(dims, error))
    effects = group_effects(
        cohort, group_by="condition", permutations=200, rng=np.random.default_rng(0)
    )
    rows = tidy(cohort.assign_coords(take=[*names, *(f"{s}.tan" for s in names)]))
    means = rows[rows.quantity == "delta E"].groupby("region").value.mean()
    said = f"larger: face {means.face:.2g}, beard {means.beard:.2g}"
    assert any(flag.endswith(said) for flag in effects.attrs["flags"])
    effects = effects.isel(contrast=0)
    normal, tanned = np.split(cohort["region_diffuse_reflectance"].values[:, 0, 1], 2)
    expected = max(1 - 2 * stated**2 / ((tanned - normal) ** 2).mean(), 0)
    reliability = effects["effect_reliability"].sel(quantity="R_d face G")
    assert float(reliability) == pytest.approx(expected)
    p = effects["effect_p"].sel(quantity="R_d face G")
    assert np.isnan(p) == (stated == 0.005)
    # without stated errors it is unknown, and p values remain
    name = "surface reflectance face"
    assert np.isnan(effects["effect_reliability"].sel(quantity=name))
    assert np.isfinite(effects["effect_p"].sel(quantity=name))


def _unlike_surfaces(after, change):
    """20 subjects with lotion, whose even reflection is known to `after`; R_d changes."""
    names = [f"S{i}" for i in range(20)]
    cohort = planted_tables(
        names * 2,
        conditions=["normal"] * 20 + ["lotion"] * 20,
        albedo=[0.0] * 20 + [change] * 20,
        fit_even_reflection=[0.01] * 20 + [0.008] * 20,
    )
    error = np.repeat([0.01, after], 20)
    cohort = cohort.assign_coords(fit_even_reflection_error=("take", error))
    cohort["region_surface_reflectance"][20:] += 0.01
    cohort["region_glossiness"] = cohort["region_surface_reflectance"] + 0.6
    names = ["R_d", "ITA", "surface reflectance", "glossiness"]
    return _compare(cohort, "condition", quantities=names).isel(contrast=0)


@pytest.mark.parametrize(
    ("after", "change", "is_withheld"),
    [
        # errors of two priors: 1.96 hypot(0.01, 0.02, 0.002)
        (0.02, 0.03, True),
        (0.02, 0.06, False),
        # one prior, whose error cancels: 1.96 x 0.002
        (0.01, 0.003, True),
        (0.01, 0.01, False),
    ],
)
def test_group_effects__of_conditions_contain_even_reflection(
    after, change, is_withheld
):
    found = _unlike_surfaces(after, change)
    error = 0.002 if after == 0.01 else np.hypot(np.hypot(0.01, 0.02), 0.002)
    one = found.sel(quantity=FACE_R)
    half = float(one["effect_high"] - one["effect_low"]) / 2
    # beside the scatter of 20 differences, 0.0013
    assert half == pytest.approx(np.hypot(1.96 * error, 0.0013), rel=0.1)
    assert np.isnan(one["effect_p"]) == is_withheld
    # 0.01, of which the highlights may have lacked 0.002
    surface = found.sel(quantity="surface reflectance face")
    assert surface["effect_high"] - surface["effect_low"] > 2 * 1.96 * 0.002
    assert surface["effect_p"] < 0.01
    # the same change of glossiness is less than such light may cause
    glossiness = found.sel(quantity="glossiness face")
    assert glossiness["effect_high"] - glossiness["effect_low"] > 20 * 1.96 * 0.002
    assert np.isnan(glossiness["effect_p"])
    assert np.isnan(found["effect_p"].sel(quantity="ITA face")) == is_withheld
    flags = " ".join(found.attrs["flags"])
    assert ("where even reflection may cause the effect: R_d" in flags) == is_withheld


@pytest.mark.slow
def test_group_effects__what_has_p_values_does_not_bias_them():
    """200 cohorts of ten pairs without a change, whose stated errors are 0.7 of the true
    ones: half of the quantities have p values, of which 5 % are below 0.05.
    """
    names = _people(10)
    found = []
    for seed in range(200):
        conditions = ["normal"] * 10 + ["tan"] * 10
        cohort = planted_tables(names * 2, conditions=conditions, seed=seed)
        cohort["region_diffuse_reflectance_error"] *= 0.7
        found.append(
            _compare(cohort, "condition", quantities=["R_d"], permutations=300)
        )
    p = np.array([one["effect_p"].values for one in found])
    known = p[np.isfinite(p)]
    assert 0.3 < known.size / p.size < 0.7
    # three standard deviations of 500 independent values
    assert (known <= 0.05).mean() == pytest.approx(0.05, abs=0.03)


def test_group_effects__one_subject_with_another_prior_is_one_of_all():
    """Such as one whose makeup counts as normal: of 20, its error counts by a twentieth."""
    conditions = np.repeat(["normal", "tan"], 20)
    cohort = planted_tables(_people(20) * 2, conditions=conditions)
    error = np.full(40, 0.01)
    plain, other = (
        _compare(
            cohort.assign_coords(fit_even_reflection_error=("take", error * factor)),
            "condition",
            quantities=["R_d"],
        ).isel(contrast=0, quantity=0)
        for factor in (1, np.where(np.arange(40), 1, 1.5))
    )
    half, wider = (one["effect_high"] - one["effect"] for one in (plain, other))
    added = 1.96 * np.hypot(0.01, 0.015) / 20
    assert wider == pytest.approx(float(np.hypot(half, added)))
