"""Surfels with 2 to 12 samples, without a scan: planted Lambert's law and one lobe under
distant lights and one camera, against NumPy's least squares.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from planted_skin import capture_of, make_skin

from skindb.analysis.summary import summary_tables
from skindb.fit import (
    FitParameters,
    estimate_diffuse_reflectance,
    estimate_gloss,
    estimate_normals,
    fit_model,
    fit_surface,
    refine_jointly,
)
from skindb.fit.gloss import common_lobes, take_gloss
from skindb.reflectance.ggx import GGX
from skindb.reflectance.joint import LOBE_REFLECTANCE, UNKNOWN_GLOSS, Gloss
from skindb.reflectance.lobes import GRADED_ROUGHNESS, SURFACE_INDEX
from skindb.reflectance.mixture import Mixture
from skindb.render.scene import from_model
from skindb.schema import FitStatus, dataset, label

ETA = 1.0  # without a smooth boundary Lambert's law is exact
FAR_MM = 1e6
NO_REGIONS = {}
R_D = np.array([0.5, 0.3, 0.2])
SURFELS = 60
ROUGHNESS = 0.45  # between the widths of two lobes of the joint fit
STRENGTH = 2.0
ISOTROPIC_95 = 1.73  # 95 % of the angles of two equal axes, over their RMS


def _unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _lights(count):
    """Directions around 35 degrees, and from the seventh on at 60."""
    inner = min(count, 6)
    ring = np.repeat(np.radians([35.0, 60.0]), [inner, count - inner])
    ring[:inner:2] -= np.radians(12.0)
    turn = np.concatenate(
        [2 * np.pi * np.arange(n) / max(n, 1) for n in (inner, count - inner)]
    )
    across = np.sin(ring)
    return np.stack([across * np.cos(turn), across * np.sin(turn), np.cos(ring)], 1)


def _lobe(normal, light):
    """GGX times the cosine, by Walter et al. (2007) and Smith's joint masking."""
    view = np.array([0.0, 0.0, 1.0])
    half = _unit(light + view)
    ci, co = normal @ light.T, (normal @ view)[:, None]
    square = ROUGHNESS**2
    spread = square / (np.pi * ((normal @ half.T) ** 2 * (square - 1) + 1) ** 2)
    tails = [np.sqrt(1 + square * (1 / c**2 - 1)) for c in (ci, co)]
    fresnel = ((1.4 - 1) / (1.4 + 1)) ** 2  # nearly constant up to 35 degrees
    return fresnel * spread * (2 / (tails[0] + tails[1])) / (4 * co)


def _planted(light, *, gloss=0.0, noise=0.0, seed=1):
    """Samples of surfels with normals up to 25 degrees from the camera, and the normals."""
    rng = np.random.default_rng(seed)
    normal = _unit(
        np.array([0.0, 0.0, 1.0]) + 0.2 * rng.uniform(-1, 1, (SURFELS, 3)) * [1, 1, 0]
    )
    sample = (normal @ light.T)[:, :, None] * R_D / np.pi
    sample = sample + gloss * _lobe(normal, light)[..., None]
    sample = sample * (1 + noise * rng.normal(size=sample.shape))
    lumitexels = dataset(
        {
            "reflectance_sample": sample[:, :, None],
            "noise_floor": 0.0,
            "surfel_position": np.zeros((SURFELS, 3)),
            "surfel_normal": np.tile([0.0, 0.0, 1.0], (SURFELS, 1)),
            "surfel_area": np.ones(SURFELS),
            "light_position": FAR_MM * light,
            "light_disc_radius": np.zeros(len(light)),
            "camera_position": np.array([[0.0, 0.0, FAR_MM]]),
        },
        coords={
            "channel": ["R", "G", "B"],
            "light": [f"l{i}" for i in range(len(light))],
            "camera": ["c0"],
        },
    )
    return lumitexels, normal


def _fitted(lumitexels, dictionary, scan_error=60.0):
    fitted = lumitexels.merge(
        estimate_normals(lumitexels, eta=ETA, scan_error=scan_error)
    )
    fitted = fitted.merge(estimate_diffuse_reflectance(fitted, eta=ETA))
    gloss = estimate_gloss(lumitexels, eta=ETA, scan_error=scan_error)
    fitted = fitted.assign(
        refine_jointly(fitted, eta=ETA, scan_error=scan_error, gloss=gloss)
    )
    surface = Mixture.of_dictionary(dictionary, rank=6)
    return fitted.merge(fit_surface(fitted, surface=surface, eta=ETA))


