"""Population analysis on small planted populations: counts, bases, colours, traits, edits."""

from __future__ import annotations

import importlib.util
import json
import tracemalloc
from pathlib import Path

import dask.array
import numpy as np
import pytest
import xarray as xr
from scipy.optimize import minimize

from skindb.analysis import (
    albedo_histograms,
    albedo_table,
    apply_traits,
    basis_size,
    basis_size_curve,
    plot_albedo,
    plot_basis_size,
    plot_traits,
    plot_translucency,
    population_basis,
    study,
    trait_vectors,
    translucency_table,
)
from skindb.analysis.albedo import levels, quantiles
from skindb.analysis.basis_size import choose_size
from skindb.analysis.edit import carry, valid_quantiles
from skindb.analysis.members import comparable, groups_by, has_trait, sides, trait_names
from skindb.analysis.population_basis import project
from skindb.analysis.study import analyze, edit_take, plot_study, tabulate_study
from skindb.errors import InputError
from skindb.optics.angles import half_difference
from skindb.optics.brdf_table import TableGrid, brdf_metric, lookup
from skindb.optics.dictionary import embedded_dictionary
from skindb.optics.diffuse import diffuse_reflectance
from skindb.optics.fresnel import fresnel_transmittance
from skindb.optics.rows import basis_rows
from skindb.schema import dataset
from skindb.store import Database

TABLES = np.ascontiguousarray(embedded_dictionary().table[..., :8])
NAMES = list(embedded_dictionary().names[:8])
GRID = TableGrid(*TABLES.shape[:3])
H = np.zeros((3, 8))
H[0, [0, 1]], H[1, [3]], H[2, [5, 6]] = (0.5, 0.5), 1.0, (0.3, 0.7)
N = 60


def _unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _model(seed: int, *, gloss=1.0, tint=1.0, tr=1.0, scope=("fit", "statistics"), probe=True, **attrs) -> xr.DataTree:
    rng = np.random.default_rng(seed)
    weight = (rng.gamma(4.0, 0.02, (N, 3)) * [gloss, 1, 1]) @ H
    colour = np.clip(np.array([0.5, 0.3, 0.2]) * tint * rng.lognormal(0, 0.08, (N, 3)), 0.01, 0.95)
    status = np.zeros(N)
    status[0] = 1
    weight[0], colour[0] = np.nan, np.nan
    position = _unit(rng.normal(size=(N, 3)) * [1, 1, 0.3] + [0, 0, 1]) * 80
    fitted = dataset(
        {
            "basis_weight": weight, "diffuse_reflectance": colour, "dipole_s": np.full((N, 3), 0.5),
            "reduced_weight": weight[:, :2], "surfel_area": rng.uniform(0.5, 1.5, N), "fit_status": status,
            "surfel_position": position, "shading_normal": _unit(position),
            "effective_transport": np.full((N, 3), 1.0), "region_mask": rng.random((N, 1)) < 0.4,
        },
        coords={"basis": NAMES, "region": ["beard"], "component": ["component0", "component1"]},
    )  # fmt: skip
    brdf = np.moveaxis(TABLES[..., :2], -1, 0)
    groups = {"fitted": fitted, "basis": dataset({"basis_brdf": brdf}, attrs={"disc_angular_radius": 0.0})}
    if probe:
        sites = {
            "site_effective_transport": tr * np.array([[0.5, 1.0, 1.5], [0.6, 1.1, 1.6]]),
            "site_effective_transport_error": np.full((2, 3), 0.05 * tr),
            "site_status": np.zeros((2, 3)),
        }
        groups["translucency"] = dataset(sites, coords={"site": ["cheek", "neck"], "channel": ["R", "G", "B"]})
    tree = xr.DataTree.from_dict(groups)
    tree.attrs = {"eta": 1.3, "consent_scope": list(scope), "condition": "normal", **attrs}
    return tree


def _population() -> dict[str, xr.DataTree]:
    return {
        "A": _model(1, subject="A", traits={"age": 20, "gender": "female"}),
        "A.lotion": _model(1, gloss=3.0, subject="A", condition="lotion", traits={"age": 20, "gender": "female"}),
        "B": _model(2, tint=0.6, tr=1.2, subject="B", traits={"age": 60, "gender": "male"}),
        "C": _model(3, tint=0.7, tr=0.8, subject="C", traits={"age": 50, "gender": "male"}),
    }


