from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from skindb.errors import InputError
from skindb.export.inputs import texture_size
from skindb.export.maps import texture_maps
from skindb.export.textures import skin_of
from skindb.schema import FitStatus, TexelStatus, dataset, label

SIZE = 64


def grid() -> tuple[np.ndarray, np.ndarray]:
    v, u = (np.mgrid[:SIZE, :SIZE] + 0.5) / SIZE
    return u, v


def test_texture_maps__linear_fields_are_reproduced_where_surfels_were_fitted(
    model: xr.DataTree,
) -> None:
    maps, (u, v) = texture_maps(model, size=SIZE), grid()
    sure = maps["confidence"].values[..., 0] > 0.999
    assert 0.7 < sure.mean() < 0.81  # the atlas covers 0.9^2 less the unseen corner
    # barycentric interpolation is exact for linear fields; float32
    np.testing.assert_allclose(
        maps["albedo"].values[sure, 0], 0.2 + 0.5 * u[sure], atol=2e-6
    )
    np.testing.assert_allclose(
        maps["albedo"].values[sure, 1], 0.2 + 0.5 * v[sure], atol=2e-6
    )
    np.testing.assert_allclose(
        maps["weight_0"].values[sure, 0], 0.4 + 0.2 * u[sure], atol=2e-6
    )
    np.testing.assert_allclose(
        maps["translucency"].values[sure],
        np.tile([2.0, 1.25, 0.8], (sure.sum(), 1)),
        rtol=1e-6,
    )


def test_texture_maps__unfitted_parts_are_filled_and_marked(model: xr.DataTree) -> None:
    maps, (u, v) = texture_maps(model, size=SIZE), grid()
    unseen = (u > 0.86) & (v > 0.86)
    assert (maps["confidence"].values[unseen] == 0).all()
    assert (maps["confidence"].values[(u < 0.04) | (v < 0.04)] == 0).all()
    for name, texture in maps.items():
        assert np.isfinite(texture.values).all(), name
    # filled values lie among those around them
    assert (maps["albedo"].values[unseen, 0] > 0.45).all()
    np.testing.assert_allclose(
        np.linalg.norm(maps["normal"].values, axis=-1), 1, atol=1e-5
    )


def test_texture_maps__values_without_a_fit_never_enter(model: xr.DataTree) -> None:
    fitted = model["fitted"].to_dataset()
    unseen = fitted["fit_status"].values != 0
    before = texture_maps(model, size=SIZE)
    for name in ("diffuse_reflectance", "basis_weight"):
        model[f"fitted/{name}"].values[unseen] = 1e6
    after = texture_maps(model, size=SIZE)
    for name, texture in before.items():
        np.testing.assert_array_equal(after[name].values, texture.values, err_msg=name)


def test_texture_maps__status_says_where_each_texel_comes_from(
    model: xr.DataTree,
) -> None:
    fitted = model["fitted"].to_dataset()
    triangles = model["mesh/triangle"].values
    u, v = fitted["surfel_uv"].values.T
    left = (u < 0.3) & (v > 0.5)
    top = (u < 0.3) & (v < 0.3)
    middle = np.hypot(u - 0.5, v - 0.5) < 0.15
    lower = (v > 0.7) & (u > 0.4) & (u < 0.6)
    status = np.where(
        lower, int(FitStatus.DIFFUSE_CLAMPED), fitted["fit_status"].values
    )
    model["fitted"] = fitted.assign(
        fit_status=label("fit_status", status),
        fit_samples=label("fit_samples", np.where(left, 15, 100)),
        fit_condition=label("fit_condition", np.where(top, 2e3, np.nan)),
    )
    keep = ~middle[triangles].any(axis=1)
    model["mesh"] = xr.Dataset({"triangle": label("triangle", triangles[keep])})
    maps = texture_maps(model, size=SIZE)
    code = maps["status"].values[..., 0]

    def at(x: float, y: float) -> TexelStatus:
        return TexelStatus(int(code[int(y * SIZE), int(x * SIZE)]))

    assert at(0.7, 0.3) == TexelStatus.MEASURED
    assert at(0.2, 0.7) == TexelStatus.FEW_SAMPLES
    assert at(0.2, 0.2) == TexelStatus.ILL_CONDITIONED
    assert at(0.5, 0.9) == TexelStatus.DOUBTFUL_FIT
    assert at(0.9, 0.9) == TexelStatus.FILLED
    assert at(0.5, 0.5) == TexelStatus.OPENING
    assert at(0.01, 0.5) == at(0.99, 0.99) == TexelStatus.OUTSIDE
    confidence = maps["confidence"].values[..., 0]
    for x, y, wanted in (
        (0.7, 0.3, 1),
        (0.2, 0.7, 0.5),
        (0.2, 0.2, 0.5),
        (0.5, 0.9, 0.5),
        (0.9, 0.9, 0),
        (0.5, 0.5, 0),
    ):
        np.testing.assert_allclose(
            confidence[int(y * SIZE), int(x * SIZE)], wanted, rtol=1e-6
        )
    assert "3 doubtful: the fit had fewer than 16 samples" in maps["status"].doc


