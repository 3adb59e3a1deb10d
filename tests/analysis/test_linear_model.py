"""Models by a formula: the numbers of statsmodels, false positives, and what is refused."""

from __future__ import annotations

import warnings

import numpy as np
import pandas as pd
import pytest
import statsmodels.formula.api as smf
import xarray as xr
from planted_tables import planted_tables
from scipy import stats

from skindb.analysis import formula_models, linear_model, tidy
from skindb.analysis.formulas import MixedModel, design_of, with_levels
from skindb.errors import InputError

PEOPLE, VISITS = 24, 4
HC3 = {"cov_type": "HC3", "use_t": True}
FORMULA = "R_d ~ treatment * visit + age + (1 | subject)"


def _fit(model, rows):
    """Of values without stated errors."""
    return formula_models._fit(model, rows.assign(error=np.nan, condition="normal"))


def planted(*, effect=0.0, slope=0.0, seed=5):
    """Subjects at four visits; under cream, R_d rises by `effect` at each visit, and in
    all by slopes with the standard deviation `slope`.
    """
    rng = np.random.default_rng(seed)
    names = np.repeat([f"S{i:02d}" for i in range(PEOPLE)], VISITS)
    visit = np.tile(np.arange(1, VISITS + 1), PEOPLE)
    is_treated = np.repeat(np.arange(PEOPLE) % 2, VISITS)
    cohort = planted_tables(
        names.tolist(),
        albedo=effect * is_treated * visit
        + rng.normal(0, 0.01, len(names))
        + visit
        * np.repeat(slope * np.random.default_rng(2).normal(size=PEOPLE), VISITS),
        treatment=np.where(is_treated, "cream", "none"),
        age=np.repeat(rng.integers(20, 60, PEOPLE), VISITS),
    )
    takes = [
        name if number == 1 else f"{name}.normal.{number}"
        for name, number in zip(names, visit, strict=True)
    ]
    return cohort.assign_coords(take=takes)


