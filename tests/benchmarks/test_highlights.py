"""Errors beside the mirror direction, and fitted peaks, of a planted surface."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from benchmarks.highlights import fitted_peaks, near_mirror
from skindb.reflectance.mixture import Mixture
from skindb.reflectance.tables import stored_brdf
from skindb.schema import dataset

LEVEL = 0.3  # sr^-1, of an even BRDF
TABLE = np.full((9, 7, 4, 1), LEVEL, np.float32)
NORMAL = np.array([[0.0, 0, 1], [0, 0, 1]])


def _samples():
    """Two surfels whose BRDF is `LEVEL`; only the first reflects the light to the camera."""
    cosine = np.array([400 / np.hypot(300, 400), 400 / np.hypot(200, 400)])
    sample = np.tile(LEVEL * cosine[:, None, None, None], (1, 1, 1, 3))
    position = np.array([[0.0, 0, 0], [100, 0, 0]])
    return xr.Dataset(
        {
            "reflectance_sample": (("surfel", "light", "camera", "channel"), sample),
            "surfel_position": (("surfel", "xyz"), position),
            "light_position": (("light", "xyz"), np.array([[300.0, 0, 400]])),
            "camera_position": (("camera", "xyz"), np.array([[-300.0, 0, 400]])),
        }
    )


def _model(weight):
    fitted = {
        "shading_normal": NORMAL,
        "diffuse_reflectance": np.zeros((2, 3)),
        "basis_weight": np.full((2, 1), weight),
        "refractive_index": 1.3,
    }
    groups = {
        "fitted": dataset(fitted),
        "basis": dataset({"basis_brdf": stored_brdf(TABLE)}),
        "held_out": dataset({"light_held_out": np.ones(1)}),
    }
    return xr.DataTree.from_dict(groups)


@pytest.mark.parametrize("weight", [1.0, 1.5])
def test_near_mirror__of_one_surfel_that_reflects_the_light(weight):
    used = np.ones(2, bool)
    near = near_mirror(_samples(), _model(weight), NORMAL, used)
    assert near.samples == 1
    assert near.relative == pytest.approx(weight - 1, abs=1e-6)
    assert near_mirror(_samples(), _model(weight), NORMAL, ~used).samples == 0


def test_fitted_peaks__of_an_even_brdf():
    peaks = fitted_peaks(Mixture(TABLE), np.array([[1.0], [2.0]]), eta=1.3)
    assert np.allclose(peaks, [LEVEL, 2 * LEVEL])
