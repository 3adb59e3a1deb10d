"""Common errors of the lights of takes, from numbers that are written down and from
virtual skin.
"""

from __future__ import annotations

import numpy as np
import pytest

from skindb.fit import estimate_camera_gains, light_residuals
from skindb.fit.corrections import LightErrors, gain_spread
from skindb.fit.rig import Common, common_camera_gains, common_light_errors
from skindb.schema import label

DISTANCE_MM = 880.0  # of the lights of virtual skin


def brightened(skin, factors):
    """Samples with the true normals, times factors."""
    sample = skin.lumitexels["reflectance_sample"].values.astype(np.float32)
    return skin.lumitexels.assign(
        surfel_normal=label("surfel_normal", skin.normal.astype(np.float32)),
        reflectance_sample=label(
            "reflectance_sample", (sample * factors).astype(np.float16)
        ),
    )


def common(gains):
    gains = np.array(gains, float)
    return Common([LightErrors(g, np.zeros((len(g), 3))) for g in gains])


def test_common__are_medians_of_gains_relative_to_their_median():
    truth = np.array([0.9, 1.0, 1.0, 1.2])
    group = common([truth, 3 * truth, 0.5 * truth, [9, 1, 1, 1]])
    np.testing.assert_allclose(group.errors.gain, truth)
    np.testing.assert_array_equal(group.takes, 4)


def test_common__lights_of_two_takes_keep_1():
    nan = np.nan
    group = common(
        [[1.1, 1, 1, nan], [1.1, 1, 1, 2], [1.1, 1, 1, 2], [nan, nan, nan, nan]]
    )
    np.testing.assert_allclose(group.errors.gain, [1.1, 1, 1, 1])
    np.testing.assert_array_equal(group.takes, [3, 3, 3, 2])
    unknown = np.isnan(group.log_error)
    np.testing.assert_array_equal(unknown, [False, False, False, True])
    none = common([[1, 1, nan, nan], [nan, nan, 1, 1]])
    assert np.isnan(none.logs).all()
    np.testing.assert_array_equal(none.errors.gain, 1)


def test_common__errors_and_spreads_are_those_of_normal_values():
    rng = np.random.default_rng(0)
    z, left = [], []
    for _ in range(100):
        planted = rng.normal(0, 0.1, 13)
        group = common(np.exp(planted + rng.normal(0, 0.02, (7, 13))))
        off = np.log(group.errors.gain) - planted
        z.append((off - off.mean()) / group.log_error)
        left.append(np.median(np.std(group.logs - group.others_logs, axis=1)))
    # 1,300 values: 1.04 here; the larger of two deviations is used
    assert 0.85 < np.std(z) < 1.15
    # the median of 6 other takes
    assert np.mean(left) == pytest.approx(0.02 * np.sqrt(1 + 1.57 / 6), rel=0.15)


def test_common__without_common_gains_the_others_make_it_worse():
    gains = np.exp(np.random.default_rng(1).normal(0, 0.05, (9, 4)))
    group = common(gains)
    left = group.logs - group.others_logs
    assert np.median(left.std(axis=1)) > np.median(group.logs.std(axis=1))


