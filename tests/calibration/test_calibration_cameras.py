from __future__ import annotations

import numpy as np
import pytest

from skindb.calibration.cameras import chart_reference, fit_colour_matrix
from skindb.errors import InputError

MIX = np.array([[0.7, 0.2, 0.1], [0.15, 0.75, 0.1], [0.05, 0.2, 0.75]])


def test_chart_reference__has_six_neutral_patches_and_published_colours():
    reference = chart_reference()
    neutral = reference[18:]
    # the chart's own greys are not quite neutral
    np.testing.assert_allclose(neutral / neutral[:, 1:2], 1, atol=0.06)
    assert (np.diff(neutral[:, 1]) < 0).all()
    encoded = 255 * (1.055 * np.clip(reference[14], 0, 1) ** (1 / 2.4) - 0.055)
    # "red" as published by its maker in sRGB
    np.testing.assert_allclose(encoded, [175, 54, 60], atol=6)


def test_fit_colour_matrix__inverts_a_camera():
    rng = np.random.default_rng(4)
    camera = chart_reference() @ MIX.T * 3.0
    fit = fit_colour_matrix(camera * (1 + 0.002 * rng.standard_normal(camera.shape)))
    expected = np.linalg.inv(MIX)
    expected = expected * (camera[18, 1] / (expected @ camera[18])[1])
    # noise of 0.2 % times the condition of the colours
    np.testing.assert_allclose(fit.matrix, expected, atol=0.03)
    assert fit.delta_e.max() < 1.0
    assert abs((fit.matrix @ camera[18])[1] / camera[18, 1] - 1) < 0.005


def test_fit_colour_matrix__leaves_out_saturated_patches():
    camera = chart_reference() @ MIX.T
    camera[[3, 7]] = np.nan
    fit = fit_colour_matrix(camera)
    assert np.isnan(fit.delta_e[[3, 7]]).all()
    assert np.nanmax(fit.delta_e) < 1e-4  # exact except for rounding of CIEDE2000


@pytest.mark.parametrize(
    ("patches", "match"),
    [
        (np.ones((24, 3)), "different colours"),
        (np.full((24, 3), np.nan), "0 usable"),
        (np.zeros((24, 3)), "different colours"),
    ],
)
def test_fit_colour_matrix__refuses_what_tells_nothing(patches, match):
    with pytest.raises(InputError, match=match):
        fit_colour_matrix(patches)
