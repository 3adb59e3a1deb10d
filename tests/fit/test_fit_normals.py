"""Normals: recovery of the truth, laws, and surfels without a result."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from three_surfels import MATTE, SCALES, surfels, unit

from skindb.errors import InputError
from skindb.fit import estimate_normals, lumitexels
from skindb.fit.normals import surfel_normals


def _angles(found, true):
    return np.degrees(np.arccos(np.clip(np.einsum("nk,nk->n", found, true), -1, 1)))


def test_estimate_normals__recovers_truth(skin):
    found = estimate_normals(skin.lumitexels)
    # degrees; 60 lights are 13 apart
    assert np.median(_angles(found["shading_normal"].values, skin.normal)) < 0.3
    np.testing.assert_allclose(
        np.linalg.norm(found["shading_normal"], axis=1), 1, atol=1e-6
    )


def test_estimate_normals__error_falls_with_noise(new_skin):
    errors = []
    for noise in (0.05, 0.0):
        skin = new_skin(noise=noise)
        errors.append(
            np.median(
                _angles(
                    estimate_normals(skin.lumitexels)["shading_normal"].values,
                    skin.normal,
                )
            )
        )
    assert errors[1] < 0.5 * errors[0]
    assert errors[1] < 0.25


def test_estimate_normals__colourless_skin_falls_back_on_shading(new_skin):
    grey = new_skin(grey=True, noise=0.003)
    found = estimate_normals(grey.lumitexels)["shading_normal"].values
    assert np.median(_angles(found, grey.normal)) < 0.8


def test_estimate_normals__colour_below_the_noise_is_ignored(new_skin):
    """Under 12 lights and one camera, without a scan."""
    grey = new_skin(grey=True, noise=0.04, gloss=0.0, lights=60)
    part = grey.lumitexels.isel(light=slice(0, 36, 3), camera=[0])
    found = estimate_normals(part, scan_error=60.0)["shading_normal"].values
    samples = part["reflectance_sample"].copy(data=_without_colour(part))
    shaded = part.assign(reflectance_sample=samples)
    alone = estimate_normals(shaded, scan_error=60.0)["shading_normal"].values
    means = [np.nanmean(_angles(n, grey.normal)) for n in (alone, found)]
    assert means[1] < 1.02 * means[0]


def _without_colour(part):
    """The mean over the channels, of which the photometric estimate is alone."""
    sample = part["reflectance_sample"].values
    mean = sample.astype(np.float32).mean(axis=-1, keepdims=True)
    return np.broadcast_to(mean, sample.shape).astype(sample.dtype)


def test_estimate_normals__rotates_with_the_scene(skin):
    turn = Rotation.from_rotvec([0.3, -0.5, 0.8])
    names = ("surfel_position", "surfel_normal", "light_position", "camera_position")
    moved = skin.lumitexels.copy()
    for name in names:
        moved[name] = moved[name].copy(
            data=turn.apply(moved[name].values).astype(np.float32)
        )
    still, turned = (
        estimate_normals(x)["shading_normal"].values for x in (skin.lumitexels, moved)
    )
    # float32 positions of 880 mm: 1e-7 relative
    np.testing.assert_allclose(turned, turn.apply(still), atol=2e-4)


def test_estimate_normals__does_not_depend_on_brightness(skin):
    bright = skin.lumitexels.assign(
        reflectance_sample=skin.lumitexels["reflectance_sample"] * np.float16(4)
    )
    bright["reflectance_sample"].attrs = skin.lumitexels["reflectance_sample"].attrs
    once, twice = (
        estimate_normals(x)["shading_normal"].values for x in (skin.lumitexels, bright)
    )
    # half floats round small samples more
    np.testing.assert_allclose(once, twice, atol=2e-4)


def test_estimate_normals__unseen_surfel_is_nan_and_leaves_others_alone(skin):
    sample = skin.lumitexels["reflectance_sample"].copy(deep=True)
    sample[3] = np.nan
    holed = skin.lumitexels.assign(reflectance_sample=sample)
    whole = estimate_normals(skin.lumitexels)["shading_normal"].values
    found = estimate_normals(holed)
    assert np.isnan(found["shading_normal"].values[3]).all()
    for name in ("normal_error", "normal_total_error"):
        assert np.isnan(found[name].values[3])
    others = np.arange(len(whole)) != 3
    np.testing.assert_allclose(
        found["shading_normal"].values[others], whole[others], atol=1e-6
    )


def test_estimate_normals__few_lights_lean_on_the_scan(skin):
    two = skin.lumitexels.isel(light=[0, 1])
    found = estimate_normals(two)["shading_normal"].values
    known = np.isfinite(found).all(axis=1)
    assert known.any()
    assert _angles(found[known], skin.normal[known]).max() < 15


def test_estimate_normals__error_covers_noise_and_scan(new_skin):
    skin = new_skin(surfels=300, gloss=0.0, noise=0.03)
    found = estimate_normals(skin.lumitexels)
    angle = _angles(found["shading_normal"].values, skin.normal)
    error = found["normal_error"].values
    # two equal axes: 95 % below 1.73 of the RMS angle (chi-square of two degrees of
    # freedom; unequal axes have up to 3 % less); 300 surfels know the share to 1.3 %,
    # three of which are allowed
    assert 0.95 - 0.03 - 0.038 < (angle < 1.73 * error).mean() < 0.95 + 0.038
    # the size itself: the RMS over surfels is known to 4 %
    assert 0.88 < np.sqrt((angle**2).mean() / (error**2).mean()) < 1.12
    # half of this error would cover 53 %
    assert (angle < 1.73 / 2 * error).mean() < 0.75
    assert (found["normal_total_error"].values > 3 * error).all()


def test_estimate_normals__error_has_the_size_of_the_noise(new_skin):
    """Rationale: matte skin, no prior: noise alone. Expected: RMS angle over RMS error
    1; 600 surfels give it to 2 %.

    Without the slope of F_t it is 0.8; without the common noise of both signals it is
    1.13 for the combined one.
    """
    skin = new_skin(surfels=600, gloss=0.0, noise=0.05)
    found = estimate_normals(skin.lumitexels, scan_error=1e3)
    angle = _angles(found["shading_normal"].values, skin.normal)
    error = found["normal_error"].values
    assert abs(np.sqrt((angle**2).mean() / (error**2).mean()) - 1) < 0.06
    # three times what 600 surfels know the share to
    assert abs((angle < 1.73 * error).mean() - 0.95) < 0.027


def test_estimate_normals__error_follows_the_scan_where_lights_are_few(skin):
    few = skin.lumitexels.isel(light=[0, 1, 2])
    errors = [
        estimate_normals(few, scan_error=e)["normal_error"].values for e in (1.0, 5.0)
    ]
    known = np.isfinite(errors).all(axis=0)
    # five times the scan's error; what the slope of F_t adds leaves it a little less
    # than a ratio of 1.5
    assert np.median(errors[1][known] / errors[0][known]) > 1.4


@pytest.mark.parametrize("chunk", [7, 40])
def test_estimate_normals__any_chunking(skin, chunk):
    eager = estimate_normals(skin.lumitexels)
    lazy = estimate_normals(skin.lumitexels.chunk(surfel=chunk))
    assert lazy["shading_normal"].chunks is not None
    # sums over other batch shapes round differently
    np.testing.assert_allclose(
        lazy["shading_normal"].values, eager["shading_normal"].values, atol=1e-5
    )


def test_lumitexels__names_every_missing_variable():
    import xarray as xr

    with pytest.raises(InputError, match="reflectance_sample") as caught:
        lumitexels(xr.DataTree.from_dict({"/surfels": xr.Dataset()}))
    assert len(caught.value.faults) == 8


# extreme inputs


def _normals(skin, *, eta=1.3, scan=None):
    """Normals (3, 3) from a scan that is off by three degrees."""
    scan = _scan(skin) if scan is None else scan
    geometry = skin.position, skin.light, skin.camera, scan
    return surfel_normals(skin.sample, *geometry, eta=eta, scan_error=3.0)[0]


def _scan(skin):
    return unit(skin.normal + np.deg2rad(3.0) * np.array([0.6, 0.8, 0.0]))


@pytest.mark.parametrize("eta", [1.0, 1.3])
def test_estimate_normals__2400_samples_of_matte_skin(eta):
    skin = surfels(150, 16, eta=eta, weight=MATTE)
    assert _angles(_normals(skin, eta=eta), skin.normal).max() < 0.5


def test_estimate_normals__black_and_saturated_surfels_leave_the_others_alone():
    expected = _normals(surfels())
    for value in (0.0, np.nan):
        estimate = _normals(surfels().filled(value))
        assert np.isnan(estimate[0]).all()
        np.testing.assert_allclose(estimate[1:], expected[1:], atol=1e-7)


def test_estimate_normals__one_or_three_samples_give_nan_or_lie_near_the_scan():
    for lights in (1, 3):
        skin = surfels(lights, 1)
        estimate = _normals(skin)
        finite = np.isfinite(estimate).all(axis=1)
        length = np.linalg.norm(estimate[finite], axis=1)
        np.testing.assert_allclose(length, 1.0, atol=1e-6)
        angle = _angles(estimate[finite], _scan(skin)[finite])
        assert (angle < 10).all()


@pytest.mark.slow
def test_estimate_normals__any_scale_of_the_samples():
    skin = surfels(weight=MATTE, dtype=np.float32)
    expected = _normals(skin)
    for scale in SCALES:
        estimate = _normals(skin.scaled(scale))
        np.testing.assert_allclose(estimate, expected, atol=1e-5)


def test_estimate_normals__one_broken_sample_changes_little():
    skin = surfels(weight=MATTE)
    for value in (np.nan, np.inf):
        assert _angles(_normals(skin.spoiled(value)), skin.normal)[0] < 0.5


def test_estimate_normals__constant_samples_give_unit_vectors_or_nan():
    skin = surfels().with_sample(np.s_[:], 0.2)
    length = np.linalg.norm(_normals(skin), axis=1)
    assert (np.isnan(length) | (np.abs(length - 1) < 1e-6)).all()


def test_estimate_normals__without_a_normal_of_the_scan_is_nan():
    scan = np.full((3, 3), np.nan)
    assert np.isnan(_normals(surfels(weight=MATTE), scan=scan)).all()


def test_estimate_normals__no_surfels():
    assert _normals(surfels().empty).shape == (0, 3)
