"""Maps of group differences: planted patches, false positives, texels that some takes lack."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from skindb.analysis import (
    describe_effect_maps,
    effect_maps,
    plot_effect_maps,
    tabulate_effect_maps,
)
from skindb.errors import InputError
from skindb.numerics.inference import effects

SIZE = 32
STEP = 0.2  # of R_d in the patch
PATCH = (slice(8, 16), slice(8, 16))


def cohort(n=24, step=STEP, seed=0, confounded=False):
    """Maps of n subjects, half of them men, who are darker in a patch."""
    rng = np.random.default_rng(seed)
    men = np.arange(n) % 2 == 1
    age = 20.0 + 40 * rng.random(n) + (20 * men if confounded else 0)
    albedo = (
        0.4
        + 0.05 * rng.standard_normal((n, SIZE, SIZE, 3))
        + 0.05 * rng.standard_normal((n, 1, 1, 1))
    )
    albedo[men, PATCH[0], PATCH[1]] -= step
    if confounded:
        albedo -= 0.005 * (age - 40)[:, None, None, None]
    sigma = np.exp(0.1 * rng.standard_normal((n, SIZE, SIZE, 3)))
    sigma[men] *= 1.5
    dims = ("take", "v", "u")
    return xr.Dataset(
        {
            "texel_diffuse_reflectance": (
                (*dims, "channel"),
                albedo.astype(np.float32),
            ),
            "texel_sigma_tr": ((*dims, "channel"), sigma.astype(np.float32)),
            "texel_coverage": (dims, np.ones((n, SIZE, SIZE), np.float32)),
        },
        coords={
            "take": [f"S{i}" for i in range(n)],
            "subject": ("take", np.array([f"S{i}" for i in range(n)], object)),
            "condition": ("take", np.array(["normal"] * n, object)),
            "gender": ("take", np.where(men, "male", "female").astype(object)),
            "age": ("take", age),
        },
    )


def maps_of(ds, group_by="gender", **options):
    return effect_maps(
        ds,
        group_by=group_by,
        **(
            {"size": SIZE, "permutations": 200, "rng": np.random.default_rng(1)}
            | options
        ),
    )


def test_effect_maps__find_the_planted_patch_and_nothing_else():
    found = maps_of(cohort()).sel(contrast="male less female")
    differ = (found["map_effect_p_adjusted"].sel(quantity="R_d G") < 0.05).values
    assert differ[PATCH].mean() > 0.95
    differ[PATCH] = False
    assert not differ.any()
    effect = found["map_effect"].sel(quantity="R_d G").values
    # 0.05 of the level differs between subjects
    assert effect[PATCH].mean() == pytest.approx(-STEP, abs=0.06)
    sigma_tr = found.sel(quantity="sigma_tr R")
    np.testing.assert_allclose(sigma_tr["map_effect"].mean(), np.log(1.5), atol=0.01)
    # it is interpolated between a few sites
    assert sigma_tr["map_effect_p"].isnull().all()
    assert (found["map_effect_count"] == 24).all()


def test_effect_maps__texels_are_regressions_of_their_own():
    """One texel is compared with `effects`, which is itself tested against statsmodels."""
    ds = cohort()
    found = (
        maps_of(ds, adjust=["age"])
        .sel(contrast="male less female", quantity="R_d R")
        .isel(v=9, u=20)
    )
    value = ds["texel_diffuse_reflectance"].values[:, 9, 20, 0].astype(np.float64)
    men = (ds["gender"].values == "male").astype(float)
    want = effects(value[:, None], men, ds["age"].values[:, None])
    assert float(found["map_effect"]) == pytest.approx(float(want.slope[0]), rel=1e-5)
    assert float(found["map_effect_half_width"]) == pytest.approx(
        float(want.high[0] - want.slope[0]), rel=1e-5
    )


@pytest.mark.slow
def test_effect_maps__family_wise_errors():
    """Of 60 cohorts without any difference, about 5 % have a texel that differs
    (binomial, 99.9 %).
    """
    found = [
        maps_of(
            cohort(16, step=0.0, seed=seed).drop_vars("texel_sigma_tr"),
            permutations=100,
            size=8,
            rng=np.random.default_rng(seed),
        )["map_effect_p_adjusted"].min()
        for seed in range(60)
    ]
    assert sum(one < 0.05 for one in found) <= 10


def test_effect_maps__a_confounder_is_held_fixed():
    plain, held = (
        maps_of(cohort(60, step=0.0, confounded=True), adjust=adjust)
        .sel(quantity="R_d G")["map_effect"]
        .mean()
        for adjust in ((), ("age",))
    )
    assert float(plain) < -0.07
    assert abs(float(held)) < 0.03  # 0.05 of the level over 60 subjects is 0.013


def test_effect_maps__blocks_are_means_of_what_is_measured():
    ds = cohort(8)
    ds["texel_coverage"][:, 0, 0] = 0
    ds["texel_diffuse_reflectance"][:, 0, 0] = 100.0
    found = maps_of(ds, size=SIZE // 2).sel(
        contrast="male less female", quantity="R_d G"
    )["map_effect"]
    other = ds["texel_diffuse_reflectance"].values[..., 1].astype(np.float64)
    block = (other[:, 0, 1] + other[:, 1, 0] + other[:, 1, 1]) / 3
    men = ds["gender"].values == "male"
    assert float(found[0, 0]) == pytest.approx(
        block[men].mean() - block[~men].mean(), rel=1e-4
    )


def test_effect_maps__too_few_subjects_make_no_texel():
    """Each take lacks a different row; a texel that two thirds of the takes lack is excluded."""
    ds = cohort(12)
    ds["texel_coverage"][:8, 4] = 0
    for take in range(12):
        ds["texel_coverage"][take, 10 + take] = 0
    found = maps_of(ds).sel(contrast="male less female", quantity="R_d G")
    assert np.isnan(found["map_effect"][4]).all()
    assert np.isnan(found["map_effect_p_adjusted"][4]).all()
    assert np.isfinite(found["map_effect"][10:22]).all()
    assert (found["map_effect_count"][10:22] == 11).all()
    ds["texel_coverage"][:] = 0
    with pytest.raises(
        InputError, match="no texel with values of 80% of the 12 subjects"
    ):
        maps_of(ds)


@pytest.mark.slow
def test_effect_maps__conditions_within_subjects_and_numbers():
    ds = cohort(12)
    other = ds.assign(texel_diffuse_reflectance=ds["texel_diffuse_reflectance"] + 0.1)
    other = other.assign_coords(
        take=[f"{take}.lotion" for take in ds["take"].values],
        condition=("take", np.array(["lotion"] * 12, object)),
    )
    both = xr.concat([ds, other], "take")
    found = maps_of(both, group_by="condition").sel(contrast="lotion less normal")
    np.testing.assert_allclose(
        found["map_effect"].sel(quantity="R_d B"), 0.1, atol=1e-6
    )
    np.testing.assert_allclose(
        found["map_effect"].sel(quantity="sigma_tr B"), 0.0, atol=1e-6
    )
    assert "age, per unit" in maps_of(ds, group_by="age")["contrast"].values


def test_effect_maps__refuses_what_cannot_be():
    with pytest.raises(InputError, match="must divide the 32 texels"):
        maps_of(cohort(8), size=24)
    with pytest.raises(InputError, match="slope: must be known at texels"):
        maps_of(cohort(8), quantities=["R_d", "RMS slope"])
    with pytest.raises(InputError, match="two groups"):
        maps_of(cohort(8).isel(take=slice(0, None, 2)))


def test_effect_maps__texels_that_repeats_do_not_confirm_have_no_p_values():
    """Six subjects, three times: texels differ by 0.05 between subjects in a half and by
    0.2 between takes in the other.
    """
    ds = cohort(18).drop_vars("texel_sigma_tr")
    own = np.repeat([f"S{i}" for i in range(6)], 3)
    rng = np.random.default_rng(2)
    noise = np.where(np.arange(SIZE) < SIZE // 2, 0.002, 0.2)[:, None, None]
    values = np.repeat(0.05 * rng.standard_normal((6, SIZE, SIZE, 3)), 3, axis=0)
    values += noise * rng.standard_normal(values.shape)
    ds = ds.assign_coords(
        subject=("take", own),
        gender=("take", np.repeat(["f", "m"], 9)),
    ).assign(texel_diffuse_reflectance=ds["texel_diffuse_reflectance"] * 0 + values)
    found = maps_of(ds).isel(contrast=0).sel(quantity="R_d G")
    has_p = found["map_effect_p"].notnull().mean("u")
    assert (has_p[: SIZE // 2] == 1).all()
    # a reliability above 0.5 by chance: of 6 subjects with the variances 0.05^2 and 0.2^2 / 3
    assert has_p[SIZE // 2 :].mean() < 0.3
    text = " ".join(found.attrs["flags"])
    assert "of the texels have no p values: the reliability is below 0.5" in text
    plain = maps_of(cohort(8)).attrs["flags"]
    assert any("reliability of texels is unknown" in flag for flag in plain)


def test_effect_maps__table_and_plot(tmp_path):
    found = maps_of(cohort())
    header, rows = tabulate_effect_maps(found)
    row = dict(zip(header, rows[1], strict=True))
    assert row["quantity"] == "R_d G"
    assert row["fraction_that_differs"] == pytest.approx(64 / 1024, rel=0.1)
    assert row["largest_effect"] < -STEP
    assert "200 permutations" in describe_effect_maps(found)[0]
    figure = plot_effect_maps(found)
    figure.savefig(tmp_path / "maps.png")
    assert [ax.get_title() for ax in figure.axes[:3]] == [
        "effect on R_d G",
        "half-width of the 95 % CI",
        "subjects",
    ]