def _analysed(models):
    basis = population_basis(models, tables=TABLES, k=3, rng=np.random.default_rng(0))
    albedo = albedo_histograms(models)
    return basis, albedo, trait_vectors(models, basis=basis, albedo=albedo)


def test_translucency_table__numbers_by_hand():
    table = translucency_table(_population()).sel(group="all", site="cheek", channel="R")
    values = 0.5 * np.array([1.0, 1.2, 0.8])  # A in another condition is no fourth subject
    assert int(table["sigma_tr_count"]) == 3
    assert float(table["sigma_tr_mean"]) == pytest.approx(values.mean(), rel=1e-6)
    assert float(table["sigma_tr_variance"]) == pytest.approx(values.var(ddof=1), rel=1e-6)
    assert float(table["sigma_tr_standard_deviation"]) == pytest.approx(values.std(ddof=1), rel=1e-6)
    assert float(table["sigma_tr_mean_low"]) < values.mean() < float(table["sigma_tr_mean_high"])
    rms = np.sqrt(((0.05 * np.array([1.0, 1.2, 0.8])) ** 2).mean())
    assert float(table["sigma_tr_measurement_error"]) == pytest.approx(rms, rel=1e-6)


def test_translucency_table__takes_without_errors_leave_the_measurement_error_unknown():
    models = _population()
    for model in models.values():
        model["translucency"] = model["translucency"].to_dataset().drop_vars("site_effective_transport_error")
    table = translucency_table(models)
    assert np.isnan(table["sigma_tr_measurement_error"]).all()
    assert (table["sigma_tr_count"].sel(site="cheek") == 3).all()


def test_translucency_table__groups_and_untrusted_sites():
    models = _population()
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
    models = _population()
    models["B"].attrs["consent_scope"] = ["fit"]
    table = translucency_table(models)
    assert "B" not in table.attrs["takes"]
    assert table.attrs["left_out"] == ["B: its consent does not cover statistics"]
    for model in models.values():
        model.attrs["consent_scope"] = ["fit"]
    with pytest.raises(InputError, match="consent to them"):
        translucency_table(models)


def test_members__traits_and_what_they_are_compared_with():
    models = _population()
    assert trait_names(models) == ["female", "lotion", "male", "older"]
    np.testing.assert_array_equal(has_trait(models, "lotion"), [False, True, False, False])
    np.testing.assert_array_equal(comparable(models, "lotion"), [True, True, False, False])  # within the subject
    np.testing.assert_array_equal(comparable(models, "male"), [True, False, True, True])  # lotion would mix in
    np.testing.assert_array_equal(comparable(models, "female"), [True, False, True, True])  # A counts once


def test_members__silent_takes_are_on_neither_side():
    models = _population()
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
    models = _population()
    models |= {f"A.{c}": _model(1, subject="A", condition=c, traits={"age": 20}) for c in ("cold", "hot")}
    assert [t for t, old in zip(models, has_trait(models, "older"), strict=True) if old] == ["B"]


def test_groups_by__attributes_traits_and_typing_errors():
    models = _population()
    assert groups_by(models, None) == dict.fromkeys(models, "all")
    assert groups_by(models, "condition")["A.lotion"] == "lotion"
    assert groups_by(models, "male") == {"A": "not male", "A.lotion": "not male", "B": "male", "C": "male"}
    del models["C"].attrs["traits"]["gender"]
    assert groups_by(models, "gender")["C"] == groups_by(models, "male")["C"] == "unknown"
    with pytest.raises(InputError, match=r"(?s)gendre.*attributes: age, condition, gender"):
        translucency_table(models, group_by="gendre")


def test_albedo_table__numbers_by_hand():
    models = _population()
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
    models = {"A.lotion": _population()["A.lotion"]}
    albedo = albedo_histograms(models)
    with pytest.raises(InputError, match=r"condition normal; found only A\.lotion; group by condition"):
        albedo_table(models, albedo=albedo)
    table = albedo_table(models, albedo=albedo, group_by="condition")
    assert list(map(str, table["group"].values)) == ["lotion"]
    assert translucency_table(models)["sigma_tr_count"].sum() == 0


def test_albedo_histograms__absent_regions_are_unknown():
    models = _population()
    models["A"]["fitted"] = models["A"]["fitted"].to_dataset().drop_vars(["region_mask", "region"])
    albedo = albedo_histograms(models)
    assert np.isnan(albedo["albedo_histogram"].sel(take="A", region="beard")).all()
    table = albedo_table(models, albedo=albedo)
    np.testing.assert_array_equal(table["group_albedo_count"].sel(region="beard"), [[2, 2, 2]])


