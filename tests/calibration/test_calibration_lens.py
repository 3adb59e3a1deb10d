"""Vignette of a lens."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.calibration.lens import fit_vignette
from skindb.errors import InputError

TRUE_VIGNETTE = np.array([-0.21, -0.06, -0.03])
CENTRE = np.array([158.0, 124.0])


def flat_frame(rng, noise=0.005):
    row, column = np.mgrid[:240, :320] + 0.5
    r2 = ((column - CENTRE[0]) ** 2 + (row - CENTRE[1]) ** 2) / (200.0**2)
    gain = 1 + r2 * (TRUE_VIGNETTE[0] + r2 * (TRUE_VIGNETTE[1] + r2 * TRUE_VIGNETTE[2]))
    return 5 * gain * (1 + noise * rng.standard_normal(gain.shape)), gain


@pytest.mark.slow
def test_fit_vignette__knows_its_error():
    z = []
    for seed in range(60):
        fit = fit_vignette(flat_frame(np.random.default_rng(seed))[0], CENTRE)
        off = fit.coefficients - TRUE_VIGNETTE
        z.append(off @ np.linalg.solve(fit.covariance, off) / 3)
    # the mean of 60 chi squared of 3 degrees has a deviation of 0.105
    assert 0.6 < np.mean(z) < 1.4


def test_fit_vignette__withstands_dust_a_gradient_and_lost_pixels():
    frame, gain = flat_frame(np.random.default_rng(1))
    row, column = np.mgrid[:240, :320] + 0.5
    r2 = ((column - CENTRE[0]) ** 2 + (row - CENTRE[1]) ** 2) / (200.0**2)
    frame[50:70, 60:80] *= 0.8
    frame[:, 200:210] = np.nan
    frame += 5 * 0.05 * (column - CENTRE[0]) / 200
    a2, a4, a6 = fit_vignette(frame, CENTRE).coefficients
    # half a per cent of the light
    np.testing.assert_allclose(1 + r2 * (a2 + r2 * (a4 + r2 * a6)), gain, atol=0.005)


@pytest.mark.parametrize(
    "frame",
    [
        np.zeros((50, 60)),
        np.full((50, 60), np.nan),
        np.pad(np.ones((9, 12)), 20),
    ],
)
def test_fit_vignette__refuses_what_tells_nothing(frame):
    with pytest.raises(InputError, match="flat frame"):
        fit_vignette(frame, [30.0, 25.0])