def noisy(model: xr.DataTree, doubtful: np.ndarray) -> dict[str, np.ndarray]:
    """Maps of a patch of white noise, some surfels of which have few samples."""
    fitted = model["fitted"].to_dataset()
    rng = np.random.default_rng(0)
    fitted["fit_status"].values[:] = int(FitStatus.FITTED)
    tilted = fitted["surfel_normal"].values + rng.normal(
        scale=0.1, size=(len(doubtful), 3)
    )
    albedo = rng.uniform(0.1, 0.9, (len(doubtful), 3))
    values = {
        "diffuse_reflectance": albedo,
        "diffuse_reflectance_total_error": albedo / 10,
        "basis_weight": rng.uniform(0.1, 0.9, (len(doubtful), 2)),
        "shading_normal": tilted / np.linalg.norm(tilted, axis=1, keepdims=True),
        "sigma_tr": 1 / rng.uniform(1, 2, (len(doubtful), 3)),
        "fit_samples": np.where(doubtful, 10, 100),
    }
    model["fitted"] = fitted.assign(
        {name: label(name, value) for name, value in values.items()}
    )
    return {
        name: texture.values for name, texture in texture_maps(model, size=SIZE).items()
    }


def test_texture_maps__evenly_doubtful_surfels_are_marked_and_not_blurred(
    model: xr.DataTree,
) -> None:
    n = model["fitted"].sizes["surfel"]
    sure = noisy(model, np.zeros(n, bool))
    doubtful = noisy(model, np.ones(n, bool))
    inside = sure["confidence"][..., 0] > 0
    np.testing.assert_allclose(
        doubtful["confidence"], sure["confidence"] / 2, rtol=1e-6
    )
    assert sure["albedo"][inside].std() > 0.1
    for name in set(sure) - {"confidence", "status"}:
        # float32
        np.testing.assert_allclose(
            doubtful[name][inside], sure[name][inside], atol=2e-6, err_msg=name
        )


def test_texture_maps__a_doubtful_part_is_blurred_at_its_rim_at_most(
    model: xr.DataTree,
) -> None:
    u, _ = grid()
    surfel_u = model["fitted/surfel_uv"].values[:, 0]
    sure = noisy(model, np.zeros(len(surfel_u), bool))
    part = noisy(model, surfel_u < 0.5)
    rim = np.abs(u - 0.5) < 0.9 / 23 + 2 / SIZE  # a surfel and two texels
    away = ~rim & (sure["confidence"][..., 0] > 0)
    np.testing.assert_allclose(part["albedo"][away], sure["albedo"][away], atol=2e-6)
    assert np.abs(part["albedo"][rim] - sure["albedo"][rim]).max() > 0.01


def test_texture_maps__a_lone_doubtful_surfel_is_drawn_towards_those_around(
    model: xr.DataTree,
) -> None:
    fitted = model["fitted"].to_dataset()
    lone = np.arange(fitted.sizes["surfel"]) == 10 * 24 + 10
    albedo = np.repeat(np.where(lone, 0.9, 0.3)[:, None], 3, axis=1)
    peak = []
    for samples in (100, 10):
        model["fitted"] = fitted.assign(
            diffuse_reflectance=label("diffuse_reflectance", albedo),
            fit_samples=label("fit_samples", np.where(lone, samples, 100)),
        )
        peak.append(texture_maps(model, size=SIZE)["albedo"].values[:40, :40].max())
    assert 0.35 < peak[1] < peak[0] - 0.1


def test_texture_maps__without_translucency_there_is_no_such_map(
    model: xr.DataTree,
) -> None:
    model["fitted"] = model["fitted"].to_dataset().drop_vars("sigma_tr")
    assert set(texture_maps(model, size=SIZE)) == {
        "albedo",
        "normal",
        "normal_tangent",
        "weight_0",
        "weight_1",
        "confidence",
        "status",
    }


def test_texture_maps__unknown_translucency_is_left_out_channel_by_channel(
    model: xr.DataTree,
) -> None:
    whole = texture_maps(model, size=SIZE)["translucency"]
    transport = model["fitted/sigma_tr"].values
    # a channel known elsewhere than the others keeps its place
    transport[300, 1] = np.nan
    np.testing.assert_allclose(
        texture_maps(model, size=SIZE)["translucency"].values, whole.values, rtol=1e-6
    )
    transport[:, 2] = np.nan
    # one trusted surfel: filled from around, where it is 2 mm everywhere
    transport[300, 0] = np.nan
    part = texture_maps(model, size=SIZE)["translucency"]
    assert part.channels == ("R", "G")
    np.testing.assert_allclose(part.values, whole.values[..., :2], rtol=1e-6)
    transport[:] = np.nan
    assert "translucency" not in texture_maps(model, size=SIZE)