def test_population_basis__spans_the_planted_one():
    models = _population()
    basis = population_basis(models, tables=TABLES, k=3, rng=np.random.default_rng(0))
    assert basis.attrs["nmf_error"] < 0.01
    found = basis["population_weight"].values
    left = H - project(H, found, np.eye(8)) @ found
    assert np.linalg.norm(left) / np.linalg.norm(H) < 0.15  # NMF of a planted cone is unique up to its noise


def test_population_basis__one_dictionary():
    models = _population()
    models["B"]["fitted"] = models["B"]["fitted"].to_dataset().assign_coords(basis=[f"x{i}" for i in range(8)])
    with pytest.raises(InputError, match="one dictionary"):
        population_basis(models, tables=TABLES, k=2, rng=np.random.default_rng(0))


def test_albedo_histograms__shares_and_decorrelation():
    histograms = albedo_histograms(_population())
    np.testing.assert_allclose(histograms["albedo_histogram"].sum("bin"), 1.0)
    flat, weights = [], []
    for take, model in _population().items():
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
    models = _population()
    models["B"]["fitted/fit_status"][:] = 1
    with pytest.raises(InputError, match=r"(?s)B.*fitted surfels.*none"):
        albedo_histograms(models)


def test_trait_vectors__planted_differences():
    basis, _, traits = _analysed(_population())
    lotion = traits.sel(trait="lotion")
    np.testing.assert_array_equal(lotion["trait_count"], [1, 1])
    change = lotion["trait_brdf_shift"].values @ basis["population_weight"].values
    want = 2.0 * np.mean(np.random.default_rng(1).gamma(4.0, 0.02, (N, 3))[1:, 0]) * H[0]  # same seed as take A
    np.testing.assert_allclose(change, want, atol=0.15 * np.linalg.norm(want))
    np.testing.assert_allclose(lotion["trait_histogram_shift"], 0.0, atol=1e-12)
    male = traits.sel(trait="male")["trait_log_sigma_tr_shift"].values
    np.testing.assert_allclose(male, np.log([1.2, 0.8]).mean(), atol=1e-6)


@pytest.mark.parametrize("trait", ["nobody", "normal"])
def test_trait_vectors__nobody_or_everybody(trait):
    models = {t: m for t, m in _population().items() if t != "A.lotion"}
    basis, albedo, _ = _analysed(models)
    with pytest.raises(InputError, match="with and takes without"):
        trait_vectors(models, basis=basis, albedo=albedo, traits=[trait])


def test_trait_vectors__sites_do_not_pass_for_traits():
    """Male takes were touched at the neck only: the other site's level must not enter."""
    models = _population()
    for take in ("B", "C"):
        models[take]["translucency"] = models[take]["translucency"].to_dataset().isel(site=[1])
    shift = _analysed(models)[2].sel(trait="male")["trait_log_sigma_tr_shift"]
    np.testing.assert_allclose(shift, np.log([1.2, 0.8]).mean(), atol=1e-6)


def test_trait_vectors__takes_go_by_name():
    """Basis and albedo of more takes, in another order, give the same differences."""
    models = _population()
    basis, albedo, traits = _analysed(models)
    turned = {take: models[take] for take in ("C", "A", "B")}
    order = ["C", "A.lotion", "B", "A"]
    again = trait_vectors(turned, basis=basis.sel(take=order), albedo=albedo.sel(take=order), traits=["male"])
    for name in ("trait_brdf_shift", "trait_histogram_shift", "trait_quantile_shift", "trait_log_sigma_tr_shift"):
        np.testing.assert_allclose(again[name].sel(trait="male"), traits[name].sel(trait="male"), atol=1e-12)


def test_trait_vectors__single_takes_are_flagged():
    traits = _analysed(_population())[2]
    assert "lotion: one take with it, not a mean" in traits.attrs["flags"]
    assert not any(flag.startswith("male: one take with it") for flag in traits.attrs["flags"])
    assert plot_traits(traits).get_xlabel()


def test_trait_vectors__one_subject_has_none():
    models = {"A": _population()["A"]}
    basis, albedo, traits = _analysed(models)
    assert traits.sizes["trait"] == 0
    with pytest.raises(InputError, match="known: none"):
        apply_traits(models["A"], amounts={"male": 1.0}, traits=traits, basis=basis, albedo=albedo, tables=TABLES)