def by_statsmodels(cohort, formula, **options):
    frame = tidy(cohort)
    rows = frame[
        (frame.quantity == "R_d") & (frame.region == "face") & (frame.channel == "G")
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return smf.mixedlm(formula, rows, groups="subject", **options).fit(
            method="powell"
        )


@pytest.mark.parametrize(
    ("random", "options"),
    [("(1 | subject)", {}), ("(1 + visit | subject)", {"re_formula": "visit"})],
)
def test_linear_model__has_the_numbers_of_statsmodels(random, options):
    """The solvers stop at other places: 0.1 % of the estimates' errors is allowed, and 3 %
    of the errors, as statsmodels takes them from the curvature in all parameters.
    """
    cohort = planted(effect=0.002, slope=0.01).isel(region=[0])
    ours = linear_model(cohort, formula=f"R_d ~ treatment * visit + age + {random}")
    ours = ours.sel(quantity="R_d face G")
    theirs = by_statsmodels(cohort, "value ~ treatment * visit + age", **options)
    terms = ours["term"].values.tolist()
    assert set(terms) == set(theirs.fe_params.index)
    error = theirs.bse_fe[terms]
    np.testing.assert_allclose(ours["model_error"], error, rtol=0.03)
    change = ours["model_estimate"].values - theirs.fe_params[terms]
    assert (np.abs(change) < 1e-3 * error).all()
    deviation = ours["model_deviation"].sel(effect=["Intercept", "residual"]).values
    expected = np.sqrt([theirs.cov_re.iloc[0, 0], theirs.scale])
    np.testing.assert_allclose(deviation, expected, rtol=0.01)
    t = np.abs(ours["model_estimate"] / ours["model_error"])
    p = 2 * stats.t.sf(t, ours["model_degrees_of_freedom"])
    np.testing.assert_allclose(ours["model_p"], p)
    assert (int(ours["model_takes"]), int(ours["model_subjects"])) == (96, 24)


@pytest.mark.parametrize(("unit", "start"), [(30.0, 0.0), (1e4, 0.0), (1.0, 2026.0)])
def test_linear_model__units_and_origin_of_a_slope_change_no_inference(unit, start):
    """The solver stops within 1e-4, perhaps elsewhere on another machine."""
    rng = np.random.default_rng(3)
    subject = np.repeat(np.arange(20), 4)
    time = np.tile([0.0, 1.0, 2.0, 3.0], 20)
    value = rng.normal(0, 1, 20)[subject] + rng.normal(0, 1, 20)[subject] * time
    rows = pd.DataFrame({"subject": subject.astype(str), "time": time})
    rows["value"] = value + rng.normal(0, 0.5, 80)
    model = MixedModel.of("R_d ~ time + (1 + time | subject)")
    fits = [_fit(model, rows), _fit(model, rows.assign(time=unit * time + start))]
    t = [fit.table["model_estimate"] / fit.table["model_error"] for fit in fits]
    np.testing.assert_allclose(t[1]["time"], t[0]["time"], rtol=1e-3)
    slopes = [fit.deviation["time"] for fit in fits]
    np.testing.assert_allclose(unit * slopes[1], slopes[0], rtol=1e-3)
    assert fits[0].flags == fits[1].flags == ()


@pytest.mark.filterwarnings("ignore:Random effects covariance is singular")
def test_linear_model__of_nested_effects_has_the_numbers_of_statsmodels():
    """Visits differ within subjects, and have two repeats; as in
    `test_linear_model__has_the_numbers_of_statsmodels`.
    """
    rng = np.random.default_rng(4)
    rows = pd.DataFrame(
        {
            "subject": np.repeat([f"S{i:02d}" for i in range(16)], 6),
            "visit": np.tile(np.repeat([1, 2, 3], 2), 16),
            "group": np.repeat(np.arange(16) % 2, 6),
            "side": np.tile([0.0, 1.0], 48),
        }
    )
    value = rng.normal(0, 1, 16).repeat(6) + rng.normal(0, 0.7, 48).repeat(2)
    rows["value"] = value + rng.normal(0, 0.5, 96)
    ours = _fit(MixedModel.of("R_d ~ group + visit + side + (1 | subject/visit)"), rows)
    theirs = smf.mixedlm(
        "value ~ group + visit + side",
        rows,
        groups="subject",
        re_formula="1",
        vc_formula={"visit": "0 + C(visit)"},
    ).fit(method="powell")
    terms = ours.table.index
    error = theirs.bse_fe[terms]
    np.testing.assert_allclose(ours.table["model_error"], error, rtol=0.03)
    assert (
        np.abs(ours.table["model_estimate"] - theirs.fe_params[terms]) < 1e-3 * error
    ).all()
    expected = np.sqrt([theirs.cov_re.iloc[0, 0], theirs.vcomp[0], theirs.scale])
    np.testing.assert_allclose([*ours.deviation.values()], expected, rtol=0.01)
    assert [*ours.deviation] == ["Intercept", "subject/visit", "residual"]
    # 16 subjects, 48 visits, 96 takes
    free = ours.table["model_degrees_of_freedom"]
    assert free.to_dict() == {"Intercept": 14, "group": 14, "visit": 31, "side": 47}


def test_linear_model__degrees_of_freedom_by_hand():
    table = linear_model(planted(), formula=FORMULA).isel(quantity=0)
    free = dict(
        zip(table["term"].values, table["model_degrees_of_freedom"].values, strict=True)
    )
    # between 24 subjects: intercept, treatment, age; within 96 takes: visit, interaction
    assert free == {
        "Intercept": 21,
        "treatment[T.none]": 21,
        "age": 21,
        "visit": 70,
        "treatment[T.none]:visit": 70,
    }


def test_linear_model__false_positives_are_5_per_cent():
    """200 null frames: a binomial of 5 % is below 2 or above 20 in 1 of 500. The
    effects of treatment are between subjects, that of visits within them.
    """
    rng = np.random.default_rng(11)
    subjects = np.repeat([f"S{i}" for i in range(12)], 3)
    model = MixedModel.of("R_d ~ group + visit + (1 | subject)")
    false = np.zeros(3)
    for _ in range(200):
        value = np.repeat(rng.normal(0, 1.0, 12), 3) + rng.normal(0, 0.7, 36)
        rows = pd.DataFrame(
            {
                "subject": subjects,
                "group": np.repeat(rng.permutation([0, 1] * 6), 3),
                "visit": np.tile([1, 2, 3], 12),
                "value": value,
            }
        )
        false += _fit(model, rows).table["model_p"].to_numpy() < 0.05
    assert ((false >= 2) & (false <= 20)).all()


def test_linear_model__without_a_random_part_is_least_squares():
    cohort = planted(effect=0.002).isel(take=slice(0, None, VISITS))
    table = linear_model(cohort, formula="log(R_d) ~ treatment + age")
    frame = tidy(cohort).query(
        "quantity == 'R_d' and region == 'beard' and channel == 'B'"
    )
    theirs = smf.ols("np.log(value) ~ treatment + age", frame).fit(**HC3)
    ours = table.sel(quantity="R_d beard B")
    terms = ours["term"].values.tolist()
    np.testing.assert_allclose(ours["model_estimate"], theirs.params[terms])
    np.testing.assert_allclose(ours["model_error"], theirs.bse[terms])
    np.testing.assert_allclose(ours["model_p"], theirs.pvalues[terms])


def test_linear_model__contrasts_and_equivalence_are_those_of_statsmodels():
    cohort = planted(effect=0.002).isel(take=slice(0, None, VISITS))
    dose = np.array(["a", "b", "c"])[np.arange(PEOPLE) % 3]
    cohort = cohort.assign_coords(dose=("take", dose))
    table = linear_model(
        cohort,
        formula="R_d ~ dose + age",
        contrasts=["dose[T.b] - dose[T.c]", "dose[T.b] + 10*age"],
    ).sel(quantity="R_d face G")
    frame = tidy(cohort).query(
        "quantity == 'R_d' and region == 'face' and channel == 'G'"
    )
    theirs = smf.ols("value ~ dose + age", frame).fit(**HC3)
    for name in table["term"].values.tolist()[-2:]:
        one = theirs.t_test(name)
        ours = table.sel(term=name)
        assert float(ours["model_estimate"]) == pytest.approx(one.effect.item())
        assert float(ours["model_p"]) == pytest.approx(one.pvalue.item())
        ends = [ours["model_estimate_low"], ours["model_estimate_high"]]
        np.testing.assert_allclose(ends, one.conf_int()[0])
    two = linear_model(cohort, formula="R_d ~ treatment", margin=0.03)
    ours = two.sel(quantity="R_d face G", term="treatment[T.none]")
    theirs = smf.ols("value ~ treatment", frame).fit(**HC3)
    ends = [theirs.t_test(f"treatment[T.none] = {end}") for end in (-0.03, 0.03)]
    sides = [
        stats.t.sf(sign * end.tvalue.item(), end.df_denom)
        for sign, end in zip((1, -1), ends, strict=True)
    ]
    assert float(ours["model_p_equivalence"]) == pytest.approx(max(sides))


def test_linear_model__contrasts_have_the_fewest_degrees_of_freedom_of_their_terms():
    table = linear_model(
        planted(),
        formula=FORMULA,
        contrasts=["visit + treatment[T.none]:visit", "treatment[T.none] + visit"],
    )
    assert table["model_degrees_of_freedom"].isel(quantity=0)[-2:].values.tolist() == [
        70,
        21,
    ]


@pytest.mark.filterwarnings("ignore:The MLE may be")  # the intercepts are explained
def test_linear_model__adjusts_for_the_baseline():
    """As statsmodels, with the first visit as a column instead of rows."""
    cohort = planted(effect=0.002)
    table = linear_model(
        cohort, formula="R_d ~ treatment + baseline + (1 | subject)"
    ).sel(quantity="R_d face G")
    values = tidy(cohort).query(
        "quantity == 'R_d' and region == 'face' and channel == 'G'"
    )
    first = values[values.visit == 1].set_index("subject").value
    rows = values[values.visit > 1].assign(
        before=lambda rows: first[rows.subject].to_numpy()
    )
    assert int(table["model_takes"]) == PEOPLE * (VISITS - 1) == len(rows)
    theirs = smf.mixedlm("value ~ treatment + before", rows, groups="subject").fit(
        method="powell"
    )
    np.testing.assert_allclose(
        table["model_estimate"].sel(term="baseline"),
        theirs.fe_params["before"],
        rtol=1e-3,
    )


def test_linear_model__of_colour_differences():
    """The first visit is the baseline, and no row."""
    table = linear_model(planted(), formula="delta E ~ visit + (1 | subject)")
    assert table["quantity"].values.tolist() == ["delta E face", "delta E beard"]
    assert (table["model_takes"] == PEOPLE * (VISITS - 1)).all()


def test_linear_model__no_variance_between_subjects_is_flagged():
    """The residuals are as large within as between subjects by construction."""
    cohort = planted()
    values = cohort["region_diffuse_reflectance"]
    rest = np.tile([0.01, -0.01, 0.01, -0.01], PEOPLE)[:, None, None]
    level = cohort["region_diffuse_reflectance"].copy(
        data=np.broadcast_to(0.4 + rest, values.shape)
    )
    table = linear_model(
        cohort.assign(region_diffuse_reflectance=level),
        formula="R_d ~ visit + (1 | subject)",
    )
    assert "R_d face R: no variance of Intercept was found" in table.attrs["flags"]
    assert np.isfinite(table["model_error"]).all()


def test_linear_model__words_are_in_the_order_of_their_numbers():
    rows = pd.DataFrame({"subject": "S", "C": ["week 10", "week 2", "rest"] * 2})
    model = MixedModel.of("R_d ~ C(C) + (1 + `a + b` | subject)")
    assert model.slopes == ("a + b",)
    terms = design_of(model, with_levels(model, rows))[1]
    assert terms == ["Intercept", "C[T.week 2]", "C[T.week 10]"]
    numbers = with_levels(model, rows.assign(C=[10.0, -2.0, 1.5] * 2))
    assert numbers["C"].cat.categories.tolist() == [-2.0, 1.5, 10.0]
    rows = rows.rename(columns={"C": "self"})  # as parameters of methods are called
    assert with_levels(MixedModel.of("R_d ~ self"), rows)["self"].cat.ordered is False
    assert rows["self"].dtype != "category"


def test_linear_model__a_small_group_of_wide_spread_does_not_seem_to_differ():
    """5 % of the p values are below 0.05: at most 8 % of 300, three standard errors more;
    with equal variances, 19 % would be.
    """
    rng = np.random.default_rng(3)
    group = np.repeat([0.0, 1.0], (40, 10))
    rows = pd.DataFrame({"subject": [f"S{i}" for i in range(50)], "group": group})
    model = MixedModel.of("R_d ~ group")
    p = [
        _fit(model, rows.assign(value=rng.normal(0, 1 + group))).table["model_p"][
            "group"
        ]
        for _ in range(300)
    ]
    assert np.mean(np.array(p) < 0.05) < 0.088


def test_linear_model__a_level_of_one_subject_has_the_error_of_the_others():
    rows = pd.DataFrame(
        {
            "subject": [f"S{i}" for i in range(12)],
            "group": [1.0, *[0.0] * 11],
            "value": np.random.default_rng(3).normal(0, 1, 12),
        }
    )
    error = _fit(MixedModel.of("R_d ~ group"), rows).table["model_error"]["group"]
    rest = rows["value"][1:]
    assert rest.std() < error < 1.2 * rest.std()


def test_linear_model__needs_more_takes_than_random_effects():
    two = planted().isel(take=[i for i in range(4 * PEOPLE) if i % 4 < 2])
    with pytest.raises(InputError, match="2 of each of 24 subjects, 48 takes"):
        linear_model(two, formula="R_d ~ visit + (1 + visit | subject)")


def test_linear_model__an_attribute_called_intercept_is_not_the_intercept():
    cohort = planted().assign_coords(Intercept=("take", np.arange(4.0 * PEOPLE)))
    table = linear_model(cohort, formula="R_d ~ attribute_Intercept + (1 | subject)")
    assert table["term"].values.tolist() == ["Intercept", "attribute_Intercept"]


def test_linear_model__says_whose_baseline_is_of_a_later_visit():
    cohort = planted()
    first = cohort["take"].values[0]
    table = linear_model(
        cohort.drop_sel(take=first),
        formula="R_d ~ treatment + baseline + (1 | subject)",
    )
    said = [flag for flag in table.attrs["flags"] if "later visit" in flag]
    assert said == [
        f"the baseline of {first.split('.')[0]} is of a later visit than others"
    ]


@pytest.mark.parametrize(
    ("formula", "said"),
    [
        ("R_d", "must have one ~"),
        ("height ~ age", "must begin with one of R_d, surface reflectance"),
        (
            "R_d ~ height + (1 | subject)",
            "height: must be columns .* choose from: subject",
        ),
        ("R_d ~ age + (1 | site)", "random effects of subjects, or of NAME within"),
        (
            "R_d ~ age + (1 | subject/2)",
            "random effects of subjects, or of NAME within",
        ),
        ("R_d ~ age + (1 | subject/site)", "site: must be columns"),
        (
            "R_d ~ age + (1 + visit | subject/visit)",
            "slopes or nested effects, not both",
        ),
        ("R_d ~ age + (1 | subject)/visit", "has the terms NAME"),
        ("R_d ~ age (1 | subject)", "has the terms NAME"),
        ("R_d ~ age + (1 | subject/visit)", "one take of each visit"),
        (
            "R_d ~ age + (1 | subject) + (0 + visit | subject)",
            "at most one random part",
        ),
        ("R_d ~ age + (0 + visit | subject)", "has random effects 1 and NAME"),
        ("R_d ~ age + (1 + treatment | subject)", "treatment is not a number"),
        ("R_d ~ Intercept + (1 | subject)", "Intercept: must be columns"),
        ("R_d ~ exit(age) + (1 | subject)", "has the terms NAME"),
        ("R_d ~ age + __import__('os').getpid()", "has the terms NAME"),
        ("R_d ~ {age} + (1 | subject)", "has the terms NAME"),
        ("R_d ~ age + (1 | subject) ~ visit", "must have one ~"),
        ("R_d ~ age +* visit + (1 | subject)", "some region must determine it"),
        ("R_d ~ age", "96 takes of 24 subjects without"),
        ("R_d ~ C(subject) + (1 | subject)", "do not determine 24 terms"),
    ],
)
def test_linear_model__refuses(formula, said):
    with pytest.raises(InputError, match=said):
        linear_model(planted(), formula=formula)


@pytest.mark.parametrize(
    "contrast", ["height", "age * age", "age = 1", "age, visit", "3", ""]
)
def test_linear_model__refuses_contrasts(contrast):
    with pytest.raises(InputError, match="not a sum of multiples of Intercept, age"):
        linear_model(
            planted(), formula="R_d ~ age + (1 | subject)", contrasts=[contrast]
        )


@pytest.mark.parametrize(
    ("formula", "takes", "found"),
    [
        ("R_d ~ 0 + (1 | subject)", slice(None), "no fixed term"),
        ("R_d ~ 1 + (1 | subject)", slice(0, None, VISITS), "one take of each of 24"),
    ],
)
def test_linear_model__what_no_data_determine_is_one_line(formula, takes, found):
    with pytest.raises(InputError, match=found):
        linear_model(planted().isel(take=takes), formula=formula)


def test_linear_model__values_that_do_not_differ_are_one_line():
    cohort = planted()
    same = cohort["region_diffuse_reflectance"] * 0 + 0.3
    with pytest.raises(InputError, match="the same in 96 takes"):
        linear_model(
            cohort.assign(region_diffuse_reflectance=same),
            formula="R_d ~ age + (1 | subject)",
        )


def test_linear_model__terms_mean_the_same_in_all_regions():
    """The region "face" lacks the first of three levels, and "beard" the last one."""
    cohort = planted().isel(take=slice(0, None, VISITS))
    dose = np.array(["a none", "b low", "c high"])[np.arange(PEOPLE) % 3]
    level = {"a none": 0.0, "b low": 0.1, "c high": 0.3}
    values = cohort["region_diffuse_reflectance"].values.copy()
    values += np.array([level[word] for word in dose])[:, None, None]
    values[dose == "a none", 0] = np.nan
    values[dose == "c high", 1] = np.nan
    dims = cohort["region_diffuse_reflectance"].dims
    cohort = planted_tables(
        [f"S{i:02d}" for i in range(PEOPLE)], albedo=np.zeros(PEOPLE), dose=dose
    ).assign(region_diffuse_reflectance=(dims, values))
    table = linear_model(cohort, formula="R_d ~ dose")
    # nothing to compare with in the face: no number instead of "high less low"
    assert {name.split()[1] for name in table["quantity"].values.tolist()} == {"beard"}
    assert any("face" in flag and "excluded" in flag for flag in table.attrs["flags"])
    assert table["term"].values.tolist() == ["Intercept", "dose[T.b low]"]
    effect = table["model_estimate"].sel(term="dose[T.b low]")
    np.testing.assert_allclose(effect, 0.1, atol=0.02)  # noise of 0.01 and 16 subjects


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (["one"] * PEOPLE, "x: must differ between takes"),
        ([7, "much"] * (PEOPLE // 2), "x: must be all numbers or all words"),
    ],
)
def test_linear_model__factors_that_are_none_are_one_line(values, said):
    names = [f"S{i:02d}" for i in range(PEOPLE)]
    rng = np.random.default_rng(1)
    cohort = planted_tables(
        names, albedo=rng.normal(0, 0.01, PEOPLE), x=np.array(values, object)
    )
    with pytest.raises(InputError, match=said):
        linear_model(cohort, formula="R_d ~ x")


def test_linear_model__slopes_of_any_name_have_degrees_of_freedom_between_subjects():
    rng = np.random.default_rng(3)
    rows = pd.DataFrame(
        {
            "subject": np.repeat([f"S{i}" for i in range(12)], 4),
            "time: [d]": np.tile([0.0, 1.0, 2.0, 3.0], 12),
            "value": rng.normal(0, 1, 48) + np.repeat(rng.normal(0, 1, 12), 4),
        }
    )
    model = MixedModel.of("R_d ~ `time: [d]` + (1 + `time: [d]` | subject)")
    free = _fit(model, rows).table["model_degrees_of_freedom"]
    assert free.tolist() == [10, 10]


def test_linear_model__slopes_have_the_freedom_of_subjects_that_show_one():
    rows = pd.DataFrame(
        {
            "subject": [f"S{i}" for i in range(12) for _ in range(4 if i < 5 else 1)],
            "time": [float(j) for i in range(12) for j in range(4 if i < 5 else 1)],
        }
    )
    rows["value"] = np.random.default_rng(3).normal(0, 1, len(rows))
    fit = _fit(MixedModel.of("R_d ~ time + (1 + time | subject)"), rows)
    # 5 of 12 subjects, less intercept and slope
    assert fit.table["model_degrees_of_freedom"].to_dict() == {
        "Intercept": 10,
        "time": 3,
    }


def test_linear_model__contrasts_that_stand_twice_are_one_term():
    table = linear_model(
        planted(),
        formula="R_d ~ age + visit + (1 | subject)",
        contrasts=["age", "2*age", "2*age", "`age`-visit"],
    )
    assert table["term"].values.tolist()[-2:] == ["2*age", "`age`-visit"]
    one = linear_model(
        planted(), formula="R_d ~ age + (1 | subject)", contrasts="2*age"
    )
    assert one["term"].values.tolist()[-1] == "2*age"


def test_linear_model__conditions_are_compared_with_normal():
    names = [f"S{i:02d}" for i in range(12)]
    conditions = ["cold"] * 12 + ["normal"] * 12
    cohort = planted_tables(
        names * 2, conditions=conditions, albedo=np.repeat([0.1, 0.0], 12)
    )
    table = linear_model(cohort, formula="R_d ~ condition + (1 | subject)")
    effect = table["model_estimate"].sel(term="condition[T.cold]")
    np.testing.assert_allclose(effect, 0.1, atol=0.02)  # noise of 0.002 * sqrt(2)


def test_linear_model__names_subjects_that_are_left_out():
    cohort = planted()
    values = cohort["region_diffuse_reflectance"].values.copy()
    values[: 2 * VISITS, 0] *= -1
    dims = cohort["region_diffuse_reflectance"].dims
    table = linear_model(
        cohort.assign(region_diffuse_reflectance=(dims, values)),
        formula="log(R_d) ~ age + (1 | subject)",
    )
    said = (
        "face G: 2 of 24 subjects lack a variable of the formula, or a positive value"
    )
    assert said in table.attrs["flags"]
    assert not any("beard" in flag for flag in table.attrs["flags"])


def test_linear_model__repeats_of_a_visit_are_flagged_and_no_baseline_rows():
    cohort = planted()
    takes = [
        f"{name}.normal.{1 + i // 2}.{1 + i % 2}"
        for name in cohort["subject"].values[::VISITS]
        for i in range(VISITS)
    ]
    cohort = cohort.assign_coords(take=takes)
    table = linear_model(cohort, formula="R_d ~ visit + (1 | subject)")
    assert any("visits have repeats" in flag for flag in table.attrs["flags"])
    table = linear_model(cohort, formula="R_d ~ visit + (1 | subject/visit)")
    assert not any("visits have repeats" in flag for flag in table.attrs["flags"])
    frame = tidy(cohort).query("quantity == 'R_d'")
    assert (frame.baseline.isna() == (frame.visit == 1)).all()


@pytest.mark.parametrize("margin", [-1.0, np.nan])
def test_linear_model__refuses_margins(margin):
    with pytest.raises(InputError, match="margin: must lie in"):
        linear_model(planted(), formula="R_d ~ age + (1 | subject)", margin=margin)


def dosed(slope, error=0.002):
    """30 subjects without and with 1 and 2 units of lotion."""
    names = [f"S{i:02d}" for i in range(30)] * 3
    dose = np.repeat([np.nan, 1.0, 2.0], 30)
    cohort = planted_tables(
        names,
        conditions=["normal"] * 30 + ["lotion"] * 60,
        albedo=slope * np.nan_to_num(dose),
        lotion=dose,
    )
    takes = [
        *names[:30],
        *(
            f"{s}.lotion.{d}"
            for s, d in zip(names[30:], np.repeat([1, 2], 30), strict=True)
        ),
    ]
    name = "region_diffuse_reflectance_error"
    return cohort.assign({name: cohort[name] * (error / 0.002)}).assign_coords(
        take=takes
    )


def test_linear_model__a_dose_is_an_axis():
    """The condition normal is the dose 0; intervals of six regions and channels contain
    the slope.
    """
    found = linear_model(dosed(-0.01), formula="R_d ~ lotion + (1 | subject)")
    assert found.attrs["condition"] == "normal, lotion"
    assert (found["model_takes"] == 90).all()
    one = found.sel(term="lotion")
    # 0.05 of six intervals do not: one may
    inside = (one["model_estimate_low"] < -0.01) & (one["model_estimate_high"] > -0.01)
    assert inside.sum() >= 5
    assert (one["model_p"] < 1e-6).all()


@pytest.mark.parametrize("error", [0.0015, 0.0025])
def test_linear_model__reliability_by_hand(error):
    """Of a dose within and of a group between subjects, who differ by 0.03."""
    cohort = dosed(-0.002, error)
    group = np.array(["a", "b"])[np.arange(90) % 2]
    found = linear_model(
        cohort.assign_coords(group=("take", group)),
        formula="R_d ~ lotion + group + (1 | subject)",
    ).sel(quantity="R_d face G")
    values = cohort["region_diffuse_reflectance"].values[:, 0, 1].reshape(3, 30)
    within = 1 - error**2 / values.var(axis=0, ddof=1).mean()
    between = 1 - error**2 / 3 / values.mean(axis=0).var(ddof=1)
    reliability = found["model_reliability"].sel(term=["lotion", "group[T.b]"])
    np.testing.assert_allclose(reliability, [max(within, 0), between])
    is_withheld = np.isnan(found["model_p"]).values.tolist()
    assert is_withheld == [name == "lotion" and within < 0.5 for name in found["term"]]
    assert (within < 0.5) == (error == 0.0025)
    flag = "no p values where the reliability is below 0.5"
    assert (flag in found.attrs["flags"]) == (within < 0.5)


@pytest.mark.parametrize("condition", ["subject", "visit", "baseline"])
def test_linear_model__conditions_that_are_called_like_columns_are_no_doses(condition):
    cohort = planted()
    conditions = np.where(np.arange(96) % 4 == 3, condition, "normal")
    cohort = cohort.assign_coords(condition=("take", conditions))
    formula = f"R_d ~ {condition} + (1 | subject)"
    if condition == "subject":
        formula = FORMULA
    fitted = linear_model(cohort, formula=formula)
    assert fitted.attrs["condition"] == "normal"
    count = 48 if condition == "baseline" else 72
    assert (fitted["model_takes"] == count).all()


def test_linear_model__of_conditions_contains_even_reflection():
    """The errors of two priors, 1.96 hypot(0.01, 0.012), and R_d that rises by 0.02."""
    names = [f"S{i:02d}" for i in range(20)]
    cohort = planted_tables(
        names * 2,
        conditions=["normal"] * 20 + ["lotion"] * 20,
        albedo=np.repeat([0.0, 0.02], 20),
    ).assign_coords(
        take=[*names, *(f"{name}.lotion" for name in names)],
        fit_even_reflection_error=("take", np.repeat([0.01, 0.012], 20)),
    )
    twice = "2 * condition[T.lotion] + Intercept - Intercept"
    found = linear_model(
        cohort,
        formula="R_d ~ condition + (1 | subject)",
        contrasts=[twice],
        margin=0.03,
    )
    one = found.sel(quantity="R_d face G", term="condition[T.lotion]")
    double = found.sel(quantity="R_d face G", term=twice)
    for name in ("model_estimate_low", "model_estimate_high"):
        np.testing.assert_allclose(double[name], 2 * one[name])
    assert np.isnan(double["model_p"])
    half = one["model_estimate_high"] - one["model_estimate"]
    even = 1.96 * np.hypot(0.01, 0.012)
    expected = np.hypot(even, 2.093 * one["model_error"])
    np.testing.assert_allclose(half, expected, rtol=1e-3)
    assert np.isnan(one["model_p"])
    assert one["model_p_equivalence"] > 0.5  # the interval exceeds the margin
    flag = "R_d face G: even reflection may cause the effect of condition[T.lotion]"
    assert flag in found.attrs["flags"]
    logarithm = linear_model(cohort, formula="log(R_d) ~ condition + (1 | subject)")
    one = logarithm.sel(quantity="R_d face G", term="condition[T.lotion]")
    bare = cohort.region_diffuse_reflectance.sel(region="face")[:20, 1]
    half = one["model_estimate_high"] - one["model_estimate"]
    expected = np.hypot(even / bare.mean(), 2.093 * one["model_error"])
    np.testing.assert_allclose(half, expected, rtol=1e-3)
    assert np.isnan(one["model_p"])


@pytest.mark.parametrize(
    ("formula", "is_mixed"),
    [
        ("R_d ~ lotion + (1 | subject)", True),
        ("R_d ~ lotion + week + (1 | subject)", True),
        ("R_d ~ lotion", False),
    ],
)
def test_linear_model__of_a_dose_that_is_a_condition_contains_even_reflection(
    formula, is_mixed
):
    """As what R_d that rises by the error in that condition adds to the estimate."""
    names = [f"S{i:02d}" for i in range(20)]
    keys = names * 2 if is_mixed else [f"S{i:02d}" for i in range(40)]
    dose = np.where(np.arange(20) % 3, 2.0, 1.0)
    cohort = planted_tables(
        keys,
        conditions=["normal"] * 20 + ["lotion"] * 20,
        lotion=[*np.full(20, np.nan), *dose],
        week=[i % 3 for i in range(40)],
    ).assign_coords(fit_even_reflection_error=("take", np.repeat([0.01, 0.012], 20)))
    found = linear_model(cohort, formula=formula)
    error = np.zeros(40)
    error[20:] = 1.96 * np.hypot(0.01, 0.012)
    name = "region_diffuse_reflectance"
    raised = cohort.assign({name: cohort[name] + xr.DataArray(error, dims="take")})
    one, other = (
        table.sel(quantity="R_d face G", term="lotion")
        for table in (found, linear_model(raised, formula=formula))
    )
    half = one["model_estimate_high"] - one["model_estimate"]
    free = float(one["model_degrees_of_freedom"])
    added = float(other["model_estimate"] - one["model_estimate"])
    assert added > 0.01
    known = stats.t.ppf(0.975, free) * float(one["model_error"])
    # variances differ a little, as the raised values are not those of one dose
    np.testing.assert_allclose(half, np.hypot(added, known), rtol=1e-2)
    assert np.isnan(one["model_p"])


def test_linear_model__levels_of_whole_numbers_have_no_fraction():
    cohort = planted_tables(
        [f"S{i:02d}" for i in range(18)], dose=[float(i % 3) for i in range(18)]
    )
    terms = linear_model(cohort, formula="R_d ~ C(dose)")["term"].values.tolist()
    assert terms == ["Intercept", "dose[T.1]", "dose[T.2]"]


def test_linear_model__a_region_that_no_normal_take_has_keeps_its_intervals():
    conditions = np.repeat(["normal", "lotion"], 12)
    cohort = planted_tables(
        [f"S{i:02d}" for i in range(24)],
        conditions=conditions.tolist(),
        lotion=[*np.full(12, np.nan), *np.tile([1.0, 2.0], 6)],
    )
    values = cohort["region_diffuse_reflectance"]
    is_normal = xr.DataArray(conditions == "normal", dims="take")
    lacking = is_normal & (cohort["region"] == "beard")
    found = linear_model(
        cohort.assign(region_diffuse_reflectance=values.where(~lacking)),
        formula="log(R_d) ~ lotion",
    )
    for end in ("model_estimate_low", "model_estimate_high"):
        assert found[end].sel(quantity=["R_d face G", "R_d beard G"]).notnull().all()
