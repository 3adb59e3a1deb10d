"""Samples behind circular polarisers: the surface term is scaled, the diffuse one is not."""

from __future__ import annotations

import numpy as np
import pytest
from three_surfels import (
    ETA,
    MATTE,
    WEIGHT,
    polariser_factors,
    six_materials,
    surfels,
)

from skindb.fit import fit_model
from skindb.fit.albedo import block_reflectance
from skindb.ingest import IngestParameters, ingest_capture, read_capture
from skindb.reflectance.model import Comparison, Judgement
from skindb.schema import FitStatus
from skindb.virtual.capture import recovered_against_true, simulate_take
from skindb.virtual.dome import build_dome
from skindb.virtual.person import Person

LIGHT = np.full(40, -0.99)
CAMERA = np.array([-1, 1, -0.98, 0, -1, 1])  # crossed, parallel and without polariser
EVEN = 0.04  # of the light, without colour


def polarised(weight, even=0.0, light=LIGHT):
    """Three surfels, their samples behind polarisers, and what the polarisers pass."""
    skin = surfels(weight=weight, dtype=np.float32)
    matte = surfels(weight=MATTE, dtype=np.float32).sample
    cosine = np.einsum(
        "nk,ntk->nt", skin.normal, skin.light - skin.position[:, None]
    ) / np.linalg.norm(skin.light - skin.position[:, None], axis=-1)
    gloss = skin.sample - matte + even / np.pi * cosine[:, :, None, None]
    factor = polariser_factors(
        skin.position, skin.light, skin.camera, np.outer(light, CAMERA)
    )
    return skin, (matte + factor[..., None] * gloss).astype(np.float16), factor


@pytest.mark.parametrize("mode", ["linear", "perceptual"])
def test_fit__mixtures_behind_polarisers(mode):
    skin, sample, _ = polarised(WEIGHT)
    block = skin.block._replace(sample=sample, polarisation=np.outer(LIGHT, CAMERA))
    comparison = Comparison(mode, ETA, 2e-3, 10)
    surface = six_materials()
    fit = surface.fit(block, comparison)
    assert (fit.status == FitStatus.FITTED).all()
    assert fit.residual.max() < 1e-3
    ignored = block._replace(polarisation=np.zeros((0, 0)))
    assert surface.fit(ignored, comparison).residual.min() > 0.05
    held = np.zeros((40, 6), np.int64)
    held[::5] = 1
    errors = Judgement(np.zeros((3, 3)), np.full(3, 0.5), held)
    judged = surface.fit(block, comparison, errors)
    assert judged.held_error[:, 0].max() < 2e-3


def test_block_reflectance__crossed_samples_show_even_reflection():
    """Rationale: without polarisers, even reflection is counted as R_d."""
    arrays = {"light_polarisation": LIGHT, "camera_polarisation": CAMERA}
    for light, low, high in ((LIGHT, 0, 0.15), (0 * LIGHT, 0.9, 2)):
        skin, sample, factor = polarised(WEIGHT, EVEN, light)
        arrays |= {
            "reflectance_sample": sample,
            "surfel_position": skin.position,
            "light_position": skin.light,
            "camera_position": skin.camera,
            "shading_normal": skin.normal,
            "light_polarisation": light,
        }
        value, _, total, _ = block_reflectance(arrays, eta=ETA)
        excess = (value - skin.diffuse) / EVEN
        assert excess.min() > low - 0.05
        assert excess.max() < high
        crossed = factor[factor < 0.3]
        # without crossed samples, R_d includes an unknown even reflection
        expected = 0.004 * crossed.mean() if len(crossed) else np.hypot(0.004, 0.02)
        np.testing.assert_allclose(total, expected, rtol=0.3)  # and noise


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ancestry", "largest_error", "largest_width"),
    [("european", 0.03, 0.1), ("african", 0.06, 0.15)],
)
def test_fit_model__albedo_in_blue_of_a_polarised_capture(
    tmp_path, ancestry, largest_error, largest_width
):
    """Light and dark skin, whose R_d in blue is 0.21 and 0.07."""
    rng = np.random.default_rng(1)
    dome = build_dome(32, 6, width=96, height=120, polarised=True, rng=rng)
    person = Person("T001", 30, "female", ancestry, 5)
    folder = tmp_path / "T001"
    simulate_take(folder, person, dome, rng=np.random.default_rng(3), spacing_mm=3.0)
    settings = IngestParameters(spacing_mm=3.0)
    scratch = tmp_path / "scratch"
    with ingest_capture(read_capture(folder), settings, scratch=scratch) as capture:
        model = fit_model(capture)
    with np.load(tmp_path / "T001.truth.npz") as truth:
        recovery = recovered_against_true(model, dict(truth))
    usable = recovery.fitted & np.isfinite(recovery.diffuse_error[:, 2])
    relative = recovery.diffuse_error[usable, 2]
    true = recovery.true_diffuse[usable, 2]
    fitted = model["fitted"].to_dataset()
    error = fitted["diffuse_reflectance_total_error"].values[usable, 2]
    assert np.median(np.abs(relative)) < largest_error
    assert np.median(1.96 * error / true) < largest_width
    assert np.mean(np.abs(relative) * true < 1.96 * error) > 0.95