def _least_squares(lumitexels, light):
    """Normals and R_d of photometric stereo (Woodham 1980)."""
    sample = lumitexels["reflectance_sample"].values[:, :, 0].astype(np.float64)
    scaled = np.linalg.lstsq(light, sample.mean(axis=2).T, rcond=None)[0].T
    normal = _unit(scaled)
    shape = (normal @ light.T)[..., None] / np.pi
    return normal, (sample * shape).sum(axis=1) / (shape**2).sum(axis=1)


def _angle(a, b):
    return np.degrees(np.arccos(np.clip((a * b).sum(axis=1), -1, 1)))


@pytest.mark.parametrize("count", [3, 4, 6, 8, 12])
def test_few_samples__of_lambert_are_those_of_least_squares(count, small_dictionary):
    light = _lights(count)
    lumitexels, normal = _planted(light)
    fitted = _fitted(lumitexels, small_dictionary)
    expected, diffuse = _least_squares(lumitexels, light)
    status = FitStatus.LAMBERT if count == 3 else FitStatus.FITTED
    assert (fitted["fit_status"] == status).all()
    # the prior of 60 degrees moves normals by up to 0.4
    assert _angle(fitted["shading_normal"].values, expected).max() < 0.5
    assert _angle(fitted["shading_normal"].values, normal).max() < 0.5
    # with 4 to 11, a wide lobe explains a part
    exact = 0.01 if count in (3, 12) else 0.1
    np.testing.assert_allclose(fitted["diffuse_reflectance"], diffuse, rtol=exact)
    weight = fitted["dictionary_weight"].values
    if count == 3:
        assert np.isnan(weight).all()
    else:
        assert np.median(weight.max(axis=1)) < 0.06


@pytest.mark.parametrize("count", [4, 6, 8, 12])
def test_few_samples__of_a_glossy_surface_are_better_than_lambert(
    count, small_dictionary
):
    light = _lights(count)
    lumitexels, normal = _planted(light, gloss=STRENGTH)
    fitted = _fitted(lumitexels, small_dictionary)
    matt, _ = _least_squares(lumitexels, light)
    angle = _angle(fitted["shading_normal"].values, normal)
    # from four to six samples, which a surfel alone needs for its parameters, by the
    # strength that the capture shares: without it they are better by 0.3 to 0.4
    limit = 0.2 if count < 8 else 0.7
    assert np.median(angle) < limit * np.median(_angle(matt, normal))


@pytest.mark.parametrize("count", [4, 6, 8])
def test_estimate_gloss__is_near_the_planted_strength(count):
    """Of four strengths the one that predicts; the planted lobe is narrower."""
    strength = []
    for gloss in (0.0, STRENGTH / 4, STRENGTH):
        lumitexels, _ = _planted(_lights(count), gloss=gloss, noise=0.01)
        prior = estimate_gloss(lumitexels, eta=ETA, scan_error=60.0)
        assert prior.spread == prior.strength / 2
        strength.append(prior.strength)
    level = np.median(R_D)
    assert strength[0] < 1.2 * level
    assert level < strength[1] < 5.0 * level
    assert strength[2] > 14.0 * level


def test_estimate_gloss__is_unknown_for_many_or_too_few_samples():
    for count in (3, 65):
        lumitexels, _ = _planted(_lights(count), gloss=STRENGTH)
        prior = estimate_gloss(lumitexels, eta=ETA, scan_error=60.0)
        assert prior == UNKNOWN_GLOSS


def _rig_lobes(*, gloss, regions=NO_REGIONS):
    """Lobes by region that three takes of other surfels under 24 lights have in common."""
    takes = [
        _planted(_lights(24), gloss=gloss, noise=0.01, seed=s)[0] for s in (7, 8, 9)
    ]
    no_scan = label("scan_normal_error", 60.0)
    takes = [take.assign(scan_normal_error=no_scan) for take in takes]
    known = [take_gloss(take, eta=ETA, regions=regions) for take in takes]
    assert np.isnan(common_lobes(known[:2])["rig_lobe_strength"]).all()
    return common_lobes(known)["rig_lobe_strength"]


def _with_lobes(lumitexels, lobes):
    """With lobes ([n,] 8) of the rig."""
    lobes = np.broadcast_to(lobes, (SURFELS, len(GRADED_ROUGHNESS)))
    return lumitexels.assign(
        lobe_strength_applied=label("lobe_strength_applied", lobes)
    )


@pytest.mark.parametrize("count", [4, 8])
def test_common_lobes__of_a_rig_help_captures_with_few_samples(count, small_dictionary):
    """The planted lobe is narrower than the one that surfels share without a rig."""
    lumitexels, normal = _planted(_lights(count), gloss=2 * STRENGTH, noise=0.01)
    alone = _fitted(lumitexels, small_dictionary)
    lobes = _rig_lobes(gloss=2 * STRENGTH).sel(region="face").values
    helped = _fitted(_with_lobes(lumitexels, lobes), small_dictionary)
    for name, error in (
        ("diffuse_reflectance", lambda x: np.abs(x / R_D - 1)),
        ("shading_normal", lambda x: _angle(x, normal)),
    ):
        before, after = (np.median(error(fit[name].values)) for fit in (alone, helped))
        assert after < 0.5 * before
    assert np.median(np.abs(helped["diffuse_reflectance"] / R_D - 1)) < 0.02


