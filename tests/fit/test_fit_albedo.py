"""Diffuse reflectance: recovery, and independence of highlights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from three_surfels import MATTE, surfels

from skindb.fit import (
    estimate_diffuse_reflectance,
    estimate_normals,
)
from skindb.fit.albedo import block_reflectance
from skindb.optics.diffusion import diffuse_reflectance
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance.mixture import basis_rows
from skindb.reflectance.separation import surface_lobes
from skindb.schema import label
from skindb.schema.declaration import LARGEST_R_D, SMALLEST_R_D


def _with_normals(skin):
    return skin.lumitexels.assign(shading_normal=label("shading_normal", skin.normal))


def test_estimate_diffuse_reflectance__recovers_truth(skin):
    found = estimate_diffuse_reflectance(_with_normals(skin))
    error = np.abs(found["diffuse_reflectance"].values / skin.diffuse - 1)
    assert np.median(error) < 0.02


def test_estimate_diffuse_reflectance__without_gloss_or_noise_is_exact(new_skin):
    skin = new_skin(gloss=0.0, noise=0.0)
    found = estimate_diffuse_reflectance(_with_normals(skin))["diffuse_reflectance"]
    # half floats: 5e-4
    assert np.abs(found.values / skin.diffuse - 1).max() < 1e-3


def test_estimate_diffuse_reflectance__white_gloss_leaves_the_colour_alone(new_skin):
    plain, glossy = (new_skin(gloss=g, noise=0.0) for g in (0.0, 0.12))
    a, b = (
        estimate_diffuse_reflectance(_with_normals(s))["diffuse_reflectance"].values
        for s in (plain, glossy)
    )
    np.testing.assert_allclose(a[:, 0] - a[:, 2], b[:, 0] - b[:, 2], rtol=0.01)
    # the common part is separated by shape only: three times the gloss of skin changes
    # it by a few per cent
    assert np.median(np.abs(b / a - 1)) < 0.03


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lights", "cameras", "noise"), [(60, 8, 0.01), (60, 8, 0.05), (150, 16, 0.03)]
)
def test_estimate_diffuse_reflectance__interval_covers_95_percent_of_noise(
    new_skin, lights, cameras, noise
):
    """Rationale: the sandwich of the residuals. Expected: 93 to 97 %; 1500 values give
    the fraction to 0.6 %.
    """
    ds, diffuse = _of_the_model(
        new_skin, 400, lights, cameras, noise, np.random.default_rng(7)
    )
    found = estimate_diffuse_reflectance(ds)
    z = (found["diffuse_reflectance"].values - diffuse) / found[
        "diffuse_reflectance_error"
    ].values
    assert 0.92 < (np.abs(z) < 1.96).mean() < 0.98
    error, total = (
        found[f"diffuse_reflectance_{name}"].values.astype(float)
        for name in ("error", "total_error")
    )
    # errors common to a device, here none
    own = np.sqrt(total**2 - 0.004**2)
    assert (own > 0.99 * error).all()
    assert np.median(own / error) < 1.4


def test_estimate_diffuse_reflectance__total_error_counts_what_lights_and_cameras_have_in_common(
    new_skin,
):
    """Rationale: a wrong gain is an error of all samples of a device. Expected: 95 %,
    less with few cameras.
    """
    ds, diffuse = _of_the_model(new_skin, 400, 60, 6, 0.01, np.random.default_rng(9))
    rng = np.random.default_rng(10)
    gain = (1 + 0.06 * rng.normal(size=(400, 60, 1, 1))) * (
        1 + 0.06 * rng.normal(size=(400, 1, 6, 1))
    )
    seen = (ds["reflectance_sample"].values * gain).astype(np.float16)
    wrong = ds.assign(reflectance_sample=label("reflectance_sample", seen))
    found = estimate_diffuse_reflectance(wrong)
    error, total = (
        found[f"diffuse_reflectance_{name}"].values.astype(float)
        for name in ("error", "total_error")
    )
    off = np.abs(found["diffuse_reflectance"].values - diffuse)
    assert (off < 1.96 * error).mean() < 0.75
    assert 0.85 < (off < 1.96 * np.sqrt(total**2 - 0.004**2)).mean() < 0.97


@pytest.mark.parametrize("gloss", [0.0, 0.3])
def test_estimate_diffuse_reflectance__interval_covers_95_percent_with_found_normals(
    new_skin, gloss
):
    """Rationale: the normal's error reaches R_d through the cosines. Expected: 95 %,
    without it 80 to 90 %.

    The channels share most of their error: 400 independent trials know the share to 1.1
    %, three of which are allowed.
    """
    ds, diffuse = _of_the_model(
        new_skin, 400, 60, 8, 0.01, np.random.default_rng(8), gloss=gloss
    )
    turned = estimate_normals(ds)
    found = estimate_diffuse_reflectance(
        ds.assign(turned[["shading_normal", "normal_error"]])
    )
    blind = estimate_diffuse_reflectance(ds.assign(turned[["shading_normal"]]))
    np.testing.assert_array_equal(
        found["diffuse_reflectance"], blind["diffuse_reflectance"]
    )
    share, without = (
        (
            np.abs(f["diffuse_reflectance"] - diffuse)
            < 1.96 * f["diffuse_reflectance_error"]
        ).values.mean()
        for f in (found, blind)
    )
    assert abs(share - 0.95) < 0.033
    assert without < 0.9


def _of_the_model(new_skin, surfels, lights, cameras, noise, rng, gloss=0.3):
    """Samples of diffuse light and of two lobes that the fit contains, by public
    functions, with relative noise.
    """
    skin = new_skin(
        surfels=surfels, lights=lights, cameras=cameras, seed=int(rng.integers(1000))
    )
    ds = _with_normals(skin)
    position = ds["surfel_position"].values.astype(float)
    wi, wo = (
        ds[f"{name}_position"].values - position[:, None]
        for name in ("light", "camera")
    )
    wi, wo = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (wi, wo))
    ci = np.einsum("nk,ntk->nt", skin.normal, wi)
    co = np.einsum("nk,ntk->nt", skin.normal, wo)
    table, grid = surface_lobes()
    rows, offsets, index = basis_rows(
        table, grid, skin.normal, wi, wo, (ci > 0)[:, :, None] & (co > 0)[:, None]
    )
    s, (i, o) = np.repeat(np.arange(surfels), np.diff(offsets)), index.T
    weight = rng.uniform(0, gloss, (surfels, 6)) * (
        rng.permuted(np.tile(np.arange(6), (surfels, 1)), axis=1) < 2
    )
    body = (ci * fresnel_transmittance(ci.clip(0, 1), 1.3))[
        s, i
    ] * fresnel_transmittance(co.clip(0, 1), 1.3)[s, o]
    value = (
        body[:, None] / np.pi * skin.diffuse[s]
        + np.einsum("tm,tm->t", rows, weight[s])[:, None]
    )
    sample = np.full((surfels, lights, cameras, 3), np.nan)
    sample[s, i, o] = value * (1 + noise * rng.normal(size=value.shape))
    return ds.assign(
        reflectance_sample=label("reflectance_sample", sample)
    ), skin.diffuse


def test_estimate_diffuse_reflectance__dipole_s_inverts_eq5(skin):
    found = estimate_diffuse_reflectance(_with_normals(skin))
    again = diffuse_reflectance(found["dipole_s"].values, eta=1.3)
    # stored float32
    np.testing.assert_allclose(again, found["diffuse_reflectance"].values, rtol=1e-5)


def test_estimate_diffuse_reflectance__too_few_samples_are_nan(skin):
    few = _with_normals(skin).isel(light=[0], camera=[0])
    found = estimate_diffuse_reflectance(few)
    assert np.isnan(found["diffuse_reflectance"].values).all()
    assert np.isnan(found["diffuse_reflectance_error"].values).all()


def test_estimate_diffuse_reflectance__black_and_overbright_are_clamped(skin):
    lumitexels = _with_normals(skin)
    for factor, limit in ((0.0, 1e-4), (20.0, 0.9999)):
        scaled = lumitexels.assign(
            reflectance_sample=lumitexels["reflectance_sample"] * np.float16(factor)
        )
        scaled["reflectance_sample"].attrs = lumitexels["reflectance_sample"].attrs
        found = estimate_diffuse_reflectance(scaled)["diffuse_reflectance"].values
        np.testing.assert_allclose(found, limit, rtol=1e-6)


def test_estimate_diffuse_reflectance__grazing_samples_do_not_count(skin):
    lumitexels = _with_normals(skin)
    position = lumitexels["surfel_position"].values
    spoiled = lumitexels["reflectance_sample"].copy(deep=True)
    for name, axis in (("light_position", 1), ("camera_position", 2)):
        way = lumitexels[name].values - position[:, None]
        cosine = np.einsum(
            "nk,ntk->nt", skin.normal, way / np.linalg.norm(way, axis=-1, keepdims=True)
        )
        grazing = np.expand_dims(cosine < 0.24, (3 - axis, 3))
        spoiled.values[np.broadcast_to(grazing, spoiled.shape)] *= 0.3
    assert (spoiled != lumitexels["reflectance_sample"]).any()
    found = estimate_diffuse_reflectance(lumitexels.assign(reflectance_sample=spoiled))
    clean = estimate_diffuse_reflectance(lumitexels)
    np.testing.assert_allclose(
        found["diffuse_reflectance"], clean["diffuse_reflectance"], rtol=1e-6
    )


def test_estimate_diffuse_reflectance__any_chunking(skin):
    lumitexels = _with_normals(skin)
    eager = estimate_diffuse_reflectance(lumitexels)
    lazy = estimate_diffuse_reflectance(lumitexels.chunk(surfel=11)).compute()
    for name in eager:
        np.testing.assert_allclose(lazy[name].values, eager[name].values, rtol=1e-5)


def _of_surfels(skin, *, eta=1.3):
    """R_d (3, 3) of three surfels, and its error."""
    arrays = {
        "reflectance_sample": skin.sample,
        "surfel_position": skin.position,
        "light_position": skin.light,
        "camera_position": skin.camera,
        "shading_normal": skin.normal,
    }
    return block_reflectance(arrays, eta=eta)[:2]


@pytest.mark.parametrize("eta", [1.0, 1.3])
@pytest.mark.parametrize(
    ("dtype", "tolerance"),
    [("float16", 1e-3), pytest.param("float32", 1e-5, marks=pytest.mark.slow)],
)
def test_block_reflectance__2400_samples_of_matte_skin(eta, dtype, tolerance):
    skin = surfels(150, 16, eta=eta, weight=MATTE, dtype=dtype)
    estimate, _ = _of_surfels(skin, eta=eta)
    np.testing.assert_allclose(estimate, skin.diffuse, rtol=tolerance)


def test_block_reflectance__one_or_two_samples_are_too_few():
    for lights in (1, 2):
        assert np.isnan(_of_surfels(surfels(lights, 1))).all()


def test_block_reflectance__broken_samples():
    skin = surfels()
    estimate, _ = _of_surfels(skin.filled(np.nan))
    assert np.isnan(estimate[0]).all()
    expected, _ = _of_surfels(skin)
    np.testing.assert_allclose(estimate[1:], expected[1:], rtol=1e-7)
    matte = surfels(weight=MATTE)
    for value in (np.nan, np.inf):
        estimate, _ = _of_surfels(matte.spoiled(value))
        np.testing.assert_allclose(estimate, matte.diffuse, rtol=2e-3)


@pytest.mark.slow
def test_block_reflectance__any_scale_is_clamped_to_the_range_of_eq_5():
    skin = surfels(weight=MATTE, dtype=np.float32)
    for factor in (0.0, 1e-30, 1e3, 1e30):
        estimate, _ = _of_surfels(skin.scaled(factor))
        limit = SMALLEST_R_D if factor < 1 else LARGEST_R_D
        np.testing.assert_allclose(estimate, limit, rtol=1e-6)


@pytest.mark.slow
def test_block_reflectance__half_floats_have_the_same_result_in_any_precision():
    skin = surfels()
    expected, _ = _of_surfels(skin)
    for dtype in (np.float32, np.float64):
        typed = replace(skin, sample=skin.sample.astype(dtype))
        np.testing.assert_allclose(_of_surfels(typed)[0], expected, rtol=1e-6)


def test_block_reflectance__no_surfels():
    assert _of_surfels(surfels().empty)[0].shape == (0, 3)
