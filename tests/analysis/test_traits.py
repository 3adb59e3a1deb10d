"""Trait vectors of planted populations, and edits by them."""

from __future__ import annotations

import json

import numpy as np
import pytest
import xarray as xr
from planted_population import TABLES, H, N, analysed, model_of, population, tables
from scipy.optimize import minimize

from skindb.analysis import (
    apply_traits,
    plot_traits,
    trait_vectors,
)
from skindb.analysis.albedo import quantiles
from skindb.analysis.edit import shift_quantiles, valid_quantiles, with_basis
from skindb.errors import InputError
from skindb.fit.translucency import translucency_map
from skindb.numerics.texture import quantile_levels
from skindb.optics.diffusion import diffuse_reflectance
from skindb.reflectance.tables import stored_brdf
from skindb.schema import dataset


def test_trait_vectors__planted_differences():
    basis, _, traits = analysed(population())
    lotion = traits.sel(trait="condition:lotion")
    np.testing.assert_array_equal(lotion["trait_count"], [1, 1])
    change = lotion["trait_brdf_shift"].values @ basis["population_mixture"].values
    # same seed as take A
    want = (
        2.0 * np.mean(np.random.default_rng(1).gamma(4.0, 0.02, (N, 3))[1:, 0]) * H[0]
    )
    np.testing.assert_allclose(change, want, atol=0.15 * np.linalg.norm(want))
    male = traits.sel(trait="gender:male")["trait_log_sigma_tr_shift"].values
    np.testing.assert_allclose(male, np.log([1.2, 0.8]).mean(), atol=1e-6)


def test_trait_vectors__sites_do_not_pass_for_traits():
    """Male takes were measured at the neck only; the level of the other site must not matter."""
    models = population()
    for take in ("B", "C"):
        models[take]["translucency"] = (
            models[take]["translucency"].to_dataset().isel(site=[1])
        )
    shift = analysed(models)[2].sel(trait="gender:male")["trait_log_sigma_tr_shift"]
    np.testing.assert_allclose(shift, np.log([1.2, 0.8]).mean(), atol=1e-6)


def test_trait_vectors__a_value_of_one_side_alone_is_no_difference():
    """Lotion has no effect, one of two subjects was not measured with it, and subjects differ."""
    models = {
        "A": model_of(1, subject="A"),
        "A.lotion": model_of(1, subject="A", condition="lotion"),
        "B": model_of(2, tr=3.0, subject="B"),
        "B.lotion": model_of(2, tr=3.0, subject="B", condition="lotion"),
    }
    models["A.lotion"]["translucency/site_status"][:] = 1
    shift = analysed(models)[2].sel(trait="condition:lotion")[
        "trait_log_sigma_tr_shift"
    ]
    np.testing.assert_allclose(shift, 0, atol=1e-6)


def test_trait_vectors__takes_go_by_name():
    """Studies of more takes in another order give the same differences, because takes
    are found by name.
    """
    models = population()
    basis, albedo, traits = analysed(models)
    turned = {take: models[take] for take in ("C", "A", "B")}
    order = ["C", "A.lotion", "B", "A"]
    again = trait_vectors(
        tables(turned),
        basis=basis.sel(take=order),
        albedo=albedo.sel(take=order),
    )
    for name in (
        "trait_brdf_shift",
        "trait_quantile_shift",
        "trait_log_sigma_tr_shift",
    ):
        np.testing.assert_allclose(
            again[name].sel(trait="gender:male"),
            traits[name].sel(trait="gender:male"),
            atol=1e-12,
        )


def test_trait_vectors__single_takes_are_flagged():
    traits = analysed(population())[2]
    assert (
        "condition:lotion: only one subject with it, so that the vector contains an individual"
        in traits.attrs["flags"]
    )
    assert not any(
        flag.startswith("gender:male: one take with it")
        for flag in traits.attrs["flags"]
    )
    assert plot_traits(traits).get_xlabel()


def test_trait_vectors__one_subject_has_none():
    models = {"A": population()["A"]}
    basis, albedo, traits = analysed(models)
    assert traits.sizes["trait"] == 0
    with pytest.raises(InputError, match="choose from: none"):
        apply_traits(
            models["A"],
            amounts={"male": 1.0},
            traits=traits,
            basis=basis,
            albedo=albedo,
            tables=TABLES,
        )