def test_common_lobes__by_region_help_where_gloss_differs(small_dictionary):
    """Half of the face has a quarter of the gloss of the other; a region of few surfels
    has none of its own.
    """
    nose = np.arange(SURFELS) % 2 == 0
    gloss = np.where(nose, 2.0, 0.5)[:, None, None] * STRENGTH
    regions = {"nose": nose, "cheek": ~nose, "lips": np.arange(SURFELS) < 29}
    rig = _rig_lobes(gloss=gloss, regions=regions)
    assert sorted(rig.dropna("region")["region"].values) == ["cheek", "face", "nose"]
    lumitexels, _ = _planted(_lights(6), gloss=gloss, noise=0.01)
    by_region = rig.sel(region=np.where(nose, "nose", "cheek")).values
    errors = []
    for lobes in (rig.sel(region="face").values, by_region):
        fitted = _fitted(_with_lobes(lumitexels, lobes), small_dictionary)
        off = np.abs(fitted["diffuse_reflectance"].values / R_D - 1)
        errors.append([np.median(off[mask]) for mask in (nose, ~nose)])
    assert max(errors[0]) > 0.2
    assert max(errors[1]) < 0.03


def test_refine_jointly__each_surfel_has_its_own_lobes():
    """As in fits of every surfel by itself."""
    lumitexels, _ = _planted(_lights(6), gloss=STRENGTH, noise=0.01)
    lobes = np.random.default_rng(3).uniform(0, 2, (SURFELS, len(GRADED_ROUGHNESS)))
    fitted = _with_lobes(lumitexels, lobes)
    fitted = fitted.merge(estimate_normals(fitted, eta=ETA, scan_error=60.0))
    fitted = fitted.merge(estimate_diffuse_reflectance(fitted, eta=ETA))
    prior = Gloss(1.0, 0.5, of_rig=True)
    together, *alone = (
        refine_jointly(part, eta=ETA, scan_error=60.0, gloss=prior)
        for part in (fitted, *(fitted.isel(surfel=[s]) for s in range(SURFELS)))
    )
    for name in ("diffuse_reflectance", "diffuse_reflectance_total_error"):
        expected = np.concatenate([part[name].values for part in alone])
        np.testing.assert_allclose(together[name], expected, rtol=1e-6)
        assert len(np.unique(expected)) > SURFELS


@pytest.mark.parametrize("count", [4, 8])
@pytest.mark.parametrize(("gloss", "of_others"), [(1, 0), (0, 1), (1, 0.5), (0.5, 1)])
def test_estimate_gloss__lobes_of_another_population(
    count, gloss, of_others, small_dictionary
):
    """R_d is as good as alone, and its total error contains the truth."""
    lumitexels, _ = _planted(_lights(count), gloss=2 * gloss * STRENGTH, noise=0.01)
    rig = _rig_lobes(gloss=2 * of_others * STRENGTH).sel(region="face").values
    errors = []
    for capture in (lumitexels, _with_lobes(lumitexels, rig)):
        fitted = _fitted(capture, small_dictionary)
        off = np.abs(fitted["diffuse_reflectance"].values - R_D)
        errors.append(np.median(off / R_D))
    total = fitted["diffuse_reflectance_total_error"].values
    assert errors[1] < errors[0] + 0.02
    assert (off < 1.96 * total).mean() > 0.95


def test_take_gloss__needs_sixteen_samples():
    lumitexels, _ = _planted(_lights(15), gloss=STRENGTH)
    known = take_gloss(lumitexels, eta=ETA, regions=NO_REGIONS)
    for takes in ([], 3 * [known]):
        assert np.isnan(common_lobes(takes)["rig_lobe_strength"]).all()


def test_refine_jointly__three_samples_have_no_gloss_whatever_the_prior():
    lumitexels, _ = _planted(_lights(3), gloss=STRENGTH)
    fitted = lumitexels.merge(estimate_normals(lumitexels, eta=ETA, scan_error=60.0))
    fitted = fitted.merge(estimate_diffuse_reflectance(fitted, eta=ETA))
    unknown, glossy = (
        refine_jointly(fitted, eta=ETA, scan_error=60.0, gloss=prior)
        for prior in (UNKNOWN_GLOSS, Gloss(5.0, 2.5))
    )
    for name in ("shading_normal", "diffuse_reflectance"):
        np.testing.assert_array_equal(unknown[name], glossy[name])


