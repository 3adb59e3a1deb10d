"""Who counts in a study; tables of translucency and albedo of planted populations."""

from __future__ import annotations

import numpy as np
import pytest
from planted import model_of, population

from skindb.analysis import (
    albedo_histograms,
    albedo_table,
    plot_albedo,
    plot_translucency,
    translucency_table,
)
from skindb.analysis.members import comparable, groups_by, has_trait, sides, trait_names
from skindb.errors import InputError


def test_translucency_table__numbers_by_hand():
    table = translucency_table(population()).sel(group="all", site="cheek", channel="R")
    values = 0.5 * np.array([1.0, 1.2, 0.8])  # A in another condition is no fourth subject
    assert int(table["sigma_tr_count"]) == 3
    assert float(table["sigma_tr_mean"]) == pytest.approx(values.mean(), rel=1e-6)
    assert float(table["sigma_tr_variance"]) == pytest.approx(values.var(ddof=1), rel=1e-6)
    assert float(table["sigma_tr_standard_deviation"]) == pytest.approx(values.std(ddof=1), rel=1e-6)
    assert float(table["sigma_tr_mean_low"]) < values.mean() < float(table["sigma_tr_mean_high"])
    rms = np.sqrt(((0.05 * np.array([1.0, 1.2, 0.8])) ** 2).mean())
    assert float(table["sigma_tr_measurement_error"]) == pytest.approx(rms, rel=1e-6)


def test_translucency_table__takes_without_errors_leave_the_measurement_error_unknown():
    models = population()
    for model in models.values():
        model["translucency"] = model["translucency"].to_dataset().drop_vars("site_effective_transport_error")
    table = translucency_table(models)
    assert np.isnan(table["sigma_tr_measurement_error"]).all()
    assert (table["sigma_tr_count"].sel(site="cheek") == 3).all()


def test_translucency_table__groups_and_untrusted_sites():
    models = population()
    models["B"]["translucency/site_status"][0, 0] = 1
    table = translucency_table(models, group_by="gender")
    assert list(map(str, table["group"].values)) == ["female", "male"]
    assert int(table["sigma_tr_count"].sel(group="male", site="cheek", channel="R")) == 1
    assert np.isnan(table["sigma_tr_variance"].sel(group="male", site="cheek", channel="R"))
    assert int(table["sigma_tr_count"].sel(group="male", site="neck", channel="R")) == 2
    conditions = translucency_table(models, group_by="condition")
    assert set(map(str, conditions["group"].values)) == {"normal", "lotion"}
    assert plot_translucency(table).get_ylabel().endswith("[mm-1]")


def test_members__consent_is_respected():
    models = population()
    models["B"].attrs["consent_scope"] = ["fit"]
    table = translucency_table(models)
    assert "B" not in table.attrs["takes"]
    assert table.attrs["left_out"] == ["B: its consent does not cover statistics"]
    for model in models.values():
        model.attrs["consent_scope"] = ["fit"]
    with pytest.raises(InputError, match="consent to them"):
        translucency_table(models)


def test_members__traits_and_what_they_are_compared_with():
    models = population()
    assert trait_names(models) == ["female", "lotion", "male", "older"]
    np.testing.assert_array_equal(has_trait(models, "lotion"), [False, True, False, False])
    np.testing.assert_array_equal(comparable(models, "lotion"), [True, True, False, False])  # within the subject
    np.testing.assert_array_equal(comparable(models, "male"), [True, False, True, True])  # lotion would mix in
    np.testing.assert_array_equal(comparable(models, "female"), [True, False, True, True])  # A counts once


def test_members__silent_takes_are_on_neither_side():
    models = population()
    del models["C"].attrs["traits"]["gender"]
    models["C"].attrs["traits"]["age"] = "fifty"
    models["B"].attrs["traits"]["tan"] = True
    with_male, without = sides(models, "male")
    np.testing.assert_array_equal(with_male, [False, False, True, False])
    np.testing.assert_array_equal(without, [True, False, False, False])
    np.testing.assert_array_equal(sides(models, "older"), [[False, False, True, False], [True, False, False, False]])
    assert trait_names(models) == ["female", "fifty", "lotion", "male", "older"]  # nobody said that they have no tan
    assert not any(sides({"A": models["A"]}, "older")[0])