def test_apply_traits__moves_every_part():
    models = _population()
    basis, albedo, traits = _analysed(models)
    call = {"traits": traits, "basis": basis, "albedo": albedo, "tables": TABLES}
    same = apply_traits(models["B"], amounts={"lotion": 0.0}, **call)
    np.testing.assert_allclose(
        same["fitted/diffuse_reflectance"][1:], models["B"]["fitted/diffuse_reflectance"][1:], atol=2e-3
    )  # one bin of the histogram
    edited = apply_traits(models["B"], amounts={"lotion": 1.0, "male": -1.0}, **call)
    assert (edited["fitted/reduced_weight"].values[1:] >= 0).all()
    assert edited["fitted/reduced_weight"].sum() > same["fitted/reduced_weight"].sum()
    assert edited["fitted/diffuse_reflectance"].mean() > 1.2 * same["fitted/diffuse_reflectance"].mean()
    assert not np.allclose(edited["fitted/effective_transport"], same["fitted/effective_transport"])
    s, rd = (edited[f"fitted/{n}"].values[1:] for n in ("dipole_s", "diffuse_reflectance"))
    np.testing.assert_allclose(diffuse_reflectance(s, eta=1.3), rd, rtol=1e-5)
    assert edited.attrs["edit"] == {"lotion": 1.0, "male": -1.0}
    assert edited.attrs["edit_distance"] > 0
    assert models["B"].attrs.get("edit") is None
    with pytest.raises(InputError, match="unknown one; known: female"):
        apply_traits(models["B"], amounts={"lotoin": 1.0}, **call)
    with pytest.raises(InputError, match="finite number"):
        apply_traits(models["B"], amounts={"lotion": np.inf}, **call)


def test_apply_traits__reports_what_was_asked_and_done():
    models = _population()
    basis, albedo, traits = _analysed(models)
    call = {"traits": traits, "basis": basis, "albedo": albedo, "tables": TABLES}
    tree = apply_traits(models["B"], amounts={"lotion": 0.5}, **call)
    report = json.loads(json.dumps(tree.attrs["edit_report"]))  # it is stored as JSON
    shift = 0.5 * traits["trait_brdf_shift"].sel(trait="lotion").values
    np.testing.assert_allclose(report["brdf"]["requested"], shift)
    area, good = models["B"]["fitted/surfel_area"].values[1:], slice(1, None)
    still = apply_traits(models["B"], amounts={}, **call)
    change = tree["fitted/reduced_weight"].values[good] - still["fitted/reduced_weight"].values[good]
    np.testing.assert_allclose(report["brdf"]["applied"], np.average(change, axis=0, weights=area), atol=1e-6)
    mine = np.average(still["fitted/reduced_weight"].values[good], axis=0, weights=area)
    assert report["albedo"]["clipped"] == report["translucency"]["clipped"] == 0
    assert report["albedo"]["projected"] == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(report["translucency"]["requested"], 1.0)  # A and A.lotion were touched alike
    for part in still.attrs["edit_report"].values():
        np.testing.assert_allclose(part["requested"], part["applied"], atol=1e-4)
    # standard deviations over takes, in the metric of the basis
    gram = basis["population_weight"].values @ brdf_metric(TABLES) @ basis["population_weight"].values.T
    root, takes = np.linalg.cholesky(gram), basis["take_coefficient"].values
    spread = np.sqrt((takes @ root).var(axis=0, ddof=1).sum())
    want = np.linalg.norm((mine - takes.mean(axis=0)) @ root) / spread
    assert still.attrs["edit_report"]["brdf"]["distance"] == pytest.approx(want, rel=1e-4)
    assert still.attrs["edit_distance"] == pytest.approx(0.0, abs=1e-3)