def test_texture_maps__errors_are_maps_where_the_model_has_them(
    model: xr.DataTree,
) -> None:
    u, _ = grid()
    fitted = model["fitted"].to_dataset()
    at = fitted["surfel_uv"].values[:, :1]
    wrong = 0.01 + 0.02 * at * [1, 2, 3]
    wrong[40] = np.nan  # a trusted surfel without an error: filled from around
    model["fitted"] = fitted.assign(
        diffuse_reflectance_total_error=label("diffuse_reflectance_total_error", wrong),
        normal_total_error=label("normal_total_error", np.full(len(at), 2.0)),
        surface_reflectance_error=label(
            "surface_reflectance_error", np.full(len(at), np.nan)
        ),
    )
    maps = texture_maps(model, size=SIZE)
    assert set(maps) >= {"albedo_error", "normal_error"}
    # absent; known nowhere
    assert not {"surface_reflectance", "surface_reflectance_error"} & set(maps)
    assert maps["normal_error"].units == "degree"
    np.testing.assert_allclose(maps["normal_error"].values, 2, rtol=1e-6)
    sure = maps["confidence"].values[..., 0] > 0.999
    away = (
        np.abs(
            maps["albedo_error"].values[sure]
            - (0.01 + 0.02 * u[sure][:, None] * [1, 2, 3])
        ).max(axis=1)
        > 1e-6
    )
    # around the surfel without; exact elsewhere, the error is linear in u
    assert 0 < away.mean() < 0.02
    assert np.isfinite(maps["albedo_error"].values).all()


def test_texture_maps__nothing_fitted_is_said(model: xr.DataTree) -> None:
    # of no use here: it may be absent
    fitted = model["fitted"].to_dataset().drop_vars("fit_residual")
    status = np.full(fitted.sizes["surfel"], int(FitStatus.UNSEEN))
    model["fitted"] = fitted.assign(fit_status=label("fit_status", status))
    with pytest.raises(
        InputError, match="at least one surfel must be fitted for an export; found none"
    ):
        texture_maps(model, size=SIZE)


def test_texture_maps__surfels_of_three_samples_are_matt(model: xr.DataTree) -> None:
    fitted = model["fitted"].to_dataset()
    status = fitted["fit_status"].values
    status[status == FitStatus.FITTED] = FitStatus.LAMBERT
    fitted["basis_weight"].values[:] = np.nan
    model["fitted"] = fitted
    maps, (u, v) = texture_maps(model, size=SIZE), grid()
    inner = np.minimum.reduce([u - 0.1, v - 0.1, 0.7 - u, 0.7 - v]) > 0
    assert (maps["weight_0"].values == 0).all()
    np.testing.assert_allclose(
        maps["albedo"].values[inner, 0], 0.2 + 0.5 * u[inner], atol=2e-3
    )
    np.testing.assert_allclose(maps["confidence"].values[inner], 0.5, atol=1e-6)


def test_texture_maps__detail_of_texels(model: xr.DataTree) -> None:
    """Rationale: a factor and a tilt that are the same everywhere are those of surfels with
    this albedo and these normals. Expected: the same maps up to half precision.
    """
    size = 2 * SIZE
    tilt = np.array([0.1, -0.2, 0.05], np.float16)
    planted = model.copy()
    planted["detail"] = xr.DataTree(
        dataset(
            {
                "diffuse_detail": np.full((size, size, 3), [0.25, -0.5, 0.5]),
                "normal_detail": np.full((size, size, 3), tilt),
            }
        )
    )
    assert texture_size(planted) == size
    maps = texture_maps(planted)
    fitted = model["fitted"].to_dataset()
    normal = fitted["shading_normal"] + tilt
    model["fitted"] = fitted.assign(
        diffuse_reflectance=fitted["diffuse_reflectance"] * [1.25, 0.5, 1.5],
        shading_normal=normal,
    )
    expected = texture_maps(model, size=size)
    sure = expected["confidence"].values[..., 0] > 0.999
    for name in ("albedo", "normal", "normal_tangent"):
        np.testing.assert_allclose(
            maps[name].values[sure], expected[name].values[sure], atol=1e-3
        )
    skins = [skin_of(tree, size=size).pictures for tree in (planted, model)]
    # in steps of 1/255; the base colour is not quite proportional to R_d
    for name, steps in (("normal", 1), ("baseColor", 6)):
        ours, theirs = (skin[name].astype(int)[sure] for skin in skins)
        assert np.abs(ours - theirs).max() <= steps