def test_apply_traits__moves_every_part():
    models = population()
    basis, albedo, traits = analysed(models)
    call = {"traits": traits, "basis": basis, "albedo": albedo, "tables": TABLES}
    same = apply_traits(models["B"], amounts={"lotion": 0.0}, **call)
    np.testing.assert_allclose(
        same["fitted/diffuse_reflectance"][1:],
        models["B"]["fitted/diffuse_reflectance"][1:],
        atol=2e-3,
    )  # one bin of the histogram
    edited = apply_traits(models["B"], amounts={"lotion": 1.0, "male": -1.0}, **call)
    assert (edited["fitted/basis_weight"].values[1:] >= 0).all()
    assert edited["fitted/basis_weight"].sum() > same["fitted/basis_weight"].sum()
    assert (
        edited["fitted/diffuse_reflectance"].mean()
        > 1.2 * same["fitted/diffuse_reflectance"].mean()
    )
    assert not np.allclose(edited["fitted/sigma_tr"], same["fitted/sigma_tr"])
    s, rd = (
        edited[f"fitted/{n}"].values[1:] for n in ("dipole_s", "diffuse_reflectance")
    )
    np.testing.assert_allclose(diffuse_reflectance(s, eta=1.3), rd, rtol=1e-5)
    assert edited.attrs["edit"] == {"lotion": 1.0, "male": -1.0}
    assert edited.attrs["edit_distance"] > 0
    assert models["B"].attrs.get("edit") is None
    with pytest.raises(InputError, match="an unknown name; choose from: age:older"):
        apply_traits(models["B"], amounts={"lotoin": 1.0}, **call)
    with pytest.raises(InputError, match="must be a number from -100 to 100"):
        apply_traits(models["B"], amounts={"lotion": 1e9}, **call)
    with pytest.raises(InputError, match="must be a number from"):
        apply_traits(models["B"], amounts={"lotion": np.inf}, **call)


def test_apply_traits__reports_what_was_asked_and_done():
    models = population()
    basis, albedo, traits = analysed(models)
    call = {"traits": traits, "basis": basis, "albedo": albedo, "tables": TABLES}
    tree = apply_traits(models["B"], amounts={"lotion": 0.5}, **call)
    report = json.loads(json.dumps(tree.attrs["edit_report"]))  # it is stored as JSON
    shift = 0.5 * traits["trait_brdf_shift"].sel(trait="condition:lotion").values
    np.testing.assert_allclose(report["brdf"]["requested"], shift)
    area = models["B"]["fitted/surfel_area"].values[1:]
    good = slice(1, None)
    still = apply_traits(models["B"], amounts={}, **call)
    change = (
        tree["fitted/basis_weight"].values[good]
        - still["fitted/basis_weight"].values[good]
    )
    np.testing.assert_allclose(
        report["brdf"]["applied"], np.average(change, axis=0, weights=area), atol=1e-6
    )
    assert report["albedo"]["clipped"] == report["translucency"]["clipped"] == 0
    # A and A.lotion have the same sites
    np.testing.assert_allclose(report["translucency"]["requested"], 1.0)
    for part in still.attrs["edit_report"].values():
        np.testing.assert_allclose(part["requested"], part["applied"], atol=1e-4)
    assert still.attrs["edit_distance"] == pytest.approx(0.0, abs=1e-3)


def test_apply_traits__drops_what_an_edit_makes_untrue():
    models = population()
    basis, albedo, traits = analysed(models)
    model = models["B"]
    fitted = model["fitted"].to_dataset()
    wrong = {
        name: ("surfel", np.full(N, 0.1))
        for name in ("fit_residual", "held_out_error", "kkt_residual")
    }
    model["fitted"] = fitted.assign(
        wrong | {"diffuse_reflectance_error": fitted["diffuse_reflectance"]}
    )
    model["basis"].attrs |= {"nmf_error": 0.1, "dictionary": "embedded"}
    model["probe"] = dataset({"fibre_distance": [1.0, 2.0]})
    model.attrs |= {
        "fit_residual": {"median": 0.1},
        "k": 2,
        "software_version": "0.0.1",
        "take": "B",
    }
    call = {
        "amounts": {"lotion": 1.0},
        "traits": traits,
        "basis": basis,
        "albedo": albedo,
        "tables": TABLES,
    }
    edited = apply_traits(model, **call)
    assert set(edited["fitted"].data_vars) == set(fitted.data_vars) - {
        "dictionary_weight"
    }
    assert edited["basis"].attrs == {"dictionary": "embedded"}
    assert set(edited.children) == {"fitted", "basis", "translucency"}
    assert set(edited["translucency"].data_vars) == {"site_sigma_tr", "site_status"}
    assert set(edited.attrs) == {
        "subject",
        "condition",
        "traits",
        "consent_scope",
        "take",
        "edit",
        "edit_distance",
        "edit_report",
        "trait_notes",
    }
    assert set(model.children) == {"fitted", "basis", "translucency", "probe"}


