"""A planted capture of GGX lobes: fitted, evaluated, rendered as tables and exported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from planted_skin import capture_of, make_skin

from skindb.errors import InputError
from skindb.fit import fit_model
from skindb.optics.fresnel import fresnel_transmittance
from skindb.parameters import FitParameters
from skindb.reflectance.kinds import as_mixture, require_mixture
from skindb.reflectance.lobes import evaluate_lobe
from skindb.render import evaluate
from skindb.schema import FitStatus, label

ETA = 1.3
PARAMETERS = FitParameters(
    surface="ggx", hold_out_lights=0.1, hold_out_cameras=0.2, eta=ETA, seed=3
)


def to_local(normal, direction):
    """Directions in a frame whose z is the normal."""
    first = np.cross(normal, [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    return direction @ np.stack([first, np.cross(normal, first), normal], axis=1)


@pytest.fixture(scope="module")
def planted():
    """A capture, with strengths and roughnesses of its surfels."""
    skin = make_skin(surfels=24, lights=90, cameras=8, scan_error=0.5)
    rng = np.random.default_rng(1)
    strength = rng.uniform(0.8, 2.0, 24)
    roughness = rng.uniform(0.2, 0.45, 24)
    ds = skin.lumitexels
    place = ds["surfel_position"].values.astype(float)
    sample = np.empty((24, 90, 8, 3))
    for s, n in enumerate(skin.normal):
        wi = ds["light_position"].values - place[s]
        wo = ds["camera_position"].values - place[s]
        wi = to_local(n, wi / np.linalg.norm(wi, axis=1, keepdims=True))[:, None]
        wo = to_local(n, wo / np.linalg.norm(wo, axis=1, keepdims=True))[None]
        wi, wo = np.broadcast_arrays(wi, wo)
        lobe = strength[s] * evaluate_lobe(wi, wo, roughness[s], ETA)
        through = fresnel_transmittance(np.abs(wi[..., 2]), ETA)
        through = through * fresnel_transmittance(np.abs(wo[..., 2]), ETA) / np.pi
        f_r = through[..., None] * skin.diffuse[s] + lobe[..., None]
        above = (wi[..., 2] > 0) & (wo[..., 2] > 0)
        value = np.where(above[..., None], wi[..., 2:] * f_r, np.nan)
        sample[s] = value * (1 + 0.01 * rng.normal(size=value.shape))
    ds = ds.assign(reflectance_sample=label("reflectance_sample", sample))
    return capture_of(replace(skin, lumitexels=ds)), strength, roughness


@pytest.fixture(scope="module")
def model(planted):
    return fit_model(planted[0], PARAMETERS)


def test_fit_model__recovers_planted_lobes_and_predicts_held_out_samples(
    planted, model
):
    """Rationale: the truth is in the model; what remains is the error of R_d and of the
    normal that the stages before leave.
    """
    _, strength, roughness = planted
    fitted = model["fitted"].to_dataset()
    good = fitted["fit_status"].values == FitStatus.FITTED
    assert good.mean() > 0.9
    error = np.abs(fitted["lobe_roughness"].values / roughness - 1)[good]
    assert np.median(error) < 0.05
    error = np.abs(fitted["lobe_strength"].values / strength - 1)[good]
    assert np.median(error) < 0.15
    assert np.nanmedian(fitted["held_out_error"]) < 0.05
    assert np.nanmedian(fitted["held_out_camera_error"]) < 0.05
    assert (fitted["surface_reflectance_error"].values[good] > 0).all()
    assert model.attrs["surface"] == "GGX lobe, refractive index 1.3"
    assert "dictionary_weight" not in fitted


@pytest.mark.slow
def test_evaluate__is_the_planted_brdf_and_that_of_the_tables(planted, model):
    fitted = model["fitted"].to_dataset()
    n = fitted["shading_normal"].values[5].astype(float)
    wi = n + np.array([0.3, 0.1, 0.0])
    wo = n + np.array([-0.2, 0.15, 0.1])
    wi, wo = (w / np.linalg.norm(w) for w in (wi, wo))
    found = evaluate(model, 5, wi, wo)
    lobe = float(fitted["lobe_strength"][5]) * evaluate_lobe(
        to_local(n, wi), to_local(n, wo), float(fitted["lobe_roughness"][5]), ETA
    )
    passed = fresnel_transmittance(wi @ n, ETA) * fresnel_transmittance(wo @ n, ETA)
    even = fitted["diffuse_reflectance"].values[5] + float(fitted["even_reflection"])
    body = passed / np.pi * even
    np.testing.assert_allclose(found, body + lobe, rtol=1e-4)
    np.testing.assert_allclose(evaluate(as_mixture(model), 5, wi, wo), found, rtol=0.02)


def test_require_mixture__names_the_cure(model):
    with pytest.raises(InputError, match="--surface mixture"):
        require_mixture(model["fitted"].to_dataset(), "model of A")
