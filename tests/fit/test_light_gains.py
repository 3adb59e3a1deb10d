"""Gains of lights: planted ones are found, correct lights stay, and unseen ones have the gain 1."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.fit import estimate_light_gains
from skindb.fit.corrections import divided_by_gains
from skindb.schema import dataset, label


def _with_gains(ds, gain):
    sample = ds["reflectance_sample"]
    values = (sample.values.astype(np.float32) * gain[:, None, None]).astype(
        sample.dtype
    )
    return ds.assign(reflectance_sample=label("reflectance_sample", values))


def _normals_of_scan(skin):
    """The samples, with the true normals as those of the scan."""
    return skin.lumitexels.assign(
        surfel_normal=label("surfel_normal", skin.normal.astype(np.float32))
    )


@pytest.mark.parametrize("spread", [0.0, 0.05, 0.15])
def test_estimate_light_gains__finds_what_was_planted(new_skin, spread):
    """Rationale: remaining gloss beyond 25 degrees. Expected: 1 to 2 %, as on
    independent captures.
    """
    gain = 1 + spread * np.clip(np.random.default_rng(3).normal(size=60), -2.5, 2.5)
    ds = _with_gains(
        _normals_of_scan(new_skin(surfels=400, lights=60, cameras=8, noise=0.01)), gain
    )
    found = estimate_light_gains(ds, rng=np.random.default_rng(0))["light_gain"].values
    left = np.log(found / gain)
    assert (left - np.median(left)).std() < 0.02
    assert abs(np.median(found) - 1) < 1e-9


def test_estimate_light_gains__tilted_normals_are_not_gains(new_skin):
    """A wrong normal changes the cosine to another linear function of the direction,
    which is not a gain.
    """
    skin = new_skin(surfels=200, lights=60, cameras=8, gloss=0.0, noise=0.0)
    tilted = skin.normal + np.array([0.03, 0.015, 0.0])
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    ds = skin.lumitexels.assign(
        surfel_normal=label("surfel_normal", tilted.astype(np.float32))
    )
    found = estimate_light_gains(ds, rng=np.random.default_rng(0))["light_gain"].values
    assert found.std() < 0.015


def test_estimate_light_gains__without_samples_is_1(new_skin):
    ds = _normals_of_scan(new_skin(surfels=50, lights=20, cameras=4))
    dark = ds["reflectance_sample"].values.copy()
    dark[:, 7] = np.nan
    one = ds.assign(reflectance_sample=label("reflectance_sample", dark))
    assert (
        estimate_light_gains(one, rng=np.random.default_rng(0))["light_gain"].values[7]
        == 1
    )
    dark[:] = np.nan
    none = ds.assign(reflectance_sample=label("reflectance_sample", dark))
    assert (
        estimate_light_gains(none, rng=np.random.default_rng(0))["light_gain"].values
        == 1
    ).all()


def test_divided_by_gains__undoes_them_lazily(new_skin):
    ds = new_skin(surfels=50, lights=20, cameras=4).lumitexels
    gain = dataset({"light_gain": np.linspace(0.8, 1.2, 20)})["light_gain"]
    back = divided_by_gains(_with_gains(ds, gain.values).chunk(surfel=20), gain)[
        "reflectance_sample"
    ]
    assert back.dtype == np.float16
    assert back.chunks is not None
    assert back.dims == ds["reflectance_sample"].dims
    # two roundings to half precision
    np.testing.assert_allclose(
        back.values.astype(float),
        ds["reflectance_sample"].values.astype(float),
        rtol=1.5e-3,
    )