def test_apply_traits__mean_albedo_moves_by_the_mean_difference():
    models = population()
    basis, albedo, traits = analysed(models)
    call = {
        "traits": traits,
        "basis": basis,
        "albedo": albedo,
        "tables": TABLES,
    }
    mean = albedo["albedo_mean"].sel(region="face")
    want = mean.sel(take=["B", "C"]).mean("take").values - mean.sel(take="A").values
    report = apply_traits(models["A"], amounts={"male": 1.0}, **call).attrs[
        "edit_report"
    ]["albedo"]
    # a tenth of a bin's width in reflectance
    np.testing.assert_allclose(report["requested"], want, atol=2e-3)
    np.testing.assert_allclose(report["applied"], want, atol=2e-3)
    same = apply_traits(models["A"], amounts={"male": 0.0}, **call)
    np.testing.assert_allclose(
        same["fitted/diffuse_reflectance"],
        models["A"]["fitted/diffuse_reflectance"],
        rtol=1e-6,
    )


@pytest.mark.slow
@pytest.mark.parametrize("amount", [30.0, -30.0, 100.0])
def test_apply_traits__an_extreme_edit_is_physical_and_reported(amount):
    models = population()
    basis, albedo, traits = analysed(models)
    tree = apply_traits(
        models["A"],
        amounts={"male": amount, "lotion": -1.0},
        traits=traits,
        basis=basis,
        albedo=albedo,
        tables=TABLES,
    )
    weight, colour, transport, s = (
        tree[f"fitted/{name}"].values[1:]
        for name in ("basis_weight", "diffuse_reflectance", "sigma_tr", "dipole_s")
    )
    assert np.isfinite(weight).all()
    assert (weight >= 0).all()
    assert ((colour > 0) & (colour < 1)).all()
    assert (np.isfinite(transport) & (transport > 0)).all()
    assert (np.isfinite(s) & (s > 0)).all()
    report = tree.attrs["edit_report"]
    # larger weights are physical, negative ones are not
    assert (report["brdf"]["clipped"] > 0.2) == (amount < 0)
    assert report["albedo"]["clipped"] > 0.5
    assert report["translucency"]["clipped"] == 0  # its shift is small
    assert tree.attrs["edit_distance"] > 1


def test_apply_traits__what_cannot_be_known_is_named():
    models = {t: m for t, m in population().items() if t.startswith("A")}
    models["A.lotion"]["translucency/site_status"][:] = 1
    basis, albedo, traits = analysed(models)
    assert np.isnan(traits["take_log_sigma_tr"].sel(take="A.lotion")).all()
    np.testing.assert_allclose(
        traits["take_log_sigma_tr"].sel(take="A"),
        np.log([[0.5, 1, 1.5], [0.6, 1.1, 1.6]]).mean(axis=0),
        atol=1e-6,  # stored in single precision
    )
    call = {
        "basis": basis,
        "albedo": albedo,
        "tables": TABLES,
        "amounts": {"lotion": 1.0},
    }
    report = apply_traits(models["A"], traits=traits, **call).attrs["edit_report"]
    assert report["translucency"]["unknown"] == ["condition:lotion"]
    assert report["translucency"]["applied"] == pytest.approx([1, 1, 1])
    # a study of an older version
    with pytest.raises(InputError, match="run skindb analyze DB traits again"):
        apply_traits(models["A"], traits=traits.drop_vars("take_log_sigma_tr"), **call)