def test_members__a_subject_counts_once_for_the_median_age():
    models = population()
    models |= {f"A.{c}": model_of(1, subject="A", condition=c, traits={"age": 20}) for c in ("cold", "hot")}
    assert [t for t, old in zip(models, has_trait(models, "older"), strict=True) if old] == ["B"]


def test_groups_by__attributes_traits_and_typing_errors():
    models = population()
    assert groups_by(models, None) == dict.fromkeys(models, "all")
    assert groups_by(models, "condition")["A.lotion"] == "lotion"
    assert groups_by(models, "male") == {"A": "not male", "A.lotion": "not male", "B": "male", "C": "male"}
    del models["C"].attrs["traits"]["gender"]
    assert groups_by(models, "gender")["C"] == groups_by(models, "male")["C"] == "unknown"
    with pytest.raises(InputError, match=r"(?s)gendre.*attributes: age, condition, gender"):
        translucency_table(models, group_by="gendre")


def test_albedo_table__numbers_by_hand():
    models = population()
    albedo = albedo_histograms(models)
    own = albedo["albedo_mean"].sel(region="face")
    table = albedo_table(models, albedo=albedo, group_by="gender").sel(region="face")
    male = own.sel(take=["B", "C"]).values
    np.testing.assert_allclose(table["group_albedo_mean"].sel(group="male"), male.mean(axis=0))
    np.testing.assert_allclose(table["group_albedo_standard_deviation"].sel(group="male"), male.std(axis=0, ddof=1))
    np.testing.assert_allclose(table["group_albedo_mean"].sel(group="female"), own.sel(take="A"))  # without the lotion
    np.testing.assert_array_equal(table["group_albedo_count"], [[1] * 3, [2] * 3])
    np.testing.assert_allclose(table["group_histogram"].sum("bin"), 1)
    assert albedo_table(models, albedo=albedo).sizes["group"] == 1


def test_albedo_table__only_takes_in_a_condition():
    models = {"A.lotion": population()["A.lotion"]}
    albedo = albedo_histograms(models)
    with pytest.raises(InputError, match=r"condition normal; found only A\.lotion; group by condition"):
        albedo_table(models, albedo=albedo)
    table = albedo_table(models, albedo=albedo, group_by="condition")
    assert list(map(str, table["group"].values)) == ["lotion"]
    assert translucency_table(models)["sigma_tr_count"].sum() == 0


def test_albedo_histograms__absent_regions_are_unknown():
    models = population()
    models["A"]["fitted"] = models["A"]["fitted"].to_dataset().drop_vars(["region_mask", "region"])
    albedo = albedo_histograms(models)
    assert np.isnan(albedo["albedo_histogram"].sel(take="A", region="beard")).all()
    table = albedo_table(models, albedo=albedo)
    np.testing.assert_array_equal(table["group_albedo_count"].sel(region="beard"), [[2, 2, 2]])


def test_albedo_histograms__shares_and_decorrelation():
    histograms = albedo_histograms(population())
    np.testing.assert_allclose(histograms["albedo_histogram"].sum("bin"), 1.0)
    flat, weights = [], []
    for take, model in population().items():
        node = model["fitted"].to_dataset()
        good = node["fit_status"].values == 0
        flat.append(
            (node["diffuse_reflectance"].values[good] - histograms["colour_mean"].values)
            @ histograms["colour_axis"].values.T
        )
        area = node["surfel_area"].values[good]
        weights.append(area / area.sum())
        got = histograms["albedo_mean"].sel(take=take, region="face").values
        np.testing.assert_allclose(
            got, np.average(node["diffuse_reflectance"].values[good], axis=0, weights=area), rtol=1e-5
        )
    spread = np.cov(np.concatenate(flat).T, aweights=np.concatenate(weights), ddof=0)
    np.testing.assert_allclose(spread, np.eye(3), atol=1e-6)
    assert plot_albedo(histograms).get_xlabel()


def test_albedo_histograms__a_take_without_fitted_surfels_is_named():
    models = population()
    models["B"]["fitted/fit_status"][:] = 1
    with pytest.raises(InputError, match=r"(?s)B.*fitted surfels.*none"):
        albedo_histograms(models)