def test_gain_spread__is_that_of_random_gains_without_what_is_linear_over_the_dome():
    rng = np.random.default_rng(0)
    towards = rng.standard_normal((500, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    random = rng.normal(0, 0.05, 500)
    smooth = 0.3 + towards @ [0.1, -0.2, 0.4]
    random[0] = np.nan
    # 3 standard errors of 500 values
    assert gain_spread(random + smooth, towards) == pytest.approx(0.05, rel=0.1)
    assert gain_spread(smooth, towards) < 1e-12
    few = gain_spread(np.array([0.0, 0.02, 0.04]), towards[:3])
    assert few == pytest.approx(0.02)
    assert np.isnan(gain_spread(np.array([np.nan, 1.0]), towards[:2]))


def test_common_light_errors__right_lights_stay_although_the_estimates_are_alike(
    new_skin,
):
    """Gains of 1 % that all takes have in common, as bounced light makes them, are not
    those of lamps.
    """
    common = np.exp(0.01 * np.random.default_rng(4).standard_normal(30))
    takes = []
    for seed in range(3):
        skin = new_skin(surfels=100, lights=30, cameras=4, noise=0.01, seed=seed)
        samples = brightened(skin, common[:, None, None])
        takes.append(light_residuals(samples, rng=np.random.default_rng(0)))
    names = [str(k) for k in range(30)]
    position = skin.lumitexels["light_position"].values
    group = common_light_errors(takes, lights=names, positions=position)
    assert 0.005 < group["rig_spread"] < 0.02
    assert group["rig_spread_left"] < 0.5 * group["rig_spread"]
    assert (group["rig_light_gain"] == 1).all()
    assert np.isnan(group["rig_light_gain_error"]).all()


@pytest.mark.parametrize("degrees", [0.0, 1.0])
def test_common_light_errors__turned_lights_are_found_and_others_stay(
    new_skin, degrees
):
    """Four takes with gains of 8 %. Lights that are all turned alike are normals that
    are, which leaves 0.4 of 1 degree here.
    """
    lights = 60
    rng = np.random.default_rng(0)
    gain = np.exp(0.08 * rng.standard_normal(lights))
    takes = []
    turn = degrees * rng.standard_normal((lights, 3))
    for seed in range(4):
        skin = new_skin(surfels=300, lights=lights, noise=0.01, seed=10 + seed)
        position = skin.lumitexels["light_position"].values.astype(float)
        towards = position / DISTANCE_MM
        across = turn - (turn * towards).sum(axis=1, keepdims=True) * towards
        offset = DISTANCE_MM * np.radians(across / np.sqrt(2))
        sample = skin.lumitexels["reflectance_sample"].values.astype(np.float32)
        session = gain * np.exp(0.02 * rng.standard_normal(lights))
        bright = (sample * session[:, None, None]).astype(np.float16)
        stated = position - offset
        planted = skin.lumitexels.assign(
            surfel_normal=label("surfel_normal", skin.normal.astype(np.float32)),
            reflectance_sample=label("reflectance_sample", bright),
            light_position=label("light_position", stated.astype(np.float32)),
        )
        takes.append(light_residuals(planted, rng=np.random.default_rng(0)))
    names = [str(k) for k in range(lights)]
    group = common_light_errors(takes, lights=names, positions=stated)
    left = np.linalg.norm(group["rig_light_offset"].values - offset, axis=1)
    assert np.degrees(np.sqrt(np.square(left / DISTANCE_MM).mean())) <= 0.5 * degrees
    # 2 % of a session in the median of four, and gloss beyond 25 degrees
    off = np.log(group["rig_light_gain"].values / gain)
    assert (off - np.median(off)).std() < 0.02
    alone, both = group["rig_misfit"].values
    assert both < alone < 0.6 or degrees == 0
    known = np.isfinite(group["rig_light_angle_error"].values)
    assert known.all() == (degrees > 0)


def test_misfit__does_not_depend_on_lights_that_a_take_does_not_show(new_skin):
    """Nor on a factor of all gains, which the albedo has, too."""
    skin = new_skin(surfels=50, lights=20, cameras=4)
    samples = skin.lumitexels.assign(
        surfel_normal=label("surfel_normal", skin.normal.astype(np.float32))
    )
    take = light_residuals(samples, rng=np.random.default_rng(0))
    gain = np.exp(0.05 * np.random.default_rng(1).standard_normal(20))
    alone = take.misfit(LightErrors(1.1 * gain, np.zeros((20, 3))))
    padded = take.of_lights(np.arange(5, 25)[::-1].tolist(), 30)
    all_gains = np.full(30, 0.7)
    all_gains[5:25] = gain[::-1]
    there = padded.misfit(LightErrors(all_gains, np.zeros((30, 3))))
    assert there == pytest.approx(alone, rel=1e-9)
    none = take.misfit(LightErrors(np.full(20, np.nan), np.full((20, 3), np.nan)))
    assert none == take.misfit(LightErrors(np.ones(20), np.zeros((20, 3))))


@pytest.mark.parametrize("spread", [0.0, 0.1])
def test_common_camera_gains__are_found_and_those_of_perfect_cameras_are_1(
    new_skin, spread
):
    """Three takes; what several cameras see of glossy skin away from its highlights
    differs by 0.3 %.
    """
    planted = np.exp(spread * np.random.default_rng(2).standard_normal((6, 3)))
    planted /= np.median(planted, axis=0)
    takes = []
    for seed in range(3):
        skin = new_skin(surfels=200, lights=40, cameras=6, noise=0.01, seed=seed)
        samples = brightened(skin, planted)
        takes.append(estimate_camera_gains(samples, rng=np.random.default_rng(0)))
    group = common_camera_gains(takes)
    gain = group["rig_camera_gain"].values
    np.testing.assert_allclose(gain, planted, rtol=0.012 if spread else 0)
    known = np.isfinite(group["rig_camera_gain_error"].values)
    assert known.all() == (spread > 0)
    # cameras that fewer than three takes have, and gains that are not common
    few = common_camera_gains([takes[0].isel(camera=slice(4)), *takes[1:]])
    np.testing.assert_array_equal(few["rig_camera_gain"].values[4:], 1)
    apart = common_camera_gains([take.roll(camera=k) for k, take in enumerate(takes)])
    np.testing.assert_array_equal(apart["rig_camera_gain"].values, 1)


def test_estimate_camera_gains__one_camera_has_none(new_skin):
    skin = new_skin(surfels=50, lights=20, cameras=1)
    samples = skin.lumitexels.assign(
        surfel_normal=label("surfel_normal", skin.normal.astype(np.float32))
    )
    gains = estimate_camera_gains(samples, rng=np.random.default_rng(0))
    assert np.isnan(gains).all()
    group = common_camera_gains([gains] * 3)
    assert (group["rig_camera_gain"] == 1).all()
    assert np.isnan(group["rig_camera_spread"])


def test_estimate_camera_gains__none_with_polarisers(new_skin):
    """Crossed and parallel cameras see different parts of the light from the surface."""
    skin = new_skin(surfels=50, lights=20, cameras=4)
    samples = skin.lumitexels.assign(
        surfel_normal=label("surfel_normal", skin.normal.astype(np.float32)),
        light_polarisation=label("light_polarisation", np.ones(20, np.float32)),
        camera_polarisation=label(
            "camera_polarisation", np.array([1, -1, 1, -1], np.float32)
        ),
    )
    gains = estimate_camera_gains(samples, rng=np.random.default_rng(0))
    assert np.isnan(gains).all()
