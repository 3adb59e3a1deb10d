"""Even reflection of the surface: what a prior of its total moves out of R_d."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from skindb.fit import FitParameters
from skindb.fit.energy import (
    Energy,
    crossed_gloss,
    energy_prior,
    without_even_reflection,
)
from skindb.optics.diffusion import dipole_s
from skindb.parameters import SURFACE_ENERGY
from skindb.schema import FitStatus, dataset

HIGHLIGHTS = 0.025
KNOWN = Energy(0.04, 1e-4)
EVEN = (0.04 - HIGHLIGHTS) / 2  # the lobes took the other half from R_d


def _planted(diffuse):
    """Fitted surfels whose R_d contains light that the surface reflects evenly, and two that
    were not fitted.
    """
    count = len(diffuse)
    status = np.full(count, FitStatus.FITTED)
    status[-2:] = FitStatus.TOO_FEW_SAMPLES
    shine = np.where(np.arange(count) % 2, 0.5, 1.5) * HIGHLIGHTS
    shine[-2:] = np.nan
    return dataset(
        {
            "diffuse_reflectance": diffuse + EVEN,
            "diffuse_reflectance_total_error": np.full((count, 3), 0.003),
            "surface_reflectance": shine,
            "surfel_area": np.ones(count),
            "fit_status": status,
            "refractive_index": 1.3,
        }
    )


@pytest.fixture
def diffuse():
    rng = np.random.default_rng(3)
    return rng.uniform(0.1, 0.6, (502, 3))


def test_without_even_reflection__recovers_planted_albedo(diffuse):
    fitted, summary = without_even_reflection(_planted(diffuse), KNOWN)
    np.testing.assert_allclose(fitted["even_reflection"], EVEN, atol=1e-5)
    np.testing.assert_allclose(fitted["diffuse_reflectance"], diffuse, atol=1e-5)
    np.testing.assert_allclose(
        fitted["dipole_s"], dipole_s(diffuse, eta=1.3)[0], atol=1e-4
    )
    assert summary["highlights"] == pytest.approx(HIGHLIGHTS)
    assert not summary["contradicted"]


def test_without_even_reflection__error_is_that_of_the_prior(diffuse):
    fitted, _ = without_even_reflection(_planted(diffuse), Energy(0.06, 0.004))
    assert fitted["even_reflection_error"] == pytest.approx(0.004, rel=1e-3)
    # that of the samples, of the prior, and 2 % of R_d
    np.testing.assert_allclose(
        fitted["diffuse_reflectance_total_error"],
        np.sqrt(0.005**2 + (0.02 * fitted["diffuse_reflectance"]) ** 2),
        rtol=1e-3,
    )


def test_without_even_reflection__the_darkest_surfels_bound_it(diffuse):
    """Moles that reflect 0.005 in blue have no even reflection of 0.0075."""
    diffuse[:20, 2] = 0.005 - EVEN
    fitted, _ = without_even_reflection(_planted(diffuse), KNOWN)
    assert fitted["even_reflection"] <= 0.005


def test_without_even_reflection__highlights_above_the_prior_contradict_it(diffuse):
    planted = _planted(diffuse)
    fitted, summary = without_even_reflection(planted, Energy(0.015, 0.004))
    assert summary["contradicted"]
    assert fitted["even_reflection"] == 0
    np.testing.assert_allclose(
        fitted["diffuse_reflectance"], planted["diffuse_reflectance"]
    )
    # more than a prior that holds
    assert fitted["even_reflection_error"] > 0.015


def test_energy_prior__by_condition_or_as_stated():
    stated = FitParameters(surface_energy=0.05, surface_energy_error=0.002)
    assert energy_prior("normal", FitParameters()) == SURFACE_ENERGY["normal"]
    assert energy_prior("lotion", FitParameters()) == SURFACE_ENERGY["lotion"]
    assert energy_prior("lotion", stated) == (0.05, 0.002)
    assert energy_prior("lotion", replace(stated, surface_energy="unknown")) is None


@pytest.mark.parametrize("mean", [0.015, 0.02, 0.04])
def test_without_even_reflection__fits_show_less_than_the_total(diffuse, mean):
    """Half the mean rest of totals that are drawn from the prior and exceed the highlights."""
    totals = np.random.default_rng(5).normal(mean, 0.012, 400_000)
    rest = (totals[totals > HIGHLIGHTS] - HIGHLIGHTS) / 2
    prior = Energy(mean, 0.012)
    fitted, summary = without_even_reflection(_planted(diffuse), prior)
    assert not summary["contradicted"]
    # five standard errors of the mean of the draws
    error = 5 * rest.std() / np.sqrt(rest.size)
    assert fitted["even_reflection"] == pytest.approx(rest.mean(), abs=error)


def test_without_even_reflection__crossed_polarisers_leave_little_of_it(diffuse):
    fitted, summary = without_even_reflection(_planted(diffuse), KNOWN, 0.1)
    assert fitted["even_reflection"] == 0
    np.testing.assert_allclose(fitted["diffuse_reflectance"], diffuse + EVEN, atol=1e-6)
    assert fitted["even_reflection_error"] == pytest.approx(0.002)
    assert "contradicted" not in summary


def test_crossed_gloss__is_the_mean_of_crossed_pairs():
    """Light that returns is stopped except for the leaks; other pairs do not count."""
    towards = np.array([[0, 0, 900.0], [0, 0, 900], [0, 900, 0]])
    samples = dataset(
        {
            "surfel_position": [[-1.0, 0, 0], [1, 0, 0]],
            "light_position": towards,
            "camera_position": towards[:2],
            "light_polarisation": [0.98, -1, 0.98],
            "camera_polarisation": [0.99, 0],
        }
    )
    assert crossed_gloss(samples, 1.3) == pytest.approx(1 - 0.98 * 0.99, rel=1e-4)
    mirrored = samples.assign(
        light_polarisation=-samples["light_polarisation"] * [1, 0, 1]
    )
    assert crossed_gloss(mirrored, 1.3) is None
    assert crossed_gloss(samples.drop_vars("camera_polarisation"), 1.3) is None