def test_apply_traits__drops_what_an_edit_makes_untrue():
    models = _population()
    basis, albedo, traits = _analysed(models)
    model = models["B"]
    fitted = model["fitted"].to_dataset()
    wrong = {name: ("surfel", np.full(N, 0.1)) for name in ("fit_residual", "held_out_error", "kkt_residual")}
    model["fitted"] = fitted.assign(wrong | {"diffuse_reflectance_error": fitted["diffuse_reflectance"]})
    model["basis"].attrs |= {"nmf_error": 0.1, "dictionary": "embedded"}
    model["probe"] = dataset({"fibre_distance": [1.0, 2.0]})
    model.attrs |= {"fit_residual": {"median": 0.1}, "k": 2, "software_version": "0.0.1", "take": "B"}
    call = {"amounts": {"lotion": 1.0}, "traits": traits, "basis": basis, "albedo": albedo, "tables": TABLES}
    edited = apply_traits(model, **call)
    assert set(edited["fitted"].data_vars) == set(fitted.data_vars) - {"basis_weight"}
    assert edited["basis"].attrs == {"dictionary": "embedded", "disc_angular_radius": 0.0}
    assert set(edited.children) == {"fitted", "basis"}
    assert set(edited.attrs) == {
        "subject", "condition", "traits", "consent_scope", "take", "eta", "edit", "edit_distance", "edit_report"
    }  # fmt: skip
    assert set(model.children) == {"fitted", "basis", "translucency", "probe"}
    assert set(apply_traits(model, **call, parts=("albedo",)).children) == set(model.children)


def test_apply_traits__mean_albedo_moves_by_the_mean_difference():
    models = _population()
    basis, albedo, traits = _analysed(models)
    call = {"traits": traits, "basis": basis, "albedo": albedo, "tables": TABLES, "parts": ("albedo",)}
    mean = albedo["albedo_mean"].sel(region="face")
    want = mean.sel(take=["B", "C"]).mean("take").values - mean.sel(take="A").values
    report = apply_traits(models["A"], amounts={"male": 1.0}, **call).attrs["edit_report"]["albedo"]
    np.testing.assert_allclose(report["requested"], want, atol=2e-3)  # a tenth of a bin's width in reflectance
    np.testing.assert_allclose(report["applied"], want, atol=2e-3)
    same = apply_traits(models["A"], amounts={"male": 0.0}, **call)
    np.testing.assert_allclose(same["fitted/diffuse_reflectance"], models["A"]["fitted/diffuse_reflectance"], rtol=1e-6)


@pytest.mark.parametrize("amount", [30.0, -30.0, 1e6])
def test_apply_traits__a_wild_edit_stays_physical_and_says_so(amount):
    models = _population()
    basis, albedo, traits = _analysed(models)
    tree = apply_traits(
        models["A"], amounts={"male": amount, "lotion": -1.0}, traits=traits, basis=basis, albedo=albedo, tables=TABLES
    )
    weight, colour, transport, s = (
        tree[f"fitted/{name}"].values[1:]
        for name in ("reduced_weight", "diffuse_reflectance", "effective_transport", "dipole_s")
    )
    assert np.isfinite(weight).all()
    assert (weight >= 0).all()
    assert ((colour > 0) & (colour < 1)).all()
    assert (np.isfinite(transport) & (transport > 0)).all()
    assert (np.isfinite(s) & (s > 0)).all()
    report = tree.attrs["edit_report"]
    assert report["brdf"]["clipped"] > 0.2
    assert report["albedo"]["projected"] > 0.1
    assert report["albedo"]["clipped"] > 0.5
    assert report["translucency"]["clipped"] == (amount == 1e6)
    assert report["brdf"]["distance"] > 0.5
    assert tree.attrs["edit_distance"] > 1


def test_apply_traits__what_cannot_be_known_is_named():
    models = {t: m for t, m in _population().items() if t.startswith("A")}
    models["A.lotion"]["translucency/site_status"][:] = 1
    basis, albedo, traits = _analysed(models)
    assert np.isnan(traits["take_log_sigma_tr"].sel(take="A.lotion")).all()
    np.testing.assert_allclose(
        traits["take_log_sigma_tr"].sel(take="A"),
        np.log([[0.5, 1, 1.5], [0.6, 1.1, 1.6]]).mean(axis=0),
        atol=1e-6,  # stored in single precision
    )
    call = {"basis": basis, "albedo": albedo, "tables": TABLES, "amounts": {"lotion": 1.0}}
    report = apply_traits(models["A"], traits=traits, **call).attrs["edit_report"]
    assert {part["distance"] for part in report.values()} == {"one subject: unknown"}
    assert report["translucency"]["unknown"] == ["lotion"]
    assert report["translucency"]["applied"] == pytest.approx([1, 1, 1])
    with pytest.raises(InputError, match="run skindb analyze DB traits again"):  # a study of an older version
        apply_traits(models["A"], traits=traits.drop_vars("take_log_sigma_tr"), **call)


