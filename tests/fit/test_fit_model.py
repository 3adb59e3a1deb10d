"""The fit of a capture: two passes over its samples, from a DataTree to a DataTree."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from planted_skin import SIGMA_A, SIGMA_S, capture_of
from threadpoolctl import threadpool_info, threadpool_limits

from skindb.errors import InputError
from skindb.fit import (
    FitParameters,
    estimate_diffuse_reflectance,
    estimate_normals,
    find_outliers,
    first_pass,
    fit_model,
    fit_surface,
    held_out_error,
    refine_jointly,
    refit,
    second_pass,
    summarise_translucency,
    tabulate_translucency,
)
from skindb.fit.energy import Energy, without_even_reflection
from skindb.fit.lumitexels import lumitexels as lumitexels_of
from skindb.fit.plan import fitted_part, hold_out, plan_fit
from skindb.fit.quality import HELD_OUT_ERRORS, error_of_misfit
from skindb.optics.diffusion import sigma_tr
from skindb.reflectance.block import gloss_of
from skindb.reflectance.mixture import Mixture
from skindb.render.scene import from_model
from skindb.schema import GROUPS, FitStatus, check, dataset, label

STAGES = {
    "dictionary",
    "choice of corrections",
    "first pass",
    "reduced basis",
    "second pass",
    "translucency",
}
HELD_OUT = FitParameters(
    k=3,
    rank=6,
    surface_energy="unknown",
    hold_out_lights=0.1,
    hold_out_cameras=0.1,
    seed=5,
)


@pytest.fixture(scope="module")
def planted(skin, small_dictionary, plant):
    lumitexels, _ = plant(
        skin, small_dictionary, np.random.default_rng(9), noise=0.005, scale=0.1
    )
    return capture_of(replace(skin, lumitexels=lumitexels), unseen=[4, 11])


@pytest.fixture(scope="module")
def blas_threads():
    """Numbers of threads of BLAS in the stages of `fitted`."""
    return set()


@pytest.fixture(scope="module")
def fitted(planted, small_dictionary, blas_threads):
    steps = []

    def progress(*step):
        steps.append(step)
        blas_threads.update(
            pool["num_threads"]
            for pool in threadpool_info()
            if pool["user_api"] == "blas"
        )

    with threadpool_limits(2):
        model = fit_model(
            planted, HELD_OUT, dictionary=small_dictionary, progress=progress
        )
    return model, steps


def test_fit_model__uses_one_thread_of_blas(fitted, blas_threads):
    """Two of them take 20 times as long for the reduced basis, and other results."""
    assert {stage for stage, *_ in fitted[1]} >= STAGES - {"translucency"}
    assert blas_threads == {1}


@pytest.mark.slow
def test_fit_model__returns_what_the_schema_declares(fitted, skin):
    model, _ = fitted
    groups = {
        "fitted",
        "basis",
        "mesh",
        "dome",
        "probe",
        "translucency",
        "outliers",
        "held_out",
    }
    assert set(model.children) == groups
    for group in ("fitted", "basis", "translucency", "outliers", "held_out"):
        names = [v.name for v in GROUPS[group] if not v.name.startswith("lobe_")]
        check(model[group].to_dataset(), names, where=group)
    assert model["fitted"].sizes["surfel"] == skin.lumitexels.sizes["surfel"]


def test_fit_model__recovers_truth(fitted, skin):
    model, _ = fitted
    found = model["fitted"].to_dataset().compute()
    seen = found["fit_status"].values == FitStatus.FITTED
    assert seen.sum() >= len(seen) - 3
    cosine = np.einsum("nk,nk->n", found["shading_normal"].values, skin.normal)[seen]
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 2.5
    error = np.abs(found["diffuse_reflectance"].values / skin.diffuse - 1)[seen]
    # the materials have diffuse parts, which cannot be separated
    assert np.median(error) < 0.15
    assert np.median(found["held_out_error"].values[seen]) < 0.02
    assert np.median(found["held_out_camera_error"].values[seen]) < 0.02
    true = sigma_tr(SIGMA_A, SIGMA_S)
    np.testing.assert_allclose(
        found["sigma_tr"].values, np.tile(true, (len(seen), 1)), rtol=1e-3
    )


def test_fit_model__unseen_surfels_have_a_status_and_nothing_else(fitted):
    found = fitted[0]["fitted"].to_dataset().compute()
    assert found["fit_status"].values[[4, 11]].tolist() == [FitStatus.UNSEEN] * 2
    for name in (
        "shading_normal",
        "diffuse_reflectance",
        "dictionary_weight",
        "basis_weight",
        "held_out_error",
        "held_out_camera_error",
    ):
        assert np.isnan(found[name].values[[4, 11]]).all()
    assert np.isfinite(found["surfel_position"].values).all()


def test_fit_model__report(fitted):
    model, steps = fitted
    attrs = model.attrs
    assert set(attrs["seconds"]) == STAGES
    assert abs(sum(attrs["status"].values()) - 1) < 1e-9
    assert attrs["status"]["unseen"] == 2 / attrs["surfels"]
    assert len(attrs["held_out_lights"]) == 6
    assert len(attrs["held_out_cameras"]) == 1
    assert attrs["suspects"] == []
    sites = model["translucency"].to_dataset()
    assert json.loads(json.dumps(attrs["translucency"])) == summarise_translucency(
        sites
    )
    assert tabulate_translucency(attrs) == tabulate_translucency(sites)
    assert any("2 of 40 are skipped" in line for line in attrs["skipped"])
    # a capture of 40 surfels supports no corrections
    neither = {"light_gains": False, "inter_reflection": False}
    assert attrs["parameters"] == HELD_OUT.as_dict() | neither
    assert attrs["corrections"].keys() == neither.keys()
    assert FitParameters.of(attrs) == replace(HELD_OUT, **neither)
    assert attrs["consent_scope"] == ["fit"]
    assert {stage for stage, done, total in steps if done == total} == STAGES
    assert all(0 <= done <= total for _, done, total in steps)


def test_fit_model__same_seed_same_model(fitted, planted, small_dictionary):
    again = fit_model(planted, HELD_OUT, dictionary=small_dictionary)
    for group in ("fitted", "basis", "translucency"):
        # rounding of BLAS depends on the alignment of arrays, so that the last digit of
        # float32 may differ
        xr.testing.assert_allclose(
            fitted[0][group].to_dataset(), again[group].to_dataset(), rtol=1e-6
        )


def test_fit_model__blocks_change_nothing(fitted, planted, small_dictionary):
    """Lazy samples in blocks of 7 surfels give the same as one block, within the
    rounding of single precision.
    """
    blocked = planted.copy()
    blocked["samples"] = xr.DataTree(planted["samples"].to_dataset().chunk(surfel=7))
    again = fit_model(blocked, HELD_OUT, dictionary=small_dictionary)
    for group in ("fitted", "basis", "outliers"):
        xr.testing.assert_allclose(
            fitted[0][group].to_dataset(), again[group].to_dataset(), rtol=1e-5
        )


def test_fit_model__is_its_two_passes(fitted, planted, small_dictionary):
    first = first_pass(planted, HELD_OUT, dictionary=small_dictionary)
    assert set(first.children) == {"fitted", "held_out"}
    model = second_pass(planted, first, dictionary=small_dictionary)
    xr.testing.assert_allclose(
        fitted[0]["fitted"].to_dataset(), model["fitted"].to_dataset(), rtol=1e-6
    )
    assert {**model.attrs, "seconds": 0} == {**fitted[0].attrs, "seconds": 0}


def test_fit_model__passes_are_their_separate_methods(
    fitted, planted, small_dictionary
):
    """Each method, called with the results of those before it, gives the same as the
    fused passes.
    """
    model, _ = fitted
    held_out = model["held_out"].to_dataset()
    found = model["fitted"].to_dataset()
    whole = lumitexels_of(planted)
    work = fitted_part(whole, held_out)
    alone = estimate_normals(work)
    alone = alone.merge(estimate_diffuse_reflectance(work.merge(alone)))
    alone = alone.assign(refine_jointly(work.merge(alone)))
    surface = Mixture.of_dictionary(_averaged(small_dictionary, whole), rank=6)
    alone = alone.merge(fit_surface(work.merge(alone), surface=surface))
    total = alone["diffuse_reflectance_total_error"]
    total[:] = np.hypot(total.values, error_of_misfit(alone))
    basis = model["basis"].to_dataset()
    alone = alone.merge(refit(work.merge(alone), basis=basis))
    gloss = gloss_of(surface.normal_reflectance(surface.parameters_of(alone)))
    alone = alone.assign(dataset(gloss))
    known = alone[["shading_normal", "diffuse_reflectance", "basis_weight"]]
    alone = alone.merge(find_outliers(work.merge(known), basis=basis))
    for dim in ("light", "camera"):
        index = {dim: np.flatnonzero(held_out[f"{dim}_held_out"].values)}
        other = "camera" if dim == "light" else "light"
        index[other] = np.flatnonzero(held_out[f"{other}_held_out"].values == 0)
        samples = whole.isel(index)
        alone = alone.merge(held_out_error(samples.merge(known), basis=basis, of=dim))
    shared = found[["surfel_area", "refractive_index"]]
    alone, _ = without_even_reflection(alone.merge(shared), None)
    names = [name for name in found.data_vars if name in alone]
    assert {
        *HELD_OUT_ERRORS["light"],
        *HELD_OUT_ERRORS["camera"],
        "fit_residual",
        "outlier_fraction",
        "basis_weight",
    } <= set(names)
    for name in names:
        np.testing.assert_allclose(
            found[name].values,
            alone[name].values,
            rtol=2e-4,
            atol=2e-6,
            err_msg=str(name),
        )
    for name in model["outliers"].data_vars:
        np.testing.assert_allclose(
            model["outliers"][name].values,
            alone[name].values,
            rtol=1e-6,
            err_msg=str(name),
        )


def test_without_even_reflection__changes_no_prediction_and_no_picture(fitted, planted):
    """The even part leaves R_d, and predictions and pictures add it."""
    model = fitted[0]
    plain = model["fitted"].to_dataset()
    seen = plain["surface_reflectance"].values[plain["fit_status"] == FitStatus.FITTED]
    prior = Energy(float(seen.mean()) + 0.05, 1e-3)
    moved, _ = without_even_reflection(plain, prior)
    assert moved["even_reflection"] > 0.02
    basis = model["basis"].to_dataset()
    samples = lumitexels_of(planted)
    errors = [
        held_out_error(samples.merge(surfels), basis=basis)["held_out_error"]
        for surfels in (plain, moved)
    ]
    np.testing.assert_allclose(*errors, rtol=1e-5)
    other = model.copy()
    other["fitted"] = xr.DataTree(moved)
    pictures = [from_model(tree).diffuse for tree in (model, other)]
    np.testing.assert_allclose(*pictures, rtol=1e-6)


def test_fit_model__gloss_does_not_depend_on_the_size_of_the_basis(
    fitted, planted, small_dictionary
):
    """One mixture has too much gloss for some surfels and too little for others."""
    one = fit_model(planted, replace(HELD_OUT, k=1), dictionary=small_dictionary)
    for name in ("surface_reflectance", "glossiness"):
        values, of_three = (tree["fitted"][name].values for tree in (one, fitted[0]))
        np.testing.assert_allclose(values, of_three, rtol=1e-6)
        assert np.nanstd(values) > 0.01 * np.nanmean(values)


def _fit_with(capture, dictionary, group, **scalars):
    """The fitted model of a capture with other scalars in a group."""
    changed = capture.copy()
    labelled = {name: label(name, value) for name, value in scalars.items()}
    changed[group] = xr.DataTree(capture[group].to_dataset().assign(labelled))
    parameters = replace(HELD_OUT, surface_energy="condition")
    return fit_model(changed, parameters, dictionary=dictionary)


def test_fit_model__relies_on_the_scan_as_far_as_its_stated_error(
    planted, small_dictionary, skin
):
    """The normals of a scan that is turned by 20 degrees."""
    turned = planted.copy()
    surfels = planted["surfels"].to_dataset().copy(deep=True)
    true = skin.normal
    tilted = true + np.tan(np.deg2rad(20)) * np.cross(true, [1.0, 0.0, 0.0])
    surfels["surfel_normal"].values[:] = tilted / np.linalg.norm(
        tilted, axis=1, keepdims=True
    )
    turned["surfels"] = xr.DataTree(surfels)
    angles = []
    for error in (1e-3, 60.0):
        model = _fit_with(turned, small_dictionary, "surfels", scan_normal_error=error)
        fitted = model["fitted"].to_dataset()
        assert fitted["scan_normal_error"] == error
        cosine = (fitted["shading_normal"].values * true).sum(axis=1)
        angles.append(np.nanmedian(np.degrees(np.arccos(np.clip(cosine, -1, 1)))))
    assert angles[0] > 10
    assert angles[1] < 2


def test_fit_model__relative_reflectance_has_no_prior_of_the_energy(
    planted, small_dictionary
):
    absolute, relative = (
        _fit_with(planted, small_dictionary, "dome", relative_reflectance=flag)
        for flag in (0, 1)
    )
    assert absolute["fitted/even_reflection"] > 0
    assert relative["fitted/even_reflection"] == 0
    line = "no white target: R_d is relative to an unknown factor per channel"
    assert line in relative.attrs["skipped"]
    assert line not in absolute.attrs["skipped"]


def _averaged(dictionary, whole):
    from skindb.fit.lumitexels import disc_angle
    from skindb.reflectance.dictionary import disc_dictionary

    return disc_dictionary(dictionary, disc_angle(whole))


@pytest.mark.slow
def test_second_pass__refuses_another_first_pass(planted, small_dictionary, skin):
    first = first_pass(planted, HELD_OUT, dictionary=small_dictionary)
    with pytest.raises(
        InputError, match="dictionary: both passes need the same surface model"
    ):
        second_pass(planted, first)
    fewer = first.copy()
    fewer["fitted"] = xr.DataTree(first["fitted"].to_dataset().isel(surfel=slice(30)))
    with pytest.raises(
        InputError, match="both passes need the same capture; found 30 surfels of 40"
    ):
        second_pass(planted, fewer, dictionary=small_dictionary)


def test_fit_model__never_sees_what_is_held_out(fitted, planted, small_dictionary):
    """Extreme samples, NaN and inf at held-out lights and cameras change nothing except
    the errors there.
    """
    model, _ = fitted
    wild = planted.copy()
    samples = planted["samples"].to_dataset().copy(deep=True)
    rng = np.random.default_rng(3)
    for dim in ("light", "camera"):
        place = {dim: model.attrs[f"held_out_{dim}s"]}
        sample = samples["reflectance_sample"].loc[place]
        values = sample.values * rng.lognormal(0, 2, sample.shape)
        values[rng.uniform(size=values.shape) < 0.05] = np.nan
        samples["reflectance_sample"].loc[place] = values
    wild["samples"] = xr.DataTree(samples)
    again = fit_model(wild, HELD_OUT, dictionary=small_dictionary)
    errors = [name for pair in HELD_OUT_ERRORS.values() for name in pair]
    for group in ("fitted", "basis", "translucency"):
        left, right = (
            tree[group].to_dataset().drop_vars(errors, errors="ignore")
            for tree in (model, again)
        )
        xr.testing.assert_allclose(left, right, rtol=1e-6)
    for name in ("held_out_error", "held_out_camera_error"):
        assert np.nanmedian(again["fitted"][name].values) > 0.5
        assert np.nanmedian(model["fitted"][name].values) < 0.02


def _held(capture, **options):
    parameters = FitParameters(**options)
    flags = hold_out(capture, plan_fit(capture, parameters), parameters)
    return {
        dim: flags[dim].values[flags[f"{dim}_held_out"].values > 0].tolist()
        for dim in ("light", "camera")
    }


def test_hold_out__those_of_photographs_first(skin):
    capture = capture_of(skin, unseen=[3])
    capture["photographs"] = xr.DataTree(
        dataset({"photograph_light": [7, 9], "photograph_camera": [2, 5]})
    )
    found = _held(capture, hold_out_lights=0.03, hold_out_cameras=0.25, seed=1)
    assert found == {"light": ["l07", "l09"], "camera": ["c2", "c5"]}
    options = {"hold_out_lights": 0.5, "hold_out_cameras": 0.5}
    assert (
        _held(capture, **options, seed=4)
        == _held(capture, **options, seed=4)
        != _held(capture, **options, seed=5)
    )


def test_hold_out__one_camera_always_remains(skin):
    capture = capture_of(skin)
    surfels = capture["surfels"].to_dataset()

    def held_of(cameras):
        """Held-out samples if no other cameras see the subject."""
        seen = surfels["camera_visible_fraction"] * np.isin(np.arange(8), cameras)
        capture["surfels"] = xr.DataTree(surfels.assign(camera_visible_fraction=seen))
        return _held(capture, hold_out_cameras=0.9, seed=1)

    assert len(held_of([1, 4, 6])["camera"]) == 2  # 0.9 of three are rounded to three
    with pytest.raises(
        InputError,
        match="to hold out a camera, two or more must reach the subject; found 1",
    ):
        held_of([6])


def test_fit_model__nothing_to_fit_is_one_line(skin, small_dictionary):
    with pytest.raises(InputError, match="no usable sample"):
        fit_model(capture_of(skin, unseen=range(40)), dictionary=small_dictionary)


def test_fit_model__more_components_than_the_dictionary_has(planted, small_dictionary):
    with pytest.raises(
        InputError,
        match="k: a reduced basis of this dictionary has 1 to 6 components; found 7",
    ):
        fit_model(planted, FitParameters(k=7), dictionary=small_dictionary)


def test_fit_model__without_a_probe_translucency_is_skipped_and_reported(
    skin, small_dictionary
):
    model = fit_model(
        capture_of(skin, probe=False),
        FitParameters(k=2, rank=6),
        dictionary=small_dictionary,
    )
    assert "translucency" not in model.children
    assert "sigma_tr" not in model["fitted"]
    assert any("translucency" in line for line in model.attrs["skipped"])
    assert "held_out_error" not in model["fitted"]


def test_fit_parameters__every_fault_at_once():
    with pytest.raises(InputError) as caught:
        FitParameters(
            k=0, mode="both", rank=0, eta=float("nan"), hold_out_lights=1.0, seed=-1
        )  # type: ignore[arg-type]
    assert [fault.where for fault in caught.value.faults] == [
        "k",
        "mode",
        "rank",
        "eta",
        "hold_out_lights",
        "seed",
    ]


def test_fit_model__two_generations_are_subtracted_by_plain_xarray(
    fitted, planted, small_dictionary
):
    """Every variable is a number, because the difference of boolean variables raises an error."""
    first = fitted[0]["fitted"].to_dataset()
    second = fit_model(planted, replace(HELD_OUT, seed=6), dictionary=small_dictionary)[
        "fitted"
    ].to_dataset()
    apart = (second - first).compute()
    assert set(apart.data_vars) == set(first.data_vars)
    change = apart["diffuse_reflectance"].values
    expected = (
        second["diffuse_reflectance"].values - first["diffuse_reflectance"].values
    )
    np.testing.assert_array_equal(change, expected)
    assert np.nanmax(np.abs(change)) > 0  # other lights were held out
    for group in ("basis", "held_out", "outliers", "translucency"):
        own = fitted[0][group].to_dataset()
        numbers = own[[name for name in own.data_vars if own[name].dtype.kind != "U"]]
        assert set((numbers - numbers).data_vars) == set(numbers.data_vars)
        assert not any(own[name].dtype == bool for name in own.data_vars)


def test_fit_model__basis_brdf_is_interpolated_over_the_closed_period(fitted):
    brdf = fitted[0]["basis"].to_dataset()["basis_brdf"].compute()
    phi = np.linspace(0, np.pi, 181)
    found = brdf.interp(
        phi_d=phi, theta_h=[0.0, 0.3, np.pi / 2], theta_d=[0.0, 1.0, np.pi / 2]
    )
    assert found.sizes["phi_d"] == 181
    assert np.isfinite(found.values).all()
    # single precision
    np.testing.assert_allclose(found.isel(phi_d=0), found.isel(phi_d=-1), rtol=2e-6)
    # between two nodes the values are theirs in proportion, in the last cell of the
    # period as in any other
    nodes = brdf["phi_d"].values
    k = brdf.sizes["phi_d"] - 2
    middle = brdf.interp(phi_d=(nodes[k] + nodes[k + 1]) / 2)
    np.testing.assert_allclose(
        middle, (brdf.isel(phi_d=k) + brdf.isel(phi_d=0)) / 2, rtol=1e-6, atol=1e-7
    )


@pytest.fixture
def unequal(planted):
    """The planted capture under lights 15 % brighter or darker than their intensity."""
    gain = 1 + 0.15 * np.clip(
        np.random.default_rng(3).normal(size=planted["samples"].sizes["light"]), -2, 2
    )
    capture = planted.copy()
    one = np.ones((gain.size, 3))
    capture["dome"] = (
        planted["dome"]
        .to_dataset()
        .assign(light_intensity=label("light_intensity", one))
    )
    return _multiplied(capture, gain[:, None])


def _multiplied(capture, factor):
    """The capture with samples times a factor (light, camera)."""
    samples = capture["samples"].to_dataset()
    product = (
        samples["reflectance_sample"].values.astype(np.float32) * factor[..., None]
    )
    changed = capture.copy()
    changed["samples"] = samples.assign(
        reflectance_sample=label("reflectance_sample", product.astype(np.float16))
    )
    return changed


def test_fit_model__light_gains_lower_the_residual(unequal, small_dictionary):
    plain, mended = (
        fit_model(
            unequal,
            FitParameters(k=2, hold_out_lights=0.2, light_gains=on),
            dictionary=small_dictionary,
        )
        for on in (False, True)
    )
    assert (
        mended.attrs["fit_residual"]["median"]
        < 0.5 * plain.attrs["fit_residual"]["median"]
    )
    assert "light_gains" not in plain.children
    found = mended["light_gains/light_gain"].values
    assert (found[mended["held_out/light_held_out"].values > 0] == 1).all()
    intensity = plain["dome/light_intensity"].values
    np.testing.assert_array_equal(intensity, np.ones_like(intensity))
    np.testing.assert_allclose(
        mended["dome/light_intensity"].values, intensity * found[:, None]
    )
    assert mended.attrs["light_gains"]["spread"] == pytest.approx(found.std())


def test_first_pass__uses_no_held_out_sample(unequal, small_dictionary):
    parameters = FitParameters(
        k=2, hold_out_lights=0.2, hold_out_cameras=0.2, light_gains=True
    )
    before = first_pass(unequal, parameters, dictionary=small_dictionary)
    flags = before["held_out"]
    away = (flags["light_held_out"].values[:, None] > 0) | (
        flags["camera_held_out"].values > 0
    )
    changed = _multiplied(unequal, np.where(away, 0.3, 1.0))
    after = first_pass(changed, parameters, dictionary=small_dictionary)
    for group in ("light_gains", "fitted"):
        assert before[group].to_dataset().identical(after[group].to_dataset())


def test_fit_model__inter_reflection_of_a_convex_face_is_nothing(
    fitted, planted, small_dictionary
):
    asked = replace(HELD_OUT, inter_reflection=True)
    found = fit_model(planted, asked, dictionary=small_dictionary)
    plain = fitted[0]
    assert {"inter-reflection", "first pass again"} <= set(found.attrs["seconds"])
    for name in ("shading_normal", "diffuse_reflectance", "basis_weight"):
        np.testing.assert_allclose(
            found[f"fitted/{name}"], plain[f"fitted/{name}"], rtol=1e-5
        )
