"""Numbers of subjects: those of statsmodels, and the power that simulated studies have."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from matplotlib import pyplot
from scipy import stats
from statsmodels.stats.power import TTestIndPower, TTestPower
from test_linear_model import planted

from skindb.analysis import linear_model, sample_sizes
from skindb.analysis.planning import plot_plan
from skindb.errors import InputError

FORMULA = "R_d ~ treatment * visit + (1 | subject)"
NAME = "R_d face G"


@pytest.fixture(scope="module")
def cohort():
    """One region of 24 subjects at four visits."""
    return planted().isel(region=[0])


@pytest.mark.parametrize(("effect", "more"), [(0.02, 0), (-0.08, 0), (0.1, 2)])
def test_sample_sizes__of_one_take_of_each_subject_have_errors_hc3(
    cohort, effect, more
):
    """Student's test needs no more; the power of 20,000 simulated studies is within 1 %."""
    plan = sample_sizes(
        cohort,
        formula="R_d ~ treatment + (1 | subject)",
        term="treatment",
        effect=effect,
    ).sel(quantity=NAME)
    size = int(plan["plan_subjects"])
    deviations = plan[["between_subject_deviation", "residual_deviation"]]
    distance = abs(effect) / np.hypot(*map(float, deviations.values()))
    student = TTestIndPower().solve_power(distance, alpha=0.05, power=0.8)
    assert more <= size - 2 * np.ceil(student) <= 4

    def power(size):
        values = np.random.default_rng(1).normal(size=(20_000, 2, size // 2))
        mean = values.mean(axis=2)
        free = size // 2 - 1
        # squares over (1 - h)^2, with the leverage h = 2 / size
        square = values.var(axis=2).sum(axis=1) * (size // 2) / free**2
        t = (mean[:, 1] - mean[:, 0] + distance) / np.sqrt(square)
        return (np.abs(t) > stats.t.ppf(0.975, size - 2)).mean()

    assert power(size) > 0.79
    assert power(size - 2) < 0.81


def test_sample_sizes__of_a_crossover_are_those_of_a_t_test(cohort):
    effect = 0.005
    plan = sample_sizes(
        cohort,
        formula="R_d ~ treatment + (1 | subject)",
        term="treatment",
        effect=effect,
        power=0.9,
        design="crossover",
    ).sel(quantity=NAME)
    between = float(plan["between_subject_deviation"])
    within = float(plan["residual_deviation"])
    known = linear_model(cohort, formula="R_d ~ 1 + (1 | subject)").sel(quantity=NAME)
    assert [between, within] == known["model_deviation"].values.tolist()
    distance = effect / (np.sqrt(2) * within)
    expected = np.ceil(TTestPower().solve_power(distance, alpha=0.05, power=0.9))
    assert float(plan["plan_subjects"]) == expected


def test_sample_sizes__of_a_change_over_visits_by_hand(cohort):
    """Slopes of two arms differ with the variance 4 s^2 / (n S), where S = 5 is the sum of
    squares of four visits; 500 simulated studies with the planned number had a power of
    81.2 %.
    """
    plan = sample_sizes(
        cohort, formula=FORMULA, term="treatment:visit", effect=0.006, visits=4
    ).sel(quantity=NAME)
    within = float(plan["residual_deviation"])
    count = np.arange(4, 200, 2)
    error = np.sqrt(4 * within**2 / (5 * count))
    free = 3 * count - 2
    power = stats.nct.sf(stats.t.ppf(0.975, free), free, 0.006 / error)
    expected = np.flatnonzero(power >= 0.8)[0]
    assert float(plan["plan_subjects"]) == count[expected]
    assert float(plan["plan_error"]) == pytest.approx(error[expected])


def test_sample_sizes__of_doses_by_hand(cohort):
    """Doses 0, 1 and 2 have the sum of squares 2 within a subject; of ten subjects one
    leaves.
    """
    formula = "R_d ~ treatment + (1 | subject)"
    options = {"formula": formula, "term": "treatment", "effect": 0.003, "doses": 2}
    plan, enlarged = (
        sample_sizes(cohort, **options, design="crossover", drop_out=part).sel(
            quantity=NAME
        )
        for part in (0.0, 0.1)
    )
    count = np.arange(3, 200)
    error = float(plan["residual_deviation"]) / np.sqrt(2 * count)
    free = 2 * count - 1
    power = stats.nct.sf(stats.t.ppf(0.975, free), free, 0.003 / error)
    expected = count[np.flatnonzero(power >= 0.8)[0]]
    assert float(plan["plan_subjects"]) == expected
    assert float(enlarged["plan_subjects"]) == np.ceil(expected / 0.9)
    assert enlarged["plan_error"].equals(plan["plan_error"])
    arms = sample_sizes(cohort, **(options | {"effect": 0.02}), drop_out=0.1)
    assert (arms["plan_subjects"] % 3 == 0).all()


def test_sample_sizes__of_factors_by_hand(cohort):
    """The change from the first to the third visit differs between arms with the variance
    8 s^2 / n: C(visit) has 3 n - n - 4 degrees of freedom within subjects.
    """
    plan = sample_sizes(
        cohort,
        formula="R_d ~ treatment * C(visit) + (1 | subject)",
        term="treatment:visit[T.3]",
        effect=0.01,
        visits=3,
    ).sel(quantity=NAME)
    count = np.arange(4, 200, 2)
    error = float(plan["residual_deviation"]) * np.sqrt(8 / count)
    free = 2 * count - 4
    power = stats.nct.sf(stats.t.ppf(0.975, free), free, 0.01 / error)
    assert float(plan["plan_subjects"]) == count[np.flatnonzero(power >= 0.8)[0]]
    formula = "R_d ~ C(treatment) + (1 | subject)"
    with pytest.raises(InputError, match=r"multiples of Intercept, treatment.T.1."):
        sample_sizes(cohort, formula=formula, term="treatment", effect=1)


@pytest.mark.parametrize("effect", [1.0, 1e9])
def test_sample_sizes__of_a_large_effect_are_the_fewest_of_the_model(cohort, effect):
    plan = sample_sizes(
        cohort,
        formula="R_d ~ treatment + (1 | subject)",
        term="treatment",
        effect=effect,
        design="crossover",
        doses=8,
    )
    assert (plan["plan_subjects"] == 2).all()


def test_sample_sizes__too_small_an_effect_has_no_number(cohort):
    plan = sample_sizes(cohort, formula=FORMULA, term="visit", effect=1e-7, visits=2)
    assert plan["plan_subjects"].isnull().all()
    ax = plot_plan(plan)
    texts = [text.get_text() for text in ax.texts]
    assert texts == ["more than 10,000"] * plan.sizes["quantity"]
    pyplot.close(ax.figure)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"formula": "R_d ~ treatment"}, "must have .1 . subject."),
        (
            {"formula": "R_d ~ treatment + (1 + visit | subject)"},
            "without slopes or nesting",
        ),
        ({"visits": 1}, "must be determined by the design"),
        ({"term": "dose"}, "not a sum of multiples of Intercept, treatment"),
        ({"formula": "R_d ~ age + (1 | subject)"}, "choose from: subject, treatment"),
        ({"effect": 0.0}, "effect: must differ from 0"),
        ({"effect": np.nan}, "effect: must lie in"),
        ({"power": 1.0}, "power: must lie in"),
        ({"design": "cluster"}, "design: must be one of parallel, crossover"),
    ],
)
def test_sample_sizes__refuses(cohort, options, said):
    given = {"formula": FORMULA, "term": "visit", "effect": 1.0, "visits": 3}
    with pytest.raises(InputError, match=said):
        sample_sizes(cohort, **(given | options))


