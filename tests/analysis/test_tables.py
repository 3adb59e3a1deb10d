"""Which takes count in a study; tables of translucency and albedo of planted populations."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from planted_population import model_of, population, surfels, tables
from planted_tables import planted_tables

from skindb.analysis import (
    albedo_histograms,
    albedo_table,
    plot_albedo,
    plot_study,
    plot_translucency,
    translucency_table,
)
from skindb.analysis.subjects import (
    comparable_takes,
    describe_visits,
    groups_by,
    has_trait,
    known_traits,
    sides,
    subjects_of,
    trait_names,
)
from skindb.errors import InputError


def test_translucency_table__numbers_by_hand():
    table = translucency_table(tables(population())).sel(
        group="all", site="cheek", channel="R"
    )
    # A in another condition is not a fourth subject
    values = 0.5 * np.array([1.0, 1.2, 0.8])
    assert int(table["sigma_tr_count"]) == 3
    assert float(table["sigma_tr_mean"]) == pytest.approx(values.mean(), rel=1e-6)
    assert float(table["sigma_tr_variance"]) == pytest.approx(
        values.var(ddof=1), rel=1e-6
    )
    assert float(table["sigma_tr_standard_deviation"]) == pytest.approx(
        values.std(ddof=1), rel=1e-6
    )
    assert (
        float(table["sigma_tr_mean_low"])
        < values.mean()
        < float(table["sigma_tr_mean_high"])
    )
    rms = np.sqrt(((0.05 * np.array([1.0, 1.2, 0.8])) ** 2).mean())
    assert float(table["sigma_tr_measurement_error"]) == pytest.approx(rms, rel=1e-6)


def test_translucency_table__a_subject_counts_once_whatever_its_visits():
    once = planted_tables(["S1", "S2", "S3"])
    visits = once.isel(take=[0, 0, 1, 2, 2, 2]).assign_coords(
        take=[f"{i}" for i in range(6)]
    )
    one, several = translucency_table(once), translucency_table(visits)
    for name in ("sigma_tr_count", "sigma_tr_mean", "sigma_tr_standard_deviation"):
        np.testing.assert_allclose(several[name], one[name], rtol=1e-12)
    assert describe_visits(once) == ""
    assert describe_visits(visits).startswith("6 takes of 3 subjects; ")


def test_translucency_table__takes_without_errors_leave_the_measurement_error_unknown():
    models = population()
    for model in models.values():
        model["translucency"] = (
            model["translucency"].to_dataset().drop_vars("site_sigma_tr_error")
        )
    table = translucency_table(tables(models))
    assert np.isnan(table["sigma_tr_measurement_error"]).all()
    assert (table["sigma_tr_count"].sel(site="cheek") == 3).all()


def test_translucency_table__groups_and_untrusted_sites():
    models = population()
    models["B"]["translucency/site_status"][0, 0] = 1
    table = translucency_table(tables(models), group_by="gender")
    assert list(map(str, table["group"].values)) == ["female", "male"]
    assert (
        int(table["sigma_tr_count"].sel(group="male", site="cheek", channel="R")) == 1
    )
    assert np.isnan(
        table["sigma_tr_variance"].sel(group="male", site="cheek", channel="R")
    )
    assert int(table["sigma_tr_count"].sel(group="male", site="neck", channel="R")) == 2
    conditions = translucency_table(tables(models), group_by="condition")
    assert set(map(str, conditions["group"].values)) == {"normal", "lotion"}
    label = r"mean $\sigma_{tr}$ with 95 % CI [mm$^{-1}$]"
    assert plot_translucency(table).get_ylabel() == label


def test_plot_study__of_albedo_draws_the_groups_that_were_asked_for(tmp_path):
    models = population()
    albedo = albedo_histograms(surfels(models))
    table = albedo_table(tables(models), albedo=albedo, group_by="gender")
    legend = plot_albedo(albedo, table=table).get_legend()
    assert [text.get_text() for text in legend.get_texts()] == [
        "female (n = 1)",
        "male (n = 2)",
    ]
    assert len(plot_albedo(albedo).get_lines()) == 4
    study = xr.DataTree.from_dict({"albedo": albedo, "albedo_table": table})
    for ending in ("png", "svg", "pdf"):
        plot_study(study, tmp_path / f"a.{ending}")
        assert (tmp_path / f"a.{ending}").stat().st_size > 1000


def test_plot_study__shows_text_with_dollars_as_it_is(tmp_path):
    models = population()
    for model in models.values():
        model.attrs["traits"]["gender"] = r"$\x$"
    albedo = albedo_histograms(surfels(models))
    table = albedo_table(tables(models), albedo=albedo, group_by="gender")
    plot_study(
        xr.DataTree.from_dict({"albedo": albedo, "albedo_table": table}),
        tmp_path / "a.svg",
    )
    assert (tmp_path / "a.svg").stat().st_size > 1000


def test_members__consent_is_respected():
    models = population()
    models["B"].attrs["consent_scope"] = ["fit"]
    table = translucency_table(tables(models))
    assert "B" not in table.attrs["takes"]
    assert table.attrs["skipped"] == [
        {"take": "B", "reason": "its consent does not cover statistics"}
    ]
    for model in models.values():
        model.attrs["consent_scope"] = ["fit"]
    with pytest.raises(InputError, match="consent of a take must cover statistics"):
        translucency_table(tables(models))


def test_members__traits_and_what_they_are_compared_with():
    models = population()
    assert trait_names(subjects_of(tables(models))) == [
        "age:older",
        "condition:lotion",
        "gender:female",
        "gender:male",
    ]
    np.testing.assert_array_equal(
        has_trait(subjects_of(tables(models)), "condition:lotion"),
        [False, True, False, False],
    )
    np.testing.assert_array_equal(
        comparable_takes(subjects_of(tables(models)), "condition:lotion"),
        [True, True, False, False],
    )  # within the subject
    np.testing.assert_array_equal(
        comparable_takes(subjects_of(tables(models)), "gender:male"),
        [True, False, True, True],
    )  # the take with lotion would be included
    np.testing.assert_array_equal(
        comparable_takes(subjects_of(tables(models)), "gender:female"),
        [True, False, True, True],
    )  # A counts once


def test_members__silent_takes_are_on_neither_side():
    models = population()
    del models["C"].attrs["traits"]["gender"]
    models["C"].attrs["traits"]["age"] = "fifty"
    models["B"].attrs["traits"]["tan"] = True
    with_male, without = sides(subjects_of(tables(models)), "gender:male")
    np.testing.assert_array_equal(with_male, [False, False, True, False])
    np.testing.assert_array_equal(without, [True, False, False, False])
    np.testing.assert_array_equal(
        sides(subjects_of(tables(models)), "age:older"),
        [[False, False, True, False], [True, False, False, False]],
    )
    expected = [
        "age:fifty",
        "age:older",
        "condition:lotion",
        "gender:female",
        "gender:male",
    ]
    # no capture states the absence of a tan
    assert trait_names(subjects_of(tables(models))) == expected
    assert not any(sides(subjects_of(tables({"A": models["A"]})), "age:older")[0])


def test_members__a_subject_counts_once_for_the_median_age():
    models = population()
    models |= {
        f"A.{c}": model_of(1, subject="A", condition=c, traits={"age": 20})
        for c in ("cold", "hot")
    }
    assert [
        t
        for t, old in zip(
            models, has_trait(subjects_of(tables(models)), "age:older"), strict=True
        )
        if old
    ] == ["B"]


def test_members__a_take_without_an_age_has_no_age_of_another_take():
    models = population()
    models["A"].attrs["traits"]["age"] = 70
    models["A.lotion"].attrs["traits"] = {"gender": "female"}
    assert has_trait(subjects_of(tables(models)), "age:older").tolist() == [
        True,
        False,
        False,
        False,
    ]


def test_groups_by__a_subject_without_a_condition_counts_once():
    models = population() | {
        f"B.{c}": model_of(2, subject="B", condition=c) for c in ("cold", "hot")
    }
    assert (
        groups_by(subjects_of(tables(models)), "lotion")[-2:]
        == ["other conditions"] * 2
    )
    table = translucency_table(tables(models), group_by="lotion").sel(
        site="cheek", channel="R"
    )
    assert int(table["sigma_tr_count"].sel(group="not condition:lotion")) == 3


def test_members__a_cohort_that_was_written_and_read_again(tmp_path):
    """Text is read as variable-length text, and missing values as empty text; they stay missing."""
    models = population()
    models["A"].attrs["traits"]["hair"] = "red"
    cohort = tables(models)
    cohort.to_zarr(tmp_path / "cohort.zarr", consolidated=False, zarr_format=3)
    again = xr.open_zarr(tmp_path / "cohort.zarr", consolidated=False)
    assert (
        groups_by(subjects_of(again), "hair")
        == groups_by(subjects_of(cohort), "hair")
        == ["red", "unknown", "unknown", "unknown"]
    )
    for trait in ("hair:red", "gender:male", "condition:lotion", "age:older"):
        np.testing.assert_array_equal(
            sides(subjects_of(again), trait), sides(subjects_of(cohort), trait)
        )
    xr.testing.assert_allclose(translucency_table(again), translucency_table(cohort))


def test_cohort_of__an_attribute_never_replaces_what_a_cohort_names_itself():
    models = population()
    models["B"].attrs["traits"] |= {"condition": "eczema", "fit_k": 9, "subject": "X"}
    cohort = tables(models)
    assert cohort["condition"].values.tolist() == [
        "normal",
        "lotion",
        "normal",
        "normal",
    ]
    assert cohort["attribute_condition"].sel(take="B") == "eczema"
    assert "attribute_condition:eczema" in known_traits(subjects_of(cohort))


def test_groups_by__attributes_traits_and_typing_errors():
    models = population()
    assert groups_by(subjects_of(tables(models)), None) == ["all"] * 4
    assert groups_by(subjects_of(tables(models)), "condition")[1] == "lotion"
    assert (
        groups_by(subjects_of(tables(models)), "male")
        == ["not gender:male"] * 2 + ["gender:male"] * 2
    )
    del models["C"].attrs["traits"]["gender"]
    assert (
        groups_by(subjects_of(tables(models)), "gender")[3]
        == groups_by(subjects_of(tables(models)), "male")[3]
        == "unknown"
    )
    with pytest.raises(
        InputError, match=r"(?s)gendre.*attributes: age, condition, gender"
    ):
        translucency_table(tables(models), group_by="gendre")


def test_trait_name__an_alias_must_be_unambiguous():
    """The value "dark" occurs for hair and for skin."""
    models = population()
    for take, hair, skin in (
        ("A", "dark", "fair"),
        ("B", "fair", "dark"),
        ("C", "red", "dark"),
    ):
        models[take].attrs["traits"] |= {"hair": hair, "skin": skin}
    cohort = tables(models)
    np.testing.assert_array_equal(
        has_trait(subjects_of(cohort), "hair:dark"), [True, False, False, False]
    )
    np.testing.assert_array_equal(
        has_trait(subjects_of(cohort), "skin:dark"), [False, False, True, True]
    )
    assert groups_by(subjects_of(cohort), "red") == [
        "not hair:red",
        "unknown",
        "not hair:red",
        "hair:red",
    ]
    with pytest.raises(InputError, match="found 2 matches: hair:dark, skin:dark"):
        groups_by(subjects_of(cohort), "dark")


def test_studies__takes_that_were_fitted_differently_are_not_mixed_silently():
    models = population()
    for take, model in models.items():
        model.attrs["parameters"] = {"eta": 1.4 if take == "B" else 1.3, "k": 4}
    with pytest.raises(
        InputError,
        match=r"eta: .* found 1.3 of A, A.lotion, C; 1.4 of B; refit them alike",
    ):
        translucency_table(tables(models))
    mixed = tables(models).assign_attrs(mixed_fits=True)
    assert translucency_table(mixed)["sigma_tr_count"].max() == 3


def test_albedo_table__numbers_by_hand():
    models = population()
    albedo = albedo_histograms(surfels(models))
    own = albedo["albedo_mean"].sel(region="face")
    table = albedo_table(tables(models), albedo=albedo, group_by="gender").sel(
        region="face"
    )
    male = own.sel(take=["B", "C"]).values
    np.testing.assert_allclose(
        table["group_albedo_mean"].sel(group="male"), male.mean(axis=0)
    )
    np.testing.assert_allclose(
        table["group_albedo_standard_deviation"].sel(group="male"),
        male.std(axis=0, ddof=1),
    )
    # without the lotion
    np.testing.assert_allclose(
        table["group_albedo_mean"].sel(group="female"), own.sel(take="A")
    )
    np.testing.assert_array_equal(table["group_albedo_count"], [[1] * 3, [2] * 3])
    np.testing.assert_allclose(table["group_histogram"].sum("bin"), 1)
    assert albedo_table(tables(models), albedo=albedo).sizes["group"] == 1


def test_albedo_table__states_the_error_that_groups_have_in_common():
    models = population()
    albedo = albedo_histograms(surfels(models))
    unstated = albedo_table(tables(models), albedo=albedo)
    assert np.isnan(unstated["group_even_reflection_error"]).all()
    for i, model in enumerate(models.values()):
        model.attrs["even_reflection_error"] = 0.01 + 0.001 * i
    table = albedo_table(tables(models), albedo=albedo)
    np.testing.assert_allclose(table["group_even_reflection_error"], 0.013)
    xr.testing.assert_identical(
        table["group_albedo_mean_low"], unstated["group_albedo_mean_low"]
    )


def test_albedo_table__only_takes_in_a_condition():
    models = {"A.lotion": population()["A.lotion"]}
    albedo = albedo_histograms(surfels(models))
    with pytest.raises(
        InputError, match=r"condition normal; found only A\.lotion; group by condition"
    ):
        albedo_table(tables(models), albedo=albedo)
    table = albedo_table(tables(models), albedo=albedo, group_by="condition")
    assert list(map(str, table["group"].values)) == ["lotion"]
    with pytest.raises(InputError, match=r"condition normal; found only A\.lotion"):
        translucency_table(tables(models))


def test_albedo_histograms__absent_regions_are_unknown():
    models = population()
    models["A"]["fitted"] = (
        models["A"]["fitted"].to_dataset().drop_vars(["region_mask", "region"])
    )
    albedo = albedo_histograms(surfels(models))
    assert np.isnan(albedo["albedo_histogram"].sel(take="A", region="beard")).all()
    table = albedo_table(tables(models), albedo=albedo)
    np.testing.assert_array_equal(
        table["group_albedo_count"].sel(region="beard"), [[2, 2, 2]]
    )


def test_albedo_histograms__shares_and_decorrelation():
    histograms = albedo_histograms(surfels(population()))
    np.testing.assert_allclose(histograms["albedo_histogram"].sum("bin"), 1.0)
    flat = []
    weights = []
    for take, model in population().items():
        node = model["fitted"].to_dataset()
        good = node["fit_status"].values == 0
        flat.append(
            (
                node["diffuse_reflectance"].values[good]
                - histograms["colour_mean"].values
            )
            @ histograms["colour_axis"].values.T
        )
        area = node["surfel_area"].values[good]
        weights.append(area / area.sum())
        got = histograms["albedo_mean"].sel(take=take, region="face").values
        np.testing.assert_allclose(
            got,
            np.average(node["diffuse_reflectance"].values[good], axis=0, weights=area),
            rtol=1e-5,
        )
    spread = np.cov(np.concatenate(flat).T, aweights=np.concatenate(weights), ddof=0)
    np.testing.assert_allclose(spread, np.eye(3), atol=1e-6)
    assert plot_albedo(histograms).get_xlabel()


def test_albedo_histograms__a_take_without_fitted_surfels_is_named():
    models = population()
    models["B"]["fitted/fit_status"][:] = 1
    with pytest.raises(InputError, match=r"(?s)B.*fitted surfels.*none"):
        albedo_histograms(surfels(models))
