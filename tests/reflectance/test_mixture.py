"""Extreme inputs of the fit of a mixture of tables, on surfels without noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import nnls
from three_surfels import (
    ETA,
    MATTE,
    SCALES,
    WEIGHT,
    rows_and_targets,
    six_materials,
    six_tables,
    surfels,
)

from skindb.fit.surface import MIN_SAMPLES, NOISE_FLOOR_SURFACE
from skindb.reflectance.mixture import Mixture
from skindb.reflectance.model import Comparison
from skindb.reflectance.reduction import reduce_dictionary
from skindb.schema import FitStatus
from skindb.schema.declaration import LARGEST_R_D, SMALLEST_R_D

HALF = 1e-3  # samples are rounded to 5e-4
# positions in a table to 1e-6, times the slope of its lobes
SINGLE = 1e-4

each_mode = pytest.mark.parametrize("mode", ["linear", "perceptual"])


def _fit(skin, mode="linear", model=None, **options):
    comparison = Comparison(mode, ETA, NOISE_FLOOR_SURFACE, MIN_SAMPLES)
    model = model or six_materials()
    return model.fit(skin.block, comparison._replace(**options))


@each_mode
@pytest.mark.parametrize(
    ("dtype", "tolerance"),
    [("float16", HALF), pytest.param("float32", SINGLE, marks=pytest.mark.slow)],
)
def test_fit__2400_samples_give_the_planted_reflectance(mode, dtype, tolerance):
    skin = surfels(150, 16, dtype=dtype)
    fit = _fit(skin, mode)
    assert (fit.status == FitStatus.FITTED).all()
    assert (fit.samples == 2400).all()
    assert fit.residual.max() < tolerance
    for s in range(3):
        M, _ = rows_and_targets(skin, s)
        expected = M @ WEIGHT
        np.testing.assert_allclose(
            M @ fit.parameters[s], expected, atol=tolerance * expected.max()
        )


def test_fit__few_samples_are_refused_or_fitted_no_worse_than_scipy():
    for lights in (1, 3):
        skin = surfels(lights, 1)
        # channels disagree
        skin = replace(skin, sample=skin.sample * np.float16([0.9, 1, 1.1]))
        refused = _fit(skin)
        assert (refused.status == FitStatus.TOO_FEW_SAMPLES).all()
        assert np.isnan(refused.parameters).all()
        fit = _fit(skin, min_samples=1)
        for s in range(3):
            M, target = rows_and_targets(skin, s)
            reference = nnls(np.repeat(M, 3, 0), target.ravel())[1]
            residual = np.linalg.norm((M @ fit.parameters[s])[:, None] - target)
            assert residual <= reference + SINGLE * np.linalg.norm(target)


def _nan_in(name):
    skin = surfels()
    values = getattr(skin, name).copy()
    values[0] = np.nan
    return replace(skin, **{name: values})


@pytest.mark.parametrize(
    ("skin", "status"),
    [
        (lambda: surfels().filled(np.nan), FitStatus.UNSEEN),
        (lambda: surfels().spoiled(np.inf), FitStatus.NOT_FINITE),
        (lambda: surfels().spoiled(-np.inf), FitStatus.NOT_FINITE),
        (lambda: _nan_in("position"), FitStatus.NOT_FINITE),
        (lambda: _nan_in("normal"), FitStatus.TOO_FEW_SAMPLES),
        (lambda: _nan_in("diffuse"), FitStatus.NO_DIFFUSE_ESTIMATE),
    ],
    ids=["all saturated", "inf", "-inf", "position", "normal", "diffuse"],
)
@each_mode
def test_fit__a_broken_surfel_has_a_status_and_leaves_the_others_alone(
    skin, status, mode
):
    fit = _fit(skin(), mode)
    assert fit.status.tolist() == [status, FitStatus.FITTED, FitStatus.FITTED]
    assert np.isnan(fit.parameters[0]).all()
    assert np.isnan(fit.residual[0])
    np.testing.assert_array_equal(
        fit.parameters[1:], _fit(surfels(), mode).parameters[1:]
    )


def test_fit__a_sample_without_one_channel_is_excluded():
    fit = _fit(surfels().spoiled(np.nan))
    assert fit.samples.tolist() == [239, 240, 240]
    assert fit.residual.max() < HALF


@each_mode
def test_fit__black_samples_have_no_weight(mode):
    fit = _fit(surfels().filled(0.0), mode)
    assert fit.status[0] == FitStatus.FITTED
    assert (fit.parameters[0] == 0).all()


@pytest.mark.parametrize("eta", [1.0, 1.3, 1.5])
def test_fit__matte_skin_has_no_weight(eta):
    fit = _fit(surfels(eta=eta, weight=MATTE), eta=eta)
    assert fit.residual.max() < HALF
    assert np.abs(fit.parameters).max() < HALF


def test_fit__clamped_diffuse_reflectance_is_flagged():
    for value in (SMALLEST_R_D, LARGEST_R_D):
        diffuse = surfels().diffuse.astype(np.float32)  # as it is stored
        diffuse[0] = value
        fit = _fit(replace(surfels(), diffuse=diffuse))
        assert fit.status.tolist() == [FitStatus.DIFFUSE_CLAMPED, 0, 0]
        assert np.isfinite(fit.parameters).all()
        assert (fit.parameters >= 0).all()


def test_fit__lights_behind_and_near_the_horizon_do_not_count():
    upright = replace(
        surfels(), normal=np.tile([0.0, 0, 1], (3, 1)), position=np.zeros((3, 3))
    )
    expected = _fit(upright).parameters
    low = [[np.cos(a), np.sin(a), 0.05] for a in (0.1, 2.0, 4.0)]
    behind = [[0.0, 0, -1], [0.1, 0, -1]]
    for lights in (low, behind):
        fit = _fit(upright.with_lights(900 * np.array(lights), 50.0))
        np.testing.assert_allclose(fit.parameters, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_fit__half_floats_have_the_same_reflectance_in_any_precision(dtype):
    skin = surfels()
    expected = _fit(skin).parameters
    fit = _fit(replace(skin, sample=skin.sample.astype(dtype)))
    # only the mixed reflectance is determined, not the weights of similar materials
    for s in range(3):
        M, _ = rows_and_targets(skin, s)
        np.testing.assert_allclose(
            M @ fit.parameters[s],
            M @ expected[s],
            atol=1e-5 * np.abs(M @ WEIGHT).max(),
        )


@pytest.mark.parametrize("kind", ["zero", "duplicate", "collinear"])
def test_fit__redundant_tables(kind):
    six = six_tables()
    extra = {
        "zero": 0 * six[..., :1],
        "duplicate": six[..., :1],
        "collinear": six[..., :1] + six[..., 1:2],
    }[kind]
    fit = _fit(surfels(), model=Mixture(np.concatenate([extra, six, extra], axis=-1)))
    assert (fit.status == FitStatus.FITTED).all()
    assert fit.kkt.max() < 1e-9
    assert fit.residual.max() < HALF
    if kind == "zero":
        assert (fit.parameters[:, [0, 7]] == 0).all()


def test_fit__a_rank_above_that_of_the_tables():
    skin = surfels()
    fit = _fit(skin, model=Mixture(*reduce_dictionary(six_tables(), 99)))
    np.testing.assert_allclose(fit.parameters, _fit(skin).parameters, rtol=1e-12)
    # six tables that are multiples of one, in a space of four dimensions
    multiples = six_tables()[..., :1] * np.geomspace(0.5, 4, 6, dtype=np.float32)
    model = Mixture(*reduce_dictionary(np.ascontiguousarray(multiples), 4))
    fit = _fit(surfels(weight=np.array([0.4, 0, 0, 0, 0, 0])), model=model)
    assert (fit.status == FitStatus.FITTED).all()
    assert fit.residual.max() < HALF


def test_fit__no_surfels():
    assert _fit(surfels().empty).parameters.shape == (0, 6)


def _basis(*weights):
    columns = [six_tables() @ weight.astype(np.float32) for weight in weights]
    return Mixture(np.stack(columns, axis=-1))


@each_mode
def test_fit__of_the_true_component_and_of_duplicates_and_black_ones(mode):
    fit = _fit(surfels(), mode, _basis(WEIGHT))
    np.testing.assert_allclose(fit.parameters, 1.0, rtol=HALF)
    assert fit.residual.max() < HALF
    fit = _fit(surfels(), mode, _basis(WEIGHT, WEIGHT, 0 * WEIGHT))
    np.testing.assert_allclose(fit.parameters[:, :2].sum(axis=1), 1.0, rtol=HALF)
    assert (fit.parameters[:, 2] == 0).all()
    assert (fit.status == FitStatus.FITTED).all()


def test_fit__weights_are_divided_by_the_scale_of_the_component():
    for scale in SCALES:
        fit = _fit(surfels(), model=_basis(WEIGHT * scale))
        np.testing.assert_allclose(fit.parameters * scale, 1.0, rtol=HALF)
