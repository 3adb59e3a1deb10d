"""Joint refinement: planted normals, R_d and lobes of an independent renderer, outliers,
stated errors, and what no sample shows.
"""

from __future__ import annotations

import numpy as np
import pytest
from planted_skin import ETA, make_skin

from skindb.fit import (
    estimate_diffuse_reflectance,
    estimate_normals,
    refine_jointly,
)
from skindb.reflectance.joint import refine_block
from skindb.reflectance.lobes import GRADED_ROUGHNESS
from skindb.reflectance.model import (
    MIN_LOBE_WIDTH,
    UNKNOWN_NOISE,
    Block,
    Comparison,
)

COMPARISON = Comparison("perceptual", ETA, 2e-3, 10, MIN_LOBE_WIDTH)
FAR_MM = 1e6
R_D = np.array([0.5, 0.3, 0.2])
STRENGTH = 1.2
LOBE = 3  # of GRADED_ROUGHNESS
# half floats have a relative error of 5e-4
HALF_FLOAT = 1e-3


def _unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _fresnel(cosine, index):
    """Exact reflectance of a dielectric, from Snell's law."""
    c = np.clip(cosine, 1e-9, 1)
    t = np.sqrt(1 - (1 - c**2) / index**2)
    s = (c - index * t) / (c + index * t)
    p = (t - index * c) / (t + index * c)
    return (s**2 + p**2) / 2


def _directions(count, steepest, rng):
    z = rng.uniform(steepest, 1, count)
    phi = rng.uniform(0, 2 * np.pi, count)
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)


def _samples(
    normal, light, camera, roughness=GRADED_ROUGHNESS[LOBE], strength=STRENGTH
):
    """Samples (n, light, camera, 3) by the textbook form of GGX with Smith's joint masking."""
    wi = light[None, :, None]
    wo = camera[None, None]
    n = normal[:, None, None]
    h = _unit(wi + wo)
    ci, co, ch = ((n * w).sum(-1) for w in (wi, wo, h))
    cd = (wi * h).sum(-1)
    a2 = roughness**2
    spread = a2 / (np.pi * (ch**2 * (a2 - 1) + 1) ** 2)
    tan_i, tan_o = (np.sqrt(np.maximum(1 / c**2 - 1, 0)) for c in (ci, co))
    hidden = sum((np.sqrt(1 + a2 * t**2) - 1) / 2 for t in (tan_i, tan_o))
    lobe = _fresnel(cd, 1.4) * spread / (1 + hidden) / (4 * ci * co)
    enters, leaves = (1 - _fresnel(c, ETA) for c in (ci, co))
    value = enters[..., None] * leaves[..., None] * R_D / np.pi
    value = ci[..., None] * (value + strength * lobe[..., None])
    seen = (ci > 0) & (co > 0)
    return np.where(seen[..., None], value, np.nan)


@pytest.fixture(scope="module")
def dome():
    rng = np.random.default_rng(4)
    light = _directions(80, 0.3, rng)
    camera = _directions(10, 0.6, rng)
    return light, camera


def _refined(sample, normal, dome, diffuse=R_D, noise=None, scan_error=1.0):
    n = len(normal)
    light, camera = (FAR_MM * w for w in dome)
    block = Block(
        sample.astype(np.float16),
        np.zeros((n, 3)),
        light,
        camera,
        normal,
        np.tile(diffuse, (n, 1)),
        noise or UNKNOWN_NOISE,
    )
    scan = np.tile([0.0, 0.0, 1.0], (n, 1))
    return refine_block(block, COMPARISON, scan_normal=scan, scan_error=scan_error)


def _angle(a, b):
    return np.degrees(np.arccos(np.clip((a * b).sum(-1), -1, 1)))


def _normals(n, spread, rng):
    return _unit(np.array([0, 0, 1.0]) + spread * rng.normal(size=(n, 3)))


def test_refine_block__returns_planted_parameters(dome):
    normal = _normals(20, 0.1, np.random.default_rng(1))
    refined = _refined(_samples(normal, *dome), normal, dome, diffuse=1.3 * R_D)
    assert _angle(refined.normal, normal).max() < 0.02
    np.testing.assert_allclose(refined.diffuse, np.tile(R_D, (20, 1)), rtol=3e-3)
    np.testing.assert_allclose(refined.strength[:, LOBE], STRENGTH, rtol=0.02)
    assert (refined.kkt < 1e-6).all()