def test_valid_quantiles__are_the_nearest_monotone_ones():
    """Against a general solver on the same problem."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        wanted = np.sort(rng.normal(size=7)) + rng.normal(0, 0.5, 7)
        found = valid_quantiles(wanted[None])[0]
        assert (np.diff(found) >= 0).all()
        assert found.mean() == pytest.approx(wanted.mean())
        best = minimize(
            lambda q, wanted=wanted: ((q - wanted) ** 2).sum(), np.sort(wanted), method="SLSQP",
            constraints={"type": "ineq", "fun": np.diff},
        )  # fmt: skip
        assert ((found - wanted) ** 2).sum() <= best.fun + 1e-6  # the solver's own tolerance


def test_quantiles__are_those_of_the_values():
    rng = np.random.default_rng(0)
    x = np.sort(rng.gamma(3.0, 1.0, (2, 50_000)), axis=1)
    edges = np.linspace(-1, 20, 257) * np.ones((2, 1))
    shares = np.stack([np.histogram(v, edges[0])[0] / x.shape[1] for v in x])
    found, want = quantiles(shares, edges), np.quantile(x, levels(), axis=1).T
    middle = slice(5, -5)
    np.testing.assert_allclose(found[:, middle], want[:, middle], atol=21 / 256)  # a bin
    assert np.isnan(quantiles(np.full((2, 256), np.nan), edges)).all()


def test_carry__moves_the_mean_and_keeps_the_order():
    rng = np.random.default_rng(0)
    edges, x = np.linspace(-6, 6, 257), rng.normal(size=5000)
    shares = np.histogram(x, edges)[0] / 5000
    shift = 0.5 + 0.3 * levels()
    got = carry(x, shares, shift, edges)
    assert (got - x).mean() == pytest.approx(shift.mean(), abs=2e-3)
    assert (np.diff(got[np.argsort(x)]) > 0).all()
    np.testing.assert_array_equal(carry(x, shares, np.zeros(256), edges), x)


def test_brdf_metric__is_the_integral_over_directions():
    """Monte Carlo over uniform pairs of directions, values by lookup."""
    rng = np.random.default_rng(0)
    wi, wo = (_unit(rng.normal(size=(300_000, 3))) * [1, 1, 1] for _ in range(2))
    wi[:, 2], wo[:, 2] = abs(wi[:, 2]), abs(wo[:, 2])
    smooth = TABLES[..., np.argsort(TABLES.max(axis=(0, 1, 2)))[:3]]  # narrow lobes need more samples
    b = lookup(smooth, *half_difference(wi, wo))
    weight = wi[:, 2] * wo[:, 2] / np.maximum(b.mean(axis=1), 1e-6) ** (4 / 3)
    want = b.T @ (b * weight[:, None])
    found = brdf_metric(smooth)
    np.testing.assert_allclose(found / np.trace(found), want / np.trace(want), rtol=0.03)
    assert np.linalg.eigvalsh(brdf_metric(TABLES)).min() > 0


def _capture(model: xr.DataTree, noise: float) -> xr.DataTree:
    """Samples that the model's own basis weights predict, with noise."""
    rng = np.random.default_rng(9)
    lights, cameras = (_unit(rng.normal(size=(n, 3)) * [1, 1, 0.3] + [0, 0, 1]) * 900 for n in (20, 3))
    node = model["fitted"].to_dataset()
    position, normal = node["surfel_position"].values.astype(float), node["shading_normal"].values.astype(float)
    to_light, to_camera = (_unit(p[None] - position[:, None]) for p in (lights, cameras))
    rows, offsets, index = basis_rows(TABLES, GRID, normal, to_light, to_camera, np.ones((N, 20, 3), bool))
    surfel = np.repeat(np.arange(N), np.diff(offsets))
    cos = [np.einsum("nc,nc->n", normal[surfel], d[surfel, index[:, i]]) for i, d in enumerate((to_light, to_camera))]
    matte = cos[0] * fresnel_transmittance(cos[0], 1.3) * fresnel_transmittance(cos[1], 1.3) / np.pi
    value = (rows * node["basis_weight"].values[surfel]).sum(1)[:, None] + matte[:, None] * node[
        "diffuse_reflectance"
    ].values[surfel]
    sample = np.full((N, 20, 3, 3), np.nan)
    sample[surfel, index[:, 0], index[:, 1]] = value * (1 + noise * rng.normal(size=value.shape))
    return xr.DataTree.from_dict({
        "samples": dataset({"reflectance_sample": sample}),
        "dome": dataset({"light_position": lights, "camera_position": cameras}),
    })  # fmt: skip


