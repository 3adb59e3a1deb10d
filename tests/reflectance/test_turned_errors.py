"""Errors of weights by the error of the normal, compared with refits of all samples."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls

from benchmarks.curves_surface import ETA, strip
from skindb.fit.surface import NOISE_FLOOR_SURFACE
from skindb.optics.angles import half_difference
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance._lumitexel_kernels import MIN_SAMPLES_GLOSS
from skindb.reflectance.dictionary import embedded_dictionary
from skindb.reflectance.mixture import Mixture
from skindb.reflectance.model import Comparison, Judgement
from skindb.reflectance.tables import lookup

TURN = 0.5  # degrees, RMS of two axes
SURFELS = 36


@pytest.fixture(scope="module")
def samples():
    return strip(SURFELS, embedded_dictionary())


def _mixture():
    """Four mixtures of the dictionary, from wide to narrow."""
    dictionary = embedded_dictionary()
    H = np.random.default_rng(3).uniform(0, 1, (4, len(dictionary.names))) ** 8
    return Mixture((dictionary.table @ H.T).astype(np.float32))


def _turned(n, angle, axis):
    away = np.eye(3)[np.argmin(np.abs(n))]
    first = np.cross(n, away) / np.linalg.norm(np.cross(n, away))
    along = first if axis == 0 else np.cross(n, first)
    return np.cos(angle) * n + np.sin(angle) * along


def _refits(model, samples, s, x):
    """Variance of the weights of surfel s over four turned normals, with all samples."""
    part = samples.parts(SURFELS)[s]
    wi, wo = (d[part] for d in samples.directions[:2])
    n = samples.block.normal[s] / np.linalg.norm(samples.block.normal[s])
    diffuse = samples.block.diffuse[s]

    def body(n):
        passed = fresnel_transmittance(wi @ n, ETA) * fresnel_transmittance(wo @ n, ETA)
        return (wi @ n * passed / np.pi)[:, None] * diffuse

    sample = samples.target[part] + body(n)
    variance = np.zeros(4)
    for sign in (-1, 1):
        for axis in range(2):
            turned = _turned(n, sign * np.sqrt(3 / 2) * np.radians(TURN), axis)
            angles = half_difference(wi, wo, np.broadcast_to(turned, wi.shape))
            M = lookup(model.table, *angles) * (wi @ turned)[:, None]
            moved, _ = nnls(M, (sample - body(turned)).mean(axis=1))
            variance += (moved - x) ** 2 / 6
    return variance


def test_fit__error_of_the_normal_as_refits_of_all_samples(samples):
    model = _mixture()
    comparison = Comparison("linear", ETA, NOISE_FLOOR_SURFACE, MIN_SAMPLES_GLOSS)
    errors = np.zeros((SURFELS, 3))
    given, exact = (
        model.fit(samples.block, comparison, Judgement(errors, normal_error))
        for normal_error in (np.full(SURFELS, TURN), None)
    )
    part = np.diagonal(given.covariance - exact.covariance, axis1=1, axis2=2)
    expected = np.array(
        [_refits(model, samples, s, given.parameters[s]) for s in range(SURFELS)]
    )
    positive = given.parameters > 0
    ratio = np.sqrt(part[positive] / expected[positive])
    # a fourth of the samples is computed anew, see `_turn_kernels`
    low, median, high = np.quantile(ratio, [0.05, 0.5, 0.95])
    assert abs(median - 1) < 0.01
    assert 0.9 < low < high < 1.1
    assert 0.8 < ratio.min() < ratio.max() < 1.25
    assert len(ratio) > 40


def test_fit__error_of_the_normal_in_cube_root_space_uses_all_samples(samples):
    # the order of the lights decides which samples would be computed anew
    order = np.random.default_rng(5).permutation(len(samples.block.light))
    shuffled = samples.block._replace(
        sample=np.ascontiguousarray(samples.block.sample[:, order]),
        light=np.ascontiguousarray(samples.block.light[order]),
    )
    comparison = Comparison("perceptual", ETA, NOISE_FLOOR_SURFACE, MIN_SAMPLES_GLOSS)
    judgement = Judgement(np.zeros((SURFELS, 3)), np.full(SURFELS, TURN))
    one, other = (
        np.diagonal(
            _mixture().fit(block, comparison, judgement).covariance, axis1=1, axis2=2
        )
        for block in (samples.block, shuffled)
    )
    # sums in single precision; with one of 8 of the dark samples a third differs by more
    np.testing.assert_allclose(np.sqrt(other), np.sqrt(one), rtol=0.02, atol=1e-6)