def test_refine_block__turns_the_normal_by_seven_tenths_of_the_way_beside_a_scan(dome):
    rng = np.random.default_rng(2)
    normal = _normals(20, 0.1, rng)
    start = _unit(normal + np.radians(1.5) * rng.normal(size=normal.shape) / 1.4)
    # of a scan, whose prior has no weight beside exact samples; curvature of the peak adds
    # to 0.3
    for scan_error, low, high in ((0.1, 0.2, 0.4), (1.0, 0.0, 0.01)):
        refined = _refined(_samples(normal, *dome), start, dome, scan_error=scan_error)
        ratio = _angle(refined.normal, normal) / _angle(start, normal)
        assert low < np.median(ratio) < high


def test_refine_block__is_robust_against_shadows(dome):
    rng = np.random.default_rng(3)
    normal = _normals(20, 0.1, rng)
    sample = _samples(normal, *dome)
    sample[:, rng.random(80) < 0.1] *= 0.3  # whole lights, partly hidden
    refined = _refined(sample, normal, dome)
    error = np.abs(refined.diffuse / R_D - 1)
    assert np.median(error) < 2 * HALF_FLOAT
    assert _angle(refined.normal, normal).max() < 0.1


def test_refine_block__has_no_lobe_narrower_than_what_was_seen(dome):
    light, camera = dome
    normal = _normals(40, 0.2, np.random.default_rng(5))
    half = _unit(light[None, :, None] + camera[None, None])
    cosine = np.einsum("nk,nlck->nlc", normal, half)
    sample = _samples(normal, light, camera, roughness=0.05)
    sample[cosine > np.cos(np.radians(8))] = np.nan
    refined = _refined(sample, normal, dome)
    nearest = np.arccos(np.where(np.isfinite(sample[..., 0]), cosine, 0).max((1, 2)))
    width = (
        0.6436 * GRADED_ROUGHNESS
    )  # tan of the half width of GGX: roughness sqrt(sqrt 2 - 1)
    narrow = width < 2 / 3 * nearest[:, None]
    assert narrow.any()
    assert (refined.strength[narrow] == 0).all()


def test_refine_block__states_the_errors_of_noise(dome):
    rng = np.random.default_rng(6)
    normal = _normals(300, 0.1, rng)
    sample = _samples(normal, *dome)
    sample = sample * (1 + 0.02 * rng.normal(size=sample.shape))
    refined = _refined(sample, normal, dome)
    z = (refined.diffuse - R_D) / refined.diffuse_error
    # 300 surfels: the error of a standard deviation is 4 %; strengths at their bound
    # make it smaller
    assert 0.75 < z.std() < 1.15
    assert (refined.diffuse_shared >= refined.diffuse_error).all()
    angle = np.radians(_angle(refined.normal, normal))
    assert 0.8 < np.sqrt((angle**2).mean()) / np.median(refined.normal_error) < 1.2


def test_refine_jointly__keeps_estimates_of_surfels_with_few_samples():
    skin = make_skin(surfels=6)
    samples = skin.lumitexels
    samples = samples.merge(estimate_normals(samples, eta=ETA))
    samples = samples.merge(estimate_diffuse_reflectance(samples, eta=ETA))
    few = samples.isel(light=slice(0, 1), camera=slice(0, 2))
    refined = refine_jointly(few, eta=ETA)
    for name in refined:
        np.testing.assert_array_equal(refined[name].values, few[name].values)


def test_refine_jointly__states_a_total_error_above_that_of_noise():
    skin = make_skin(surfels=12)
    samples = skin.lumitexels
    samples = samples.merge(estimate_normals(samples, eta=ETA))
    samples = samples.merge(estimate_diffuse_reflectance(samples, eta=ETA))
    refined = refine_jointly(samples, eta=ETA)
    assert (refined["normal_total_error"] > refined["normal_error"]).all()
    angle = _angle(refined["shading_normal"].values, skin.normal)
    assert (angle < 1.73 * refined["normal_total_error"].values).mean() > 0.8


def test_refine_block__one_camera_alone_shares_no_error(dome):
    """The sum over all samples is the gradient, which a damped step leaves."""
    rng = np.random.default_rng(7)
    normal = _normals(30, 0.1, rng)
    light, camera = dome
    one = (light, camera[:1])
    start = _unit(normal + np.radians(3) * rng.normal(size=normal.shape))
    refined = _refined(_samples(normal, *one), start, one)
    ratio = refined.normal_shared / refined.normal_error
    # each light has one sample: the same errors, up to the number of lights
    assert np.nanmax(ratio) < 1.1
