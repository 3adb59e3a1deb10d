"""The fit of a take, from store to store."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

import skindb
from skindb.errors import InputError
from skindb.fit import fit_take, plan_take
from skindb.fit.held_out import ERRORS, split_take
from skindb.fit.lumitexels import lumitexels as lumitexels_of
from skindb.optics.dipole import effective_transport
from skindb.optics.transport import transport_profile
from skindb.plan import Plan, plan_fit
from skindb.schema import GROUPS, FitStatus, check, dataset

SIGMA_A, SIGMA_S = np.array([0.05, 0.17, 0.36]), np.array([2.4, 2.3, 2.9])
FIXED = {"dictionary", "normals", "diffuse reflectance", "surface", "reduced basis", "refit", "outliers", "write"}


def _store(folder, skin, *, scope=("fit",), probe=True, unseen=()):
    """A database with the capture `S1`."""
    ds = skin.lumitexels.copy(deep=True)
    ds["reflectance_sample"].values[list(unseen)] = np.nan
    sample, n = ds["reflectance_sample"].values, ds.sizes["surfel"]
    coords = {name: ds[name].values for name in ("light", "camera", "channel")}
    lit, seen = np.isfinite(sample).any((2, 3)), np.isfinite(sample).any((1, 3))
    groups = {
        "samples": ds[["reflectance_sample"]].merge(
            dataset({name: np.isfinite(sample).all(-1).sum((1, 2)) for name in ("sample_count",)})
        ),
        "surfels": ds[["surfel_position", "surfel_normal", "surfel_area"]].merge(
            dataset(
                {
                    "surfel_uv": np.zeros((n, 2)),
                    "light_visible_fraction": lit,
                    "camera_visible_fraction": seen,
                    "region_mask": np.ones((n, 1), bool),
                },
                coords={"light": coords["light"], "camera": coords["camera"], "region": ["beard"]},
            )
        ),
        "mesh": dataset({"triangle": np.array([[0, 1, 2]])}),
        "dome": ds[["light_position", "light_disc_radius", "camera_position"]],
    }
    if probe:
        distance = 1 + 0.5 * np.arange(28)
        profile = transport_profile(distance[:, None], SIGMA_A, SIGMA_S, eta=1.3)[None]
        groups["probe"] = dataset(
            {
                "fibre_distance": distance,
                "fibre_profile": profile,
                "fibre_profile_error": 0.004 * profile,
                "site_position": [[30.0, 0, 75]],
            },
            coords={"site": ["cheek"], "channel": ["R", "G", "B"]},
            attrs={"gain_known": 1},
        )
    db = skindb.open(str(folder))
    with db.stage("capture", "S1") as stage:
        stage.write(groups)
        stage.commit({"subject": "S1", "condition": "normal", "traits": {"age": 30}, "consent_scope": list(scope)})
    return db


@pytest.fixture(scope="module")
def fitted(tmp_path_factory, skin, small_dictionary, plant):
    lumitexels, _ = plant(skin, small_dictionary, np.random.default_rng(9), noise=0.005, scale=0.1)
    planted = replace(skin, lumitexels=lumitexels)
    db = _store(tmp_path_factory.mktemp("db"), planted, unseen=[4, 11])
    told = []
    record, report = fit_take(
        db,
        "S1",
        k=3,
        rank=6,
        hold_out_lights=0.1,
        hold_out_cameras=0.1,
        seed=5,
        dictionary=small_dictionary,
        progress=lambda *step: told.append(step),
    )
    return db, record, report, told


def test_fit_take__commits_a_model_that_fits_the_schema(fitted, skin):
    db, record, _, _ = fitted
    assert (record.kind, record.take, record.generation) == ("model", "S1", 1)
    assert db.verify() == []
    model = db.read("model", "S1")
    assert set(model.children) == {"fitted", "basis", "mesh", "dome", "probe", "translucency", "outliers"}
    for group in ("fitted", "basis", "translucency", "outliers"):
        check(model[group].to_dataset(), [v.name for v in GROUPS[group]], where=group)
    assert model["fitted"].sizes["surfel"] == skin.lumitexels.sizes["surfel"]


def test_fit_take__recovers_truth(fitted, skin):
    model = fitted[0].read("model", "S1")
    found = model["fitted"].to_dataset().compute()
    seen = found["fit_status"].values == FitStatus.FITTED
    assert seen.sum() >= len(seen) - 3
    cosine = np.einsum("nk,nk->n", found["shading_normal"].values, skin.normal)[seen]
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 2.5
    error = np.abs(found["diffuse_reflectance"].values / skin.diffuse - 1)[seen]
    assert np.median(error) < 0.15  # the materials have diffuse parts of their own, which nothing can tell apart
    assert np.median(found["held_out_error"].values[seen]) < 0.02
    assert np.median(found["held_out_camera_error"].values[seen]) < 0.02
    true = effective_transport(SIGMA_A, SIGMA_S)
    np.testing.assert_allclose(found["effective_transport"].values, np.tile(true, (len(seen), 1)), rtol=1e-3)
    assert model.attrs["profile"] == model["translucency"].attrs["profile"] == "transport"


def test_fit_take__unseen_surfels_have_a_status_and_nothing_else(fitted):
    found = fitted[0].read("model", "S1")["fitted"].to_dataset().compute()
    assert found["fit_status"].values[[4, 11]].tolist() == [FitStatus.UNSEEN] * 2
    for name in (
        "shading_normal",
        "diffuse_reflectance",
        "basis_weight",
        "reduced_weight",
        "held_out_error",
        "held_out_camera_error",
    ):
        assert np.isnan(found[name].values[[4, 11]]).all()
    assert np.isfinite(found["surfel_position"].values).all()


def test_fit_take__report_and_provenance(fitted):
    db, record, report, told = fitted
    assert set(report["seconds"]) == FIXED | {"held out", "translucency"}
    assert abs(sum(report["status"].values()) - 1) < 1e-9
    assert report["status"]["unseen"] == 2 / report["surfels"]
    assert len(report["held_out_lights"]) == 6
    assert len(report["held_out_cameras"]) == 1
    assert set(report["prediction"]["regions"]["all"]) >= {"fit", "held_out_lights", "held_out_cameras"}
    assert report["suspects"] == []
    assert any("2 of 40 left out" in line for line in report["left_out"])
    attrs = db.read("model", "S1").attrs
    assert attrs["eta"] == 1.3
    assert (attrs["mode"], attrs["k"], attrs["rank"], attrs["seeds"]) == ("perceptual", 3, 6, {"fit": 5})
    assert attrs["consent_scope"] == ["fit"]
    assert attrs["inputs"][0]["generation"] == 1
    assert len(attrs["inputs"][0]["sha256"]) == 64
    assert attrs["held_out_lights"] == report["held_out_lights"]
    assert attrs["held_out_cameras"] == report["held_out_cameras"]
    assert record.provenance["status"] == report["status"]
    ended = [stage for stage, done, total in told if done == total]
    assert set(ended) == set(report["seconds"])
    assert all(0 <= done <= total for _, done, total in told)


def test_fit_take__same_seed_same_model(fitted, skin, small_dictionary):
    db = fitted[0]
    first = db.read("model", "S1", generation=1)
    held = {"hold_out_lights": 0.1, "hold_out_cameras": 0.1}
    record, _ = fit_take(db, "S1", k=3, rank=6, seed=5, dictionary=small_dictionary, **held)
    again = db.read("model", "S1", generation=record.generation)
    assert record.generation == 2
    for group in ("fitted", "basis", "translucency"):
        # BLAS rounds by how arrays happen to be aligned: the last digit of float32, not always the same bits
        xr.testing.assert_allclose(first[group].to_dataset(), again[group].to_dataset(), rtol=1e-6)


def test_fit_take__never_sees_what_is_held_out(fitted, tmp_path, skin, small_dictionary, plant):
    """Wild samples, NaN and inf among them, at the held-out lights and cameras move nothing but their own errors."""
    db, _, report, _ = fitted
    lumitexels, _ = plant(skin, small_dictionary, np.random.default_rng(9), noise=0.005, scale=0.1)
    wild = lumitexels.copy(deep=True)
    rng = np.random.default_rng(3)
    for dim, names in (("light", report["held_out_lights"]), ("camera", report["held_out_cameras"])):
        sample = wild["reflectance_sample"].loc[{dim: names}]
        values = sample.values * rng.lognormal(0, 2, sample.shape)
        values[rng.uniform(size=values.shape) < 0.05] = np.nan
        wild["reflectance_sample"].loc[{dim: names}] = values
    other = _store(tmp_path / "db", replace(skin, lumitexels=wild), unseen=[4, 11])
    held = {"hold_out_lights": 0.1, "hold_out_cameras": 0.1}
    fit_take(other, "S1", k=3, rank=6, seed=5, dictionary=small_dictionary, **held)
    errors = [name for pair in ERRORS.values() for name in pair]
    first, again = (one.read("model", "S1", generation=1) for one in (db, other))
    for group in ("fitted", "basis", "translucency"):
        left, right = (tree[group].to_dataset().drop_vars(errors, errors="ignore") for tree in (first, again))
        # BLAS rounds by how arrays happen to be aligned, as above
        xr.testing.assert_allclose(left, right, rtol=1e-6)
    for name in ("held_out_error", "held_out_camera_error"):
        assert np.nanmedian(again["fitted"][name].values) > 0.5
        assert np.nanmedian(first["fitted"][name].values) < 0.02


def test_split_take__lights_and_cameras_apart_and_those_of_photographs_first(tmp_path, skin):
    capture = _store(tmp_path / "db", skin, unseen=[3]).read("capture", "S1")
    photographs = dataset({"photograph_light": [7, 9], "photograph_camera": [2, 5]})
    capture["photographs"] = xr.DataTree(photographs)
    whole, plan = lumitexels_of(capture), plan_fit(capture)
    split = split_take(whole, capture, plan, lights=0.03, cameras=0.25, seed=1)
    assert split.lights["light"].values.tolist() == ["l07", "l09"]
    assert split.cameras["camera"].values.tolist() == ["c2", "c5"]
    kept = {dim: set(split.work[dim].values) for dim in ("light", "camera")}
    assert kept["light"] == set(whole["light"].values) - {"l07", "l09"} == set(split.cameras["light"].values)
    assert kept["camera"] == set(whole["camera"].values) - {"c2", "c5"} == set(split.lights["camera"].values)
    assert split.work.sizes["surfel"] == split.lights.sizes["surfel"] == 39
    again = split_take(whole, capture, plan, lights=0.5, cameras=0.5, seed=4)
    same = split_take(whole, capture, plan, lights=0.5, cameras=0.5, seed=4)
    other = split_take(whole, capture, plan, lights=0.5, cameras=0.5, seed=5)
    assert again.work.identical(same.work)
    assert not again.work.identical(other.work)


def test_split_take__one_camera_is_always_kept(tmp_path, skin):
    capture = _store(tmp_path / "db", skin).read("capture", "S1")
    whole, plan = lumitexels_of(capture), plan_fit(capture)
    assert split_take(whole, capture, plan, lights=0.99, cameras=0.99, seed=1).work.sizes["camera"] == 1
    blind = capture["surfels"].to_dataset()
    blind["camera_visible_fraction"] = blind["camera_visible_fraction"] * (np.arange(8) == 6)
    capture["surfels"] = xr.DataTree(blind)
    with pytest.raises(InputError, match="a camera is held out of two or more that reach the subject; found 1"):
        split_take(whole, capture, plan, lights=0, cameras=0.1, seed=1)


def test_fit_take__plan_leaves_results_the_same(tmp_path, skin, small_dictionary):
    dark = skin.lumitexels.copy(deep=True)
    dark["reflectance_sample"].values[:, 7] = np.nan
    db = _store(tmp_path / "db", replace(skin, lumitexels=dark), probe=False, unseen=[0])
    capture = db.read("capture", "S1")
    planned = plan_fit(capture)
    assert (np.flatnonzero(~planned.surfels), np.flatnonzero(~planned.lights)) == ([0], [7])
    everything = Plan(np.ones(40, bool), np.ones(60, bool), planned.translucency, ())
    call = {"k": 2, "rank": 6, "dictionary": small_dictionary}
    fit_take(db, "S1", plan=everything, **call)
    fit_take(db, "S1", **call)
    whole, left = (db.read("model", "S1", generation=g)["fitted"].to_dataset().compute() for g in (1, 2))
    assert whole["fit_status"].identical(left["fit_status"])
    for name in ("shading_normal", "diffuse_reflectance", "fit_residual"):
        np.testing.assert_allclose(whole[name].values, left[name].values, rtol=1e-4, atol=1e-5)


def test_fit_take__fits_the_version_that_was_planned(tmp_path, skin, small_dictionary):
    db = _store(tmp_path / "db", skin, probe=False)
    planned = plan_take(db.read("capture", "S1"), dictionary=small_dictionary)
    _store(tmp_path / "db", skin, probe=False)  # while somebody reads the plan
    record, _ = fit_take(db, "S1", k=2, rank=6, dictionary=small_dictionary, plan=planned)
    assert [one["generation"] for one in record.provenance["inputs"]] == [planned.generation] == [1]
    record, _ = fit_take(db, "S1", k=2, rank=6, dictionary=small_dictionary)
    assert record.provenance["inputs"][0]["generation"] == 2


def test_plan_take__says_what_the_rank_costs(tmp_path, skin, small_dictionary):
    capture = _store(tmp_path / "db", skin, probe=False).read("capture", "S1")
    said = {rank: plan_take(capture, rank=rank, dictionary=small_dictionary).omissions for rank in (3, 5, 6)}
    assert [one.what for one in said[6]] == ["translucency"]
    for rank in (3, 5):
        left = said[rank][-1]
        assert (left.left_out, left.of) == (6 - rank, 6)
        assert f"differ by at most {100 * left.bound:.3g} %" in str(left)
    assert 0 < said[5][-1].bound < said[3][-1].bound < 1
    paper = plan_take(capture, mode="paper", rank=3, dictionary=small_dictionary).omissions[-1]
    assert "cube roots of mixtures" in str(paper)
    assert paper.bound != said[3][-1].bound


def test_fit_take__no_probe_no_translucency_and_it_says_so(tmp_path, skin, small_dictionary):
    db = _store(tmp_path / "db", skin, probe=False)
    _, report = fit_take(db, "S1", k=2, rank=6, dictionary=small_dictionary)
    model = db.read("model", "S1")
    assert "translucency" not in model.children
    assert "effective_transport" not in model["fitted"]
    assert any("translucency" in line for line in model.attrs["left_out"])
    assert report["left_out"] == model.attrs["left_out"]
    assert "held_out_error" not in model["fitted"]


def test_fit_take__refuses_without_consent_and_commits_nothing(tmp_path, skin):
    db = _store(tmp_path / "db", skin, scope=["statistics"])
    with pytest.raises(InputError, match="needs the scope 'fit'; found only statistics") as caught:
        fit_take(db, "S1", hold_out_lights=1.0)
    assert len(caught.value.faults) == 2
    assert db.takes("model") == []


def test_fit_take__nothing_to_fit_is_one_line(tmp_path, skin, small_dictionary):
    db = _store(tmp_path / "db", skin, unseen=range(40))
    with pytest.raises(InputError, match="no usable sample"):
        fit_take(db, "S1", dictionary=small_dictionary)
    assert db.takes("model") == []