def test_basis_size_curve__finds_the_planted_size():
    models = {t: m for t, m in _population().items() if t in ("A", "B")}
    captures = {t: _capture(m, 0.003) for t, m in models.items()}
    curve = basis_size_curve(
        captures, models, tables=TABLES, ks=(1, 2, 3, 4, 5, 6), per_take=40, rng=np.random.default_rng(0)
    )
    assert curve.attrs["chosen_k"] == 3
    assert float(curve["relative_error"].sel(k=1)) > 1.2
    assert (curve["relative_error_low"] <= curve["relative_error"] + 1e-9).all()
    assert curve.attrs["surfels"] == 80
    assert plot_basis_size(curve).get_xlabel()


def _benchmark():
    path = Path(__file__).parents[2] / "benchmarks" / "basis_size.py"
    spec = importlib.util.spec_from_file_location("benchmark_of_basis_size", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_basis_size_curve__streams_what_it_does_not_factor(monkeypatch):
    """Bases from 40 of 80 surfels, in blocks of 7: the curve of all of them, its plateau where it was."""
    models = {t: m for t, m in _population().items() if t in ("A", "B")}
    captures = {t: _capture(m, 0.003) for t, m in models.items()}
    call = {"tables": TABLES, "ks": (1, 2, 3, 4, 5, 99), "per_take": 40}
    whole = basis_size_curve(captures, models, rng=np.random.default_rng(0), **call)
    monkeypatch.setattr(basis_size, "FACTORED", 40)
    monkeypatch.setattr(basis_size, "BLOCK", 7)
    part = basis_size_curve(captures, models, rng=np.random.default_rng(0), **call)
    assert list(part["k"].values) == [1, 2, 3, 4, 5]  # 8 bases hold no 99
    assert part.attrs["surfels"] == whole.attrs["surfels"] == 80
    assert part.attrs["full_basis_error"] == pytest.approx(whole.attrs["full_basis_error"], rel=1e-6)
    assert whole.attrs["chosen_k"] == 3
    np.testing.assert_allclose(part["relative_error"], whole["relative_error"], rtol=0.1)


@pytest.mark.parametrize(("size", "noise", "seed"), [(4, 0.01, 1), (4, 0.03, 2), (6, 0.01, 1)])
def test_choose_size__finds_planted_sizes_and_refuses_below_them(size, noise, seed):
    """Problems whose bases all matter; the benchmark has more of them, and those that cannot be told."""
    benchmark = _benchmark()
    systems, needed = benchmark.planted(size, noise, seed, surfels=150, lights=30)
    assert needed > 1.05
    found, error = benchmark.found_size(systems, largest=size + 2)
    assert found in (size, size + 1)  # the search stops short of the minimum: rounding decides at the rule's 1 %
    assert error[size - 1] < 1.02
    assert benchmark.found_size(systems, largest=size - 1)[0] == 0  # every basis does better than the sizes tried


def test_choose_size__by_hand():
    """Every surfel the same: the interval is a point and the rule is arithmetic."""

    def size(*rms, tolerance=0.01):
        errors = np.ones((20, 3, len(rms)))
        errors[:, 0] = np.square(rms)
        ks = range(1, len(rms))
        return choose_size(errors, ks, tolerance=tolerance, rng=np.random.default_rng(0))[3]

    assert size(3.0, 1.5, 1.009, 1.008, 1.0) == 3
    assert size(3.0, 1.5, 1.019, 1.008, 1.0) == 0  # only the largest
    assert size(3.0, 1.5, 1.019, 1.008, 1.0, tolerance=0.02) == 3
    assert size(3.0, 1.5, 1.5, 1.5, 1.0) == 0  # level, but far above every basis
    assert size(1.0, 1.0) == 0  # one size is no curve


def test_choose_size__an_uncertain_error_is_not_on_the_plateau():
    """One surfel in fifty carries what the second size lacks: drawn twice it is above the tolerance."""
    errors = np.ones((50, 3, 4))
    errors[:, 0, 0] = 4.0
    errors[0, 0, 1] += 0.7
    error, low, high, size = choose_size(errors, (1, 2, 3), tolerance=0.01, rng=np.random.default_rng(0))
    assert error[1] < 1.01 < high[1]
    assert low[1] == 1.0
    assert size == 0


def _lazy_take(seed: int, n: int) -> xr.DataTree:
    """A fitted take whose blocks are made when they are asked for and forgotten after."""

    def lazy(width, make):
        shape = (n, width) if width else (n,)

        def block(block_info=None):
            (start, stop), *_ = block_info[None]["array-location"]
            return make(np.random.default_rng([seed, start]), (stop - start, *shape[1:])).astype(np.float32)

        chunks = ((5000,) * (n // 5000), *((w,) for w in shape[1:]))
        return dask.array.map_blocks(block, chunks=chunks, dtype=np.float32)

    fitted = xr.Dataset(
        {
            "basis_weight": (("surfel", "basis"), lazy(8, lambda rng, shape: rng.gamma(0.3, 0.02, shape))),
            "diffuse_reflectance": (("surfel", "channel"), lazy(3, lambda rng, shape: rng.uniform(0.2, 0.6, shape))),
            "surfel_area": (("surfel",), lazy(0, lambda rng, shape: rng.uniform(0.5, 1.5, shape))),
            "fit_status": (("surfel",), lazy(0, lambda rng, shape: np.zeros(shape))),
        },
        coords={"basis": NAMES},
    )
    tree = xr.DataTree.from_dict({"fitted": fitted})
    tree.attrs = {"consent_scope": ["statistics"], "subject": f"S{seed}", "traits": {"age": 20 + seed}}
    return tree


def test_studies__memory_does_not_grow_with_the_population():
    """Six takes in the memory of two: one take is held at a time, and a sample of each."""

    def peak(takes):
        models = {f"S{i}": _lazy_take(i, 40_000) for i in range(takes)}
        tracemalloc.start()
        with dask.config.set(scheduler="synchronous"):
            basis = population_basis(models, tables=TABLES, k=2, per_take=20, rng=np.random.default_rng(0))
            albedo = albedo_histograms(models)
            trait_vectors(models, basis=basis, albedo=albedo)
        top = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return top

    peak(2)  # imports and compiled code
    assert peak(6) < 1.15 * peak(2)  # a take held would be 1 to 3 MB of some 8


def test_study__commits_reads_back_and_tabulates(tmp_path):
    """Through the store, where labels come back as variable-length text."""
    db = Database(tmp_path)
    for take, model in _population().items():
        with db.stage("model", take) as stage:
            stage.write({str(name): node.to_dataset() for name, node in model.children.items()})
            stage.commit(model.attrs)
    record, tree = analyze(db, "translucency")
    header, rows = tabulate_study(tree)
    assert record.provenance["command"] == "analyze"
    assert header[:3] == ["group", "site", "channel"]
    assert rows[0][:3] == ["all", "cheek", "R"]
    assert len(rows) == 6
    assert rows[0][3] == 3
    header, rows = tabulate_study(analyze(db, "albedo")[1])
    assert len(rows) == 4 * 2 * 3
    plot_study(tree, tmp_path / "t.png")
    assert (tmp_path / "t.png").stat().st_size > 1000
    with pytest.raises(InputError, match="must be one of"):
        analyze(db, "weather")
    with pytest.raises(InputError, match="an edit needs trait vectors"):
        edit_take(db, "A", {"lotion": 1.0})


def test_edit_take__is_stored_with_its_report(tmp_path, monkeypatch):
    monkeypatch.setattr(study, "dictionary_tables", lambda *_: TABLES)  # 8 of the 59
    db = Database(tmp_path)
    for take, model in _population().items():
        with db.stage("model", take) as stage:
            stage.write({str(name): node.to_dataset() for name, node in model.children.items()})
            stage.commit(model.attrs)
    analyze(db, "traits", k=3)
    record, tree = edit_take(db, "B", {"lotion": 0.5})
    report = tree.attrs["edit_report"]
    assert set(report) == {"brdf", "albedo", "translucency"}
    assert all({"requested", "applied", "clipped", "distance"} <= set(part) for part in report.values())
    assert record.provenance["edit_report"] == report
    assert record.provenance["parameters"] == {"amounts": {"lotion": 0.5}}
    assert [source["take"] for source in record.provenance["inputs"]] == ["B", "traits"]
    assert np.isfinite(tree["fitted/reduced_weight"].values[1:]).all()