def test_sample_sizes__need_repeats(cohort):
    with pytest.raises(InputError, match="one take of each of 24"):
        sample_sizes(
            cohort.isel(take=slice(0, None, 4)),
            formula="R_d ~ treatment + (1 | subject)",
            term="treatment",
            effect=1,
        )


def test_sample_sizes__flags_quantities_whose_model_has_no_p_value(cohort):
    """Errors of 0.008 explain most of the variance within subjects, 0.01^2, but not
    between them; the study that is planned has no p value.
    """
    cohort = cohort.copy()
    cohort["region_diffuse_reflectance_error"] = xr.full_like(
        cohort["region_diffuse_reflectance"], 0.008
    )
    options = {"formula": "R_d ~ visit + (1 | subject)", "term": "visit", "visits": 4}
    plan = sample_sizes(cohort, effect=0.01, **options)
    flag = f"{NAME}: errors explain the variance: the model has no p value"
    assert flag in plan.attrs["flags"]
    fitted = linear_model(cohort, formula=options["formula"])
    assert fitted["model_p"].sel(quantity=NAME, term="visit").isnull()
    options = {"formula": "R_d ~ treatment + (1 | subject)", "term": "treatment"}
    assert not sample_sizes(cohort, effect=0.01, **options).attrs["flags"]


def test_sample_sizes__repeats_are_no_visits(cohort):
    """Visits of two takes: only the first ones count."""
    takes = [
        f"{name}.normal.{1 + i // 2}.{1 + i % 2}"
        for name in cohort["subject"].values[::4]
        for i in range(4)
    ]
    options = {"formula": FORMULA, "term": "visit", "effect": 0.01, "visits": 3}
    repeated = sample_sizes(cohort.assign_coords(take=takes), **options)
    first = sample_sizes(
        cohort.isel(take=[i for i in range(96) if not i % 2]), **options
    )
    assert repeated["residual_deviation"].equals(first["residual_deviation"])