def test_valid_quantiles__are_the_nearest_monotone_ones():
    """Compared with a general solver of the same problem."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        wanted = np.sort(rng.normal(size=7)) + rng.normal(0, 0.5, 7)
        found = valid_quantiles(wanted[None])[0]
        assert (np.diff(found) >= 0).all()
        assert found.mean() == pytest.approx(wanted.mean())
        best = minimize(
            lambda q, wanted=wanted: ((q - wanted) ** 2).sum(),
            np.sort(wanted),
            method="SLSQP",
            constraints={"type": "ineq", "fun": np.diff},
        )
        # the solver's own tolerance
        assert ((found - wanted) ** 2).sum() <= best.fun + 1e-6


def test_quantiles__are_those_of_the_values():
    rng = np.random.default_rng(0)
    x = np.sort(rng.gamma(3.0, 1.0, (2, 50_000)), axis=1)
    edges = np.linspace(-1, 20, 257) * np.ones((2, 1))
    shares = np.stack([np.histogram(v, edges[0])[0] / x.shape[1] for v in x])
    found = quantiles(shares, edges)
    want = np.quantile(x, quantile_levels(), axis=1).T
    middle = slice(5, -5)
    # a bin
    np.testing.assert_allclose(found[:, middle], want[:, middle], atol=21 / 256)
    assert np.isnan(quantiles(np.full((2, 256), np.nan), edges)).all()


def test_carry__moves_the_mean_and_keeps_the_order():
    rng = np.random.default_rng(0)
    edges = np.linspace(-6, 6, 257)
    x = rng.normal(size=5000)
    shares = np.histogram(x, edges)[0] / 5000
    shift = 0.5 + 0.3 * quantile_levels()
    got = shift_quantiles(x, shares, shift, edges)
    assert (got - x).mean() == pytest.approx(shift.mean(), abs=2e-3)
    assert (np.diff(got[np.argsort(x)]) > 0).all()
    np.testing.assert_array_equal(shift_quantiles(x, shares, np.zeros(256), edges), x)


def test_apply_traits__moves_the_probe_sites_like_the_map():
    """The map of the edited sites equals the edited map, since interpolation of
    1/sigma_tr is linear.
    """
    models = population()
    basis, albedo, traits = analysed(models)
    traits["trait_log_sigma_tr_shift"].values[:] = np.linspace(
        -0.4, 0.3, traits["trait_log_sigma_tr_shift"].size
    ).reshape(traits["trait_log_sigma_tr_shift"].shape)
    model = models["B"]
    place = dataset(
        {"site_position": [[30.0, 0, 60], [0, -40, 50]]},
        coords={"site": ["cheek", "neck"]},
    )
    fitted = model["fitted"].to_dataset()
    sites = model["translucency"].to_dataset().merge(place)
    model["translucency"] = xr.DataTree(sites)
    model["fitted"] = fitted.merge(
        translucency_map(fitted, sites), overwrite_vars="sigma_tr"
    )
    edited = apply_traits(
        model,
        amounts={"lotion": 1.0, "male": 0.5},
        traits=traits,
        basis=basis,
        albedo=albedo,
        tables=TABLES,
    )
    moved = edited["translucency"].to_dataset()
    assert not np.allclose(moved["site_sigma_tr"], sites["site_sigma_tr"], rtol=0.05)
    again = translucency_map(fitted, moved)["sigma_tr"]
    # both are stored in float32
    np.testing.assert_allclose(edited["fitted/sigma_tr"], again, rtol=1e-5)


def test_with_basis__the_whole_dictionary_is_the_model_itself():
    model = population()["A"]
    whole = with_basis(
        model, mixture=np.eye(8), names=[f"b{i}" for i in range(8)], tables=TABLES
    )
    own = model["fitted/dictionary_weight"].values
    np.testing.assert_allclose(
        whole["fitted/basis_weight"].values[1:], own[1:], atol=1e-5
    )  # stored in single precision
    brdf = whole["basis/basis_brdf"]
    np.testing.assert_allclose(brdf.values, stored_brdf(TABLES), rtol=1e-3)
    one = with_basis(
        model,
        mixture=np.ones((1, 8)) / 8,
        names=[f"b{i}" for i in range(8)],
        tables=TABLES,
    )
    assert one["fitted/basis_weight"].shape == (N, 1)
    assert (one["fitted/basis_weight"].values[1:] > 0).all()