def test_lobe_reflectance__is_that_of_the_lobes():
    lobes = np.stack([np.ones(len(GRADED_ROUGHNESS)), GRADED_ROUGHNESS], axis=1)
    reflectance = GGX(SURFACE_INDEX).normal_reflectance(lobes)[0]
    np.testing.assert_allclose(LOBE_REFLECTANCE, reflectance, rtol=5e-3)


@pytest.mark.parametrize("count", [3, 4, 6, 12])
def test_few_samples__total_errors_cover_the_truth(count, small_dictionary):
    gloss = 0.0 if count == 3 else STRENGTH / 2
    lumitexels, normal = _planted(_lights(count), gloss=gloss, noise=0.02)
    fitted = _fitted(lumitexels, small_dictionary)
    angle = _angle(fitted["shading_normal"].values, normal)
    assert (angle < ISOTROPIC_95 * fitted["normal_total_error"].values).mean() > 0.85
    wrong = np.abs(fitted["diffuse_reflectance"].values - R_D)
    total = fitted["diffuse_reflectance_total_error"].values
    assert (wrong < 1.96 * total).mean() > 0.85


def test_few_samples__errors_are_wider_for_fewer(small_dictionary):
    errors = ("normal_error", "normal_total_error", "diffuse_reflectance_total_error")
    medians = []
    for count in (4, 12):
        lumitexels, _ = _planted(_lights(count), gloss=STRENGTH / 2, noise=0.02)
        fitted = _fitted(lumitexels, small_dictionary)
        medians.append([float(np.median(fitted[name])) for name in errors])
    # the factor of the total error of normals is the root of the number
    assert (np.array(medians[0]) > np.array([1.5, 1.2, 1.5]) * medians[1]).all()


def test_few_samples__lights_in_a_plane_need_a_scan(small_dictionary):
    turn = np.radians([-60.0, -30.0, 0.0, 30.0, 60.0])
    light = np.stack([np.sin(turn), np.zeros(5), np.cos(turn)], axis=1)
    lumitexels, normal = _planted(light)
    alone = _fitted(lumitexels, small_dictionary)
    assert (alone["fit_status"] == FitStatus.UNDETERMINED).all()
    for name in ("shading_normal", "normal_error", "diffuse_reflectance"):
        assert np.isnan(alone[name]).all()
    lumitexels["surfel_normal"].values[:] = normal
    fitted = _fitted(lumitexels, small_dictionary, scan_error=3.0)
    assert (fitted["fit_status"] == FitStatus.FITTED).all()
    assert _angle(fitted["shading_normal"].values, normal).max() < 1.0


def test_few_samples__two_are_too_few(small_dictionary):
    lumitexels, normal = _planted(_lights(2))
    lumitexels["surfel_normal"].values[:] = normal
    fitted = _fitted(lumitexels, small_dictionary, scan_error=3.0)
    assert (fitted["fit_status"] == FitStatus.TOO_FEW_SAMPLES).all()
    assert np.isnan(fitted["diffuse_reflectance"]).all()


@pytest.mark.parametrize(
    ("count", "surface"), [(3, "mixture"), (3, "ggx"), (8, "mixture")]
)
def test_fit_model__of_a_few_photographs(count, surface, small_dictionary):
    """One camera: the model has R_d and normals, and gloss from four samples on."""
    skin = make_skin(lights=60)
    chosen = np.linspace(0, 24, count).astype(int)
    part = skin.lumitexels.isel(light=chosen, camera=[0])
    capture = capture_of(replace(skin, lumitexels=part), probe=False)
    size = {"k": 2, "rank": 6} if surface == "mixture" else {}
    parameters = FitParameters(surface=surface, **size)
    dictionary = small_dictionary if surface == "mixture" else None
    model = fit_model(capture, parameters, dictionary=dictionary)
    fitted = model["fitted"].to_dataset()
    complete = fitted["fit_samples"].values == count
    assert complete.mean() >= 0.4
    status = FitStatus.LAMBERT if count == 3 else FitStatus.FITTED
    assert (fitted["fit_status"].values[complete] == status).all()
    wrong = np.abs(fitted["diffuse_reflectance"].values / skin.diffuse - 1)[complete]
    assert np.median(wrong) < 0.2
    gloss = fitted["surface_reflectance"].values[complete]
    assert np.isnan(gloss).all() if count == 3 else (gloss >= 0).all()
    tables = summary_tables(model)
    assert np.isfinite(tables["region_diffuse_reflectance"].sel(region="face")).all()
    assert np.isnan(tables["region_surface_reflectance"].sel(region="face")) == (
        count == 3
    )
    shown = from_model(model).parameters[complete]
    assert (shown == 0).all() if count == 3 else np.isfinite(shown).all()
