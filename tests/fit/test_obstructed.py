"""Surfels that are hidden by hair: which ones are marked, and which are not."""

from __future__ import annotations

import numpy as np

from skindb.fit import find_obstructed
from skindb.fit.quality import error_of_misfit
from skindb.schema import FitStatus, dataset


def _face(residual, brightness, status=None):
    """Twenty surfels of a face, and others after them."""
    residual = np.asarray(residual, np.float32)
    brightness = np.asarray(brightness, np.float32)
    n = 20 + len(residual)
    fitted = np.full(n, FitStatus.FITTED, np.uint8)
    fitted[20:] = FitStatus.FITTED if status is None else status
    return dataset(
        {
            "fit_status": fitted,
            "dictionary_residual": np.concatenate(
                [np.full(20, 0.03, np.float32), residual]
            ),
            "diffuse_reflectance": np.concatenate(
                [np.full(20, 0.4, np.float32), brightness]
            )[:, None].repeat(3, axis=1),
        }
    )


def test_find_obstructed__dark_and_unlike_any_surface():
    fitted = _face(residual=[0.3, 0.3, 0.02, 0.08], brightness=[0.1, 0.35, 0.1, 0.1])
    # hair; a bright place that fits badly; a mole; a dark place that fits rather badly
    np.testing.assert_array_equal(np.flatnonzero(find_obstructed(fitted)), [20])


def test_find_obstructed__limit_grows_with_the_residual_of_the_take():
    fitted = _face(residual=[0.15], brightness=[0.1])
    assert find_obstructed(fitted)[20]
    fitted["dictionary_residual"][:20] = 0.09
    assert not find_obstructed(fitted).any()


def test_find_obstructed__only_fitted_surfels():
    assert not find_obstructed(
        _face([0.3], [0.1], status=FitStatus.DIFFUSE_CLAMPED)
    ).any()
    nothing = _face([], [])
    nothing["fit_status"][:] = FitStatus.UNSEEN
    assert not find_obstructed(nothing).any()


def test_error_of_misfit__grows_with_the_unexplained_residual():
    """The residual of usual surfels is 0.03, so that 0.045 is explained."""
    error = error_of_misfit(_face(residual=[0.04, 0.06, 0.3], brightness=[0.2] * 3))
    assert (error[:21] == 0).all()
    by_hand = 1.5 * np.sqrt(np.array([0.06, 0.3]) ** 2 - 0.045**2) * 0.2
    np.testing.assert_allclose(error[21:], by_hand[:, None].repeat(3, 1), rtol=1e-5)
    nothing = _face([], [])
    nothing["fit_status"][:] = FitStatus.UNSEEN
    assert (error_of_misfit(nothing) == 0).all()
