"""Blur, glare and vignette of a lens."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from skindb.calibration.lens import fit_edge, fit_vignette, veiling_glare
from skindb.errors import InputError


def edge_picture(blur, rng, *, shape=(80, 64), noise=0.002, slant=0.09):
    """An edge drawn at 8 times the resolution, blurred there, and averaged over the pixels."""
    fine = 8
    row, column = (np.mgrid[: shape[0] * fine, : shape[1] * fine] + 0.5) / fine
    sharp = np.where(column - shape[1] / 2 - slant * (row - shape[0] / 2) > 0, 1.0, 0.0)
    soft = (
        ndimage.gaussian_filter(sharp, blur * fine, mode="nearest") if blur else sharp
    )
    picture = soft.reshape(shape[0], fine, shape[1], fine).mean(axis=(1, 3))
    return picture + noise * rng.standard_normal(shape)


@pytest.mark.parametrize("blur", [0.6, 1.0, 2.0])
@pytest.mark.parametrize("side", [1, -1])
def test_fit_edge__finds_the_blur(blur, side):
    fit = fit_edge(edge_picture(blur, np.random.default_rng(5))[:, ::side])
    # the square pixel adds a variance of 1/12 px2; 1 % as it is no Gaussian
    assert abs(fit.blur / np.sqrt(blur**2 + 1 / 12) - 1) < 0.01 + 4 * fit.blur_error


def test_veiling_glare__is_that_of_an_even_veil():
    rng = np.random.default_rng(6)
    scene = 0.05 + 0.95 * edge_picture(0.6, rng, noise=0.0)
    glare = 0.02
    image = (
        (1 - glare) * scene
        + glare * scene.mean()
        + 0.001 * rng.standard_normal(scene.shape)
    )
    assert veiling_glare(
        fit_edge(image), mean=float(image.mean()), contrast=0.05
    ) == pytest.approx(glare, abs=0.001)


@pytest.mark.parametrize(
    ("picture", "match"),
    [
        (np.zeros((40, 40)), "a uniform picture"),
        (np.full((40, 40), np.nan), "must be finite"),
        (np.zeros((8, 8)), "16 px"),
        (
            np.where(np.arange(40) < 20, 0.0, 1.0) + np.zeros((40, 40)),
            "slanted by 0.0 degrees",
        ),
        (np.random.default_rng(7).standard_normal((40, 40)), "slanted edge"),
    ],
)
def test_fit_edge__refuses_what_is_no_slanted_edge(picture, match):
    with pytest.raises(InputError, match=match):
        fit_edge(picture)


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
